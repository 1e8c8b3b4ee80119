/** What several parts of the map draw: paths, and short texts. */

import { css } from "../colours";
import type { PathSamples, Scene } from "../wire";
import { floats } from "../wire";
import type { View } from "./view";

const CHORD_PX = 2; // a path is drawn with points about this far apart

export type Pen = CanvasRenderingContext2D;

const paths = new WeakMap<PathSamples, Float32Array>();

/** A path's samples, unpacked once. */
export function samples(path: PathSamples): Float32Array {
  let found = paths.get(path);
  if (found === undefined) paths.set(path, (found = floats(path.eta)));
  return found;
}

export function placeOf(s: Scene, robot: number): number {
  return s.robots.findIndex((r) => r.id === robot);
}

export function drawPath(pen: Pen, view: View, path: PathSamples, colour: string, alpha: number, dash: number[] = []): void {
  const eta = samples(path);
  pen.save();
  pen.globalAlpha = alpha;
  pen.strokeStyle = colour;
  pen.lineWidth = 1.5;
  pen.setLineDash(dash);
  pen.beginPath();
  let [lastX, lastY] = [Infinity, Infinity];
  for (let k = 0; k + 1 < eta.length; k += 4) {
    const [px, py] = [view.px(eta[k]!), view.py(eta[k + 1]!)];
    if (Math.abs(px - lastX) + Math.abs(py - lastY) < CHORD_PX && k + 4 < eta.length) continue;
    if (k === 0) pen.moveTo(px, py);
    else pen.lineTo(px, py);
    [lastX, lastY] = [px, py];
  }
  pen.save();
  pen.strokeStyle = css("--halo");
  pen.globalAlpha = alpha * 0.6;
  pen.lineWidth = 3.5;
  pen.stroke();
  pen.restore();
  pen.stroke();
  pen.restore();
}

/** Rows of `stride` numbers, x and y first, as one line: as many points as can be told apart. */
export function polyline(pen: Pen, view: View, rows: Float32Array, stride: number): void {
  pen.beginPath();
  let [lastX, lastY] = [Infinity, Infinity];
  for (let k = 0; k + 1 < rows.length; k += stride) {
    const [px, py] = [view.px(rows[k]!), view.py(rows[k + 1]!)];
    if (Math.abs(px - lastX) + Math.abs(py - lastY) < CHORD_PX && k + stride < rows.length) continue;
    pen.lineTo(px, py);
    [lastX, lastY] = [px, py];
  }
}

export function label(pen: Pen, text: string, x: number, y: number, colour: string): void {
  pen.font = "600 12px system-ui, sans-serif";
  pen.textAlign = "center";
  pen.textBaseline = "middle";
  pen.lineWidth = 3;
  pen.strokeStyle = css("--halo");
  pen.strokeText(text, x, y);
  pen.fillStyle = colour;
  pen.fillText(text, x, y);
}
