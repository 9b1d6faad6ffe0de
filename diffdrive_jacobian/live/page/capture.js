// A still and a film of the map, which the browser saves as files.

import { byId, setText } from './dom.js';

const FILMS = ['video/webm', 'video/mp4'];
const RATE = 30;

export class Capture {
  constructor(map, model, notices) {
    // The map has no ground of its own.
    Object.assign(this, { map, model, notices, recorder: null });
    byId('picture').addEventListener('click', () => this.picture());
    byId('film').addEventListener('click', () => { if (this.recorder) this.recorder.stop(); else this.film(); });
  }

  /** Take what the map shows, if a film is made; to be called when it was drawn. */
  drawn() {
    if (this.recorder) this.take(this.frame);
  }

  canvas(width, height) {
    return Object.assign(document.createElement('canvas'), { width, height });
  }

  take(copy) {
    const { map } = this, context = copy.getContext('2d');
    context.fillStyle = getComputedStyle(map.parentElement).backgroundColor;
    context.fillRect(0, 0, copy.width, copy.height);
    // A film keeps its size and the map its shape when the page is laid out anew.
    const scale = Math.min(copy.width / map.width, copy.height / map.height);
    const [width, height] = [scale * map.width, scale * map.height];
    context.drawImage(map, (copy.width - width) / 2, (copy.height - height) / 2, width, height);
  }

  picture() {
    const still = this.canvas(this.map.width, this.map.height);
    this.take(still);
    still.toBlob((blob) => this.save(blob, 'png'), 'image/png');
  }

  film() {
    const mimeType = FILMS.find((type) => window.MediaRecorder?.isTypeSupported(type));
    if (!mimeType) {
      this.notices.show('error', 'this browser cannot make films: plot_run --film makes one of a bag');
      return;
    }
    // Films have even sizes.
    this.frame = this.canvas(this.map.width & ~1, this.map.height & ~1);
    this.take(this.frame);
    const parts = [];
    const recorder = new MediaRecorder(this.frame.captureStream(RATE), { mimeType, videoBitsPerSecond: 4e6 });
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
