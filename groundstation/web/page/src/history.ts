/** What the plots show: one row per tenth of a second since the page connected and the station's own rows before, a column per curve. Of a
 * recorded run, the whole run from the first. */

import { began, since } from "./clock";
import { fieldOf, valueAt } from "./fields";
import type { RobotState } from "./messages";
import { isAlone, isLocated, onSamples, type Sample, scene, shown } from "./store";
import type { Scene } from "./wire";

const ROW_S = 0.1;
const MOST_ROWS = 6000; // ten minutes
const COARSE_S = 0.5; // between the whole states that are kept, for a field that somebody asks for later: in fleets of up to three
const COARSE_ROBOTS = 3600;
const OLD_MS = 1000; // of silence: what was said before draws nothing, or a curve would go on as if it were heard
const SPARE_ROWS = 300; // dropped at a time: shifting arrays for every row would cost more than drawing them

const AT_REST = ["WAITING", "LOADING", "ARMING", "STOPPED", "DONE", "CANCELLED", "FAILED"]; // no flight is under way
const FLIES = ["ARMED", "TRACKING", "HOLDING", "DRIVEN"];
const WAIT_SHOWN_S = 60;
let flew_s = -Infinity; // the last time at which a robot flew

/** What plots show by themselves, of rows from `first_s` to `last_s`: the flight, and before one the last minute. */
export function flight(first_s: number, last_s: number): [from_s: number, to_s: number] {
  const [from_s, to_s] = [Math.max(began() ?? Infinity, first_s), Math.min(flew_s, last_s)];
  return from_s < to_s ? [from_s, to_s] : [last_s - WAIT_SHOWN_S, last_s];
}

/** How long the formation has been flying; it stands when the flight is over. Null while nothing has been started. */
export function flown(): number | null {
  const state = shown.value;
  if (state === null) return null;
  const at_s = state.replay?.time_s ?? (AT_REST.includes(state.mission) ? flew_s : state.time_s);
  return Number.isFinite(at_s) ? since(at_s) : null;
}

/** The end of what the clock shows, by the clock: of a recorded run its end, under way that of the plan, before a flight what is planned.
 * Null after a flight: nothing goes on. */
export function planned(): number | null {
  const [s, state] = [scene.value, shown.value];
  if (s === null || state === null) return null;
  if (s.replay) return since(s.replay.end_s);
  const time_s = flown();
  if (time_s === null) return state.flown_s || s.duration_s;
  return AT_REST.includes(state.mission) ? null : Math.max(time_s, 0) + state.left_s;
}

interface Curve {
  name: string;
  robot?: number; // whose colour it has
  dash?: number[];
  value(sample: Sample): number | null;
}

export interface Chart {
  id: string;
  title: string;
  unit: string;
  curves: Curve[];
  limit?: number; // drawn as a line, above and, with `both`, below zero
  both?: boolean;
}

/** A robot of a sample, if it was heard then. */
function heard(sample: Sample, id: number) {
  const robot = sample.robots.get(id);
  return robot?.news.state !== undefined && robot.news.age_ms <= OLD_MS ? robot : undefined;
}

function tracking(sample: Sample, id: number): number | null {
  const robot = heard(sample, id);
  if (robot?.news.state?.mode !== "TRACKING" || !isLocated(robot)) return null;
  return 1e3 * Math.hypot(robot.eta[0]! - robot.reference[0]!, robot.eta[1]! - robot.reference[1]!, robot.eta[2]! - robot.reference[2]!);
}

function formation(sample: Sample, a: number, b: number): number | null {
  const [p, q] = [heard(sample, a), heard(sample, b)];
  if (p?.news.state?.mode !== "TRACKING" || q?.news.state?.mode !== "TRACKING") return null;
  if (!isLocated(p) || !isLocated(q)) return null;
  if (isAlone(p.news.state) || isAlone(q.news.state)) return null; // they are in no formation
  const off = [0, 1, 2].map((k) => p.eta[k]! - q.eta[k]! - p.reference[k]! + q.reference[k]!);
  return 1e3 * Math.hypot(off[0]!, off[1]!, off[2]!);
}

const state = (sample: Sample, id: number) => heard(sample, id)?.news.state;
const never = (ms: number | undefined) => (ms === undefined || ms <= 0 || ms >= 1e6 ? null : ms);

/** Every chart of a scene; `chosen` is the robot whose inputs and disturbance are shown. */
export function charts(s: Scene, chosen: number): Chart[] {
  const each = (value: (sample: Sample, id: number) => number | null): Curve[] =>
    s.robots.map(({ id }) => ({ name: `robot ${id}`, robot: id, value: (sample) => value(sample, id) }));
  const pairs = s.robots.flatMap(({ id, neighbours }) =>
    neighbours.filter((other) => id < other || !s.robots.find((r) => r.id === other)?.neighbours.includes(id)).map((other) => [id, other] as const),
  );
  const scaled = (value: number | undefined, by: number) => (value === undefined ? null : value * by);
  const share = (k: number) => (sample: Sample) => scaled(heard(sample, chosen)?.wrench[k], 100 / s.limits.wrench[k]!);
  const gamma = (k: number) => (sample: Sample) => scaled(heard(sample, chosen)?.disturbance[k], 1e3);
  return [
    { id: "tracking", title: "Tracking error", unit: "mm", curves: each(tracking) },
    {
      id: "formation",
      title: "Formation error",
      unit: "mm",
      curves: pairs.map(([a, b]) => ({ name: `${a}-${b}`, robot: a, dash: [6, 3], value: (sample) => formation(sample, a, b) })),
    },
    {
      id: "inputs",
      title: `Robot ${chosen}: inputs`,
      unit: "% of limit",
      limit: 100,
      both: true,
      curves: ["surge", "heave", "yaw", "sway"].slice(0, s.limits.wrench.length).map((name, k) => ({ name, value: share(k) })),
    },
    {
      id: "disturbance",
      title: `Robot ${chosen}: disturbance`,
      unit: "mm/s², mrad/s²",
      curves: ["surge", "sway", "heave", "yaw"].map((name, k) => ({ name, value: gamma(k) })),
    },
    {
      id: "solve",
      title: "Control step",
      unit: "ms",
      limit: 500 * s.period_s,
      curves: each((sample, id) => never((state(sample, id)?.timing.step_us ?? 0) * 1e-3)),
    },
    {
      id: "latency",
      title: "Latency per hop",
      unit: "ms",
      curves: [
        { name: "→ pose", value: ({ localizer }) => never(localizer && localizer.age_ms <= OLD_MS ? localizer.frame_age_ms : undefined) },
        { name: "→ PWM", value: (sample) => never(Math.max(0, ...s.robots.map(({ id }) => state(sample, id)?.timing.exposure_to_pwm_ms ?? 0))) },
        { name: "→ station", value: ({ robots }) => never(Math.max(0, ...[...robots.values()].filter((r) => r.news.state).map((r) => r.news.age_ms))) },
        { name: "↔ page", value: (sample) => sample.roundTripMs },
      ],
    },
    { id: "battery", title: "Battery", unit: "V", curves: each((sample, id) => never(state(sample, id)?.board?.battery_v)) },
  ];
}

/** A chart of one field of the robots' states, every robot a curve. Undefined for an id that is none. */
export function fieldChart(s: Scene, id: string): Chart | undefined {
  const field = fieldOf(s, id);
  if (field === undefined) return undefined;
  const curves = s.robots.map(({ id: robot }) => ({ name: `robot ${robot}`, robot, value: (sample: Sample) => at(field.path, state(sample, robot)) }));
  return { id, title: field.title, unit: field.unit, both: true, curves };
}

function at(path: string, from: RobotState | undefined): number | null {
  const value = from === undefined ? undefined : valueAt(from, path);
  return value === undefined || !Number.isFinite(value) ? null : value;
}

/** Record a chart from now on, and what is known of it from before. */
export function record(chart: Chart, chosen: number): void {
  for (const curve of chart.curves) {
    const name = key(chart, curve, chosen);
    if (columns.has(name)) continue;
    let k = 0;
    columns.set(name, times.map((t) => {
      while (k + 1 < coarse.length && coarse[k + 1]!.time_s <= t) k += 1;
      const row = coarse[k];
      return row !== undefined && Math.abs(t - row.time_s) <= 1.5 * coarse_s ? curve.value(row) : null;
    }));
    recorded.push([name, curve]);
  }
}

/** Rows of every curve ever asked for. Keyed by chart, robot and curve, so that changing the choice keeps what there is. */
export const times: number[] = [];
const columns = new Map<string, (number | null)[]>();
let recorded: [string, Curve][] = [];
let coarse: Sample[] = [];
let coarse_s = COARSE_S;

function key(chart: Chart, curve: Curve, chosen: number): string {
  return `${chart.id}/${chart.id === "inputs" || chart.id === "disturbance" ? chosen : ""}/${curve.name}`;
}

export function column(chart: Chart, curve: Curve, chosen: number): (number | null)[] {
  return columns.get(key(chart, curve, chosen)) ?? times.map(() => null);
}

function begin(s: Scene): void {
  times.length = 0;
  columns.clear();
  recorded = [];
  coarse = [];
  flew_s = -Infinity;
  coarse_s = Math.max(COARSE_S, (MOST_ROWS * ROW_S * s.robots.length) / COARSE_ROBOTS);
  for (const { id } of s.robots) {
    for (const chart of charts(s, id)) {
      for (const curve of chart.curves) {
        const name = key(chart, curve, id);
        if (columns.has(name)) continue;
        columns.set(name, []);
        recorded.push([name, curve]);
      }
    }
  }
}

function add(sample: Sample): void {
  times.push(sample.time_s);
  if ([...sample.robots.keys()].some((id) => FLIES.includes(state(sample, id)?.mode ?? ""))) flew_s = sample.time_s;
  if (coarse.length === 0 || sample.time_s - coarse.at(-1)!.time_s >= coarse_s) coarse.push({ ...sample, robots: new Map(sample.robots) });
  for (const [name, curve] of recorded) columns.get(name)!.push(curve.value(sample));
  if (times.length > MOST_ROWS + SPARE_ROWS) {
    times.splice(0, SPARE_ROWS);
    coarse = coarse.filter(({ time_s }) => time_s >= times[0]!);
    for (const values of columns.values()) values.splice(0, SPARE_ROWS);
  }
}

onSamples(
  (sample) => {
    const s = scene.peek();
    if (s === null || s.replay !== undefined) return;
    const last = times[times.length - 1];
    if (last !== undefined && sample.time_s < last - 0.5) begin(s); // another run
    else if (last !== undefined && sample.time_s - last < ROW_S) return;
    add(sample);
  },
  (samples) => {
    begin(scene.peek()!); // said with the scene
    samples.forEach(add);
  },
);
