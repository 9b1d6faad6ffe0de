// Pause, step, speed, and the time of a bag.

import { byId, element, format, leaveAfterPointer, setText } from './dom.js';

const SEEK_PERIOD = 30;
const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 5, 10, 50];

export class Transport {
  constructor(model, send) {
    this.model = model;
    this.send = send;
    this.seeking = -Infinity;
    this.wanted = null;
    for (const speed of SPEEDS) byId('speed').append(element('option', { value: speed }, `${speed}×`));
    byId('play').addEventListener('click', () => this.toggle());
    byId('step').addEventListener('click', () => send({ do: 'step' }));
    byId('speed').addEventListener('change', () => send({ do: 'speed', speed: Number(byId('speed').value) }));
    leaveAfterPointer(byId('speed'));
    byId('time').addEventListener('input', () => this.seek(Number(byId('time').value)));
    byId('time').addEventListener('pointerup', () => byId('time').blur());
    addEventListener('keydown', (event) => {
      if (event.code !== 'Space' || event.repeat || event.target.matches?.('input, select, button, summary')) return;
      if (model.world.kind === 'robots' || !model.may.steer) return;
      event.preventDefault();
      this.toggle();
    });
  }

  toggle() {
    this.send({ do: 'pause', paused: !this.model.world.paused });
  }

  /** Go to a time; of many in a row the last one counts. */
  seek(time) {
    this.seeking = performance.now();
    this.wanted ??= setTimeout(() => {
      this.send({ do: 'seek', time: Math.max(0, this.time) });
      this.wanted = null;
    }, SEEK_PERIOD);
    this.time = time;
  }

  show() {
    const { kind, paused, speed, time, duration } = this.model.world;
    const bar = byId('transport');
    bar.hidden = kind === 'robots';
    if (bar.hidden) return;
    for (const control of bar.querySelectorAll('button, input, select')) control.disabled = !this.model.may.steer;
    bar.classList.toggle('bag', kind === 'bag');
    setText(byId('play'), paused ? '▶' : '❚❚');
    byId('play').setAttribute('aria-label', paused ? 'Continue' : 'Pause');
    byId('time').hidden = kind !== 'bag';
    if (kind === 'bag') {
      byId('time').max = duration;
      if (performance.now() - this.seeking > 300) byId('time').value = time;
    }
    setText(byId('clock'), kind === 'bag' ? `${format(time, 1)} / ${format(duration, 1)} s` : `${format(time, 2)} s`);
    const select = byId('speed');
    if (![...select.options].some((option) => Number(option.value) === speed)) select.append(element('option', { value: speed }, `${speed}×`));
    if (document.activeElement !== select) select.value = String(speed);
  }
}
