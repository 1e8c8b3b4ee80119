/** Weights and gains, changed while the fleet flies: all robots together, or none; and how well each lap went with which. */

import { signal } from "@preact/signals";
import { useEffect } from "preact/hooks";
import { tune } from "../link";
import { connected, inControl, scene, shown } from "../store";
import type { Knob, Scene, Tuning as Told } from "../wire";

/** What a person has typed and not yet given to the fleet, by key. */
const draft = signal<Record<string, string>>({});

interface Group {
  name: string;
  text: string;
  axes: string[];
  knobs: Knob[];
}

const POSE = ["x", "y", "z", "yaw"];
const WRENCH = ["surge", "heave", "yaw"];
const TEXTS: Record<string, [text: string, axes?: string[]]> = {
  "mpc.q": ["Tracking Q", POSE],
  "mpc.q_formation": ["Formation Q", POSE],
  "mpc.r": ["Inputs R", WRENCH],
  "nmpc.heading_m": ["heading"],
  "nmpc.arm_m": ["steering, smooth yaw"],
  "nmpc.turning_m": ["turning"],
  "nmpc.hold_turning_m": ["turning, HOLD"],
  "estimator.bandwidth_radps": ["observer"],
  "estimator.yaw_bandwidth_radps": ["observer, yaw"],
};
const UNITS: [suffix: string, unit: string][] = [["_radps", "rad/s"], ["_m", "m"]];

/** Knobs by the key of the experiment file: a list is one row. */
function groups(s: Scene): Group[] {
  const found = new Map<string, Group>();
  for (const knob of s.knobs) {
    const [, name = "", index] = /^controller\.(.*?)(?:\.(\d+))?$/.exec(knob.key) ?? [];
    const [text, axes] = TEXTS[name] ?? [name];
    const group = found.get(name) ?? { name, text, axes: axes ?? [], knobs: [] };
    if (index !== undefined && axes === undefined) group.axes.push(index);
    group.knobs.push(knob);
    found.set(name, group);
  }
  return [...found.values()].sort((a, b) => b.knobs.length - a.knobs.length);
}

function unitOf(name: string): string {
  return UNITS.find(([suffix]) => name.endsWith(suffix))?.[1] ?? "";
}

function allowed(knob: Knob): string {
  const [least, most] = [knob.least, knob.most].map((bound) => Number(bound.toPrecision(4)));
  return `${knob.above ? "above" : "from"} ${least} ${knob.below ? "to below" : "to"} ${most}`;
}

/** Meaning and range, as the experiment's reference has them. */
function hint(knob: Knob): string {
  return scene.value?.hints[knob.key.replace(/\.\d+$/, "")] ?? knob.key;
}

/** What a text would set; null is nothing that may be flown. */
function valueOf(knob: Knob, text: string): number | null {
  const value = text.trim() === "" ? NaN : Number(text);
  const high = knob.above ? value > knob.least : value >= knob.least;
  const low = knob.below ? value < knob.most : value <= knob.most;
  return Number.isFinite(value) && high && low ? value : null;
}

const short = (value: number) => String(Number(value.toPrecision(6)));

function Field({ knob, flown, label }: { knob: Knob; flown: number; label: string }) {
  const text = draft.value[knob.key];
  const wrong = text !== undefined && valueOf(knob, text) === null;
  const changed = text !== undefined && !wrong && valueOf(knob, text) !== flown;
  return (
    <input
      inputMode="decimal"
      class={wrong ? "wrong" : changed ? "changed" : ""}
      value={text ?? short(flown)}
      aria-label={label}
      aria-invalid={wrong}
      title={`${hint(knob)}\n${knob.key}: ${allowed(knob)}; flown: ${short(flown)}`}
      onInput={(event) => (draft.value = { ...draft.value, [knob.key]: event.currentTarget.value })}
      onKeyDown={(event) => event.key === "Enter" && event.currentTarget.blur()}
    />
  );
}

/** A letter for each set, in the order in which they came up. */
function letter(told: Told, id: string): string {
  const place = told.known.indexOf(id);
  return place < 0 ? id : place < 26 ? String.fromCharCode(65 + place) : `${place + 1}`;
}

function Laps({ told }: { told: Told }) {
  if (told.laps.length === 0) return null;
  return (
    <table aria-label="Tracking error by lap">
      <thead>
        <tr>
          <th>lap</th>
          <th>set</th>
          <th>flown</th>
          <th>RMS</th>
          <th>largest</th>
        </tr>
      </thead>
      <tbody>
        {told.laps.slice(-6).map((lap) => (
          <tr key={`${lap.n} ${lap.id}`}>
            <td>{lap.n || "-"}</td>
            <td>{letter(told, lap.id)}</td>
            <td>{lap.s.toFixed(0)} s</td>
            <td>{(1e3 * lap.rms).toFixed(1)} mm</td>
            <td>{(1e3 * lap.max).toFixed(1)} mm</td>
          </tr>
        ))}
      </tbody>
    </table>
  );
}

function Fields({ s, told }: { s: Scene; told: Told }) {
  const flown = new Map(s.knobs.map(({ key }, k) => [key, told.values[k] ?? 0]));
  return (
    <div class="knobs">
      {groups(s).map((group) => (
        <div key={group.name} class={group.knobs.length > 1 ? "knob list" : "knob"}>
          <span class="what">
            {group.text} <span class="unit">{unitOf(group.name)}</span>
          </span>
          {group.knobs.map((knob, k) => (
            <label key={knob.key}>
              {group.axes[k] && <span class="unit">{group.axes[k]}</span>}
              <Field knob={knob} flown={flown.get(knob.key)!} label={`${group.text} ${group.axes[k] ?? ""}`.trim()} />
            </label>
          ))}
        </div>
      ))}
    </div>
  );
}

function Buttons({ s, told, changes, wrong }: { s: Scene; told: Told; changes: Record<string, number>; wrong: Knob | undefined }) {
  const busy = told.stage !== "";
  const none = Object.keys(changes).length === 0;
  const why = !connected.value ? "no connection to the station" : !inControl.value ? "you are watching: take control first" : "";
  const cannot = why || (busy ? told.stage : wrong ? `${wrong.key}: ${allowed(wrong)}` : none ? "nothing is changed" : "");
  return (
    <div class="row">
      <button type="button" disabled={cannot !== ""} title={cannot} onClick={() => tune(changes, false)}>
        Apply
      </button>
      {s.path.kind === "circle" && (
        <button type="button" disabled={cannot !== ""} title={cannot || "every robot changes over as the lap begins"} onClick={() => tune(changes, true)}>
          On the next lap
        </button>
      )}
      <button
        type="button"
        disabled={why !== "" || !(told.undo || told.waiting)}
        title={why || (told.waiting ? "do not change after all" : "back to the set before")}
        onClick={() => {
          draft.value = {};
          tune(null, false);
        }}
      >
        Undo
      </button>
      <button type="button" disabled={Object.keys(draft.value).length === 0} onClick={() => (draft.value = {})}>
        Reset
      </button>
    </div>
  );
}

export function Tuning() {
  const s = scene.value;
  const told = shown.value?.tuning;
  useEffect(() => {
    const now = new Map(s?.knobs.map(({ key }, k) => [key, told?.values[k]]));
    draft.value = Object.fromEntries(Object.entries(draft.peek()).filter(([key, text]) => Number(text) !== now.get(key)));
  }, [told?.id]); // what is flown now is no longer a draft
  if (s === null || !told || s.mode === "replay") return null;
  const typed = s.knobs.flatMap((knob, k) => {
    const text = draft.value[knob.key];
    return text === undefined ? [] : [{ knob, value: valueOf(knob, text), flown: told.values[k] }];
  });
  const changes = Object.fromEntries(typed.flatMap(({ knob, value, flown }) => (value === null || value === flown ? [] : [[knob.key, value]])));
  const wrong = typed.find(({ value }) => value === null)?.knob;
  return (
    <details class="tuning">
      <summary>
        <h2>
          Gains <span class="set">set {letter(told, told.id)}</span>
          {told.stage && (
            <span class="stage">
              {letter(told, told.wanted)}: {told.stage}
            </span>
          )}
        </h2>
      </summary>
      <Fields s={s} told={told} />
      {wrong && <p class="no" role="status">{`${wrong.key}: ${allowed(wrong)}`}</p>}
      <Buttons s={s} told={told} changes={changes} wrong={wrong} />
      {told.reason && (
        <p class="no" role="status">
          {told.reason}
        </p>
      )}
      <Laps told={told} />
    </details>
  );
}
