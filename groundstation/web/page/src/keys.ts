/** Keyboard shortcuts. Escape is always the emergency stop, wherever the focus is. */

import { acknowledgeAlarms } from "./sound";
import { order } from "./link";
import { follow } from "./pool/layers";
import { fitView, zoomBy } from "./pool/Pool";
import { drawSoon, inControl, scene, selected, shown } from "./store";
import type { OrderName } from "./wire";

export const KEYS: [string, string][] = [
  ["Esc", "emergency stop"],
  ["Shift+A", "arm"],
  ["Shift+S", "start"],
  ["H", "hold"],
  ["Shift+R", "resume"],
  ["Shift+B", "return to start"],
  ["Shift+D", "disarm"],
  ["F", "show the whole pool"],
  ["G", "follow"],
  ["+ -", "zoom"],
  ["1 … 9", "choose a robot"],
  ["M", "silence the alarm"],
];

const ORDERS: Record<string, OrderName> = { A: "arm", S: "start", h: "hold", H: "hold", R: "resume", B: "return", D: "disarm" };

addEventListener("keydown", (event) => {
  if (event.key === "Escape") {
    event.preventDefault();
    if (scene.peek()?.mode !== "replay") order("stop");
    return;
  }
  const target = event.target as HTMLElement;
  if (/^(INPUT|SELECT|TEXTAREA)$/.test(target.tagName) || event.ctrlKey || event.metaKey || event.altKey) return;
  const name = ORDERS[event.key];
  if (name !== undefined) {
    if (inControl.peek() && shown.peek()?.allowed.includes(name)) order(name);
  } else if (event.key === "f" || event.key === "F") fitView();
  else if (event.key === "g" || event.key === "G") follow.value = !follow.value;
  else if (event.key === "+" || event.key === "=") zoomBy(1.25);
  else if (event.key === "-") zoomBy(0.8);
  else if (event.key === "m" || event.key === "M") acknowledgeAlarms();
  else if (/^[1-9]$/.test(event.key)) {
    const id = scene.peek()?.robots[Number(event.key) - 1]?.id ?? 0;
    selected.value = selected.peek() === id ? 0 : id;
  }
  drawSoon();
});
