// The map: grid, paths, goals and robots on a canvas.

import { niceStep, prepared } from './dom.js';
import { drawHandle, drawRegion, drawRobot, drawTruth } from './robot_shape.js';

const TAU = 2 * Math.PI;
const NAMES = ['map', 'grid', 'grid-strong', 'muted', 'text', 'path', 'goal', 'region', 'truth', 'body', 'body-edge',
  'wheel', 'right', 'left', 'surface', 'accent', 'v', 'omega', 'line'];

/** Return the colours of the theme by name. */
export function themeColors() {
  const style = getComputedStyle(document.documentElement);
  return Object.fromEntries(NAMES.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
}

export class MapDrawing {
  constructor(canvas, view, model) {
    this.canvas = canvas;
    this.view = view;
    this.model = model;
    this.angles = new Map();
    this.preview = null;
    this.fontSize = 11;
    this.colors = themeColors();
  }

  draw(seconds) {
    const { context, width, height } = prepared(this.canvas);
    const { view, model, colors } = this;
    Object.assign(view, { width, height });
    const selected = model.selected;
    view.track(selected?.pose, seconds);
    // Where the robot is on the canvas, for tests of the page.
    if (selected) this.canvas.dataset.robot = view.toScreen(selected.pose[0], selected.pose[1]).map(Math.round).join(' ');
    this.drawGrid(context, width, height);
    for (const robot of model.robots.values()) {
      this.drawPath(context, model.paths.get(robot.name), robot.travelled, robot.pose, colors.path, []);
      this.drawPath(context, model.truePaths.get(robot.name), robot.truly_travelled, robot.truth, colors.truth, [2, 5]);
    }
    for (const robot of model.robots.values()) this.drawGoals(context, robot, robot === selected);
    for (const robot of model.robots.values()) drawRegion(context, view, robot, colors);
    const last = [...model.robots.values()].sort((a, b) => Number(a === selected) - Number(b === selected));
    for (const robot of last) drawTruth(context, view, robot, colors);
    for (const robot of last) this.drawRobot(context, robot, robot === selected, seconds);
    if (this.preview) this.drawPreview(context, selected);
    this.drawScale(context, width, height);
  }

  drawGrid(context, width, height) {
    const { view, colors } = this, step = niceStep(70 / view.scale);
    const [left, top] = view.toWorld(0, 0), [right, bottom] = view.toWorld(width, height);
    const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
    context.lineWidth = 1;
    context.font = `${this.fontSize}px system-ui, sans-serif`;
    for (const [from, to, vertical] of [[left, right, true], [bottom, top, false]]) {
      for (let k = Math.ceil(from / step); k * step <= to; k += 1) {
        const [px, py] = view.toScreen(k * step, k * step);
        context.strokeStyle = k === 0 ? colors['grid-strong'] : colors.grid;
        context.beginPath();
        if (vertical) { context.moveTo(Math.round(px) + 0.5, 0); context.lineTo(Math.round(px) + 0.5, height); }
        else { context.moveTo(0, Math.round(py) + 0.5); context.lineTo(width, Math.round(py) + 0.5); }
        context.stroke();
        context.fillStyle = colors.muted;
        const label = `${(k * step).toFixed(digits).replace('-', '−')}`;
        if (vertical) context.fillText(label, px + 3, height - 7);
        else if (py < height - 20 && py > 160) context.fillText(label, 5, py - 3);
      }
    }
  }

  /** Draw a path up to a pose: of a bag, what is still to come is pale. */
  drawPath(context, points = [], travelled, pose, color, dashes) {
    const { view } = this, past = travelled ?? points.length;
    context.setLineDash(dashes);
    for (const [from, to, alpha] of [[0, past, 0.9], [Math.max(0, past - 1), points.length, 0.28]]) {
      context.beginPath();
      let pen = false;
      for (let index = from; index < to; index += 1) {
        const point = points[index];
        if (point === null) { pen = false; continue; }
        const [px, py] = view.toScreen(point[0], point[1]);
        if (pen) context.lineTo(px, py); else context.moveTo(px, py);
        pen = true;
      }
      if (pen && pose && to === points.length && travelled === undefined) context.lineTo(...view.toScreen(pose[0], pose[1]));
      context.globalAlpha = alpha;
      context.strokeStyle = color;
      context.lineWidth = 2.5;
      context.lineJoin = context.lineCap = 'round';
      context.stroke();
    }
    context.globalAlpha = 1;
    context.setLineDash([]);
  }

  drawGoals(context, robot, selected) {
    const { goals, index, active, state } = robot.goal, { view, colors } = this;
    if (!goals || (!active && state !== 'succeeded')) return;
    context.save();
    context.globalAlpha = selected ? 1 : 0.5;
    if (robot.goal.path) this.drawPlanned(context, robot.goal, context.globalAlpha);
    else if (active) {
      context.strokeStyle = colors.goal;
      context.setLineDash([5, 6]);
      context.lineWidth = 1.5;
      context.beginPath();
      context.moveTo(...view.toScreen(robot.pose[0], robot.pose[1]));
      for (const goal of goals.slice(index)) context.lineTo(...view.toScreen(goal[0], goal[1]));
      context.stroke();
      context.setLineDash([]);
    }
    goals.forEach((goal, number) => {
      const last = number === goals.length - 1;
      const done = active ? number < index : true;
      this.drawGoal(context, goal, {
        tolerance: robot.tolerance, heading: last && robot.use_heading, done,
        label: goals.length > 1 ? String(number + 1) : '',
      });
    });
    context.restore();
  }

  /** Draw the path that a robot is to drive along, wide and pale, below the one that it has driven; and where its times are. */
  drawPlanned(context, { path: points, reference }, alpha) {
    context.globalAlpha = 0.4 * alpha;
    context.strokeStyle = this.colors.goal;
    context.lineWidth = 7;
    context.lineJoin = context.lineCap = 'round';
    context.beginPath();
    for (const [x, y] of points) context.lineTo(...this.view.toScreen(x, y));
    context.stroke();
    context.globalAlpha = alpha;
    if (!reference) return;
    context.lineWidth = 2;
    context.beginPath();
    context.arc(...this.view.toScreen(reference[0], reference[1]), 7, 0, TAU);
    context.stroke();
  }

  drawGoal(context, goal, { tolerance, heading, done, label }) {
    const { view, colors } = this, [px, py] = view.toScreen(goal[0], goal[1]);
    const before = context.globalAlpha;
    context.globalAlpha = before * (done ? 0.5 : 1);
    context.fillStyle = context.strokeStyle = colors.goal;
    context.lineWidth = 2;
    const alpha = context.globalAlpha;
    context.globalAlpha = alpha * 0.2;
    context.beginPath();
    context.arc(px, py, Math.max(tolerance * view.scale, 1), 0, TAU);
    context.fill();
    context.globalAlpha = alpha;
    context.stroke();
    context.beginPath();
    for (const [dx, dy] of [[1, 0], [0, 1], [-1, 0], [0, -1]]) {
      context.moveTo(px + 4 * dx, py + 4 * dy);
      context.lineTo(px + 11 * dx, py + 11 * dy);
    }
    context.stroke();
    if (heading) this.drawArrow(context, px, py, goal[2], 42);
    if (label) {
      context.font = `600 ${this.fontSize + 1}px system-ui, sans-serif`;
      context.fillText(label, px + 12, py - 10);
    }
    context.globalAlpha = before;
  }

  drawArrow(context, px, py, theta, length) {
    context.save();
    context.translate(px, py);
    context.rotate(-theta);
    context.lineWidth = 3;
    context.beginPath();
    context.moveTo(0, 0);
    context.lineTo(length - 6, 0);
    context.stroke();
    context.beginPath();
    context.moveTo(length, 0);
    context.lineTo(length - 12, 6);
    context.lineTo(length - 12, -6);
    context.fill();
    context.restore();
  }

  drawRobot(context, robot, selected, seconds) {
    const { view, colors } = this, [right, left] = robot.chain.wheels;
    const angles = this.angles.get(robot.name) ?? [0, 0], moves = this.model.world.paused ? 0 : Math.min(seconds, 0.1);
    angles[0] += right * moves;
    angles[1] += left * moves;
    this.angles.set(robot.name, angles);
    drawRobot(context, view, robot, robot.pose, angles, colors, { selected, ghost: false });
    if (selected && !this.model.looking) drawHandle(context, view, robot, colors);
    if (this.model.robots.size > 1) {
      const [px, py] = view.toScreen(robot.pose[0], robot.pose[1]);
      context.fillStyle = selected ? colors.text : colors.muted;
      context.font = `${selected ? 600 : 400} ${this.fontSize + 1}px system-ui, sans-serif`;
      context.fillText(robot.name, px + 10, py + robot.geometry[1] * 0.6 * view.scale + 16);
    }
  }

  drawPreview(context, robot) {
    const { kind, pose, heading } = this.preview, { view, colors } = this;
    if (kind === 'place') {
      if (robot) drawRobot(context, view, robot, pose, [0, 0], colors, { selected: true, ghost: true });
      return;
    }
    this.drawGoal(context, pose, { tolerance: robot?.tolerance ?? 0.02, heading, done: false, label: '' });
  }

  drawScale(context, width, height) {
    const { view, colors } = this, step = niceStep(50 / view.scale), length = step * view.scale;
    context.strokeStyle = context.fillStyle = colors.muted;
    context.lineWidth = 2;
    context.beginPath();
    const right = width - 14.5, bottom = height - 24;
    context.moveTo(right - length, bottom - 4); context.lineTo(right - length, bottom);
    context.lineTo(right, bottom); context.lineTo(right, bottom - 4);
    context.stroke();
    context.font = `${this.fontSize}px system-ui, sans-serif`;
    context.textAlign = 'center';
    context.fillText(step < 1 ? `${Math.round(step * 100)} cm` : `${step} m`, right - length / 2, bottom - 6);
    context.textAlign = 'left';
  }
}
