/** Small pictures that are drawn once and then stamped: dashes, discs, and letters with a halo cost more than the rest of a robot. */

import type { Pen } from "./path";

const MOST = 400; // kept; a zoom makes new ones
const LARGEST_PX = 300; // what is larger is dearer to copy than to draw

const kept = new Map<string, HTMLCanvasElement>();

/** Draw `what` around (px, py), at most `halfWidth` and `halfHeight` CSS pixels away from it. `key` names all that it hangs on. */
export function stamp(pen: Pen, key: string, px: number, py: number, halfWidth: number, halfHeight: number, what: (pen: Pen) => void): void {
  if (Math.max(halfWidth, halfHeight) * 2 > LARGEST_PX) {
    pen.save();
    pen.translate(px, py);
    what(pen);
    pen.restore();
    return;
  }
  const ratio = devicePixelRatio;
  const name = `${ratio} ${key}`;
  let found = kept.get(name);
  if (found === undefined) {
    if (kept.size >= MOST) kept.clear();
    found = document.createElement("canvas");
    found.width = Math.ceil(2 * halfWidth * ratio);
    found.height = Math.ceil(2 * halfHeight * ratio);
    const to = found.getContext("2d")!;
    to.setTransform(ratio, 0, 0, ratio, halfWidth * ratio, halfHeight * ratio);
    what(to);
    kept.set(name, found);
  }
  pen.drawImage(found, px - halfWidth, py - halfHeight, found.width / ratio, found.height / ratio);
}
