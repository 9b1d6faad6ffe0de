// The view of the map: which part of the world is where on the screen.

const MIN_SCALE = 0.5, MAX_SCALE = 4000;
const ABOVE = 70, BELOW = 110;

export class View {
  constructor() {
    this.x = 0;
    this.y = 0;
    this.scale = 280;
    this.follow = true;
    this.width = 1;
    this.height = 1;
  }

  /** Return the place on the screen (px) of a place in the world (m). */
  toScreen(x, y) {
    return [this.width / 2 + (x - this.x) * this.scale, this.height / 2 - (y - this.y) * this.scale];
  }

  /** Return the place in the world (m) of a place on the screen (px). */
  toWorld(px, py) {
    return [this.x + (px - this.width / 2) / this.scale, this.y - (py - this.height / 2) / this.scale];
  }

  /** Zoom so that a place on the screen stays where it is. */
  zoom(factor, px = this.width / 2, py = this.height / 2) {
    const [x, y] = this.toWorld(px, py);
    this.scale = Math.min(MAX_SCALE, Math.max(MIN_SCALE, this.scale * factor));
    if (this.follow) return;
    const [nx, ny] = this.toWorld(px, py);
    this.x += x - nx;
    this.y += y - ny;
  }

  pan(dx, dy) {
    this.follow = false;
    this.x -= dx / this.scale;
    this.y += dy / this.scale;
  }

  /** Show all of these points. */
  fit(points) {
    if (!points.length) return;
    let [left, bottom] = points[0], [right, top] = points[0];
    for (const [x, y] of points) {
      left = Math.min(left, x); right = Math.max(right, x);
      bottom = Math.min(bottom, y); top = Math.max(top, y);
    }
    this.follow = false;
    this.x = (left + right) / 2;
    this.y = (bottom + top) / 2;
    // The bars above and below take their share.
    const width = Math.max(right - left, 0.5) * 1.3, height = Math.max(top - bottom, 0.5) * 1.15;
    const scale = Math.min(this.width / width, (this.height - ABOVE - BELOW) / height);
    this.scale = Math.min(MAX_SCALE, Math.max(MIN_SCALE, scale));
    this.y += (ABOVE - BELOW) / 2 / this.scale;
  }

  /** Keep a robot in the middle, gently. */
  track(pose, seconds) {
    if (!this.follow || !pose) return;
    const share = 1 - Math.exp(-6 * seconds);
    const [dx, dy] = [pose[0] - this.x, pose[1] - this.y];
    const far = Math.hypot(dx, dy) * this.scale > Math.max(this.width, this.height);
    this.x += far ? dx : dx * share;
    this.y += far ? dy : dy * share;
  }
}
