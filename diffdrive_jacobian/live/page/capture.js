// A still and a film of the map, which the browser saves as files.

import { byId, setText } from './dom.js';

const FILMS = ['video/webm', 'video/mp4'];
const RATE = 30;

export class Capture {
  constructor(map, model, notices) {
    // The map has no ground of its own.
    Object.assign(this, { map, model, notices, copy: document.createElement('canvas'), recorder: null });
    byId('picture').addEventListener('click', () => this.picture());
    byId('film').addEventListener('click', () => { if (this.recorder) this.recorder.stop(); else this.film(); });
  }

  /** Take what the map shows, if a film is made; to be called when it was drawn. */
  drawn() {
    if (this.recorder) this.take();
  }

  take() {
    const { map, copy } = this, context = copy.getContext('2d');
    context.fillStyle = getComputedStyle(map.parentElement).backgroundColor;
    context.fillRect(0, 0, copy.width, copy.height);
    context.drawImage(map, 0, 0, copy.width, copy.height);
  }

  resize() {
    // Films have even sizes.
    this.copy.width = this.map.width - (this.map.width % 2);
    this.copy.height = this.map.height - (this.map.height % 2);
  }

  picture() {
    // The size of a film must not change.
    if (!this.recorder) this.resize();
    this.take();
    this.copy.toBlob((blob) => this.save(blob, 'png'), 'image/png');
  }

  film() {
    const mimeType = FILMS.find((type) => window.MediaRecorder?.isTypeSupported(type));
    if (!mimeType) {
      this.notices.show('error', 'this browser cannot make films: plot_run --film makes one of a bag');
      return;
    }
    this.resize();
    this.take();
    const parts = [];
    const recorder = new MediaRecorder(this.copy.captureStream(RATE), { mimeType, videoBitsPerSecond: 4e6 });
    recorder.addEventListener('dataavailable', (event) => parts.push(event.data));
    recorder.addEventListener('stop', () => {
      this.recorder = null;
      this.show();
      this.save(new Blob(parts, { type: mimeType }), mimeType.split('/')[1]);
    });
    recorder.start();
    this.recorder = recorder;
    this.show();
  }

  show() {
    const on = this.recorder !== null;
    setText(byId('film'), on ? '■' : '●');
    byId('film').setAttribute('aria-pressed', String(on));
    byId('film').title = on ? 'End the film, and save it' : 'Make a film of the map';
  }

  save(blob, ending) {
    const link = document.createElement('a');
    link.href = URL.createObjectURL(blob);
    link.download = `${this.model.bag || 'robot'}_${(this.model.selected?.time ?? 0).toFixed(1)}s.${ending}`;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  }
}
