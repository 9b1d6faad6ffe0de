// What the page knows: the latest state of all robots, their paths and their histories.

const CURVES = ['v', 'omega', 'command_v', 'command_omega', 'right', 'left', 'distance', 'bearing_error', 'goal_heading_error',
  'across', 'path_heading_error'];
const KEPT = 20;

class History {
  constructor() {
    this.time = [];
    this.curves = Object.fromEntries(CURVES.map((name) => [name, []]));
    this.whole = false;
  }

  /** Return the history of a bag, over its whole duration. */
  static recorded(strips) {
    const history = new History();
    history.whole = true;
    history.time = strips.time;
    for (const name of CURVES) history.curves[name] = strips[name] ?? strips.time.map(() => null);
    return history;
  }

  add(robot) {
    const last = this.time.at(-1);
    if (last !== undefined && robot.time === last) return;
    if (last !== undefined && robot.time < last) this.clear();
    const { chain } = robot;
    const values = {
      v: robot.twist[0],
      omega: robot.twist[1],
      command_v: robot.commanded ? chain.command[0] : null,
      command_omega: robot.commanded ? chain.command[1] : null,
      right: chain.wheels[0],
      left: chain.wheels[1],
      distance: robot.distance,
      bearing_error: robot.bearing_error,
      goal_heading_error: robot.goal_heading_error,
      across: robot.across,
      path_heading_error: robot.path_heading_error,
    };
    this.time.push(robot.time);
    for (const name of CURVES) this.curves[name].push(values[name]);
    let late = 0;
    while (this.time[late] < robot.time - KEPT - 2) late += 1;
    // In blocks, because removing from the front costs as much as there is.
    if (late > 200) {
      this.time.splice(0, late);
      for (const name of CURVES) this.curves[name].splice(0, late);
    }
  }

  clear() {
    this.time.length = 0;
    for (const name of CURVES) this.curves[name].length = 0;
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
  }

  /** The robot that the panels show and commands go to; undefined: there is none. */
  get selected() {
    return this.robots.get(this.selectedName) ?? this.robots.values().next().value;
  }

  get recorded() {
    return this.world.kind === 'bag';
  }

  take(frame) {
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
