/** Where in a recorded run we are, and how fast it goes on. */

import { say } from "../link";
import { scene, shown } from "../store";
import { clock } from "./Header";

const RATES = [0.25, 0.5, 1, 2, 4, 8, 16];

export function Replay() {
  const s = scene.value;
  const at = shown.value?.replay;
  if (s?.replay === undefined || at === undefined) return null;
  return (
    <section class="replay" aria-label="Replay">
      <button type="button" onClick={() => say({ kind: "seek", rate: at.rate > 0 ? 0 : 1 })}>
        {at.rate > 0 ? "Pause" : "Play"}
      </button>
      <span class="clock">{clock(at.time_s)}</span>
      <input
        type="range"
        min={0}
        max={s.replay.end_s}
        step={0.05}
        value={at.time_s}
        aria-label="Time in the run, seconds"
        onInput={(event) => say({ kind: "seek", time_s: event.currentTarget.valueAsNumber })}
      />
      <span class="clock">{clock(s.replay.end_s)}</span>
      <select aria-label="Pace" value={at.rate > 0 ? at.rate : 1} onChange={(event) => say({ kind: "seek", rate: Number(event.currentTarget.value) })}>
        {RATES.map((rate) => (
          <option key={rate} value={rate}>
            {rate} ×
          </option>
        ))}
      </select>
    </section>
  );
}
