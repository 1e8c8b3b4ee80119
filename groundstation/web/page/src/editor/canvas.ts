/** The edit on the map: handles to drag, the paths it would give, and the preview. */

import { signal } from "@preact/signals";
import { css, robotColour } from "../colours";
import { drawPath, placeOf, samples } from "../pool/path";
import type { View } from "../pool/view";
import { scene, tried } from "../store";
import { change, type Draft, draft, freed, nodesOf, playhead, withoutRobot } from "./model";

const GRAB_PX = matchMedia("(pointer: coarse)").matches ? 24 : 14;
const SNAP_M = 0.01;

type Point = [number, number];
type Handle = { kind: "point"; index: number } | { kind: "node"; robot: number } | { kind: "island" | "shore"; index: number } | { kind: "corner" };

/** What a press on the free map adds; empty: nothing, the map is dragged. */
export const adding = signal<"" | "point" | "island">("");
/** The last thing that was pressed: Delete takes it away. */
const picked = signal<Handle | null>(null);

const NEW_ISLAND_M = 0.2;

let held: Handle | null = null;

/** Where the formation's centre is at the start: nodes are drawn around it. */
function centre(d: Draft): Point {
  return d.kind === "circle" ? [d.diameter / 2, 0] : (d.points[d.start] ?? [0, 0]);
}

/** In mode `rotate` the formation's y points along the path: its axes in the pool at the start. */
function axes(d: Draft): Point {
  if (d.mode === "translate") return [1, 0];
  const a: Point = d.points[d.start] ?? [0, 0];
  const b: Point = d.points[d.start + 1] ?? [0, 1];
  const heading = d.kind === "circle" ? Math.PI / 2 : Math.atan2(b[1] - a[1], b[0] - a[0]);
  return [Math.cos(heading - Math.PI / 2), Math.sin(heading - Math.PI / 2)];
}

function nodeAt(d: Draft, robot: number): Point {
  const [cx, cy] = centre(d);
  const [c, s] = axes(d);
  const [x, y] = nodesOf(d).get(robot) ?? [0, 0, 0];
  return [cx + d.scale * (c * x - s * y), cy + d.scale * (s * x + c * y)];
}

function handles(d: Draft): [Handle, Point][] {
  const points = d.kind === "circle" ? [] : d.points.map((p, index): [Handle, Point] => [{ kind: "point", index }, p]);
  const nodes = [...d.nodes.keys()].map((robot): [Handle, Point] => [{ kind: "node", robot }, nodeAt(d, robot)]);
  const islands = d.islands.flatMap(([x, y, radius], index): [Handle, Point][] => [
    [{ kind: "shore", index }, [x + radius, y]],
    [{ kind: "island", index }, [x, y]],
  ]);
  return [...nodes, ...points, ...islands, [{ kind: "corner" }, [d.pool[0] / 2, d.pool[1] / 2]]];
}

export function editGrab(view: View, px: number, py: number): boolean {
  const d = draft.peek();
  if (d === null) return false;
  let nearest = GRAB_PX;
  for (const [handle, [x, y]] of handles(d)) {
    const [hx, hy] = view.toScreen(x, y);
    const away = Math.hypot(px - hx, py - hy);
    if (away < nearest) [held, nearest] = [handle, away];
  }
  picked.value = held;
  if (held === null && adding.peek() !== "") add(d, view.toPool(px, py));
  return held !== null;
}

/** Put a waypoint where it lengthens the path least, or an island. */
function add(d: Draft, [x, y]: Point): void {
  const at: Point = [snapped(x), snapped(y)];
  if (adding.peek() === "island") {
    held = { kind: "island", index: d.islands.length };
    change({ ...d, islands: [...d.islands, [...at, NEW_ISLAND_M]] });
  } else {
    const detour = d.points.map((p, k) => {
      const next = d.points[k + 1];
      return next === undefined ? Math.hypot(at[0] - p[0], at[1] - p[1]) : between(p, at) + between(at, next) - between(p, next);
    });
    const index = detour.indexOf(Math.min(...detour)) + 1;
    held = { kind: "point", index };
    change({ ...d, points: [...d.points.slice(0, index), at, ...d.points.slice(index)], start: d.start >= index ? d.start + 1 : d.start });
  }
  picked.value = held;
}

const between = (a: Point, b: Point) => Math.hypot(a[0] - b[0], a[1] - b[1]);

/** What `picked` is called; empty where it cannot be taken away. */
export function pickedName(d: Draft): string {
  const handle = picked.value;
  if (handle === null || handle.kind === "corner") return "";
  if (handle.kind === "node") return d.nodes.has(handle.robot) && d.nodes.size > 1 ? `robot ${handle.robot}` : "";
  if (handle.kind === "point") return d.points.length > 2 && handle.index < d.points.length ? `waypoint ${handle.index + 1}` : "";
  return handle.index < d.islands.length ? `island ${handle.index + 1}` : "";
}

export function removePicked(): void {
  const [d, handle] = [draft.peek(), picked.peek()];
  if (d === null || handle === null || pickedName(d) === "") return;
  picked.value = null;
  if (handle.kind === "node") change(withoutRobot(d, handle.robot));
  else if (handle.kind === "point") {
    const points = d.points.filter((_, k) => k !== handle.index);
    change({ ...d, points, start: Math.min(handle.index < d.start ? d.start - 1 : d.start, points.length - 2) });
  } else if (handle.kind !== "corner") change({ ...d, islands: d.islands.filter((_, k) => k !== handle.index) });
}

const snapped = (value: number) => Math.round(value / SNAP_M) * SNAP_M;

/** Returns whether something was dragged; else the map itself is. */
export function editDrag(view: View, px: number, py: number): boolean {
  const d = draft.peek();
  if (held === null || d === null) return false;
  const grabbed = held;
  const [x, y] = view.toPool(px, py).map(snapped) as Point;
  switch (grabbed.kind) {
    case "point":
      change({ ...d, points: d.points.map((p, index) => (index === grabbed.index ? [x, y] : p)) });
      break;
    case "island":
      change({ ...d, islands: d.islands.map((island, index) => (index === grabbed.index ? [x, y, island[2]] : island)) });
      break;
    case "shore":
      change({ ...d, islands: d.islands.map((i, index) => (index === grabbed.index ? [i[0], i[1], Math.max(0.05, snapped(Math.hypot(x - i[0], y - i[1])))] : i)) });
      break;
    case "corner":
      change({ ...d, pool: [Math.max(0.5, 2 * Math.abs(x)), Math.max(0.5, 2 * Math.abs(y)), d.pool[2]] });
      break;
    case "node": {
      const own = freed(d);
      const [cx, cy] = centre(d);
      const [c, s] = axes(d);
      const [dx, dy] = [(x - cx) / d.scale, (y - cy) / d.scale];
      const z = own.nodes.get(grabbed.robot)?.[2] ?? 0;
      change({ ...own, nodes: own.nodes.set(grabbed.robot, [snapped(c * dx + s * dy), snapped(-s * dx + c * dy), z]) });
    }
  }
  return true;
}

export function editDrop(): boolean {
  const was = held !== null;
  held = null;
  return was;
}

export function drawEdit(pen: CanvasRenderingContext2D, view: View): void {
  const d = draft.peek();
  const s = scene.peek();
  if (d === null || s === null) return;
  const answer = tried.peek();
  drawScene(pen, view, d);
  for (const path of answer?.paths ?? []) {
    const colour = answer?.ok ? robotColour(placeOf(s, path.robot)) : css("--critical");
    drawPath(pen, view, path, colour, 1, [8, 5]);
  }
  drawCentreLine(pen, view, d);
  for (const [id] of d.nodes) ghost(pen, view, nodeAt(d, id), null, s.hull_m, robotColour(placeOf(s, id)), `${id}`);
  const at = playhead.peek();
  if (at === null) return;
  for (const path of answer?.paths ?? []) {
    const eta = samples(path);
    const k = 4 * Math.min(Math.floor(at / path.every_s), eta.length / 4 - 1);
    ghost(pen, view, [eta[k]!, eta[k + 1]!], eta[k + 3]!, s.hull_m, robotColour(placeOf(s, path.robot)), `${path.robot}`);
  }
}

function drawCentreLine(pen: CanvasRenderingContext2D, view: View, d: Draft): void {
  pen.strokeStyle = css("--ink");
  pen.lineWidth = 1.5;
  if (d.kind !== "circle") d.points.forEach((point, index) => square(pen, view, point, `${index + 1}`));
}

/** The basin's edge with its corner to drag, and islands with a point on the shore that makes them larger. */
function drawScene(pen: CanvasRenderingContext2D, view: View, d: Draft): void {
  const [left, top] = view.toScreen(-d.pool[0] / 2, -d.pool[1] / 2);
  pen.strokeStyle = css("--accent");
  pen.lineWidth = 1.5;
  pen.setLineDash([6, 4]);
  pen.strokeRect(left, top, d.pool[0] * view.scale, d.pool[1] * view.scale);
  pen.setLineDash([]);
  square(pen, view, [d.pool[0] / 2, d.pool[1] / 2], "");
  for (const [x, y, radius] of d.islands) {
    pen.fillStyle = css("--island");
    pen.strokeStyle = css("--accent");
    pen.beginPath();
    pen.arc(...view.toScreen(x, y), radius * view.scale, 0, 2 * Math.PI);
    pen.fill();
    pen.stroke();
    square(pen, view, [x + radius, y], "");
  }
}

function square(pen: CanvasRenderingContext2D, view: View, at: Point, text: string): void {
  const [px, py] = view.toScreen(...at);
  pen.fillStyle = css("--deck");
  pen.fillRect(px - 6, py - 6, 12, 12);
  pen.strokeRect(px - 6, py - 6, 12, 12);
  pen.fillStyle = css("--ink");
  pen.font = "12px system-ui, sans-serif";
  pen.textAlign = "left";
  pen.textBaseline = "bottom";
  pen.fillText(text, px + 9, py - 4);
}

function ghost(pen: CanvasRenderingContext2D, view: View, at: [number, number], yaw: number | null, radius: number, colour: string, text: string): void {
  const [px, py] = view.toScreen(...at);
  pen.strokeStyle = colour;
  pen.fillStyle = colour;
  pen.lineWidth = 2;
  pen.setLineDash(yaw === null ? [3, 3] : []);
  pen.beginPath();
  pen.arc(px, py, radius * view.scale, 0, 2 * Math.PI);
  pen.stroke();
  pen.setLineDash([]);
  pen.save();
  pen.globalAlpha *= yaw === null ? 0.15 : 0.5;
  pen.fill();
  pen.restore();
  if (yaw !== null) {
    pen.beginPath();
    pen.moveTo(px, py);
    pen.lineTo(px + 1.3 * radius * view.scale * Math.cos(yaw), py + 1.3 * radius * view.scale * Math.sin(yaw));
    pen.stroke();
  } else {
    pen.beginPath();
    pen.arc(px, py, 6, 0, 2 * Math.PI);
    pen.fill();
  }
  pen.fillStyle = css("--ink");
  pen.font = "600 12px system-ui, sans-serif";
  pen.textAlign = "center";
  pen.textBaseline = "middle";
  pen.fillText(text, px, py - radius * view.scale - 9);
}
