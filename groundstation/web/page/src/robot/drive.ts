/** Driving one robot by keys, buttons or gamepad. While something is held, its velocity is said ten times a second; the robot
 * holds by itself when it hears none any more.
 *
 * What is held belongs to the chosen robot. It is known by the key's place on the keyboard or by the pointer, for what a key means
 * may change while it is down, and it is let go whenever the page may miss its end: at another robot, a modifier, another window. */

import { effect, signal } from "@preact/signals";
import { say } from "../link";
import { connected, inControl, live, scene, selected, undriven } from "../store";
import { forgetPads, padShare, type Share } from "./gamepad";

const SAY_EVERY_MS = 100;

const KEYS: Record<string, Share> = {
  w: [1, 0, 0], s: [-1, 0, 0], a: [0, 0, -1], d: [0, 0, 1], q: [0, -1, 0], e: [0, 1, 0],
  arrowup: [1, 0, 0], arrowdown: [-1, 0, 0], arrowleft: [0, 0, -1], arrowright: [0, 0, 1], pageup: [0, -1, 0], pagedown: [0, 1, 0],
}; // prettier-ignore

/** Fields whose keys write. */
export const TYPING = "select, textarea, input:not([type=checkbox], [type=range])";

export const driven = signal(0); // the robot that keys move; 0: none
export const pace = signal(0.4); // of the vehicle's limits, at most

const held = new Map<string, Share>(); // by the key's place, or the pointer
let moving = false;

export function startDriving(robot: number): void {
  stopDriving();
  undriven.value = "";
  forgetPads();
  driven.value = robot;
}

export function stopDriving(): void {
  release();
  driven.value = 0;
}

/** Nothing is held any more: the robot is told at once. */
function release(): void {
  held.clear();
  tell();
}

export function hold(name: string, share: Share): void {
  held.set(name, share);
  tell();
}

export function letGo(name: string): void {
  if (held.delete(name)) tell();
}

/** Take a key if it drives. Returns whether it did. */
export function driveKey(event: KeyboardEvent): boolean {
  const moved = (event.target as HTMLElement).matches("input[type=range]") && event.key.length > 1; // arrows are the slider's
  const share = driven.peek() === 0 || moved || modified(event) ? undefined : KEYS[event.key.toLowerCase()];
  if (share === undefined) return false;
  event.preventDefault();
  if (!event.repeat) hold(event.code, share);
  return true;
}

const MODIFIERS = ["Alt", "AltGraph", "Control", "Meta", "OS", "Shift"]; // as they come down some systems do not count them yet

/** Whether another key changes what this one means, or this one what others mean. */
function modified(event: KeyboardEvent): boolean {
  return MODIFIERS.includes(event.key) || event.ctrlKey || event.metaKey || event.altKey || event.shiftKey || event.getModifierState("AltGraph");
}

function tell(): void {
  const robot = driven.peek();
  const limits = scene.peek()?.limits;
  if (robot === 0 || limits === undefined) return;
  const asked: [number, number, number] = [0, 0, 0];
  for (const share of [...held.values(), padShare()]) share.forEach((value, k) => (asked[k] = Math.max(-1, Math.min(1, asked[k]! + value))));
  const moves = asked.some((value) => value !== 0);
  if (!moves && !moving) return;
  if (moves && !moving) undriven.value = "";
  moving = moves;
  const [ahead, down, right] = asked.map((value) => value * pace.peek()) as [number, number, number];
  say({
    kind: "drive",
    robot,
    surge_mps: ahead * limits.speed_mps,
    heave_mps: down * limits.heave_mps,
    yaw_rate_radps: right * limits.yaw_rate_radps,
    seen_ms: live.snapshot?.clock_ms ?? 0,
  });
}

setInterval(() => {
  if (driven.peek() !== 0 && (!connected.peek() || !inControl.peek() || live.snapshot?.stop)) stopDriving();
  tell();
}, SAY_EVERY_MS);
effect(() => {
  if (selected.value !== driven.peek() && driven.peek() !== 0) stopDriving();
});
addEventListener("keydown", (event) => modified(event) && release(), { capture: true }); // some systems then swallow the end of other keys
addEventListener("keyup", (event) => letGo(event.code));
addEventListener("blur", release);
addEventListener("focusin", (event) => (event.target as HTMLElement).matches(TYPING) && release()); // what is typed there drives nobody
document.addEventListener("visibilitychange", () => document.hidden && release());
