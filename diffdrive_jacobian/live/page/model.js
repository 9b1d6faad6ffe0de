// What the page knows: the latest state of all robots, their paths and their histories.

const KEPT = 20;

/** Quantities over time, of a robot or of a bag, by the names of `robot.now`. */
class History {
  constructor() {
    this.time = [];
    this.curves = {};
    this.whole = false;
  }

  /** Return the history of a bag, over its whole duration. */
  static recorded(strips) {
    const history = new History();
    history.whole = true;
    ({ time: history.time, ...history.curves } = strips);
    return history;
  }

  add(robot) {
    const last = this.time.at(-1);
    if (last !== undefined && robot.time === last) return;
    if (last !== undefined && robot.time < last) this.clear();
    this.time.push(robot.time);
    for (const [name, value] of Object.entries(robot.now)) (this.curves[name] ??= []).push(value);
    let late = 0;
    while (this.time[late] < robot.time - KEPT - 2) late += 1;
    // In blocks, because removing from the front costs as much as there is.
    if (late > 200) {
      this.time.splice(0, late);
      for (const curve of Object.values(this.curves)) curve.splice(0, late);
    }
  }

  clear() {
    this.time.length = 0;
    for (const curve of Object.values(this.curves)) curve.length = 0;
  }

  /** Return the interval of time to show. */
  window(now) {
    if (this.whole) return [this.time[0] ?? 0, this.time.at(-1) ?? 1];
    const from = Math.max(this.time[0] ?? now, now - KEPT);
    return [from, from + KEPT];
  }
}

export class Model {
  constructor() {
    this.robots = new Map();
    this.paths = new Map();
    this.truePaths = new Map();
    this.histories = new Map();
    this.settings = {};
    this.strips = null;
    this.world = { kind: 'robots' };
    this.bag = '';
    this.notes = [];
    this.selectedName = null;
    /** What the server lets this page do: a guest may only look, unless control was given. */
    this.may = { steer: true, shared: '', guests_steer: false };
  }

  /** The robot that the panels show and commands go to; undefined: there is none. */
  get selected() {
    return this.robots.get(this.selectedName) ?? this.robots.values().next().value;
  }

  get recorded() {
    return this.world.kind === 'bag';
  }

  /** Whether nothing can be steered from here. */
  get looking() {
    return this.recorded || !this.may.steer;
  }

  take(frame) {
    this.may = frame.may ?? this.may;
    this.world = frame.world.kind ? frame.world : this.world;
    this.robots = new Map(frame.robots.map((robot) => [robot.name, robot]));
    for (const robot of frame.robots) {
      if (!this.histories.has(robot.name)) this.histories.set(robot.name, new History());
      if (!this.recorded) this.histories.get(robot.name).add(robot);
    }
    for (const [paths, news] of [[this.paths, frame.paths], [this.truePaths, frame.true_paths]]) {
      for (const [name, path] of Object.entries(news)) {
        if (path.new || !paths.has(name)) paths.set(name, []);
        const points = paths.get(name);
        for (const point of path.points) points.push(point);
      }
    }
    if (frame.fixed) {
      this.settings = frame.fixed.settings ?? {};
      this.bag = frame.fixed.bag ?? '';
      this.notes = frame.fixed.notes ?? [];
      for (const [name, strips] of Object.entries(frame.fixed.strips ?? {})) {
        this.histories.set(name, History.recorded(strips));
      }
    }
  }

  /** Forget what a new connection sends again. */
  reconnected() {
    this.paths.clear();
    this.truePaths.clear();
  }
}
