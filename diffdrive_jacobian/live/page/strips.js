// Small diagrams of the quantities over time.

import { element, format, niceStep, prepared, setText } from './dom.js';

const STRIPS = [
  { name: 'v', unit: 'm/s', curves: [['command_v', 'muted', 'set', true], ['v', 'v', 'v']] },
  { name: 'ω', unit: 'rad/s', curves: [['command_omega', 'muted', 'set', true], ['omega', 'omega', 'ω']] },
  { name: 'wheels', unit: 'rad/s', digits: 1, curves: [['left', 'left', 'L'], ['right', 'right', 'R']] },
  { name: 'distance', unit: 'm', curves: [['distance', 'v', 'd']], ofPath: false },
  { name: 'bearing error', unit: 'rad', curves: [['goal_heading_error', 'muted', 'Δθ', true], ['bearing_error', 'omega', 'e']], ofPath: false },
  { name: 'off the path', unit: 'm', digits: 3, curves: [['along', 'muted', 'ahead', true], ['across', 'v', 'left']], ofPath: true },
  { name: 'heading to path', unit: 'rad', curves: [['path_heading_error', 'omega', 'Δθ']], ofPath: true },
];

/** Room for the labels (px). */
const GUTTER = 30;

export class Strips {
  constructor(section, model, onSeek) {
    this.model = model;
    this.strips = STRIPS.map((strip) => {
      const canvas = element('canvas', { role: 'img', 'aria-label': `${strip.name} over time` });
      const values = strip.curves.map(([, color]) => element('span', { class: color === 'muted' ? 'unit' : color }));
      // Without a path, as at the start: the map must not change its size after it is shown.
      const node = element('div', { class: 'strip', hidden: strip.ofPath === true },
        element('p', {}, element('span', { class: 'name' }, strip.name, ' ', element('span', { class: 'unit' }, strip.unit)), ...values), canvas);
      section.append(node);
      canvas.addEventListener('pointerdown', (event) => this.seek(event, canvas, onSeek));
      canvas.addEventListener('pointermove', (event) => { if (event.buttons) this.seek(event, canvas, onSeek); });
      return { ...strip, node, canvas, values };
    });
  }

  seek(event, canvas, onSeek) {
    if (!this.model.recorded || !this.model.selected || !this.model.may.steer) return;
    const [from, to] = this.model.histories.get(this.model.selected.name).window(0);
    const box = canvas.getBoundingClientRect();
    onSeek(from + ((event.clientX - box.left - GUTTER) / (box.width - GUTTER)) * (to - from));
  }

  draw(colors) {
    const robot = this.model.selected, history = robot && this.model.histories.get(robot.name);
    if (!history) return;
    const now = this.model.recorded ? this.model.world.time : robot.time;
    const onPath = Boolean(robot.goal.path);
    for (const strip of this.strips) {
      strip.node.hidden = 'ofPath' in strip && strip.ofPath !== onPath;
      if (!strip.node.hidden) this.drawStrip(strip, history, now, colors);
    }
  }

  drawStrip(strip, history, now, colors) {
    const { context, width, height } = prepared(strip.canvas);
    const [from, to] = history.window(now), toX = (time) => GUTTER + ((time - from) / Math.max(to - from, 1e-9)) * (width - GUTTER);
    let low = 0, high = 0;
    for (const [name] of strip.curves) {
      const curve = history.curves[name] ?? [];
      for (let k = 0; k < curve.length; k += 1) {
        if (curve[k] === null || history.time[k] < from) continue;
        low = Math.min(low, curve[k]);
        high = Math.max(high, curve[k]);
      }
    }
    const step = niceStep(Math.max(high - low, 0.02) / 2);
    low = Math.floor(low / step + 1e-9) * step;
    high = Math.max(Math.ceil(high / step - 1e-9) * step, low + step);
    const margin = 7, toY = (value) => height - margin - ((value - low) / (high - low)) * (height - 2 * margin);
    const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
    context.font = '10px system-ui, sans-serif';
    for (let value = low; value <= high + step / 2; value += step) {
      const zero = Math.abs(value) < step / 2;
      context.strokeStyle = zero ? colors['grid-strong'] : colors.grid;
      context.lineWidth = 1;
      context.beginPath();
      context.moveTo(GUTTER, toY(value)); context.lineTo(width, toY(value));
      context.stroke();
      context.fillStyle = colors.muted;
      context.textAlign = 'right';
      context.fillText(format(value, digits), GUTTER - 4, toY(value) + 3.5);
    }
    strip.curves.forEach(([name, color, label, dashed], number) => {
      const last = this.drawCurve(context, history, name, colors[color], dashed, { from, now, toX, toY });
      // A path without times has no curve along it.
      setText(strip.values[number], last === null && dashed ? '' : `${label} ${format(last, strip.digits ?? 2)}`);
    });
    if (history.whole) {
      context.strokeStyle = colors.text;
      context.lineWidth = 1;
      context.beginPath();
      context.moveTo(toX(now), 0); context.lineTo(toX(now), height);
      context.stroke();
    }
  }

  /** Draw a curve; return its value now. */
  drawCurve(context, history, name, color, dashed, { from, now, toX, toY }) {
    const curve = history.curves[name] ?? [];
    let pen = false, last = null;
    context.strokeStyle = color;
    context.lineWidth = dashed ? 1.2 : 1.8;
    context.setLineDash(dashed ? [4, 3] : []);
    context.beginPath();
    for (let k = 0; k < curve.length; k += 1) {
      const time = history.time[k];
      if (time <= now) last = curve[k];
      if (time < from) continue;
      if (curve[k] === null) { pen = false; continue; }
      if (pen) context.lineTo(toX(time), toY(curve[k])); else context.moveTo(toX(time), toY(curve[k]));
      pen = true;
    }
    context.stroke();
    context.setLineDash([]);
    return last;
  }
}
