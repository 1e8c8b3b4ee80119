/** Draws the pool as seen from above, back to front. Plain Canvas 2D; positions in metres, line widths in CSS pixels. */

import { css, isLight, robotColour } from "../colours";
import type { Robot } from "../store";
import { ageMs, isStale, live, scene, selected } from "../store";
import type { PathSamples, Scene } from "../wire";
import { floats } from "../wire";
import { layers } from "./layers";
import { straightened } from "./picture";
import { trails } from "./trails";
import type { View } from "./view";

const SIGMAS = 3;
const DISTURBANCE_M_PER_MPS2 = 4; // 0.1 m/s^2 is drawn 0.4 m long
const CHORD_PX = 2; // a path is drawn with points about this far apart

type Pen = CanvasRenderingContext2D;

const paths = new WeakMap<PathSamples, Float32Array>();

/** A path's samples, unpacked once. */
export function samples(path: PathSamples): Float32Array {
  let found = paths.get(path);
  if (found === undefined) paths.set(path, (found = floats(path.eta)));
  return found;
}

export function drawPool(pen: Pen, view: View): void {
  const s = scene.peek();
  if (s === null) {
    pen.fillStyle = css("--deck");
    pen.fillRect(0, 0, view.width, view.height);
    return;
  }
  const on = layers.peek();
  pen.drawImage(ground(view, s), 0, 0, view.width, view.height);
  if (on.obstacles) drawObstacles(pen, view);
  if (on.formation) drawLinks(pen, view, s);
  if (on.constraints) drawConstraints(pen, view, s);
  s.robots.forEach(({ id }, place) => {
    const robot = live.robots.get(id);
    if (robot?.news.state !== undefined) drawRobot(pen, view, s, robot, place);
  });
  for (const ghost of live.snapshot?.ghosts ?? []) drawGhost(pen, view, s, ghost.id, floats(ghost.eta));
  drawRulers(pen, view);
}

const groundCanvas = document.createElement("canvas");
let groundOf = "";

/** What lies under the robots. Drawn again only when it changes: without a graphics card it costs more than all robots. */
function ground(view: View, s: Scene): HTMLCanvasElement {
  const on = layers.peek();
  const old = pictureIsOld(s);
  const now = [s.hash, view.x, view.y, view.scale, view.width, view.height, devicePixelRatio, isLight(), live.pictureSerial, old, JSON.stringify(on)].join();
  if (now === groundOf) return groundCanvas;
  groundOf = now;
  groundCanvas.width = Math.round(view.width * devicePixelRatio);
  groundCanvas.height = Math.round(view.height * devicePixelRatio);
  const pen = groundCanvas.getContext("2d", { alpha: false })!;
  pen.setTransform(devicePixelRatio, 0, 0, devicePixelRatio, 0, 0);
  pen.fillStyle = css("--deck");
  pen.fillRect(0, 0, view.width, view.height);
  drawBasin(pen, view, s);
  if (on.camera) drawPicture(pen, view, old);
  drawGrid(pen, view, s);
  if (on.reference) for (const path of s.paths) drawPath(pen, view, path, robotColour(placeOf(s, path.robot)), 0.7);
  if (on.obstacles) drawIslands(pen, view, s);
  return groundCanvas;
}

function pictureIsOld(s: Scene): boolean {
  return live.pictureAgeMs + performance.now() - live.pictureArrivedMs > s.picture_stale_s * 1e3;
}

/** A robot of the run beside: only an outline, so that nobody takes it for one that is there. */
function drawGhost(pen: Pen, view: View, s: Scene, id: number, eta: Float32Array): void {
  const [px, py] = view.toScreen(eta[0]!, eta[1]!);
  const radius = s.hull_m * view.scale;
  pen.save();
  pen.strokeStyle = robotColour(placeOf(s, id));
  pen.lineWidth = 1.5;
  pen.setLineDash([2, 3]);
  pen.beginPath();
  pen.arc(px, py, radius, 0, 2 * Math.PI);
  pen.moveTo(px, py);
  pen.lineTo(px + 1.25 * radius * Math.cos(eta[3]!), py + 1.25 * radius * Math.sin(eta[3]!));
  pen.stroke();
  pen.restore();
}

export function placeOf(s: Scene, robot: number): number {
  return s.robots.findIndex((r) => r.id === robot);
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
    const [px, py] = view.toScreen(eta[k]!, eta[k + 1]!);
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

function drawObstacles(pen: Pen, view: View): void {
  const found = live.snapshot?.obstacles;
  if (!found || found.age_ms + performance.now() - live.arrivedMs > 1500) return;
  const outline = floats(found.outline);
  pen.save();
  pen.fillStyle = css("--obstacle");
  pen.strokeStyle = css("--warning");
  pen.lineWidth = 1.5;
  found.ids.forEach((_, index) => {
    pen.beginPath();
    for (let corner = 0; corner < 12; corner++) {
      const [px, py] = view.toScreen(outline[24 * index + 2 * corner]!, outline[24 * index + 2 * corner + 1]!);
      if (corner === 0) pen.moveTo(px, py);
      else pen.lineTo(px, py);
    }
    pen.closePath();
    pen.fill();
    pen.stroke();
  });
  pen.restore();
}

function fresh(id: number): Robot | null {
  const robot = live.robots.get(id);
  return robot !== undefined && !isStale(robot.news, robot.arrivedMs) ? robot : null;
}

function drawLinks(pen: Pen, view: View, s: Scene): void {
  pen.save();
  pen.strokeStyle = css("--faint");
  pen.lineWidth = 1;
  pen.setLineDash([2, 4]);
  pen.beginPath();
  for (const { id, neighbours } of s.robots) {
    const robot = fresh(id);
    for (const other of neighbours) {
      const neighbour = fresh(other);
      if (robot === null || neighbour === null || (other < id && s.robots.find((r) => r.id === other)?.neighbours.includes(id))) continue;
      pen.moveTo(...view.toScreen(robot.eta[0]!, robot.eta[1]!));
      pen.lineTo(...view.toScreen(neighbour.eta[0]!, neighbour.eta[1]!));
    }
  }
  pen.stroke();
  pen.restore();
}

/** The least distance of two predicted paths, node by node, and that node. */
function closest(a: Float32Array, b: Float32Array): [number, number] {
  let [least, node] = [Infinity, -1];
  for (let k = 0; k + 2 < a.length && k + 2 < b.length; k += 3) {
    const d = Math.hypot(a[k]! - b[k]!, a[k + 1]! - b[k + 1]!, a[k + 2]! - b[k + 2]!);
    if (d < least) [least, node] = [d, k];
  }
  return [least, node];
}

/** Pairs whose predicted distance enters 2 R + margin: there the collision constraint acts. */
function drawConstraints(pen: Pen, view: View, s: Scene): void {
  const limit = 2 * s.safety_m + s.margin_m;
  const reach = limit + 4 * s.limits.speed_mps; // nothing further apart can meet within a horizon
  const robots = s.robots.map(({ id }) => fresh(id)).filter((robot) => robot !== null && robot.horizon.length > 0) as Robot[];
  pen.save();
  pen.strokeStyle = css("--critical");
  pen.fillStyle = css("--critical");
  pen.lineWidth = 2;
  pen.textAlign = "center";
  for (let i = 0; i < robots.length; i++) {
    for (let j = i + 1; j < robots.length; j++) {
      const [a, b] = [robots[i]!, robots[j]!];
      if (Math.hypot(a.eta[0]! - b.eta[0]!, a.eta[1]! - b.eta[1]!) > reach) continue;
      const [least, k] = closest(a.horizon, b.horizon);
      if (least >= limit) continue;
      const [ax, ay] = view.toScreen(a.horizon[k]!, a.horizon[k + 1]!);
      const [bx, by] = view.toScreen(b.horizon[k]!, b.horizon[k + 1]!);
      pen.beginPath();
      pen.moveTo(ax, ay);
      pen.lineTo(bx, by);
      pen.stroke();
      label(pen, `${least.toFixed(2)} m`, (ax + bx) / 2, (ay + by) / 2 - 8, css("--critical"));
    }
  }
  pen.restore();
}

function label(pen: Pen, text: string, x: number, y: number, colour: string): void {
  pen.font = "600 12px system-ui, sans-serif";
  pen.textAlign = "center";
  pen.textBaseline = "middle";
  pen.lineWidth = 3;
  pen.strokeStyle = css("--halo");
  pen.strokeText(text, x, y);
  pen.fillStyle = colour;
  pen.fillText(text, x, y);
}

function drawRobot(pen: Pen, view: View, s: Scene, robot: Robot, place: number): void {
  const stale = isStale(robot.news, robot.arrivedMs);
  const colour = stale ? css("--stale") : robotColour(place);
  const on = layers.peek();
  pen.save();
  if (stale) pen.globalAlpha = 0.6;
  if (on.trails) drawTrail(pen, view, robot, colour);
  const located = robot.news.state!.pose_age_ms < 1e6;
  if (!located) {
    pen.restore();
    return;
  }
  if (on.horizon && !stale) drawHorizon(pen, view, robot, colour);
  if (on.reference && !stale && robot.news.state!.mode === "TRACKING") drawReference(pen, view, robot, colour);
  const [px, py] = view.toScreen(robot.eta[0]!, robot.eta[1]!);
  if (on.safety) {
    pen.strokeStyle = colour;
    pen.lineWidth = 1;
    pen.setLineDash([5, 4]);
    pen.beginPath();
    pen.arc(px, py, s.safety_m * view.scale, 0, 2 * Math.PI);
    pen.stroke();
    pen.setLineDash([]);
  }
  drawHull(pen, view, s, robot, colour, px, py);
  if (on.covariance && robot.news.pose !== undefined && !stale) drawEllipse(pen, view, robot.news.pose);
  if (on.disturbance && !stale) drawDisturbance(pen, view, robot, px, py);
  const text = stale ? `${robot.news.id}  ${(ageMs(robot.news, robot.arrivedMs) / 1e3).toFixed(1)} s old` : `${robot.news.id}`;
  label(pen, text, px, py + s.hull_m * view.scale + 13, colour); // above it the localizer writes into the picture
  if (selected.peek() === robot.news.id) {
    pen.strokeStyle = css("--ink");
    pen.lineWidth = 2;
    pen.beginPath();
    pen.arc(px, py, s.hull_m * view.scale + 5, 0, 2 * Math.PI);
    pen.stroke();
  }
  pen.restore();
}

function drawTrail(pen: Pen, view: View, robot: Robot, colour: string): void {
  const trail = trails.get(robot.news.id);
  if (trail === undefined || trail.t.length < 2) return;
  pen.save();
  pen.strokeStyle = colour;
  pen.lineWidth = 2.5;
  pen.lineJoin = "round";
  const now = live.snapshot?.time_s ?? 0;
  const bands = 4; // each fainter than the next: a gradient would cost a stroke per segment
  for (let band = 0; band < bands; band++) {
    pen.globalAlpha = 0.15 + 0.17 * (bands - 1 - band);
    pen.beginPath();
    let drawing = false;
    for (let k = 0; k < trail.t.length; k++) {
      const inside = Math.min(bands - 1, Math.floor((now - trail.t[k]!) / 15)) === band;
      const [x, y] = view.toScreen(trail.x[k]!, trail.y[k]!);
      if (drawing || inside) {
        if (drawing) pen.lineTo(x, y);
        else pen.moveTo(x, y);
      }
      drawing = inside;
    }
    pen.stroke();
  }
  pen.restore();
}

function drawHorizon(pen: Pen, view: View, robot: Robot, colour: string): void {
  const nodes = robot.horizon;
  if (nodes.length < 6) return;
  pen.strokeStyle = css("--halo");
  pen.lineWidth = 4;
  pen.beginPath();
  for (let k = 0; k + 1 < nodes.length; k += 3) pen.lineTo(...view.toScreen(nodes[k]!, nodes[k + 1]!));
  pen.stroke();
  pen.strokeStyle = colour;
  pen.lineWidth = 2;
  pen.stroke();
  pen.fillStyle = colour;
  const end = nodes.length - 3;
  pen.beginPath();
  pen.arc(...view.toScreen(nodes[end]!, nodes[end + 1]!), 3, 0, 2 * Math.PI);
  pen.fill();
}

function drawReference(pen: Pen, view: View, robot: Robot, colour: string): void {
  const [rx, ry] = view.toScreen(robot.reference[0]!, robot.reference[1]!);
  const yaw = robot.reference[3]!;
  pen.strokeStyle = colour;
  pen.lineWidth = 2;
  pen.beginPath();
  pen.arc(rx, ry, 7, 0, 2 * Math.PI);
  pen.moveTo(rx + 7 * Math.cos(yaw), ry + 7 * Math.sin(yaw));
  pen.lineTo(rx + 15 * Math.cos(yaw), ry + 15 * Math.sin(yaw));
  pen.stroke();
}

function drawHull(pen: Pen, view: View, s: Scene, robot: Robot, colour: string, px: number, py: number): void {
  const radius = s.hull_m * view.scale;
  const yaw = robot.eta[3]!;
  pen.save();
  pen.translate(px, py);
  pen.rotate(yaw);
  pen.fillStyle = colour;
  const alpha = pen.globalAlpha;
  pen.globalAlpha = alpha * 0.28;
  pen.beginPath();
  pen.arc(0, 0, radius, 0, 2 * Math.PI);
  pen.fill();
  pen.globalAlpha = alpha;
  pen.strokeStyle = colour;
  pen.lineWidth = 2;
  pen.stroke();
  if (layers.peek().thrusters) drawThrusters(pen, view, s, robot);
  pen.fillStyle = colour;
  pen.beginPath(); // the arrow head: where it heads
  pen.moveTo(radius * 1.25, 0);
  pen.lineTo(radius * 0.72, -radius * 0.3);
  pen.lineTo(radius * 0.72, radius * 0.3);
  pen.fill();
  pen.restore();
}

/** One bar a thruster, ahead or astern from its place, as long as its pulse is far from neutral. In the robot's own axes. */
function drawThrusters(pen: Pen, view: View, s: Scene, robot: Robot): void {
  const state = robot.news.state!;
  const pulses = state.echo_us.length >= 4 ? state.echo_us : state.pulse_us;
  const [reverse, neutral, ahead] = s.limits.pulse_us;
  const full = 0.45 * s.hull_m * view.scale;
  const width = Math.max(2, 0.07 * s.hull_m * view.scale);
  s.legs_m.forEach(([x, y], leg) => {
    const pulse = pulses[leg];
    if (pulse === undefined) return;
    const share = pulse >= neutral ? (pulse - neutral) / (ahead - neutral) : (pulse - neutral) / (neutral - reverse);
    const [cx, cy] = [x * view.scale, y * view.scale];
    pen.fillStyle = css("--track");
    pen.fillRect(cx - full, cy - width / 2, 2 * full, width);
    pen.fillStyle = share >= 0 ? css("--ahead") : css("--astern");
    pen.fillRect(Math.min(cx, cx + share * full), cy - width, Math.abs(share) * full, 2 * width);
  });
}

function drawEllipse(pen: Pen, view: View, pose: { x_m: number; y_m: number; ellipse: [number, number, number] }): void {
  const [px, py] = view.toScreen(pose.x_m, pose.y_m);
  const [major, minor, angle] = pose.ellipse;
  pen.strokeStyle = css("--ink");
  pen.lineWidth = 1.25;
  pen.beginPath();
  pen.ellipse(px, py, Math.max(1.5, SIGMAS * major * view.scale), Math.max(1.5, SIGMAS * minor * view.scale), angle, 0, 2 * Math.PI);
  pen.stroke();
}

function drawDisturbance(pen: Pen, view: View, robot: Robot, px: number, py: number): void {
  const yaw = robot.eta[3]!;
  const [surge, sway] = [robot.disturbance[0]!, robot.disturbance[1]!];
  const dx = (surge * Math.cos(yaw) - sway * Math.sin(yaw)) * DISTURBANCE_M_PER_MPS2 * view.scale;
  const dy = (surge * Math.sin(yaw) + sway * Math.cos(yaw)) * DISTURBANCE_M_PER_MPS2 * view.scale;
  const length = Math.hypot(dx, dy);
  if (length < 3) return;
  const [tx, ty] = [px + dx, py + dy];
  const [ux, uy] = [dx / length, dy / length];
  pen.strokeStyle = pen.fillStyle = css("--disturbance");
  pen.lineWidth = 2.5;
  pen.beginPath();
  pen.moveTo(px, py);
  pen.lineTo(tx, ty);
  pen.stroke();
  pen.beginPath();
  pen.moveTo(tx + 6 * ux, ty + 6 * uy);
  pen.lineTo(tx - 4 * uy, ty + 4 * ux);
  pen.lineTo(tx + 4 * uy, ty - 4 * ux);
  pen.fill();
}
