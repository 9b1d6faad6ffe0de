// Driving by hand with keys or buttons. Whatever ends the attention of the driver stops the robot.

import { byId, format } from './dom.js';

const KEYS = {
  ArrowUp: 'up', ArrowDown: 'down', ArrowLeft: 'left', ArrowRight: 'right',
  KeyW: 'up', KeyS: 'down', KeyA: 'left', KeyD: 'right',
};
const PERIOD = 100;

export class HandDriving {
  constructor(model, send) {
    this.model = model;
    this.send = send;
    this.held = new Map();
    this.robot = null;
    this.timer = null;
    addEventListener('keydown', (event) => this.keyDown(event));
    addEventListener('keyup', (event) => this.release(event.code));
    addEventListener('blur', () => this.stop());
    addEventListener('pagehide', () => this.stop());
    document.addEventListener('visibilitychange', () => { if (document.hidden) this.stop(); });
    this.preparePad();
    this.prepareSpeeds();
  }

  preparePad() {
    for (const button of byId('pad').children) {
      const id = `pad ${button.dataset.way}`;
      const press = (event) => { event.preventDefault(); this.press(id, button.dataset.way); };
      button.addEventListener('pointerdown', (event) => { button.setPointerCapture(event.pointerId); press(event); });
      for (const end of ['pointerup', 'pointercancel', 'lostpointercapture']) button.addEventListener(end, () => this.release(id));
      button.addEventListener('contextmenu', (event) => event.preventDefault());
      button.addEventListener('keydown', (event) => { if (event.code === 'Space' || event.code === 'Enter') press(event); });
      button.addEventListener('keyup', (event) => { if (event.code === 'Space' || event.code === 'Enter') this.release(id); });
      button.addEventListener('blur', () => this.release(id));
    }
  }

  prepareSpeeds() {
    for (const [id, unit] of [['hand-v', 'm/s'], ['hand-omega', 'rad/s']]) {
      const input = byId(id), show = () => { byId(`${id}-value`).textContent = `${format(Number(input.value), 2)} ${unit}`; };
      input.addEventListener('input', show);
      // Afterwards the arrow keys shall drive again.
      input.addEventListener('pointerup', () => input.blur());
      show();
    }
  }

  keyDown(event) {
    const way = KEYS[event.code];
    if (!way || event.ctrlKey || event.metaKey || event.altKey || event.target.matches?.('input, select, textarea')) return;
    event.preventDefault();
    if (!event.repeat) this.press(event.code, way);
  }

  press(id, way) {
    const robot = this.model.selected;
    if (!robot || this.model.looking || this.held.has(id)) return;
    this.robot ??= robot.name;
    this.held.set(id, way);
    this.timer ??= setInterval(() => this.repeat(), PERIOD);
    this.repeat();
    this.show();
  }

  release(id) {
    if (!this.held.delete(id)) return;
    if (this.held.size) { this.repeat(); this.show(); } else this.stop();
  }

  /** Let go of everything. */
  stop() {
    this.held.clear();
    clearInterval(this.timer);
    this.timer = null;
    if (this.robot !== null) this.send({ do: 'release', robot: this.robot });
    this.robot = null;
    this.show();
  }

  repeat() {
    const ways = new Set(this.held.values()), sign = (more, less) => Number(ways.has(more)) - Number(ways.has(less));
    const v = sign('up', 'down') * Number(byId('hand-v').value), omega = sign('left', 'right') * Number(byId('hand-omega').value);
    if (!this.send({ do: 'drive', robot: this.robot, v, omega })) this.stop();
  }

  show() {
    const ways = new Set(this.held.values());
    for (const button of byId('pad').children) button.classList.toggle('held', ways.has(button.dataset.way));
  }
}
