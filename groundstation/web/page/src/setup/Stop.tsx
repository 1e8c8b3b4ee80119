/** The emergency stop of the fleet, for whoever sees a robot go wrong while this page is open: that of every station of this machine. */

import { signal } from "@preact/signals";
import { ask } from "./api";

const TOLD_WITHIN_MS = 6000; // the program tells within 5 s what it has reached
const said = signal("");
let asked = false; // a stop is under way; a second one would tell nothing new

export async function stop(): Promise<void> {
  if (asked) return;
  asked = true;
  said.value = "emergency stop: asked";
  const late = setTimeout(() => {
    said.value = "emergency stop: no answer, press again, or run groundstation stop";
    asked = false;
  }, TOLD_WITHIN_MS);
  const answer = await ask<string>("stop");
  clearTimeout(late);
  said.value = answer === undefined ? "emergency stop: NOT HEARD, press again, or run groundstation stop" : `${answer} (at ${new Date().toTimeString().slice(0, 8)})`; // it stays there, and is old then
  asked = false;
}

addEventListener("keydown", (event) => {
  if (event.key !== " " || !event.shiftKey) return;
  event.preventDefault();
  if (!event.repeat) void stop();
});

export function Stop() {
  return (
    <>
      <button
        type="button"
        class="stop"
        onPointerDown={() => void stop()} // not when it comes up: a hand may have slipped by then
        onClick={(event) => event.detail === 0 && void stop()}
        aria-keyshortcuts="Shift+Space"
        title="Emergency stop of every station of this machine: Shift+Space"
      >
        EMERGENCY STOP
      </button>
      {said.value !== "" && (
        <p class="stop-said" role="alert">
          {said.value}
        </p>
      )}
    </>
  );
}
