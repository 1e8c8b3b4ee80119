/** What is being edited, and what the station's planner says of it. Nothing here flies: an edit is saved for the next run. */

import { computed, effect, signal } from "@preact/signals";
import { nextSerial, say } from "../link";
import { connected, drawSoon, editing, scene, tried } from "../store";
import type { Corner, Edit, Scene, Shape } from "../wire";

type Point = [number, number];
export type PathKind = "circle" | "waypoints" | "route";

export interface Draft {
  pool: [number, number, number];
  islands: [number, number, number][]; // x, y, radius
  kind: PathKind;
  points: Point[]; // waypoints, or the places of a route
  start: number; // index of the waypoint at which the run begins
  diameter: number;
  lap: number;
  speed: number;
  laps: number;
  corner: Corner;
  cornerReach: number; // before a round corner
  stops: boolean; // at the last waypoint
  depth: number;
  duration: number;
  mode: "translate" | "rotate";
  scale: number;
  shape: Shape | ""; // gives the robots their nodes; empty: each has its own
  spacing: number;
  nodes: Map<number, [number, number, number]>; // by robot, in the file's order
}

export const SHAPES: Shape[] = ["line", "column", "triangle", "diamond", "circle"]; // the station places them
const AS_DRAWN = { laps: 1, corner: "smooth" as Corner, cornerReach: 0.5, stops: false };
const MOST_ROBOTS = 49;
const TOGETHER_MS = 700; // changes that follow one another so closely are undone together: a drag is one

export const draft = signal<Draft | null>(null);
export const playhead = signal<number | null>(null); // seconds into the preview; null: not playing
export const undoable = signal(0);
export const redoable = signal(0);

let before: Draft[] = [];
let after: Draft[] = [];
let changedAtMs = -Infinity;

function fromScene(s: Scene): Draft {
  const { path } = s;
  const circle = path.kind === "circle";
  return {
    pool: [...s.pool_m],
    islands: s.islands.map((island) => [...island]),
    kind: path.kind,
    points: path.kind === "waypoints" ? path.points_m.map(([x, y]) => [x, y]) : path.kind === "route" ? path.via_m.map(([x, y]) => [x, y]) : [],
    start: path.kind === "waypoints" ? path.start_index : 0,
    diameter: circle ? path.diameter_m : 0.5 * Math.min(s.pool_m[0], s.pool_m[1]),
    lap: circle ? path.lap_s : 100,
    speed: circle ? 0.1 : path.speed_mps,
    ...(path.kind === "waypoints" ? { laps: path.laps, corner: path.corner, cornerReach: path.corner_m, stops: path.stop } : AS_DRAWN),
    depth: path.depth_m,
    duration: s.duration_s,
    mode: s.formation.mode,
    scale: s.formation.scale,
    shape: s.formation.shape ?? "",
    spacing: s.formation.spacing_m,
    nodes: new Map(s.robots.map(({ id, node_m }) => [id, [...node_m]])),
  };
}

/** Begin again from what is flown now. That can be undone, too. */
export function reset(): void {
  const s = scene.peek();
  if (s === null) return;
  begunFrom = s.hash;
  change(fromScene(s));
}

let begunFrom = ""; // hash of the experiment that the draft began from

editing.subscribe((on) => {
  if (on && (draft.peek() === null || begunFrom !== scene.peek()?.hash)) reset();
  else if (on) change(draft.peek()!); // another program may answer now
  playhead.value = null;
});

export function toEdit(d: Draft): Edit {
  const ofWaypoints: Edit = d.kind === "waypoints" ? { start_index: d.start, laps: d.laps, corner: d.corner, corner_m: d.cornerReach, stop: d.stops } : {};
  const path: Edit = d.kind === "circle" ? { diameter_m: d.diameter, lap_s: d.lap } : { points_m: d.points, speed_mps: d.speed, ...ofWaypoints };
  const nodes: Edit = d.shape === "" ? { nodes_m: Object.fromEntries(d.nodes) } : { shape: d.shape, spacing_m: d.spacing };
  const formation: Edit = { mode: d.mode, scale: d.scale, robots: [...d.nodes.keys()], ...nodes };
  return { pool_m: d.pool, islands_m: d.islands, kind: d.kind, ...path, depth_m: d.depth, duration_s: d.duration, ...formation };
}

/** Take a change, and ask the planner about it. The station answers the newest question; those in between fall away. */
export function change(next: Draft): void {
  const old = draft.peek();
  const now = performance.now();
  if (old !== null && now - changedAtMs > TOGETHER_MS) before.push(old);
  changedAtMs = now;
  after = [];
  take(next);
}

function take(next: Draft): void {
  draft.value = next;
  saveNumber.value = 0;
  [undoable.value, redoable.value] = [before.length, after.length];
  askPlanner(next);
  drawSoon();
}

const questionNumber = signal(0); // of the newest draft
export const saveNumber = signal(0); // of the request that saves it; 0: it is not saved

/** What the planner says of this draft; null until it has said something. An answer to an earlier draft is none. */
export const verdict = computed(() => (connected.value && tried.value?.n === questionNumber.value ? tried.value : null));

function askPlanner(about: Draft): void {
  questionNumber.value = nextSerial();
  say({ kind: "try", n: questionNumber.value, edit: toEdit(about) });
}

effect(() => {
  if (connected.value && editing.peek() && draft.peek() !== null) askPlanner(draft.peek()!); // a question may have gone with the connection
});

/** Go to the latest draft on one side; the present one goes to the other side. */
function step(from: Draft[], to: Draft[]): void {
  const [next, now] = [from.pop(), draft.peek()];
  if (next === undefined || now === null) return;
  to.push(now);
  changedAtMs = -Infinity;
  take(next);
}

export const undo = (): void => step(before, after);
export const redo = (): void => step(after, before);

/** Where the nodes are: those of a shape, as the station has placed them, until it has. */
export function nodesOf(d: Draft): Map<number, [number, number, number]> {
  const placed = tried.value?.nodes_m;
  if (d.shape === "" || placed === undefined || placed.some(([id]) => !d.nodes.has(id))) return d.nodes;
  return new Map(placed.map(([id, x, y, z]) => [id, [x, y, z]]));
}

/** The draft with every node its own: what a hand has moved is no shape any more. */
export function freed(d: Draft): Draft {
  return { ...d, shape: "", nodes: new Map(nodesOf(d)) };
}

/** Another kind of path, with points from the old one where it had none; a circle becomes laps, as many as last, for a single one is not closed. */
export function ofKind(d: Draft, kind: PathKind): Draft {
  const r = d.diameter / 2;
  const points: Point[] = d.points.length >= 2 ? d.points : [[-r, -r], [r, -r], [r, r], [-r, r]];
  const around = points.reduce((sum, [x, y], k) => sum + Math.hypot(points.at(k - 1)![0] - x, points.at(k - 1)![1] - y), 0);
  const laps = d.kind === "circle" && kind === "waypoints" ? Math.max(2, Math.ceil((1.2 * d.duration * d.speed) / around)) : d.laps;
  return { ...d, kind, points: kind === "circle" ? d.points : points, start: 0, laps };
}

/** A robot more, beside the last one. */
export function withRobot(d: Draft): Draft {
  const ids = [...d.nodes.keys()];
  let id = 1;
  while (d.nodes.has(id)) id += 1;
  if (id > MOST_ROBOTS) return d;
  const [x, y, z] = nodesOf(d).get(ids.at(-1) ?? 0) ?? [0, 0, 0];
  const own = d.shape === "" ? d.nodes : nodesOf(d);
  return { ...d, nodes: new Map(own).set(id, [x + d.spacing, y, z]) };
}

export function withoutRobot(d: Draft, robot: number): Draft {
  return { ...d, nodes: new Map([...d.nodes].filter(([id]) => id !== robot)) };
}

/** Turn the formation about its centre, seen from above. */
export function rotate(d: Draft, angle: number): Draft {
  const [c, s] = [Math.cos(angle), Math.sin(angle)];
  const own = freed(d);
  return { ...own, nodes: new Map([...own.nodes].map(([id, [x, y, z]]) => [id, [c * x - s * y, s * x + c * y, z]])) };
}

let playing = 0;

/** Play the tried paths, a minute of the run in some seconds. */
export function play(): void {
  cancelAnimationFrame(playing);
  if (playhead.peek() !== null) {
    playhead.value = null;
    drawSoon();
    return;
  }
  const began = performance.now();
  const step = () => {
    const lasts = tried.peek()?.duration_s ?? 0; // of the newest edit
    const at = ((performance.now() - began) / 1e3) * Math.max(1, lasts / 12);
    playhead.value = at < lasts && editing.peek() ? at : null;
    drawSoon();
    if (playhead.peek() !== null) playing = requestAnimationFrame(step);
  };
  step();
}
