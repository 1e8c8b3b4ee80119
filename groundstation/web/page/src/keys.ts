/** Keyboard shortcuts. Shift+Space is always the emergency stop, wherever the focus is. Escape is, too, unless there is something that
 * people are used to leave by it: a question, a field with the focus, an open menu, places being chosen, the list of runs. */

import { stepFrames, togglePlay } from "./panels/Replay";
import { showRuns } from "./panels/Runs";
import { driveKey, TYPING } from "./robot/drive";
import { acknowledgeAlarms } from "./sound";
import { order } from "./link";
import { closeQuestion } from "./Question";
import { choosePlaces, places } from "./pool/places";
import { follow } from "./pool/layers";
import { fitView, showNextCamera, zoomBy } from "./pool/Pool";
import { removePicked } from "./editor/canvas";
import { redo, undo } from "./editor/model";
import { browsing, choose, drawSoon, editing, inControl, scene, shown } from "./store";
import type { OrderName } from "./wire";

export const KEYS: [string, string][] = [
  ["Shift+Space", "emergency stop, from anywhere"],
  ["Esc", "leave a field or a question, close a menu or list; else emergency stop"],
  ["Shift+A", "arm"],
  ["Shift+S", "start"],
  ["H", "hold"],
  ["Shift+R", "resume"],
  ["Shift+B", "return to start"],
  ["Shift+D", "disarm"],
  ["F", "show the whole pool"],
  ["G", "follow"],
  ["+ -", "zoom"],
  ["C", "the next camera's picture"],
  ["1, 12, …", "choose a robot by its number; Shift+click chooses several"],
  ["W A S D, Q E", "drive the chosen robot, while Drive is on"],
  ["Ctrl+Z, Ctrl+Y, Del", "editor: undo, redo, remove what was touched last"],
  ["M", "silence the alarm"],
  ["Space", "recorded run: play or pause"],
  [", .", "recorded run: a state back or on"],
];

const WITH_SHIFT: Record<string, OrderName> = { a: "arm", s: "start", h: "hold", r: "resume", b: "return", d: "disarm" };
const ALONE: Record<string, OrderName> = { h: "hold" };

/** Leave what Escape leaves everywhere. Returns false if there is nothing of the kind: then it stops the fleet. */
function left(target: HTMLElement): boolean {
  const menu = document.querySelector<HTMLDetailsElement>("details.layers[open]");
  if (menu !== null) menu.open = false;
  else if (closeQuestion()) return true;
  else if (target.matches(TYPING)) target.blur();
  else if (places.peek() !== null) choosePlaces(false);
  else if (browsing.peek()) showRuns(false);
  else return false;
  return true;
}

/** Undo and redo of the editor. Returns whether it was one of them. */
function editKey(event: KeyboardEvent): boolean {
  const key = event.key.toLowerCase();
  if (!(event.ctrlKey || event.metaKey) || event.altKey || (key !== "z" && key !== "y")) return false;
  event.preventDefault();
  if (key === "y" || event.shiftKey) redo();
  else undo();
  return true;
}

const DIGITS_MS = 1000; // a second digit within this time belongs to the first: 1 and then 2 is robot 12
let digits = "";
let digitAtMs = -Infinity;

function chooseByDigit(digit: string): void {
  digits = performance.now() - digitAtMs < DIGITS_MS ? digits + digit : digit;
  digitAtMs = performance.now();
  const ids = scene.peek()?.robots.map(({ id }) => id) ?? [];
  if (!ids.includes(Number(digits))) digits = digit;
  if (ids.includes(Number(digits))) choose(Number(digits));
}

let spaceStops = false; // the last key that went down was the Space of a stop

addEventListener("keydown", (event) => {
  const target = event.target as HTMLElement;
  const typing = target.matches(TYPING);
  if ((event.key === "Escape" && !left(target)) || (event.key === " " && event.shiftKey)) {
    event.preventDefault();
    spaceStops = event.key === " ";
    if (!event.repeat && scene.peek()?.mode !== "replay") order("stop");
    return;
  }
  spaceStops = false;
  if (editing.peek() && !typing && editKey(event)) return;
  if (event.key === "Escape" || typing || event.ctrlKey || event.metaKey || event.altKey) return;
  if (driveKey(event)) return;
  if (editing.peek() && (event.key === "Delete" || event.key === "Backspace")) removePicked();
  const name = (event.shiftKey ? WITH_SHIFT : ALONE)[event.key.toLowerCase()]; // Caps Lock is no Shift
  if (name !== undefined) {
    if (!event.repeat && inControl.peek() && shown.peek()?.allowed.includes(name)) order(name);
  } else if (event.key === "f" || event.key === "F") fitView();
  else if (event.key === "g" || event.key === "G") follow.value = !follow.value;
  else if (event.key === "c" || event.key === "C") showNextCamera();
  else if (event.key === "+" || event.key === "=") zoomBy(1.25);
  else if (event.key === "-") zoomBy(0.8);
  else if (event.key === "," || event.key === ".") stepFrames(event.key === "." ? 1 : -1);
  else if (event.key === " " && scene.peek()?.replay !== undefined && target.tagName !== "BUTTON") {
    event.preventDefault(); // no scrolling
    togglePlay();
  } else if (event.key === "m" || event.key === "M") acknowledgeAlarms();
  else if (/^[0-9]$/.test(event.key)) {
    chooseByDigit(event.key);
  }
  drawSoon();
});

/** Some browsers press a button that has the focus when Space comes up: not after a stop, whichever of its keys comes up first. */
addEventListener("keyup", (event) => event.key === " " && (spaceStops || event.shiftKey) && event.preventDefault());
