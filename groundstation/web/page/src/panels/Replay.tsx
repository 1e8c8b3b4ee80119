/** Where in a recorded run we are, how fast it goes on, and where something happened in it. */

import { signal } from "@preact/signals";
import { clock, moment, since } from "../clock";
import { say } from "../link";
import { lines, scene, shown } from "../store";
import type { LogLine } from "../wire";

const RATES = [0.25, 0.5, 1, 2, 4, 8, 16];
const WARNING = 3; // levels of the log from here on are marked
const MISSION = /^mission: |^emergency stop|^remark: /;

const pace = signal(1); // of playing, also while it pauses

/** Play or pause. */
export function togglePlay(): void {
  const at = shown.peek()?.replay;
  if (at !== undefined) say({ kind: "seek", rate: at.rate > 0 ? 0 : pace.value });
}

/** Pause, and go `frames` states on or back. */
export function stepFrames(frames: number): void {
  const [at, period_s] = [shown.peek()?.replay, scene.peek()?.period_s];
  if (at !== undefined && period_s !== undefined) say({ kind: "seek", rate: 0, time_s: Math.max(0, at.time_s + frames * period_s) });
}

const APART = 0.012; // of the slider: as wide as a mark
const MOST_TOLD = 12; // lines that a mark's title holds

/** Lines by the mark that they share: marks that lie on one another could not be read nor hit. */
function marks(marked: LogLine[], end_s: number): LogLine[][] {
  const found: LogLine[][] = [];
  for (const line of [...marked].sort((a, b) => a.time_s - b.time_s)) {
    const last = found.at(-1);
    if (last !== undefined && line.time_s - last[0]!.time_s < APART * end_s) last.push(line);
    else found.push([line]);
  }
  return found;
}

function Mark({ of, end_s }: { of: LogLine[]; end_s: number }) {
  const [at_s, level] = [Math.max(0, of[0]!.time_s), Math.max(...of.map((line) => line.level))];
  const told = of.slice(0, MOST_TOLD).map((line) => `${moment(line.time_s, line.began_s)} ${line.source}: ${line.text}`);
  if (of.length > MOST_TOLD) told.push(`and ${of.length - MOST_TOLD} more`);
  return (
    <button
      type="button"
      tabIndex={-1}
      class={level > WARNING ? "mark error" : level === WARNING ? "mark warning" : "mark"}
      style={`left: ${(100 * at_s) / end_s}%`}
      title={told.join("\n")}
      aria-label={`To ${told.join("; ")}`}
      onClick={() => say({ kind: "seek", time_s: at_s })}
    />
  );
}

export function Replay() {
  const s = scene.value;
  const at = shown.value?.replay;
  if (s?.replay === undefined || at === undefined) return null;
  const end_s = s.replay.end_s;
  const marked = lines.value.filter((line) => line.level >= WARNING || MISSION.test(line.text));
  return (
    <section class="replay" aria-label="Replay">
      <button type="button" onClick={togglePlay} title="Space">
        {at.rate > 0 ? "Pause" : "Play"}
      </button>
      <button type="button" class="frame" onClick={() => stepFrames(-1)} title="One state back: ," aria-label="One state back">
        ‹
      </button>
      <button type="button" class="frame" onClick={() => stepFrames(1)} title="One state on: ." aria-label="One state on">
        ›
      </button>
      <span class="clock">{clock(since(at.time_s) ?? 0)}</span>
      <div class="slider">
        <input
          type="range"
          min={0}
          max={end_s}
          step={0.05}
          value={at.time_s}
          aria-label="Time in the run, seconds"
          onInput={(event) => say({ kind: "seek", time_s: event.currentTarget.valueAsNumber })}
        />
        {marks(marked, end_s).map((of, k) => (
          <Mark key={k} of={of} end_s={end_s} />
        ))}
      </div>
      <span class="clock">{clock(since(end_s) ?? 0)}</span>
      <select
        aria-label="Pace"
        value={pace.value}
        onChange={(event) => {
          pace.value = Number(event.currentTarget.value);
          if (at.rate > 0) say({ kind: "seek", rate: pace.value });
        }}
      >
        {RATES.map((rate) => (
          <option key={rate} value={rate}>
            {rate} ×
          </option>
        ))}
      </select>
      {s.report !== "" && (
        <a href={s.report} target="_blank" rel="noopener">
          Report
        </a>
      )}
    </section>
  );
}
