/** What the station sends (groundstation/web/scene.py, snapshot.py, client_hub.py) and what the page may say (protocol.py). */

import { decode } from "@msgpack/msgpack";
import type { LocalizerStatus, Obstacles, Pose, RobotState } from "./messages";

/** float32 values as they lie in a message; `floats` makes them readable. */
export type Packed = Uint8Array;

export interface PathSamples {
  robot: number;
  id: string;
  every_s: number;
  eta: Packed; // rows of [x, y, z, yaw]
}

interface CirclePath {
  kind: "circle";
  diameter_m: number;
  lap_s: number;
  depth_m: number;
}

interface WaypointPath {
  kind: "waypoints";
  points_m: [number, number][];
  speed_mps: number;
  depth_m: number;
  start_index: number;
  laps: number;
  corner: Corner;
  corner_m: number;
  stop: boolean;
}

export type Corner = "smooth" | "round" | "stop";

/** A figure of a plan, the worst of all robots, and what is allowed: at least, of a distance, else at most. */
export interface PlanFigure {
  what: string;
  unit: string;
  value: number;
  limit: number;
  least: boolean;
}

interface RoutePath {
  kind: "route";
  via_m: [number, number][];
  speed_mps: number;
  depth_m: number;
}

export interface Scene {
  name: string;
  title: string;
  mode: "real-time" | "lockstep" | "replay";
  hash: string;
  duration_s: number;
  period_s: number;
  stale_s: number;
  picture_stale_s: number;
  pool_m: [number, number, number];
  walls: boolean;
  hull_m: number;
  safety_m: number;
  margin_m: number;
  limits: {
    wrench: number[]; // surge, heave, yaw, and sway where thrusters push sideways
    speed_mps: number;
    heave_mps: number;
    yaw_rate_radps: number;
    thrust_n: number;
    pulse_us: [number, number, number]; // full reverse, neutral, full ahead
    battery_v: [number, number, number, number]; // neutral, no arming, warning, full
  };
  thrusters: [number, number, number, number][]; // by output: place ahead, to starboard, m; direction of positive thrust
  outputs: number[]; // of the board, from 1, that have a thruster
  islands: [number, number, number][]; // x, y, radius
  robots: { id: number; node_m: [number, number, number]; neighbours: number[] }[];
  path: CirclePath | WaypointPath | RoutePath;
  formation: { mode: "translate" | "rotate"; scale: number; shape: Shape | null; spacing_m: number };
  fields: Field[]; // numbers of a robot's state that can be plotted
  hints: Record<string, string>; // meaning, range and default of keys of the experiment file
  knobs: Knob[]; // of the controller, that may be turned in flight
  paths: PathSamples[];
  cameras: { name: string; underlay: { columns: number; pool: Packed; picture: Packed } | null }[]; // one without a name, or several
  replay?: { begin_s: number; end_s: number };
  run?: string; // the run's folder
  loadable?: string[]; // experiments whose path this run's robots can fly
  report: string; // its address; empty if there is none
  end?: RunEnd | null; // what became of it; none while it is flown
  offers?: ("again" | "edited" | "close")[]; // what may follow an ended run
  problem?: string; // with the run, or with what was chosen after it
  life?: string; // of the station: requests are numbered anew in each
}

/** A number of a robot's state: where it stands there (`control.wrench.0`), and as what it is shown. */
export interface Field {
  path: string;
  title: string;
  unit: string;
}

/** What became of a run, as people read it (groundstation/web/run_desk.py). */
export interface RunEnd {
  verdict: "passed" | "failed" | "not judged";
  cause: string; // empty if it passed
  outcome: string;
  injected: string;
  notes: string[];
  figures: { heads: string[]; rows: { name: string; cells: string[][] }[] }; // x and y in mm under each head
  requirements: { text: string; met: "yes" | "no" | "not reached" }[];
}

/** A number that may be changed in flight. `above`: `least` itself may not be; `below`: nor may `most`. */
export interface Knob {
  key: string;
  value: number;
  least: number;
  most: number;
  above: boolean;
  below: boolean;
}

/** What the fleet flies with, and what it is about to. Values are in the order of the scene's knobs. */
export interface Tuning {
  id: string;
  values: number[];
  wanted: string;
  stage: string;
  waiting: boolean; // for the next lap: it may still be called off
  reason: string;
  undo: boolean;
  known: string[];
  laps: { n: number; id: string; s: number; rms: number; max: number }[];
}

export interface RobotNews {
  id: number;
  age_ms: number;
  state?: RobotState;
  pose?: Pose & { age_ms: number; ellipse: [number, number, number] }; // half axes m and direction of one sigma
  plan?: { age_ms: number; period_s: number; xyz: Packed };
}

type Level = "critical" | "warning" | "notice";
export interface Alarm {
  level: Level;
  key: string;
  robot: number; // whose it is; 0: of the whole system
  text: string;
}

export type OrderName = "load" | "arm" | "start" | "hold" | "resume" | "stop" | "disarm" | "clear-stop" | "return" | "rejoin" | "test" | "end" | "go" | "formation" | "path" | "fault" | "out" | "back-in";

/** What became of a person's request, by the station's account. */
export interface Outcome {
  request: number;
  order: string;
  progress: "UNDER_WAY" | "DONE" | "FAILED";
  reason: string;
  confirmed: number[];
  waiting: { robot: number; why: string }[];
}

export interface Snapshot {
  k: "state";
  stamp_ms: number;
  clock_ms: number; // the station's own, to be told with an order
  holder: number;
  watchers: number;
  time_s: number;
  began_s: number | null; // when the formation's flight began: time 0 for people; null: it has not been started
  mission: string;
  mission_text: string;
  reason: string;
  allowed: OrderName[];
  refused?: Partial<Record<OrderName, string>>; // of those: the reason for which it would be refused now
  preflight: { robot: number; text: string }[];
  stop: boolean;
  alarms: Alarm[];
  present: string[];
  tuning: Tuning | null;
  requests: Outcome[]; // oldest first
  ended: boolean; // the run is over
  next?: "" | "again" | "edited" | "close"; // of an ended run: what a person has chosen
  flown?: string; // name of the experiment whose path is flown, and the path's duration
  flown_s?: number;
  left_s: number; // until the end of the plan that flies, if nothing holds the robots up
  led: { robot: number; text: string }[]; // robots that a person leads one by one
  localizer: (LocalizerStatus & { age_ms: number }) | null;
  obstacles: (Obstacles & { age_ms: number }) | null;
  robots: RobotNews[];
  pace?: number | null; // simulated seconds per second; null by the wall clock and before it is known
  replay?: { time_s: number; rate: number };
  ghosts?: { id: number; eta: Packed }[]; // of the run beside which this one is replayed
}

export interface Tried {
  k: "tried";
  n: number;
  ok: boolean;
  problems: string[];
  paths?: PathSamples[];
  duration_s?: number;
  figures?: PlanFigure[];
  nodes_m?: [number, number, number, number][]; // robot, x, y, z
}

/** What the planner says of another form or path of the formation. */
export interface Drafted {
  k: "drafted";
  n: number;
  ok: boolean;
  problems: string[];
  paths?: PathSamples[];
  figures?: PlanFigure[];
}

/** A line of the log. */
export interface LogLine {
  time_s: number;
  level: number;
  source: string;
  text: string;
  began_s?: number; // of a recorded run: when the flight began from which this is counted
}

/** A row of the past: what plots and trails need of a state. */
export interface PastState {
  time_s: number;
  robots: (Pick<RobotNews, "id" | "age_ms"> & { state?: RobotState })[];
  localizer: Pick<LocalizerStatus & { age_ms: number }, "age_ms" | "frame_age_ms"> | null;
}

/** A run's folder, as its files tell it. */
export interface ListedRun {
  run: string; // its folder
  name: string; // given by a person, as are the tags in `given`; others are of remarks
  tags: string[];
  given: string[];
  date: string;
  experiment: string;
  mode: string;
  duration_s: number;
  size_mb: number;
  verdict: string;
  commit: string;
  report: string; // its address; empty if there is none
  shown: boolean; // it is the one of this page
}

export interface RunList {
  folder: string;
  runs: ListedRun[]; // newest first
  problem: string; // with this page's last request
}

export type Frame =
  | { k: "hello"; you: number; scene: Scene; events: LogLine[] }
  | Snapshot
  | { k: "past"; states: PastState[] }
  | { k: "picture"; stamp_ms: number; clock_ms: number; camera: string; age_ms: number; time_s: number | null; jpeg: Uint8Array<ArrayBuffer> }
  | { k: "paths"; paths: PathSamples[] }
  | ({ k: "event" } & LogLine)
  | { k: "reply"; n: number; order: string; ok: boolean; reason: string; request: number }
  | { k: "undriven"; robot: number; reason: string }
  | Tried
  | Drafted
  | { k: "chosen"; n: number; problems: string[] }
  | ({ k: "runs" } & RunList)
  | { k: "saved"; n: number; ok: boolean; problems: string[]; path?: string };

export interface Edit {
  pool_m?: [number, number, number];
  islands_m?: [number, number, number][];
  kind?: "circle" | "waypoints" | "route";
  points_m?: [number, number][];
  start_index?: number;
  speed_mps?: number;
  laps?: number;
  corner?: Corner;
  corner_m?: number;
  stop?: boolean;
  diameter_m?: number;
  lap_s?: number;
  depth_m?: number;
  duration_s?: number;
  mode?: "translate" | "rotate";
  scale?: number;
  robots?: number[];
  nodes_m?: Record<string, [number, number, number]>;
  shape?: Shape;
  spacing_m?: number;
}

export type Shape = "line" | "column" | "triangle" | "diamond" | "circle";

export type Request =
  | { kind: "hello"; token: string; page: string; camera: string }
  | { kind: "camera"; camera: string }
  | { kind: "ack"; n: number }
  | { kind: "take"; over?: boolean }
  | { kind: "release" }
  | { kind: "order"; n: number; order: OrderName; via_m?: [number, number][]; robot?: number; text?: string; edit?: Edit; seen_ms: number }
  | { kind: "draft"; n: number; order: "formation" | "path"; text: string }
  | { kind: "drive"; robot: number; surge_mps: number; heave_mps: number; yaw_rate_radps: number; seen_ms: number }
  | { kind: "tune"; n: number; values: Record<string, number> | null; next_lap: boolean; seen_ms: number }
  | { kind: "try"; n: number; edit: Edit }
  | { kind: "save"; n: number; edit: Edit; name: string }
  | { kind: "after"; n: number; what: "again" | "edited" | "close"; edit?: Edit }
  | { kind: "remark"; text: string }
  | { kind: "runs" }
  | { kind: "label"; run: string; name: string; tags: string[] }
  | { kind: "delete"; run: string }
  | { kind: "seek"; time_s?: number; rate?: number };

const HEAD_BYTES = 8;

interface Received {
  n: number;
  roundTripMs: number;
  frame: Frame;
}

/** A frame off the wire: u32 number, f32 round trip in ms, MessagePack. */
export function read(data: ArrayBuffer): Received {
  const head = new DataView(data, 0, HEAD_BYTES);
  const frame = decode(new Uint8Array(data, HEAD_BYTES)) as Frame;
  return { n: head.getUint32(0, true), roundTripMs: head.getFloat32(4, true), frame };
}

/** Packed numbers as an array. Copied: in a message they lie where float32 may not be read. */
export function floats(packed: Packed): Float32Array {
  return new Float32Array(packed.slice().buffer);
}
