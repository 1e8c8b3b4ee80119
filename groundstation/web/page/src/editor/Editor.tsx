/** Path and formation by number and by shape; dragging happens on the map. */

import { signal } from "@preact/signals";
import { nextSerial, say } from "../link";
import { inControl, saved, scene, tried } from "../store";
import { change, draft, play, playhead, reset, rotate, SHAPES, shaped, toEdit } from "./model";

const name = signal("");
const turned = signal(0);
const ORIGIN: [number, number] = [0, 0];

function Number_({ text, unit, value, step, min, onChange }: { text: string; unit: string; value: number; step: number; min?: number; onChange: (value: number) => void }) {
  return (
    <label class="number">
      <span>{text}</span>
      <input
        type="number"
        value={Number(value.toFixed(4))}
        step={step}
        {...(min === undefined ? {} : { min })}
        onInput={(event) => Number.isFinite(event.currentTarget.valueAsNumber) && onChange(event.currentTarget.valueAsNumber)}
      />
      <span class="unit">{unit}</span>
    </label>
  );
}

function Verdict() {
  const answer = tried.value;
  if (answer === null) return <p class="verdict">asking the planner ...</p>;
  if (answer.ok) {
    return (
      <p class="verdict ok" role="status">
        <b>✓</b> can be flown: closest {answer.clearance_m! > 999 ? "-" : `${answer.clearance_m!.toFixed(2)} m`} (needs {answer.needed_m!.toFixed(2)}), fastest{" "}
        {answer.fastest_mps!.toFixed(2)} m/s
      </p>
    );
  }
  return (
    <div class="verdict bad" role="status">
      <b>✕</b> cannot be flown
      <ul>
        {answer.problems.slice(0, 5).map((problem) => (
          <li key={problem}>{problem}</li>
        ))}
        {answer.problems.length > 5 && <li>and {answer.problems.length - 5} more</li>}
      </ul>
    </div>
  );
}

function SaveForm() {
  const answer = saved.value;
  const good = /^[a-z0-9][a-z0-9-]{0,63}$/.test(name.value);
  const d = draft.value;
  return (
    <form
      class="save"
      onSubmit={(event) => {
        event.preventDefault();
        if (d !== null) say({ kind: "save", n: nextSerial(), edit: toEdit(d), name: name.value });
      }}
    >
      <input
        aria-label="Name of the new experiment"
        placeholder="name-of-experiment"
        value={name.value}
        onInput={(event) => (name.value = event.currentTarget.value)}
      />
      <button type="submit" disabled={!good || !inControl.value || !tried.value?.ok} title={inControl.value ? "" : "take control first"}>
        Save
      </button>
      {answer !== null && (
        <p class={answer.ok ? "ok" : "bad"} role="status">
          {answer.ok ? `saved: groundstation run ${answer.path}` : answer.problems.join("; ")}
        </p>
      )}
    </form>
  );
}

export function Editor() {
  const d = draft.value;
  const s = scene.value;
  if (d === null || s === null) return null;
  return (
    <section class="editor" aria-label="Editor of path and formation">
      <h2>
        Next run
        <button type="button" onClick={reset}>
          Reset
        </button>
      </h2>
      <p class="hint">Drag {d.kind === "waypoints" ? "the numbered waypoints and " : ""}the robots' places on the map. Nothing here moves a robot.</p>
      <Verdict />
      <div class="row">
        <button type="button" onClick={play} disabled={!tried.value?.paths}>
          {playhead.value === null ? "Preview" : `${playhead.value.toFixed(0)} s of ${d.duration.toFixed(0)}`}
        </button>
      </div>
      <h3>Path</h3>
      {d.kind === "circle" ? (
        <>
          <Number_ text="diameter" unit="m" step={0.05} min={0} value={d.diameter} onChange={(diameter) => change({ ...d, diameter })} />
          <Number_ text="one lap" unit="s" step={5} min={1} value={d.lap} onChange={(lap) => change({ ...d, lap })} />
        </>
      ) : (
        <>
          <Number_ text="speed" unit="m/s" step={0.01} min={0} value={d.speed} onChange={(speed) => change({ ...d, speed })} />
          {d.kind === "waypoints" && (
            <div class="row">
              <button type="button" onClick={() => change({ ...d, points: [...d.points, beyond(d.points)] })}>
                Add waypoint
              </button>
              <button type="button" disabled={d.points.length < d.start + 3} onClick={() => change({ ...d, points: d.points.slice(0, -1) })}>
                Remove last
              </button>
            </div>
          )}
        </>
      )}
      <Number_ text="depth" unit="m" step={0.05} min={0} value={d.depth} onChange={(depth) => change({ ...d, depth })} />
      <Number_ text="duration" unit="s" step={5} min={1} value={d.duration} onChange={(duration) => change({ ...d, duration })} />
      <h3>Formation</h3>
      <label class="number">
        <span>shape</span>
        <select
          value=""
          onChange={(event) => {
            change(shaped(d, event.currentTarget.value, 2 * s.safety_m + 0.2));
            event.currentTarget.value = "";
          }}
        >
          <option value="">choose …</option>
          {Object.keys(SHAPES).map((shape) => (
            <option key={shape}>{shape}</option>
          ))}
        </select>
      </label>
      <label class="number">
        <span>turns with the path</span>
        <input type="checkbox" checked={d.mode === "rotate"} onChange={(event) => change({ ...d, mode: event.currentTarget.checked ? "rotate" : "translate" })} />
      </label>
      <label class="number">
        <span>scale</span>
        <input type="range" min={0.5} max={3} step={0.01} value={d.scale} onInput={(event) => change({ ...d, scale: event.currentTarget.valueAsNumber })} />
        <span class="unit">{d.scale.toFixed(2)}</span>
      </label>
      <label class="number">
        <span>turn</span>
        <input
          type="range"
          min={-180}
          max={180}
          step={1}
          value={turned.value}
          onInput={(event) => {
            const to = event.currentTarget.valueAsNumber;
            change(rotate(d, ((to - turned.value) * Math.PI) / 180));
            turned.value = to;
          }}
        />
        <span class="unit">{turned.value}°</span>
      </label>
      <h3>Keep it</h3>
      <SaveForm />
    </section>
  );
}

/** A new waypoint goes on in the direction of the last two. */
function beyond(points: [number, number][]): [number, number] {
  const a = points.at(-2) ?? ORIGIN;
  const b = points.at(-1) ?? ORIGIN;
  const length = Math.hypot(b[0] - a[0], b[1] - a[1]) || 1;
  return [b[0] + (0.5 * (b[0] - a[0])) / length, b[1] + (0.5 * (b[1] - a[1])) / length];
}
