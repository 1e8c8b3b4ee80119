/** Draws the pool as seen from above, back to front. Plain Canvas 2D; positions in metres, line widths in CSS pixels. */

import { css, robotColour } from "../colours";
import type { Robot } from "../store";
import { isLocated, isStale, live, scene } from "../store";
import type { Scene } from "../wire";
import { floats } from "../wire";
import { drawGround } from "./ground";
import { layers } from "./layers";
import { label, type Pen, placeOf } from "./path";
import { drawRobot } from "./robot";
import type { View } from "./view";

export function drawPool(pen: Pen, view: View): void {
  const s = scene.peek();
  if (s === null) {
    pen.fillStyle = css("--deck");
    pen.fillRect(0, 0, view.width, view.height);
    return;
  }
  const on = layers.peek();
  drawGround(pen, view, s);
  if (on.obstacles) drawObstacles(pen, view);
  if (on.formation) drawLinks(pen, view, s);
  if (on.constraints) drawConstraints(pen, view, s);
  s.robots.forEach(({ id }, place) => {
    const robot = live.robots.get(id);
    if (robot?.news.state !== undefined) drawRobot(pen, view, s, robot, place);
  });
  for (const ghost of live.snapshot?.ghosts ?? []) drawGhost(pen, view, s, ghost.id, floats(ghost.eta));
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

function drawObstacles(pen: Pen, view: View): void {
  const found = live.snapshot?.obstacles;
  if (!found || found.age_ms + performance.now() - live.sentMs > 1500) return;
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
  return robot !== undefined && isLocated(robot) && !isStale(robot.news, robot.sentMs) ? robot : null;
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
    const [x, y, z] = [a[k]! - b[k]!, a[k + 1]! - b[k + 1]!, a[k + 2]! - b[k + 2]!];
    const squared = x * x + y * y + z * z;
    if (squared < least) [least, node] = [squared, k];
  }
  return [Math.sqrt(least), node];
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
