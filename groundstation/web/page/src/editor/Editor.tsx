/** Pool, path, formation and robots by number and by name; dragging happens on the map. */

import { signal } from "@preact/signals";
import { nextSerial, order, say } from "../link";
import { NumberInput } from "../NumberInput";
import { after } from "../panels/End";
import { Figures } from "../panels/Figures";
import { chosen, connected, inControl, saved, scene, shown, tried } from "../store";
import { adding, pickedName, removePicked } from "./canvas";
import type { Corner } from "../wire";
import type { Draft, PathKind } from "./model";
import { change, draft, freed, ofKind, play, playhead, redo, redoable, reset, rotate, saveNumber, SHAPES, toEdit, undo, undoable, verdict, withRobot } from "./model";

const name = signal("");
const turned = signal(0);

interface Field {
  text: string;
  of: string; // the key of the experiment file
  unit: string;
  value: number;
  step: number;
  min?: number;
  onChange: (value: number) => void;
}

const hint = (key: string) => scene.value?.hints[key] ?? key;

function Number_({ text, of, unit, value, step, min, onChange }: Field) {
  return (
    <label class="number" title={hint(of)}>
      <span>{text}</span>
      <NumberInput value={value} step={step} {...(min === undefined ? {} : { min })} onNumber={onChange} />
      <span class="unit">{unit}</span>
    </label>
  );
}

function Verdict() {
  const answer = verdict.value;
  if (answer === null) return <p class="verdict">{connected.value ? "asking the planner ..." : "no connection: the planner cannot be asked"}</p>;
  if (answer.ok) {
    return (
      <div class="verdict ok">
        <p role="status">
          <b>✓</b> can be flown
        </p>
        <Figures figures={answer.figures ?? []} />
      </div>
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
  const answer = saved.value?.n === saveNumber.value ? saved.value : null; // of an earlier draft nothing is said
  const good = /^[a-z0-9][a-z0-9-]{0,63}$/.test(name.value);
  const d = draft.value;
  return (
    <form
      class="save"
      onSubmit={(event) => {
        event.preventDefault();
        if (d === null) return;
        saveNumber.value = nextSerial();
        say({ kind: "save", n: saveNumber.value, edit: toEdit(d), name: name.value });
      }}
    >
      <input
        aria-label="Name of the new experiment"
        placeholder="name-of-experiment"
        value={name.value}
        onInput={(event) => (name.value = event.currentTarget.value)}
      />
      <button type="submit" disabled={!good || !inControl.value || !verdict.value?.ok} title={inControl.value ? "" : "take control first"}>
        Save
      </button>
      {answer !== null && (
        <p class={answer.ok ? "ok" : "bad"} role="status">
          {answer.ok ? `saved: ${answer.path}; fly it with groundstation run, in software with sim-bridge sil` : answer.problems.join("; ")}
        </p>
      )}
    </form>
  );
}

/** What of an edit the robots that run cannot have; empty if there is nothing of the kind. */
function foreign(d: Draft): string {
  const s = scene.value!;
  const same = (a: unknown, b: unknown) => JSON.stringify(a) === JSON.stringify(b);
  if (!same([...d.nodes.keys()], s.robots.map(({ id }) => id))) return "another fleet: save it, and start it as a run of its own";
  return same(d.pool, s.pool_m) && same(d.islands, s.islands) ? "" : "another pool: save it, and start it as a run of its own";
}

/** In a run: the robots fly the edited path, from a hold at once, at rest with the next start. */
function FlyHere({ d }: { d: Draft }) {
  const state = shown.value;
  if (state === null || scene.value?.mode === "replay") return null;
  const cannot = !inControl.value ? "take control first" : !state.allowed.includes("path") ? "not under way: Hold first" : !verdict.value?.ok ? "it cannot be flown" : foreign(d);
  return (
    <button type="button" class="order start" disabled={cannot !== ""} title={cannot || "its path and places, in this run"} onClick={() => order("path", [], 0, "", "as edited", toEdit(d))}>
      Fly this here
    </button>
  );
}

/** After a run: fly the edit, without a file of its own. */
function FlyNow({ d }: { d: Draft }) {
  if (!scene.value?.offers?.includes("edited")) return null;
  return (
    <button type="button" class="order start" disabled={!verdict.value?.ok || !inControl.value || chosen.value} title={inControl.value ? "" : "take control first"} onClick={() => after("edited", toEdit(d))}>
      Fly this
    </button>
  );
}

/** Undo and redo, the preview, and what a click on the free map adds. */
function Tools({ d }: { d: Draft }) {
  const name = pickedName(d);
  const toggle = (what: "point" | "island") => (adding.value = adding.value === what ? "" : what);
  return (
    <>
      <div class="row">
        <button type="button" disabled={undoable.value === 0} onClick={undo} title="Ctrl+Z">
          Undo
        </button>
        <button type="button" disabled={redoable.value === 0} onClick={redo} title="Ctrl+Shift+Z, Ctrl+Y">
          Redo
        </button>
        <button type="button" onClick={play} disabled={!tried.value?.paths}>
          {playhead.value === null ? "Preview" : `${playhead.value.toFixed(0)} s of ${(tried.value?.duration_s ?? d.duration).toFixed(0)}`}
        </button>
      </div>
      <div class="row">
        {d.kind !== "circle" && (
          <button type="button" aria-pressed={adding.value === "point"} onClick={() => toggle("point")} title="Each click on the free map adds one">
            Add waypoints
          </button>
        )}
        <button type="button" aria-pressed={adding.value === "island"} onClick={() => toggle("island")} title="Each click on the free map adds one">
          Add islands
        </button>
        <button type="button" onClick={() => change(withRobot(d))}>
          Add robot
        </button>
        <button type="button" disabled={name === ""} onClick={removePicked} title="Delete: what was touched last on the map">
          Remove {name}
        </button>
      </div>
    </>
  );
}

/** Laps, and what happens between waypoints and at the last one. */
function WaypointFields({ d }: { d: Draft }) {
  return (
    <>
      <Number_ text="laps" of="path.laps" unit="" step={1} min={1} value={d.laps} onChange={(laps) => change({ ...d, laps: Math.max(1, Math.round(laps)) })} />
      <label class="number" title={hint("path.corner")}>
        <span>corners</span>
        <select value={d.corner} onChange={(event) => change({ ...d, corner: event.currentTarget.value as Corner })}>
          <option value="smooth">smooth curve</option>
          <option value="round">round</option>
          <option value="stop">stop and turn</option>
        </select>
      </label>
      {d.corner === "round" && (
        <Number_ text="corners begin" of="path.corner_m" unit="m" step={0.05} min={0.05} value={d.cornerReach} onChange={(cornerReach) => change({ ...d, cornerReach })} />
      )}
      <label class="number" title={hint("path.stop")}>
        <span>stops at the end</span>
        <input type="checkbox" checked={d.stops} onChange={(event) => change({ ...d, stops: event.currentTarget.checked })} />
      </label>
    </>
  );
}

function PathFields({ d }: { d: Draft }) {
  return (
    <>
      <label class="number" title={hint("path.kind")}>
        <span>kind</span>
        <select value={d.kind} onChange={(event) => change(ofKind(d, event.currentTarget.value as PathKind))}>
          <option value="circle">circle</option>
          <option value="waypoints">waypoints</option>
          <option value="route">route: the shortest clear way</option>
        </select>
      </label>
      {d.kind === "circle" ? (
        <>
          <Number_ text="diameter" of="path.diameter_m" unit="m" step={0.05} min={0} value={d.diameter} onChange={(diameter) => change({ ...d, diameter })} />
          <Number_ text="one lap" of="path.lap_s" unit="s" step={5} min={1} value={d.lap} onChange={(lap) => change({ ...d, lap })} />
        </>
      ) : (
        <Number_ text="speed" of="path.speed_mps" unit="m/s" step={0.01} min={0} value={d.speed} onChange={(speed) => change({ ...d, speed })} />
      )}
      {d.kind === "waypoints" && <WaypointFields d={d} />}
      <Number_ text="depth" of="path.depth_m" unit="m" step={0.05} min={0} value={d.depth} onChange={(depth) => change({ ...d, depth })} />
      <Number_ text="duration" of="duration_s" unit="s" step={5} min={1} value={d.duration} onChange={(duration) => change({ ...d, duration })} />
    </>
  );
}

function FormationFields({ d }: { d: Draft }) {
  return (
    <>
      <label class="number" title={hint("formation.shape")}>
        <span>shape</span>
        <select value={d.shape} onChange={(event) => change({ ...freed(d), shape: event.currentTarget.value as Draft["shape"] })}>
          <option value="">own places</option>
          {SHAPES.map((shape) => (
            <option key={shape}>{shape}</option>
          ))}
        </select>
      </label>
      {d.shape !== "" && (
        <Number_ text="spacing" of="formation.spacing_m" unit="m" step={0.05} min={0} value={d.spacing} onChange={(spacing) => change({ ...d, spacing })} />
      )}
      <label class="number" title={hint("formation.mode")}>
        <span>turns with the path</span>
        <input type="checkbox" checked={d.mode === "rotate"} onChange={(event) => change({ ...d, mode: event.currentTarget.checked ? "rotate" : "translate" })} />
      </label>
      <label class="number" title={hint("formation.scale")}>
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
    </>
  );
}

export function Editor() {
  const d = draft.value;
  if (d === null || scene.value === null) return null;
  const side = (k: 0 | 1 | 2, text: string) => (
    <Number_
      text={text}
      of="pool.size_m"
      unit="m"
      step={0.1}
      min={0.1}
      value={d.pool[k]}
      onChange={(to) => change({ ...d, pool: d.pool.map((old, axis) => (axis === k ? to : old)) as Draft["pool"] })}
    />
  );
  return (
    <section class="editor" aria-label="Editor of the next run">
      <h2>
        Next run
        <button type="button" onClick={reset}>
          Reset
        </button>
      </h2>
      <p class="hint">Drag waypoints, robots' places, islands, their shores and the pool's corner on the map. Nothing here moves a robot.</p>
      <FlyHere d={d} />
      <FlyNow d={d} />
      <Verdict />
      <Tools d={d} />
      <h3>Path</h3>
      <PathFields d={d} />
      <h3>Formation</h3>
      <FormationFields d={d} />
      <h3>Pool</h3>
      {side(0, "length (x)")}
      {side(1, "width (y)")}
      {side(2, "depth (z)")}
      <h3>Keep it</h3>
      <SaveForm />
    </section>
  );
}
