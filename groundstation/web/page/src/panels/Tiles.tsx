/** A tile for each robot, the worst first. What is older than three periods is grey and says its age: it is not now. */

import { robotColour } from "../colours";
import type { RobotState } from "../messages";
import { ageMs, alarms, choose, isChosen, isLocated, isStale, live, now, type Robot, scene, shown } from "../store";
import type { RobotNews, Scene } from "../wire";

const MARK: Record<string, string> = { DISARMED: "○", ARMED: "◐", TRACKING: "▶", HOLDING: "❚❚", STOPPED: "■", FAULT: "✕", DRIVEN: "✥" };
const FLIES = ["ARMED", "TRACKING", "HOLDING", "DRIVEN"];
const MANY = 6; // from here on a tile tells the mode, the error, the pose, and what is wrong
const RISES_MS = 2000; // what has been amiss for so long brings a tile to the front,
const SINKS_MS = 15_000; // and it stays there for so long: a notice that comes and goes moves nothing under a hand

/** 2: cannot be trusted or flown, 1: a warning, 0: well. Notices do not count: they come and go. */
function badness(robot: RobotNews): number {
  if (isStale(robot, live.sentMs)) return 2;
  const own = alarms.value.filter((alarm) => alarm.robot === robot.id);
  return own.some(({ level }) => level === "critical") ? 2 : own.some(({ level }) => level === "warning") ? 1 : 0;
}

const ranks = new Map<number, { shown: number; wanted: number; sinceMs: number }>();
let touched = false; // a pointer is over the tiles: they stay where they are

/** The rank by which a robot's tile is placed: it follows its badness late. */
function rank(robot: RobotNews, atMs: number): number {
  const bad = badness(robot);
  const known = ranks.get(robot.id) ?? { shown: bad, wanted: bad, sinceMs: atMs };
  if (bad !== known.wanted) [known.wanted, known.sinceMs] = [bad, atMs];
  if (!touched && atMs - known.sinceMs > (bad > known.shown ? RISES_MS : SINKS_MS)) known.shown = bad;
  ranks.set(robot.id, known);
  return known.shown;
}

/** A robot's own estimate of where it is and how it moves; null while it has none. */
function located(id: number): Robot | null {
  const robot = live.robots.get(id);
  return robot !== undefined && isLocated(robot) ? robot : null;
}

/** Distance from where the robot should be: on its path, or at the place that it holds. */
function errorMm(id: number): number | null {
  const robot = located(id);
  if (robot === null || !["TRACKING", "HOLDING"].includes(robot.news.state?.mode ?? "")) return null;
  return 1e3 * Math.hypot(...[0, 1, 2].map((k) => robot.eta[k]! - robot.reference[k]!));
}

function age(ms: number | null): string {
  return ms === null || ms >= 1e8 ? "never" : ms >= 1e4 ? `${(ms / 1e3).toFixed(0)} s` : ms >= 1e3 ? `${(ms / 1e3).toFixed(1)} s` : `${ms.toFixed(0)} ms`;
}

/** 0 to 359: a robot's own heading counts its turns. */
function heading(id: number): string {
  const yaw = located(id)?.eta[3];
  return yaw === undefined ? "-" : `${((Math.round((yaw * 180) / Math.PI) % 360) + 360) % 360}°`;
}

/** Through the water's plane, by the robot's own estimate. */
function speed(id: number): string {
  const nu = located(id)?.nu;
  return nu === undefined ? "-" : `${Math.hypot(nu[0]!, nu[1]!).toFixed(3)} m/s`;
}

function depth(id: number): string {
  const z = located(id)?.eta[2];
  return z === undefined ? "-" : `${z.toFixed(2)} m`;
}

/** The mode, and along a path what decides the motion: "tracking, giving way"; with little room that alone. */
function doing(state: RobotState, short: boolean): string {
  const [mode, along] = [state.mode.toLowerCase(), state.mode === "TRACKING" && state.guidance !== "NONE" ? state.guidance.toLowerCase().replace("_", " ") : ""];
  return `${MARK[state.mode]} ${short && along !== "" ? along : [mode, along].filter((text) => text !== "").join(", ")}`;
}

/** What the board does, where that is not as the mode has it. */
function unlike(mode: string, armed: boolean): string {
  return armed === FLIES.includes(mode) ? "" : armed ? ", board armed" : ", board not armed";
}

function Fact({ name, value, bad }: { name: string; value: string; bad?: boolean | undefined }) {
  return (
    <div class={bad ? "bad" : ""}>
      <dt>{name}</dt>
      <dd>{value}</dd>
    </div>
  );
}

/** How a robot moves, in a line: beside what it is driven with, for its tile may be out of sight. */
export function Motion({ robot }: { robot: RobotNews }) {
  now.value;
  const state = robot.state;
  if (state === undefined || isStale(robot, live.sentMs)) return <p class="reason">not heard</p>;
  return (
    <p class="motion">
      {doing(state, false)}: {speed(robot.id)}, depth {depth(robot.id)}, yaw {heading(robot.id)}, pose {state.track.toLowerCase()} {age(state.timing.pose_age_ms)}
    </p>
  );
}

function Tile({ robot, place, s }: { robot: RobotNews; place: number; s: Scene }) {
  now.value; // ages go on, also when nothing comes
  const state = robot.state;
  const [known, board, toPwmMs] = [state?.estimate, state?.board ?? null, state?.timing.exposure_to_pwm_ms ?? null];
  const stale = isStale(robot, live.sentMs);
  const mm = errorMm(robot.id);
  const chosen = isChosen(robot.id);
  const battery = s.limits.battery_v;
  const own = alarms.value.filter((alarm) => alarm.robot === robot.id);
  const worst = own[0]?.level ?? "";
  return (
    <li
      class={`tile ${stale ? "stale" : worst}${chosen ? " chosen" : ""}`}
      data-robot={robot.id}
      data-mode={state?.mode ?? "NONE"}
      style={`--robot: ${robotColour(place)}`}
      onMouseDown={(event) => event.shiftKey && event.preventDefault()} // else the browser marks the text between two clicks
      onClick={(event) => choose(robot.id, event.shiftKey || event.ctrlKey || event.metaKey)} // anywhere on it, and by its button for keys
    >
      <button type="button" class="name" aria-pressed={chosen} title="Choose it; with Shift or Ctrl, choose several">
        <span class="id">{robot.id}</span>
        <span class="mode">
          {state ? doing(state, s.robots.length > MANY) : "not heard"}
          {state?.board && <small>{unlike(state.mode, state.board.armed)}</small>}
        </span>
        <span class="age">{stale ? `${state ? "last heard " : ""}${state ? age(ageMs(robot, live.sentMs)) + " ago" : ""}` : age(ageMs(robot, live.sentMs))}</span>
      </button>
      {state && (
        <dl>
          <Fact name={state.mode === "HOLDING" ? "from its place" : "error"} value={mm === null ? "-" : `${mm.toFixed(mm < 10 ? 1 : 0)} mm`} />
          <Fact name="pose" value={`${state.track.toLowerCase()} ${age(state.timing.pose_age_ms)}`} bad={state.track === "LOST" || state.track === "COAST"} />
          <Fact name="depth" value={depth(robot.id)} />
          <Fact name="yaw" value={heading(robot.id)} />
          <Fact name="speed" value={speed(robot.id)} />
          <Fact name="step" value={`${(state.timing.step_us / 1e3).toFixed(1)} ms`} bad={s.mode !== "lockstep" && state.timing.step_us > 500e3 * s.period_s} />
          <Fact name="battery" value={board ? `${board.battery_v.toFixed(1)} V` : "-"} bad={board !== null && board.battery_v < battery[2]} />
          <Fact name="board loss" value={board ? `${(100 * board.loss).toFixed(0)} %` : "-"} bad={board !== null && board.loss > 0.05} />
          {known && known.drag_ratio !== null && known.thrust_ratio !== null && <Fact name="drag, thrust" value={`× ${known.drag_ratio.toFixed(2)}, ${known.thrust_ratio.toFixed(2)}`} />}
          <Fact name="to PWM" value={toPwmMs !== null ? `${toPwmMs.toFixed(0)} ms` : "-"} />
        </dl>
      )}
      {own.slice(0, 2).map((alarm) => (
        <p key={alarm.key} class={`fault ${alarm.level}`}>
          {alarm.text}
        </p>
      ))}
    </li>
  );
}

export function Tiles() {
  now.value; // so does their order
  const s = scene.value;
  const state = shown.value;
  if (s === null || state === null) return null;
  const places = new Map(s.robots.map(({ id }, place) => [id, place]));
  const by = new Map(state.robots.map((robot) => [robot.id, rank(robot, performance.now())]));
  const order = [...state.robots].sort((a, b) => by.get(b.id)! - by.get(a.id)! || places.get(a.id)! - places.get(b.id)!);
  return (
    <section class={order.length > MANY ? "tiles many" : "tiles"} aria-label="Robots" onPointerEnter={() => (touched = true)} onPointerLeave={() => (touched = false)}>
      <h2>Robots</h2>
      <ul>
        {order.map((robot) => (
          <Tile key={robot.id} robot={robot} place={places.get(robot.id) ?? 0} s={s} />
        ))}
      </ul>
    </section>
  );
}
