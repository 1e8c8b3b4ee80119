/** The pool in three dimensions: paths, trails, horizons, and a line down to the floor, so that depth can be read. */

import { css, robotColour } from "../colours";
import { samples } from "../pool/path";
import { trails } from "../pool/trails";
import { drawSoon, isLocated, isStale, live, scene } from "../store";
import type { Scene } from "../wire";
import { ball, Gl, lookAt, type Matrix, multiply, nose, perspective, project, type Vector } from "./gl";

const FOV_RAD = 0.7;
const BALL = ball(12, 20);
const NOSE = nose(16);

export interface Deep {
  draw(): void;
  close(): void;
}

const parsed = new Map<string, number[]>();

/** A colour of the style sheet as four numbers from 0 to 1. */
function rgba(text: string, alpha = 1): number[] {
  let found = parsed.get(text);
  if (found === undefined) {
    const pen = document.createElement("canvas").getContext("2d")!;
    pen.fillStyle = text;
    pen.fillRect(0, 0, 1, 1);
    found = [...pen.getImageData(0, 0, 1, 1).data].map((value) => value / 255);
    parsed.set(text, found);
  }
  return [found[0]!, found[1]!, found[2]!, alpha * found[3]!];
}

function edges(s: Scene): Float32Array {
  const [x, y] = [s.pool_m[0] / 2, s.pool_m[1] / 2];
  const z = s.pool_m[2];
  const out: number[] = [];
  const corners: [number, number][] = [[-x, -y], [x, -y], [x, y], [-x, y]];
  corners.forEach(([ax, ay], k) => {
    const [bx, by] = corners[(k + 1) % 4]!;
    out.push(ax, ay, 0, bx, by, 0, ax, ay, z, bx, by, z, ax, ay, 0, ax, ay, z);
  });
  return new Float32Array(out);
}

function floorGrid(s: Scene): Float32Array {
  const [x, y, z] = [s.pool_m[0] / 2, s.pool_m[1] / 2, s.pool_m[2]];
  const step = Math.max(0.5, Math.ceil(Math.max(x, y) / 8));
  const out: number[] = [];
  for (let k = Math.ceil(-x / step) * step; k <= x; k += step) out.push(k, -y, z, k, y, z);
  for (let k = Math.ceil(-y / step) * step; k <= y; k += step) out.push(-x, k, z, x, k, z);
  return new Float32Array(out);
}

function surface(s: Scene): Float32Array {
  const [x, y] = [s.pool_m[0] / 2, s.pool_m[1] / 2];
  return new Float32Array([-x, -y, 0, x, -y, 0, x, y, 0, -x, -y, 0, x, y, 0, -x, y, 0]);
}

/** An island: its rim at the surface and at the floor, and uprights between. */
function posts([x, y, radius]: [number, number, number], depth: number): Float32Array {
  const around = 24;
  const at = (k: number): [number, number] => [x + radius * Math.cos((2 * Math.PI * k) / around), y + radius * Math.sin((2 * Math.PI * k) / around)];
  const out: number[] = [];
  for (let k = 0; k < around; k++) {
    const [a, b] = [at(k), at(k + 1)];
    out.push(...a, 0, ...b, 0, ...a, depth, ...b, depth, ...a, 0, ...a, depth);
  }
  return new Float32Array(out);
}

class Orbit {
  azimuth = Math.PI / 2 - 0.5;
  elevation = 0.55;
  distance = 0;

  matrix(s: Scene, aspect: number): Matrix {
    const size = Math.hypot(...s.pool_m);
    const away = (this.distance ||= 1.25 * size);
    const centre: Vector = [0, 0, s.pool_m[2] / 2];
    const flat = away * Math.cos(this.elevation);
    const eye: Vector = [flat * Math.cos(this.azimuth), flat * Math.sin(this.azimuth), centre[2] - away * Math.sin(this.elevation)];
    return multiply(perspective(FOV_RAD, aspect, away / 100, away + 4 * size), lookAt(eye, centre, [0, 0, -1]));
  }
}

export function openDeep(box: HTMLElement): Deep {
  const [canvas, labels] = [document.createElement("canvas"), document.createElement("canvas")];
  labels.style.pointerEvents = "none";
  box.append(canvas, labels);
  const gl = new Gl(canvas);
  const orbit = new Orbit();
  canvas.onpointerdown = (event) => canvas.setPointerCapture(event.pointerId);
  canvas.onpointermove = (event) => {
    if (event.buttons === 0) return;
    orbit.azimuth += event.movementX * 0.006;
    orbit.elevation = Math.min(1.5, Math.max(-0.3, orbit.elevation + event.movementY * 0.006));
    drawSoon();
  };
  canvas.onwheel = (event) => {
    event.preventDefault();
    orbit.distance *= Math.exp(event.deltaY * 0.001);
    drawSoon();
  };
  return {
    draw: () => drawDeep(gl, canvas, labels, orbit),
    close: () => gl.lose(),
  };
}

function drawDeep(gl: Gl, canvas: HTMLCanvasElement, labels: HTMLCanvasElement, orbit: Orbit): void {
  const s = scene.peek();
  if (s === null || canvas.clientWidth === 0) return;
  const [width, height] = [canvas.clientWidth * devicePixelRatio, canvas.clientHeight * devicePixelRatio];
  if (canvas.width !== width || canvas.height !== height) {
    for (const each of [canvas, labels]) [each.width, each.height] = [width, height];
  }
  const view = orbit.matrix(s, width / height);
  gl.begin(width, height, rgba(css("--deck")), view);
  gl.segments(floorGrid(s), rgba(css("--faint"), 0.35));
  gl.segments(edges(s), rgba(css("--wall"), 0.8));
  for (const island of s.islands) gl.segments(posts(island, s.pool_m[2]), rgba(css("--wall"), 0.9));
  const pen = labels.getContext("2d")!;
  pen.clearRect(0, 0, width, height);
  pen.font = `600 ${13 * devicePixelRatio}px system-ui, sans-serif`;
  pen.textAlign = "center";
  s.robots.forEach(({ id }, place) => drawRobot(gl, pen, view, s, id, place, width, height));
  gl.pane(surface(s), rgba(css("--accent"), 0.1));
}

function drawRobot(gl: Gl, pen: CanvasRenderingContext2D, view: Matrix, s: Scene, id: number, place: number, width: number, height: number): void {
  const robot = live.robots.get(id);
  const colour = robotColour(place);
  const path = live.paths.find((p) => p.robot === id);
  if (path !== undefined) gl.line(rows(samples(path), 4), rgba(colour, 0.35));
  if (robot?.news.state === undefined || !isLocated(robot) || robot.news.state.timing.pose_age_ms === null) return;
  const stale = isStale(robot.news, robot.sentMs);
  const solid = rgba(stale ? css("--stale") : colour);
  const [x, y, z, yaw] = [robot.eta[0]!, robot.eta[1]!, robot.eta[2]!, robot.eta[3]!];
  const trail = trails.get(id);
  if (trail !== undefined) gl.line(Float32Array.from(trail.t.flatMap((_, k) => [trail.x[k]!, trail.y[k]!, trail.z[k]!])), solid);
  gl.segments(new Float32Array([x, y, z, x, y, s.pool_m[2]]), rgba(css("--dim"), 0.7));
  if (!stale) gl.line(robot.horizon, rgba(css("--ink")));
  gl.solid(BALL, solid, [x, y, z], s.hull_m, yaw);
  gl.solid(NOSE, solid, [x, y, z], s.hull_m, yaw);
  const [px, py, ahead] = project(view, [x, y, z - 1.5 * s.hull_m]);
  if (!ahead) return;
  const text = `${id}   ${z.toFixed(2)} m deep`;
  const [lx, ly] = [((px + 1) / 2) * width, ((1 - py) / 2) * height];
  pen.lineWidth = 4;
  pen.strokeStyle = css("--halo");
  pen.strokeText(text, lx, ly);
  pen.fillStyle = stale ? css("--stale") : colour;
  pen.fillText(text, lx, ly);
}

/** x, y, z of rows that have more. */
function rows(values: Float32Array, each: number): Float32Array {
  const out = new Float32Array((values.length / each) * 3);
  for (let k = 0; k * each < values.length; k++) out.set(values.subarray(k * each, k * each + 3), 3 * k);
  return out;
}
