/** From the pool to the canvas: x to the right, y down, as seen from above. */

export class View {
  scale = 100; // CSS pixels per metre
  x = 0; // pool point in the canvas's centre
  y = 0;
  width = 1; // of the canvas, CSS pixels
  height = 1;
  touched = false; // a person has moved it: no more fitting by itself

  /** Show a rectangle of this size around the origin. */
  fit(length: number, width: number): void {
    const room = 56; // for the rulers and what sticks out
    this.scale = Math.max(1, Math.min((this.width - room) / length, (this.height - room) / width));
    this.x = 0;
    this.y = 0;
  }

  /** Across, for a pool x: loops over many points take one number at a time, without a pair for the collector. */
  px(x: number): number {
    return this.width / 2 + (x - this.x) * this.scale;
  }

  /** Down, for a pool y. */
  py(y: number): number {
    return this.height / 2 + (y - this.y) * this.scale;
  }

  toScreen(x: number, y: number): [number, number] {
    return [this.px(x), this.py(y)];
  }

  toPool(px: number, py: number): [number, number] {
    return [this.x + (px - this.width / 2) / this.scale, this.y + (py - this.height / 2) / this.scale];
  }

  /** Zoom by a factor around a point of the canvas, which stays where it is. */
  zoom(factor: number, px: number, py: number): void {
    const [x, y] = this.toPool(px, py);
    this.scale = Math.min(4000, Math.max(4, this.scale * factor));
    const [nx, ny] = this.toPool(px, py);
    this.x += x - nx;
    this.y += y - ny;
    this.touched = true;
  }

  pan(dx: number, dy: number): void {
    this.x -= dx / this.scale;
    this.y -= dy / this.scale;
    this.touched = true;
  }
}
