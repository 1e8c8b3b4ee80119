/** The edit on the map: handles to drag, the paths it would give, and the preview. */

import { css, robotColour } from "../colours";
import { drawPath, placeOf, samples } from "../pool/path";
import type { View } from "../pool/view";
import { scene, tried } from "../store";
import { change, type Draft, draft, playhead } from "./model";

const GRAB_PX = 14;
const SNAP_M = 0.01;

type Point = [number, number];
type Handle = { kind: "point"; index: number } | { kind: "node"; robot: number };

let held: Handle | null = null;

/** Where the formation's centre is at the start: nodes are drawn around it. */
function centre(d: Draft): [number, number] {
  return d.kind === "circle" ? [d.diameter / 2, 0] : (d.points[d.start] ?? [0, 0]);
}

/** In mode `rotate` the formation's y points along the path: its axes in the pool at the start. */
function axes(d: Draft): [number, number] {
  if (d.mode === "translate") return [1, 0];
  const a: Point = d.points[d.start] ?? [0, 0];
  const b: Point = d.points[d.start + 1] ?? [0, 1];
  const heading = d.kind === "circle" ? Math.PI / 2 : Math.atan2(b[1] - a[1], b[0] - a[0]);
  return [Math.cos(heading - Math.PI / 2), Math.sin(heading - Math.PI / 2)];
}

function nodeAt(d: Draft, robot: number): [number, number] {
  const [cx, cy] = centre(d);
  const [c, s] = axes(d);
  const [x, y] = d.nodes.get(robot) ?? [0, 0, 0];
  return [cx + d.scale * (c * x - s * y), cy + d.scale * (s * x + c * y)];
}

function handles(d: Draft): [Handle, [number, number]][] {
  const points = d.kind === "waypoints" ? d.points.map((p, index): [Handle, [number, number]] => [{ kind: "point", index }, p]) : [];
  const nodes = [...d.nodes.keys()].map((robot): [Handle, [number, number]] => [{ kind: "node", robot }, nodeAt(d, robot)]);
  return [...nodes, ...points];
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
  return held !== null;
}

const snapped = (value: number) => Math.round(value / SNAP_M) * SNAP_M;

/** Returns whether something was dragged; else the map itself is. */
export function editDrag(view: View, px: number, py: number): boolean {
  const d = draft.peek();
  if (held === null || d === null) return false;
  const grabbed = held;
  const [x, y] = view.toPool(px, py);
  if (grabbed.kind === "point") {
    change({ ...d, points: d.points.map((p, index) => (index === grabbed.index ? [snapped(x), snapped(y)] : p)) });
  } else {
    const [cx, cy] = centre(d);
    const [c, s] = axes(d);
    const [dx, dy] = [(x - cx) / d.scale, (y - cy) / d.scale];
    const z = d.nodes.get(grabbed.robot)?.[2] ?? 0;
    change({ ...d, nodes: new Map(d.nodes).set(grabbed.robot, [snapped(c * dx + s * dy), snapped(-s * dx + c * dy), z]) });
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
  pen.fillStyle = css("--deck");
  pen.lineWidth = 1.5;
  d.points.forEach(([x, y], index) => {
    const [px, py] = view.toScreen(x, y);
    pen.fillStyle = css("--deck");
    pen.fillRect(px - 6, py - 6, 12, 12);
    pen.strokeRect(px - 6, py - 6, 12, 12);
    pen.fillStyle = css("--ink");
    pen.font = "11px system-ui, sans-serif";
    pen.textAlign = "left";
    pen.textBaseline = "bottom";
    pen.fillText(`${index + 1}`, px + 9, py - 4);
  });
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
