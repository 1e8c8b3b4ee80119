/** What the plots show: one row per tenth of a second of the run, five minutes of them, a column per curve. */

import { live, onState, roundTripMs, scene } from "./store";
import type { Scene, Snapshot } from "./wire";

const ROW_S = 0.1;
const MOST_ROWS = 3000;
const SPARE_ROWS = 300; // dropped at a time: shifting arrays for every row would cost more than drawing them

export interface Curve {
  name: string;
  robot?: number; // whose colour it has
  dash?: number[];
  value(state: Snapshot): number | null;
}

export interface Chart {
  id: string;
  title: string;
  unit: string;
  curves: Curve[];
  limit?: number; // drawn as a line, above and, with `both`, below zero
  both?: boolean;
}

function tracking(id: number): number | null {
  const robot = live.robots.get(id);
  if (robot?.news.state?.mode !== "TRACKING") return null;
  return 1e3 * Math.hypot(robot.eta[0]! - robot.reference[0]!, robot.eta[1]! - robot.reference[1]!, robot.eta[2]! - robot.reference[2]!);
}

function formation(a: number, b: number): number | null {
  const [p, q] = [live.robots.get(a), live.robots.get(b)];
  if (p?.news.state?.mode !== "TRACKING" || q?.news.state?.mode !== "TRACKING") return null;
  const off = [0, 1, 2].map((k) => p.eta[k]! - q.eta[k]! - p.reference[k]! + q.reference[k]!);
  return 1e3 * Math.hypot(off[0]!, off[1]!, off[2]!);
}

const state = (id: number) => live.robots.get(id)?.news.state;
const never = (ms: number | undefined) => (ms === undefined || ms <= 0 || ms >= 1e6 ? null : ms);

/** Every chart of a scene; `chosen` is the robot whose inputs and disturbance are shown. */
export function charts(s: Scene, chosen: number): Chart[] {
  const each = (value: (id: number) => number | null): Curve[] =>
    s.robots.map(({ id }) => ({ name: `robot ${id}`, robot: id, value: () => value(id) }));
  const pairs = s.robots.flatMap(({ id, neighbours }) =>
    neighbours.filter((other) => id < other || !s.robots.find((r) => r.id === other)?.neighbours.includes(id)).map((other) => [id, other] as const),
  );
  const share = (k: number) => () => (live.robots.get(chosen)?.wrench[k] ?? 0) / s.limits.wrench[k as 0 | 1 | 2] * 100;
  const gamma = (k: number) => () => (live.robots.get(chosen)?.disturbance[k] ?? 0) * 1e3;
  return [
    { id: "tracking", title: "Tracking error", unit: "mm", curves: each(tracking) },
    {
      id: "formation",
      title: "Formation error",
      unit: "mm",
      curves: pairs.map(([a, b]) => ({ name: `${a}-${b}`, robot: a, dash: [6, 3], value: () => formation(a, b) })),
    },
    {
      id: "inputs",
      title: `Inputs of robot ${chosen}`,
      unit: "% of limit",
      limit: 100,
      both: true,
      curves: ["surge", "heave", "yaw"].map((name, k) => ({ name, value: share(k) })),
    },
    {
      id: "disturbance",
      title: `Disturbance on robot ${chosen}`,
      unit: "mm/s², mrad/s²",
      curves: ["surge", "sway", "heave", "yaw"].map((name, k) => ({ name, value: gamma(k) })),
    },
    {
      id: "solve",
      title: "Control step",
      unit: "ms",
      limit: 500 * s.period_s,
      curves: each((id) => never((state(id)?.step_us ?? 0) * 1e-3)),
    },
    {
      id: "latency",
      title: "Latency per hop",
      unit: "ms",
      curves: [
        { name: "→ pose", value: (seen) => never(seen.localizer?.to_pose_ms) },
        { name: "→ PWM", value: () => never(Math.max(0, ...s.robots.map(({ id }) => state(id)?.to_pwm_ms ?? 0))) },
        { name: "→ station", value: (seen) => never(Math.max(0, ...seen.robots.filter((r) => r.state).map((r) => r.age_ms))) },
        { name: "page and back", value: () => roundTripMs.peek() },
      ],
    },
    { id: "battery", title: "Battery", unit: "V", curves: each((id) => never(state(id)?.battery_v)) },
  ];
}

/** Rows of every curve ever asked for. Keyed by chart, robot and curve, so that changing the choice keeps what there is. */
export const times: number[] = [];
const columns = new Map<string, (number | null)[]>();
let recorded: [string, Curve][] = [];
let runOf = "";

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

onState((snapshot) => {
  const s = scene.peek();
  if (s === null) return;
  const last = times[times.length - 1];
  if (runOf !== s.hash || (last !== undefined && snapshot.time_s < last - 0.5)) {
    runOf = s.hash;
    begin(s);
  } else if (last !== undefined && snapshot.time_s - last < ROW_S) return;
  times.push(snapshot.time_s);
  for (const [name, curve] of recorded) columns.get(name)!.push(curve.value(snapshot));
  if (times.length > MOST_ROWS + SPARE_ROWS) {
    times.splice(0, SPARE_ROWS);
    for (const values of columns.values()) values.splice(0, SPARE_ROWS);
  }
});
