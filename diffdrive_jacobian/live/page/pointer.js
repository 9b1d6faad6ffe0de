// Mouse, touch and wheel on the map: goals, placing the robot, moving the map.

import { bodyRadius, handle } from './robot_shape.js';

const DRAG = 9;

export class MapPointer {
  /** @param {(command: object) => void} send */
  constructor(canvas, view, drawing, model, send, onChange) {
    Object.assign(this, { canvas, view, drawing, model, send, onChange });
    this.tool = 'goal';
    this.pointers = new Map();
    this.action = null;
    canvas.addEventListener('pointerdown', (event) => this.down(event));
    canvas.addEventListener('pointermove', (event) => this.move(event));
    canvas.addEventListener('pointerup', (event) => this.up(event));
    canvas.addEventListener('pointercancel', (event) => this.cancel(event));
    canvas.addEventListener('contextmenu', (event) => event.preventDefault());
    canvas.addEventListener('wheel', (event) => {
      event.preventDefault();
      view.zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), ...this.at(event));
    }, { passive: false });
  }

  at(event) {
    const box = this.canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }

  down(event) {
    this.canvas.setPointerCapture(event.pointerId);
    const place = this.at(event);
    this.pointers.set(event.pointerId, place);
    if (this.pointers.size === 2) {
      this.drawing.preview = null;
      this.action = { kind: 'pinch' };
      return;
    }
    const moves = event.button !== 0 || this.tool === 'move' || this.model.looking;
    this.action = { kind: 'pan', start: place, last: place };
    if (!moves) this.action = this.steering(place, event.shiftKey);
    this.canvas.classList.toggle('moving', this.action.kind === 'pan');
  }

  /** Return the action that begins at a place on the screen. */
  steering(place, shift) {
    const robot = this.model.selected, start = this.view.toWorld(...place);
    if (robot) {
      const reach = Math.max(14, bodyRadius(robot) * this.view.scale);
      const near = (point, most) => {
        const [px, py] = this.view.toScreen(point[0], point[1]);
        return Math.hypot(px - place[0], py - place[1]) <= most;
      };
      if (near(handle(robot), 11)) return { kind: 'turn', pose: [...robot.pose], place };
      if (near(robot.pose, reach)) {
        return { kind: 'place', pose: [...robot.pose], grip: [robot.pose[0] - start[0], robot.pose[1] - start[1]], place };
      }
    }
    return { kind: 'goal', append: shift || this.tool === 'waypoint', pose: [...start, 0], heading: false, place };
  }

  move(event) {
    const place = this.at(event), before = this.pointers.get(event.pointerId);
    if (!before) return;
    if (this.action?.kind === 'pinch') {
      this.pinch(event.pointerId, place);
      return;
    }
    this.pointers.set(event.pointerId, place);
    const action = this.action;
    if (!action) return;
    if (action.kind === 'pan') {
      this.view.pan(place[0] - action.last[0], place[1] - action.last[1]);
      action.last = place;
      this.onChange();
      return;
    }
    const far = Math.hypot(place[0] - action.place[0], place[1] - action.place[1]) > DRAG;
    const [x, y] = this.view.toWorld(...place);
    if (action.kind === 'goal') {
      action.heading = far;
      if (far) action.pose[2] = Math.atan2(y - action.pose[1], x - action.pose[0]);
      this.drawing.preview = { kind: 'goal', pose: action.pose, heading: far };
    } else if (far || action.moved) {
      action.moved = true;
      if (action.kind === 'turn') action.pose[2] = Math.atan2(y - action.pose[1], x - action.pose[0]);
      else [action.pose[0], action.pose[1]] = [x + action.grip[0], y + action.grip[1]];
      this.drawing.preview = { kind: 'place', pose: action.pose };
    }
  }

  pinch(id, place) {
    const [other] = [...this.pointers.entries()].filter(([key]) => key !== id).map(([, value]) => value);
    const before = this.pointers.get(id);
    const distance = (a, b) => Math.max(10, Math.hypot(a[0] - b[0], a[1] - b[1]));
    this.view.pan((place[0] - before[0]) / 2, (place[1] - before[1]) / 2);
    this.view.zoom(distance(place, other) / distance(before, other), (place[0] + other[0]) / 2, (place[1] + other[1]) / 2);
    this.pointers.set(id, place);
    this.onChange();
  }

  up(event) {
    if (!this.pointers.delete(event.pointerId)) return;
    const action = this.action, robot = this.model.selected;
    if (this.pointers.size) return;
    this.action = null;
    this.drawing.preview = null;
    this.canvas.classList.remove('moving');
    if (!action || !robot) return;
    const [x, y, theta] = action.pose ?? [];
    if (action.kind === 'goal') {
      this.send({ do: 'goal', robot: robot.name, x, y, theta: action.heading ? theta : null, append: action.append });
    } else if (action.moved && (action.kind === 'place' || action.kind === 'turn')) {
      this.send({ do: 'place', robot: robot.name, x, y, theta });
    }
  }

  cancel(event) {
    this.pointers.delete(event.pointerId);
    this.action = null;
    this.drawing.preview = null;
    this.canvas.classList.remove('moving');
  }
}
