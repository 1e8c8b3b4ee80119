/** Everything the page knows, in one place. What the canvas draws is plain data; what text shows are signals. */

import { computed, signal } from "@preact/signals";
import type { RobotState } from "./messages";
import type { Alarm, Drafted, Frame, LogLine, OrderName, Outcome, PastState, PathSamples, RobotNews, RunList, Scene, Snapshot, Tried } from "./wire";
import { floats } from "./wire";

const MOST_LINES = 500;
const SHOW_EVERY_MS = 200; // people cannot read faster; the canvas draws every state
const SHOW_MANY_EVERY_MS = 400; // nor so many
const MANY = 16;
const TICK_MS = 300;
const GONE_AFTER_MS = 90_000; // of silence after a run's end: a report of an hour's run takes a minute on a slow machine
const MOST_DRIFT = 2e-4; // of two computers' clocks from one another
const ANSWER_WITHIN_MS = 1000; // then nobody seems to have heard

/** One robot, unpacked for drawing. */
export interface Robot {
  news: RobotNews;
  eta: Float32Array; // x, y, z, yaw
  nu: Float32Array;
  reference: Float32Array;
  disturbance: Float32Array;
  wrench: Float32Array;
  horizon: Float32Array; // rows of x, y, z
  sentMs: number; // by the page's clock
}

/** What plots and trails are made of: a state as it came, or a row of the past. */
export interface Sample {
  time_s: number;
  robots: Map<number, Pick<Robot, "eta" | "reference" | "disturbance" | "wrench"> & { news: { age_ms: number; state?: RobotState } }>;
  localizer: PastState["localizer"];
  roundTripMs: number | null; // of the page itself: not known of the past
}

/** A request of this page. `heard`: the station has answered it; what became of it then, the station tells under its number. */
export interface Given {
  n: number;
  order: string;
  atMs: number;
  heard: boolean;
  refusal: string;
  request: number;
  outcome: Outcome | null; // as last told
}

export const scene = signal<Scene | null>(null);
const me = signal(0);
export const shown = signal<Snapshot | null>(null); // at a pace for reading
/** Whether the station is heard now. A connection over which nothing has come for SILENT_MS is none, whatever the browser thinks of it. */
export const connected = signal(false);
export const refusal = signal(""); // why the station does not let us in
export const roundTripMs = signal(0);
export const now = signal(performance.now());
export const lines = signal<LogLine[]>([]);
export const given = signal<Given[]>([]);
export const selected = signal(0); // robot; 0 is none
export const also = signal<ReadonlySet<number>>(new Set()); // robots that are chosen besides: what several may do, all of them do
export const tried = signal<Tried | null>(null);
export const drafted = signal<Drafted | null>(null); // the answer about another form or path
export const saved = signal<{ n: number; ok: boolean; problems: string[]; path?: string } | null>(null);
export const editing = signal(false);
export const browsing = signal(false); // the list of runs is open
export const runs = signal<RunList | null>(null); // as last told
/** The camera whose picture a person wants to see; a choice is remembered. */
export const wantedCamera = signal(localStorage.getItem("camera") ?? "");
/** The camera whose picture is shown: the one that is wanted, or the first where there is none of that name. */
export const camera = computed(() => {
  const cameras = scene.value?.cameras ?? [];
  return cameras.find(({ name }) => name === wantedCamera.value) ?? cameras[0];
});
/** What was chosen after this run; no problems: it is under way, null: not answered. */
export const choice = signal<{ n: number; what: string; problems: string[] | null } | null>(null);
/** Whether something was chosen, from here or from another page. */
export const chosen = computed(() => (choice.value !== null && choice.value.problems === null) || Boolean(shown.value?.next));
export const undriven = signal(""); // why a velocity is not driven

export const inControl = computed(() => connected.value && shown.value !== null && me.value !== 0 && shown.value.holder === me.value);
/** Whether nothing flies that this page shows: the run is over, or a recorded run is not shown any more. */
export const ended = computed(() => shown.value !== null && (shown.value.ended || (!connected.value && scene.value?.replay !== undefined)));
/** What an ended run says of itself while its page waits for the program, or has lost it. */
export const waiting = computed(() => {
  const [state, gone] = [shown.value, !connected.value && now.value - live.arrivedMs > GONE_AFTER_MS];
  if (state?.next === "again" || state?.next === "edited") return gone ? "the program has ended" : "the next run is being started";
  if (scene.value?.replay !== undefined) return "the program has ended";
  if (gone) return "no answer: the report takes long, or the program has ended";
  return "the run is over: its report is being written";
});
export const alarms = computed<Alarm[]>(() => {
  const known = shown.value?.alarms ?? [];
  if (connected.value || scene.value === null) return known;
  if (ended.value) return [];
  return [{ level: "critical", key: "page", robot: 0, text: "no connection to the station: what you see is old" }, ...known];
});

/** An emergency stop of this page that the station has not answered: nobody may have heard it. */
export const stopUnheard = computed(() => {
  const stop = given.value.find((g) => g.order === "stop" && !g.heard);
  return stop !== undefined && unanswered(stop);
});

/** Whether the station would take a request for the whole fleet now, as far as that can be known before. */
export function takes(state: Snapshot, order: OrderName): boolean {
  return state.allowed.includes(order) && state.refused?.[order] === undefined;
}

/** Whether a request should have been answered by now. */
export function unanswered(g: Given): boolean {
  return !g.heard && (!connected.value || now.value - g.atMs > ANSWER_WITHIN_MS);
}

/** The newest state as it is drawn, when it came, and when the station sent it, both by the page's clock. */
export const live = {
  snapshot: null as Snapshot | null,
  arrivedMs: 0,
  sentMs: 0,
  robots: new Map<number, Robot>(),
  paths: [] as PathSamples[], // what is flown now
  pathSerial: 0,
  picture: null as ImageBitmap | null,
  pictureStampMs: 0,
  pictureAgeMs: 0,
  pictureSentMs: 0, // by the page's clock
  pictureTime_s: null as number | null, // of a recorded run, when it was
  pictureSerial: 0,
  drawnStampMs: 0,
};

const onStates: ((sample: Sample) => void)[] = [];
const onPasts: ((samples: Sample[]) => void)[] = [];
let shownAtMs = 0;

/** Call `state` for every state, at the pace at which they come, and `past` with all that was before this page connected: of a
 * live run its last minutes, of a recorded one the whole run. */
export function onSamples(state: (sample: Sample) => void, past: (samples: Sample[]) => void): void {
  onStates.push(state);
  onPasts.push(past);
}

function takePast(states: PastState[]): void {
  const samples = states.map(({ time_s, robots, localizer }) => ({ time_s, localizer, roundTripMs: null, robots: new Map(robots.map(unpack)) }));
  for (const listener of onPasts) listener(samples);
}

function unpack(news: PastState["robots"][number]) {
  return [news.id, { news, ...numbers(news.state) }] as const;
}

const NONE = new Float32Array(4);

/** Whether a robot knows where it is: without an estimate its vectors are zeros that nothing may show. */
export function isLocated(robot: { news: { state?: RobotState } } | undefined): boolean {
  return (robot?.news.state?.estimate ?? null) !== null;
}

/** The vectors of a state. A robot without a goal is where it should be. */
function numbers(state: RobotState | undefined) {
  const [estimate, control] = [state?.estimate, state?.control];
  const eta = estimate ? floats(estimate.eta) : NONE;
  return {
    eta,
    nu: estimate ? floats(estimate.nu) : NONE,
    disturbance: estimate ? floats(estimate.disturbance) : NONE,
    reference: control ? floats(control.eta_reference) : eta,
    wrench: control ? floats(control.wrench) : NONE,
  };
}

let leastLateMs = Infinity; // least that the page's clock was past the station's when a state came

/** When the station sent what came now, by the page's clock: the line's least delay cannot be known, what it adds to that can. */
function sentMs(arrivedMs: number, clockMs: number): number {
  const drift = MOST_DRIFT * (arrivedMs - live.arrivedMs);
  leastLateMs = Math.min(leastLateMs + drift, arrivedMs - clockMs);
  return clockMs + leastLateMs;
}

function takeState(state: Snapshot): void {
  const at = performance.now();
  live.snapshot = state;
  live.sentMs = sentMs(at, state.clock_ms);
  live.arrivedMs = at;
  for (const news of state.robots) {
    live.robots.set(news.id, {
      news,
      sentMs: live.sentMs,
      ...numbers(news.state),
      horizon: news.plan && news.plan.age_ms < 500 ? floats(news.plan.xyz) : new Float32Array(0),
    });
  }
  const sample = { time_s: state.time_s, robots: live.robots, localizer: state.localizer, roundTripMs: roundTripMs.peek() };
  for (const listener of onStates) listener(sample);
  takeOutcomes(state.requests);
  const before = shown.peek();
  const changed = !before || before.mission !== state.mission || before.holder !== state.holder || before.stop !== state.stop;
  if (changed || at - shownAtMs >= (state.robots.length > MANY ? SHOW_MANY_EVERY_MS : SHOW_EVERY_MS)) {
    shownAtMs = at;
    shown.value = state;
    now.value = at;
  }
}

function takePicture({ camera: of, jpeg, age_ms, stamp_ms, clock_ms, time_s }: Frame & { k: "picture" }): void {
  const sent = sentMs(performance.now(), clock_ms);
  createImageBitmap(new Blob([jpeg], { type: "image/jpeg" })).then(
    (bitmap) => {
      if (camera.peek()?.name !== of) return bitmap.close(); // another one was chosen meanwhile
      live.picture?.close();
      Object.assign(live, { picture: bitmap, pictureAgeMs: age_ms, pictureSentMs: sent, pictureTime_s: time_s, pictureStampMs: stamp_ms });
      live.pictureSerial += 1;
      drawSoon();
    },
    () => undefined, // a broken picture: the age of the last one tells
  );
}

/** Age of the picture now, in ms; of a recorded run, how far it is from the time at which the run stands. */
export function pictureAgeMs(): number {
  const at = live.snapshot?.replay?.time_s;
  if (at !== undefined && live.pictureTime_s !== null) return 1e3 * Math.abs(at - live.pictureTime_s);
  return live.pictureAgeMs + performance.now() - live.pictureSentMs;
}

/** Show no picture until one of the chosen camera comes. */
export function forgetPicture(): void {
  live.picture?.close();
  live.picture = null;
  live.pictureSerial += 1;
  drawSoon();
}

/** Take in a frame from the station. */
export function take(frame: Frame): void {
  switch (frame.k) {
    case "hello":
      if (scene.peek()?.hash !== frame.scene.hash) forgetPicture(); // another experiment has other cameras
      if (scene.peek()?.hash !== frame.scene.hash || scene.peek()?.run !== frame.scene.run) live.robots.clear();
      if (scene.peek()?.run !== frame.scene.run || scene.peek()?.mode !== frame.scene.mode) {
        choice.value = null;
        if (scene.peek() !== null && frame.scene.mode !== "replay") editing.value = false; // what was edited flies now
      }
      if (choice.peek()?.problems === null) choice.value = null; // its answer went with the connection; `next` says whether it was taken
      if (scene.peek()?.life !== frame.scene.life) given.value = given.value.filter((g) => !g.heard);
      leastLateMs = Infinity; // another connection, and another station's clock perhaps
      me.value = frame.you;
      scene.value = frame.scene;
      takePaths(frame.scene.paths);
      lines.value = frame.events;
      document.title = `${frame.scene.name} - Shoal`;
      break;
    case "state":
      takeState(frame);
      drawSoon();
      break;
    case "past":
      takePast(frame.states);
      break;
    case "paths":
      takePaths(frame.paths);
      drawSoon();
      break;
    case "picture":
      takePicture(frame);
      break;
    case "event":
      lines.value = [...lines.value, frame].slice(-MOST_LINES);
      break;
    case "reply":
      given.value = given.value.map((g) =>
        g.n === frame.n ? { ...g, heard: true, refusal: frame.ok ? "" : frame.reason || "refused", request: frame.request } : g,
      );
      break;
    case "tried":
      tried.value = frame;
      break;
    case "drafted":
      if (frame.n > (drafted.peek()?.n ?? 0)) drafted.value = frame; // two are planned at a time: an older one may take longer
      drawSoon();
      break;
    case "chosen":
      if (choice.peek()?.n === frame.n) choice.value = frame.problems.length > 0 ? { ...choice.peek()!, problems: frame.problems } : choice.peek();
      break;
    case "undriven":
      undriven.value = frame.reason;
      break;
    case "runs":
      runs.value = frame;
      break;
    case "saved":
      saved.value = frame;
      break;
  }
}

function takePaths(paths: PathSamples[]): void {
  live.paths = paths;
  live.pathSerial += 1;
}

/** What the station tells of requests: only of those that this page gave, and only when something of it is new. */
function takeOutcomes(outcomes: Outcome[]): void {
  const told = new Map(outcomes.map((outcome) => [outcome.request, outcome]));
  let changed = false;
  const next = given.peek().map((g) => {
    const outcome = g.heard ? told.get(g.request) : undefined;
    if (outcome === undefined || JSON.stringify(outcome) === JSON.stringify(g.outcome)) return g;
    changed = true;
    return { ...g, outcome };
  });
  if (changed) given.value = next;
}

/** Whether a person has taken a robot out of the water: nobody waits for it. */
export function isOut(state: Snapshot, robot: number): boolean {
  return state.alarms.some(({ key }) => key === `${robot}:out`);
}

/** Age of a robot's state now, in ms. */
export function ageMs(robot: RobotNews, sentMs: number): number {
  return robot.age_ms + performance.now() - sentMs;
}

/** Whether what a robot last said is too old to be shown as if it were now. */
export function isStale(robot: RobotNews | undefined, sentMs: number): boolean {
  if (ended.peek()) return false; // nothing is now: what is shown is how it ended
  const limit = scene.peek()?.stale_s ?? 0;
  return robot?.state === undefined || ageMs(robot, sentMs) > limit * 1e3;
}

/** Whether a robot is on a trajectory of its own, which a person gave it, and not on the formation's (groundstation/formation_clock.py). */
export function isAlone(state: RobotState): boolean {
  return state.trajectory_id.startsWith("alone-");
}

/** Choose a robot, or nobody if it is chosen already; with `more` in addition to those that are chosen. */
export function choose(robot: number, more = false): void {
  const chosen = new Set(selected.peek() === 0 ? [] : [selected.peek(), ...also.peek()]);
  const had = chosen.has(robot);
  if (more && had) chosen.delete(robot);
  const [first, ...others] = more ? (had ? chosen : [...chosen, robot]) : had && chosen.size === 1 ? [] : [robot];
  also.value = new Set(others);
  selected.value = first ?? 0;
  drawSoon();
}

/** Whether a robot is one of those that are chosen. */
export function isChosen(robot: number): boolean {
  return robot !== 0 && (selected.value === robot || also.value.has(robot));
}

let draw: () => void = () => undefined;
let asked = false;

/** Whoever draws the pool says so here. */
export function drawWith(drawing: () => void): void {
  draw = drawing;
}

window.shoal?.ready?.(() => drawSoon());

/** Draw the pool at the screen's next chance. */
export function drawSoon(): void {
  if (asked) return;
  asked = true;
  requestAnimationFrame(() => {
    asked = false;
    draw();
  });
}

setInterval(() => {
  if (performance.now() - live.arrivedMs < TICK_MS) return;
  shown.value = live.snapshot; // the last one may have come too soon after the one before
  now.value = performance.now(); // ages go on when nothing comes: that is when they matter
  drawSoon();
}, TICK_MS);
