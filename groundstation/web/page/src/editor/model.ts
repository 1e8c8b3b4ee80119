/** What is being edited, and what the station's planner says of it. Nothing here flies: an edit is saved for the next run. */

import { signal } from "@preact/signals";
import { nextSerial, say } from "../link";
import { drawSoon, editing, saved, scene, tried } from "../store";
import type { Edit, Scene } from "../wire";

export interface Draft {
  kind: "circle" | "waypoints" | "route";
  points: [number, number][]; // of a route: the places that it leads through, which stay as they are
  start: number; // index of the waypoint at which the run begins
  diameter: number;
  lap: number;
  speed: number;
  depth: number;
  duration: number;
  mode: "translate" | "rotate";
  scale: number;
  nodes: Map<number, [number, number, number]>;
}

export const draft = signal<Draft | null>(null);
export const playhead = signal<number | null>(null); // seconds into the preview; null: not playing

function fromScene(s: Scene): Draft {
  const { path } = s;
  return {
    kind: path.kind,
    points: path.kind === "waypoints" ? path.points_m.map(([x, y]) => [x, y]) : path.kind === "route" ? path.via_m : [],
    start: path.kind === "waypoints" ? path.start_index : 0,
    diameter: path.kind === "circle" ? path.diameter_m : 0,
    lap: path.kind === "circle" ? path.lap_s : 0,
    speed: path.kind === "circle" ? 0 : path.speed_mps,
    depth: path.depth_m,
    duration: s.duration_s,
    mode: s.formation.mode,
    scale: s.formation.scale,
    nodes: new Map(s.robots.map(({ id, node_m }) => [id, [...node_m]])),
  };
}

/** Begin again from what is flown now. */
export function reset(): void {
  const s = scene.peek();
  if (s === null) return;
  saved.value = null;
  change(fromScene(s));
}

editing.subscribe((on) => {
  if (on && draft.peek() === null) reset();
  playhead.value = null;
});

export function toEdit(d: Draft): Edit {
  const path: Edit = d.kind === "circle" ? { diameter_m: d.diameter, lap_s: d.lap } : { speed_mps: d.speed };
  if (d.kind === "waypoints") path.points_m = d.points;
  return { ...path, depth_m: d.depth, duration_s: d.duration, mode: d.mode, scale: d.scale, nodes_m: Object.fromEntries(d.nodes) };
}

/** Take a change, and ask the planner about it. The station answers the newest question; those in between fall away. */
export function change(next: Draft): void {
  draft.value = next;
  say({ kind: "try", n: nextSerial(), edit: toEdit(next) });
  drawSoon();
}

/** Turn the formation about its centre, seen from above. */
export function rotate(d: Draft, angle: number): Draft {
  const [c, s] = [Math.cos(angle), Math.sin(angle)];
  return { ...d, nodes: new Map([...d.nodes].map(([id, [x, y, z]]) => [id, [c * x - s * y, s * x + c * y, z]])) };
}

/** Well-known shapes for n robots, neighbours `apart` metres from each other. */
export const SHAPES: Record<string, (n: number, apart: number) => [number, number][]> = {
  "line across": (n, apart) => Array.from({ length: n }, (_, k) => [(k - (n - 1) / 2) * apart, 0]),
  "line ahead": (n, apart) => Array.from({ length: n }, (_, k) => [0, ((n - 1) / 2 - k) * apart]),
  wedge: (n, apart) =>
    centred(Array.from({ length: n }, (_, k) => [Math.ceil(k / 2) * (k % 2 ? -1 : 1) * apart * 0.71, -Math.ceil(k / 2) * apart * 0.71])),
  ring: (n, apart) => {
    const radius = n > 1 ? apart / (2 * Math.sin(Math.PI / n)) : 0;
    return Array.from({ length: n }, (_, k) => [radius * Math.sin((2 * Math.PI * k) / n), radius * Math.cos((2 * Math.PI * k) / n)]);
  },
  grid: (n, apart) => {
    const columns = Math.ceil(Math.sqrt(n));
    return centred(Array.from({ length: n }, (_, k) => [(k % columns) * apart, -Math.floor(k / columns) * apart]));
  },
};

function centred(points: [number, number][]): [number, number][] {
  const [mx, my] = [0, 1].map((axis) => points.reduce((sum, p) => sum + p[axis]!, 0) / points.length) as [number, number];
  return points.map(([x, y]) => [x - mx, y - my]);
}

export function shaped(d: Draft, shape: string, apart: number): Draft {
  const made = SHAPES[shape]?.(d.nodes.size, apart) ?? [];
  return { ...d, scale: 1, nodes: new Map([...d.nodes].map(([id, [, , z]], k) => [id, [made[k]![0], made[k]![1], z]])) };
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
  const lasts = tried.peek()?.duration_s ?? 0;
  const pace = Math.max(1, lasts / 12);
  const began = performance.now();
  const step = () => {
    const at = ((performance.now() - began) / 1e3) * pace;
    playhead.value = at < lasts && editing.peek() ? at : null;
    drawSoon();
    if (playhead.peek() !== null) playing = requestAnimationFrame(step);
  };
  step();
}
