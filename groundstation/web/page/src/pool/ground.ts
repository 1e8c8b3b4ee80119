/** What lies under the robots: water, picture, grid, rulers, planned paths, trails. Two canvases of its own, each drawn again only
 * when it changes: without a graphics card a line that is drawn costs more than the robot it is for. */

import { css, isLight, robotColour } from "../colours";
import { isStale, live, pictureAgeMs } from "../store";
import type { Scene } from "../wire";
import { layers } from "./layers";
import { drawPath, type Pen, placeOf } from "./path";
import { straightened } from "./picture";
import { trails } from "./trails";
import type { View } from "./view";

const TRAILS_EVERY_MS = 400; // the end of a trail, up to the robot, is drawn with the robot

const groundCanvas = document.createElement("canvas");
const linesCanvas = document.createElement("canvas");
let groundOf = "";
let linesOf = "";
let trailsAtMs = 0;

/** The time of the run up to which trails are in the ground. */
export let trailsUntil_s = 0;

/** Put the ground under everything: pixel by pixel, which is a copy. */
export function drawGround(pen: Pen, view: View, s: Scene): void {
  const canvas = ground(view, s);
  pen.setTransform(1, 0, 0, 1, 0, 0);
  pen.drawImage(canvas, 0, 0);
  pen.setTransform(devicePixelRatio, 0, 0, devicePixelRatio, 0, 0);
}

function ground(view: View, s: Scene): HTMLCanvasElement {
  const on = layers.peek();
  const old = pictureIsOld(s);
  const look = [s.hash, view.x, view.y, view.scale, view.width, view.height, devicePixelRatio, isLight(), JSON.stringify(on), live.pathSerial].join();
  const now = [look, live.pictureSerial, old].join();
  const moved = on.trails && performance.now() - trailsAtMs >= TRAILS_EVERY_MS;
  if (now === groundOf && !moved) return groundCanvas;
  groundOf = now;
  const pen = fresh(groundCanvas, view, false);
  pen.fillStyle = css("--deck");
  pen.fillRect(0, 0, view.width, view.height);
  drawBasin(pen, view, s);
  if (on.camera) drawPicture(pen, view, old);
  pen.drawImage(lines(view, s, look), 0, 0, view.width, view.height);
  trailsAtMs = performance.now();
  trailsUntil_s = live.snapshot?.time_s ?? 0;
  if (on.trails) s.robots.forEach(({ id }, place) => drawTrail(pen, view, id, place));
  return groundCanvas;
}

function lines(view: View, s: Scene, look: string): HTMLCanvasElement {
  if (look === linesOf) return linesCanvas;
  linesOf = look;
  const on = layers.peek();
  const pen = fresh(linesCanvas, view, true);
  drawGrid(pen, view, s);
  if (on.reference) for (const path of live.paths) drawPath(pen, view, path, robotColour(placeOf(s, path.robot)), 0.7);
  if (on.obstacles) drawIslands(pen, view, s);
  drawRulers(pen, view);
  return linesCanvas;
}

/** A canvas as large as the map, and empty. */
function fresh(canvas: HTMLCanvasElement, view: View, alpha: boolean): Pen {
  const [width, height] = [Math.round(view.width * devicePixelRatio), Math.round(view.height * devicePixelRatio)];
  if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
  const pen = canvas.getContext("2d", { alpha })!;
  pen.setTransform(1, 0, 0, 1, 0, 0);
  if (alpha) pen.clearRect(0, 0, width, height);
  pen.setTransform(devicePixelRatio, 0, 0, devicePixelRatio, 0, 0);
  return pen;
}

function pictureIsOld(s: Scene): boolean {
  return pictureAgeMs() > s.picture_stale_s * 1e3;
}

function drawBasin(pen: Pen, view: View, s: Scene): void {
  const [length, width] = s.pool_m;
  const [left, top] = view.toScreen(-length / 2, -width / 2);
  pen.fillStyle = css("--water");
  if (s.walls) pen.fillRect(left, top, length * view.scale, width * view.scale);
  else pen.fillRect(0, 0, view.width, view.height);
}

function drawPicture(pen: Pen, view: View, old: boolean): void {
  const found = straightened();
  if (found === null) return;
  const [x, y, width, height] = found.at;
  const [left, top] = view.toScreen(x, y);
  pen.save();
  pen.globalAlpha = old ? 0.25 : isLight() ? 0.75 : 0.62; // what is drawn on it must be seen
  if (old) pen.filter = "grayscale(1)";
  pen.imageSmoothingQuality = "low";
  pen.drawImage(found.image, left, top, width * view.scale, height * view.scale);
  pen.restore();
}

/** 1, 2 or 5 times a power of ten: a step at least this long. */
function niceStep(least: number): number {
  const power = 10 ** Math.floor(Math.log10(least));
  return power * ([1, 2, 5, 10].find((m) => m * power >= least) ?? 10);
}

function drawGrid(pen: Pen, view: View, s: Scene): void {
  const step = niceStep(70 / view.scale);
  const [x0, y0] = view.toPool(0, 0);
  const [x1, y1] = view.toPool(view.width, view.height);
  pen.lineWidth = 1;
  pen.strokeStyle = css("--grid");
  pen.beginPath();
  for (let x = Math.ceil(x0 / step) * step; x <= x1; x += step) {
    const px = Math.round(view.toScreen(x, 0)[0]) + 0.5;
    pen.moveTo(px, 0);
    pen.lineTo(px, view.height);
  }
  for (let y = Math.ceil(y0 / step) * step; y <= y1; y += step) {
    const py = Math.round(view.toScreen(0, y)[1]) + 0.5;
    pen.moveTo(0, py);
    pen.lineTo(view.width, py);
  }
  pen.stroke();
  if (s.walls) {
    const [length, width] = s.pool_m;
    const [left, top] = view.toScreen(-length / 2, -width / 2);
    pen.strokeStyle = css("--wall");
    pen.lineWidth = 3;
    pen.strokeRect(left - 1.5, top - 1.5, length * view.scale + 3, width * view.scale + 3);
  }
  const [ox, oy] = view.toScreen(0, 0);
  pen.strokeStyle = css("--faint");
  pen.lineWidth = 1.5;
  pen.beginPath();
  pen.moveTo(ox - 6, oy);
  pen.lineTo(ox + 6, oy);
  pen.moveTo(ox, oy - 6);
  pen.lineTo(ox, oy + 6);
  pen.stroke();
}

function drawRulers(pen: Pen, view: View): void {
  const step = niceStep(70 / view.scale);
  const digits = Math.max(0, -Math.floor(Math.log10(step)));
  const [x0, y0] = view.toPool(0, 0);
  const [x1, y1] = view.toPool(view.width, view.height);
  pen.font = "11px system-ui, sans-serif";
  pen.fillStyle = css("--ink");
  pen.textAlign = "center";
  pen.textBaseline = "top";
  pen.strokeStyle = css("--halo");
  pen.lineWidth = 3;
  const mark = (text: string, x: number, y: number) => {
    pen.strokeText(text, x, y);
    pen.fillText(text, x, y);
  };
  for (let x = Math.ceil(x0 / step) * step; x <= x1; x += step) mark((x + 0).toFixed(digits), view.toScreen(x, 0)[0], 4);
  pen.textAlign = "left";
  pen.textBaseline = "middle";
  for (let y = Math.ceil(y0 / step) * step; y <= y1; y += step) {
    const py = view.toScreen(0, y)[1];
    if (py > 24) mark((y + 0).toFixed(digits), 5, py);
  }
  drawScaleBar(pen, view);
}

function drawScaleBar(pen: Pen, view: View): void {
  const metres = niceStep(60 / view.scale);
  const width = metres * view.scale;
  const [right, y] = [view.width - 16, view.height - 16];
  pen.strokeStyle = css("--ink");
  pen.lineWidth = 2;
  pen.beginPath();
  pen.moveTo(right - width, y - 5);
  pen.lineTo(right - width, y);
  pen.lineTo(right, y);
  pen.lineTo(right, y - 5);
  pen.stroke();
  pen.fillStyle = css("--ink");
  pen.textAlign = "center";
  pen.textBaseline = "bottom";
  pen.fillText(metres >= 1 ? `${metres} m` : `${Math.round(metres * 100)} cm`, right - width / 2, y - 4);
}

function drawIslands(pen: Pen, view: View, s: Scene): void {
  pen.fillStyle = css("--island");
  pen.strokeStyle = css("--wall");
  pen.lineWidth = 2;
  for (const [x, y, radius] of s.islands) {
    pen.beginPath();
    pen.arc(...view.toScreen(x, y), radius * view.scale, 0, 2 * Math.PI);
    pen.fill();
    pen.stroke();
  }
}

/** Where a robot has been, the longer ago the fainter: a band at a time, as a gradient would cost a stroke per segment. */
function drawTrail(pen: Pen, view: View, id: number, place: number): void {
  const trail = trails.get(id);
  const robot = live.robots.get(id);
  if (trail === undefined || robot === undefined || trail.t.length < 2) return;
  pen.save();
  pen.strokeStyle = isStale(robot.news, robot.sentMs) ? css("--stale") : robotColour(place);
  pen.lineWidth = 2.5;
  pen.lineJoin = "round";
  const bands = 4;
  let k = 0;
  for (let band = bands - 1; band >= 0; band--) {
    const until_s = trailsUntil_s - 15 * band;
    pen.globalAlpha = 0.15 + 0.17 * (bands - 1 - band);
    pen.beginPath();
    for (k = Math.max(0, k - 1); k < trail.t.length && trail.t[k]! <= until_s; k++) pen.lineTo(view.px(trail.x[k]!), view.py(trail.y[k]!));
    pen.stroke();
  }
  pen.restore();
}
