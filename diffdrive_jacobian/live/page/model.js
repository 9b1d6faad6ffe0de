// What the page knows: the latest state of all robots, their paths and their histories.

import { History } from './history.js';

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
