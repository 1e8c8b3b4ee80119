/** Sticks of a gamepad as shares of a robot's limits.
 *
 * Browsers give a pad's axes an order of their own unless its mapping is "standard": then 0, 1 are the left stick and 2, 3 the right
 * one. In every other order 0, 1 are still the left stick, and what the rest is nobody knows: a trigger, for example, rests at -1.
 * So of such a pad only the left stick counts. A pad counts at all once all of its sticks that count have been at rest: one that is
 * held, stuck or far off its middle when driving begins moves nothing. */

/** Shares of the vehicle's limits ahead, down, and to the right. */
export type Share = readonly [ahead: number, down: number, right: number];

const DEAD = 0.12; // of a stick's way: it never rests quite in the middle
const STILL: Share = [0, 0, 0];

const rested = new Set<string>(); // pads that count

/** Begin anew: every pad has to be at rest first. */
export function forgetPads(): void {
  rested.clear();
}

/** A stick's value beyond its dead zone, which begins at 0 there: nothing jumps. */
function beyond(value: number): number {
  return Number.isFinite(value) && Math.abs(value) > DEAD ? (Math.sign(value) * (Math.min(Math.abs(value), 1) - DEAD)) / (1 - DEAD) : 0;
}

/** What the first pad that counts asks for. A page that has not the focus is asked nothing: browsers differ in what pads say to it. */
export function padShare(): Share {
  const pads = document.hasFocus() ? [...(navigator.getGamepads?.() ?? [])].filter((pad) => pad?.connected) : [];
  const shares = pads.map((pad) => [`${pad!.index} ${pad!.id}`, shareOf(pad!)] as const);
  for (const name of rested) if (!shares.some(([known]) => known === name)) rested.delete(name); // pulled out: at rest again first
  for (const [name, share] of shares) if (share.every((value) => value === 0)) rested.add(name);
  return shares.find(([name]) => rested.has(name))?.[1] ?? STILL;
}

function shareOf(pad: Gamepad): Share {
  const [x, y, rightX, rightY] = [0, 1, 2, 3].map((k) => beyond(pad.axes[k] ?? 0)) as [number, number, number, number];
  return pad.mapping === "standard" ? [-y || 0, rightY, rightX || x] : [-y || 0, 0, x];
}
