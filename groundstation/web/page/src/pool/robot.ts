/** One robot on the map, with all that is known of it. */

import { css, robotColour } from "../colours";
import type { Robot } from "../store";
import { ageMs, isChosen, isLocated, isStale } from "../store";
import type { Scene } from "../wire";
import { trailsUntil_s } from "./ground";
import { layers } from "./layers";
import { label, type Pen, polyline } from "./path";
import { stamp } from "./stamps";
import { trails } from "./trails";
import type { View } from "./view";

const SIGMAS = 3;
const DISTURBANCE_M_PER_MPS2 = 4; // 0.1 m/s^2 is drawn 0.4 m long
const BARS_FROM_PX = 15; // of a hull's radius: on smaller ones nobody can read thruster bars
const ELLIPSE_FROM_PX = 1.5; // and no smaller uncertainty

export function drawRobot(pen: Pen, view: View, s: Scene, robot: Robot, place: number): void {
  const stale = isStale(robot.news, robot.sentMs);
  const colour = stale ? css("--stale") : robotColour(place);
  const on = layers.peek();
  pen.save();
  if (stale) pen.globalAlpha = 0.6;
  if (on.trails) drawTrailEnd(pen, view, robot, colour);
  const located = isLocated(robot) && robot.news.state!.timing.pose_age_ms !== null;
  if (!located) {
    pen.restore();
    return;
  }
  if (on.horizon && !stale) drawHorizon(pen, view, robot, colour);
  if (on.reference && !stale && ["TRACKING", "HOLDING"].includes(robot.news.state!.mode)) drawReference(pen, view, robot, colour);
  const [px, py] = view.toScreen(robot.eta[0]!, robot.eta[1]!);
  if (on.safety) drawSafety(pen, s.safety_m * view.scale, colour, px, py);
  drawHull(pen, view, s, robot, colour, px, py);
  if (on.covariance && robot.news.pose !== undefined && !stale) drawEllipse(pen, view, robot.news.pose);
  if (on.disturbance && !stale) drawDisturbance(pen, view, robot, px, py);
  const below = py + s.hull_m * view.scale + 13; // above it the localizer writes into the picture
  const text = stale && s.hull_m * view.scale >= BARS_FROM_PX ? `${robot.news.id}  ${(ageMs(robot.news, robot.sentMs) / 1e3).toFixed(1)} s old` : `${robot.news.id}`;
  if (stale) label(pen, text, px, below, colour);
  else drawName(pen, text, px, below, colour);
  if (isChosen(robot.news.id)) {
    pen.strokeStyle = css("--ink");
    pen.lineWidth = 2;
    pen.beginPath();
    pen.arc(px, py, s.hull_m * view.scale + 5, 0, 2 * Math.PI);
    pen.stroke();
  }
  pen.restore();
}

/** From where the ground's trail ends to where the robot is. */
function drawTrailEnd(pen: Pen, view: View, robot: Robot, colour: string): void {
  const trail = trails.get(robot.news.id);
  if (trail === undefined) return;
  let k = trail.t.length - 1;
  while (k > 0 && trail.t[k]! > trailsUntil_s) k--;
  if (k < 0) return;
  const alpha = pen.globalAlpha;
  pen.globalAlpha = 0.66 * alpha;
  pen.strokeStyle = colour;
  pen.lineWidth = 2.5;
  pen.beginPath();
  for (; k < trail.t.length; k++) pen.lineTo(view.px(trail.x[k]!), view.py(trail.y[k]!));
  if (isLocated(robot)) pen.lineTo(view.px(robot.eta[0]!), view.py(robot.eta[1]!));
  pen.stroke();
  pen.globalAlpha = alpha;
}

/** Dashes are dear: drawn once, then stamped. */
function drawSafety(pen: Pen, radius: number, colour: string, px: number, py: number): void {
  const half = Math.ceil(radius + 2);
  stamp(pen, `safety ${radius} ${colour}`, px, py, half, half, (to) => {
    to.strokeStyle = colour;
    to.lineWidth = 1;
    to.setLineDash([5, 4]);
    to.beginPath();
    to.arc(0, 0, radius, 0, 2 * Math.PI);
    to.stroke();
  });
}

/** So are letters with a halo. */
function drawName(pen: Pen, text: string, px: number, py: number, colour: string): void {
  stamp(pen, `name ${text} ${colour}`, px, py, 16, 11, (to) => label(to, text, 0, 0, colour));
}

function drawHorizon(pen: Pen, view: View, robot: Robot, colour: string): void {
  const nodes = robot.horizon;
  if (nodes.length < 6) return;
  pen.strokeStyle = css("--halo");
  pen.lineWidth = 4;
  polyline(pen, view, nodes, 3);
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
  if (layers.peek().thrusters && radius >= BARS_FROM_PX) drawThrusters(pen, view, s, robot);
  pen.fillStyle = colour;
  pen.beginPath(); // the arrow head: where it heads
  pen.moveTo(radius * 1.25, 0);
  pen.lineTo(radius * 0.72, -radius * 0.3);
  pen.lineTo(radius * 0.72, radius * 0.3);
  pen.fill();
  pen.restore();
}

/** One bar a thruster, along its thrust or against it, as long as its pulse is far from neutral. In the robot's own axes. */
function drawThrusters(pen: Pen, view: View, s: Scene, robot: Robot): void {
  const state = robot.news.state!;
  const pulses = state.board && state.board.echo_us.length >= 4 ? state.board.echo_us : state.pulse_us;
  const [reverse, neutral, ahead] = s.limits.pulse_us;
  const full = 0.45 * s.hull_m * view.scale;
  const width = Math.max(2, 0.07 * s.hull_m * view.scale);
  s.thrusters.forEach(([x, y, along, across], output) => {
    const pulse = pulses[output];
    if (pulse === undefined || Math.hypot(along, across) < 0.1) return; // upright: a bar would say nothing
    const share = pulse >= neutral ? (pulse - neutral) / (ahead - neutral) : (pulse - neutral) / (neutral - reverse);
    const [cx, cy] = [x * view.scale, y * view.scale];
    pen.save();
    pen.translate(cx, cy);
    pen.rotate(Math.atan2(across, along));
    pen.fillStyle = css("--track");
    pen.fillRect(-full, -width / 2, 2 * full, width);
    pen.fillStyle = share >= 0 ? css("--ahead") : css("--astern");
    pen.fillRect(Math.min(0, share * full), -width, Math.abs(share) * full, 2 * width);
    pen.restore();
  });
}

function drawEllipse(pen: Pen, view: View, pose: { x_m: number; y_m: number; ellipse: [number, number, number] }): void {
  const [px, py] = view.toScreen(pose.x_m, pose.y_m);
  const [major, minor, angle] = pose.ellipse;
  if (SIGMAS * major * view.scale < ELLIPSE_FROM_PX) return;
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
