/** A tile for each robot, the worst first. What is older than three periods is grey and says its age: it is not now. */

import { robotColour } from "../colours";
import { ageMs, alarms, drawSoon, isStale, live, now, scene, selected, shown } from "../store";
import type { RobotNews, RobotState, Scene } from "../wire";

const MARK: Record<string, string> = { DISARMED: "○", ARMED: "◐", TRACKING: "▶", HOLDING: "❚❚", STOPPED: "■", FAULT: "✕", DRIVEN: "✥" };
const MANY = 6; // from here on a tile tells the mode, the error, the pose, and what is wrong
const WEIGHT = { critical: 100, warning: 10, notice: 1 };

function badness(robot: RobotNews): number {
  const stale = isStale(robot, live.sentMs) ? 1000 : 0;
  const own = alarms.value.filter((alarm) => alarm.robot === robot.id);
  return stale + own.reduce((sum, alarm) => sum + WEIGHT[alarm.level], 0);
}

/** Distance from where the robot should be: on its path, or at the place that it holds. */
function errorMm(id: number): number | null {
  const robot = live.robots.get(id);
  if (!["TRACKING", "HOLDING"].includes(robot?.news.state?.mode ?? "") || robot === undefined) return null;
  return 1e3 * Math.hypot(...[0, 1, 2].map((k) => robot.eta[k]! - robot.reference[k]!));
}

function age(ms: number): string {
  return ms >= 1e8 ? "never" : ms >= 1e4 ? `${(ms / 1e3).toFixed(0)} s` : ms >= 1e3 ? `${(ms / 1e3).toFixed(1)} s` : `${ms.toFixed(0)} ms`;
}

/** 0 to 359: a robot's own heading counts its turns. */
function degrees(radians: number | undefined): string {
  return radians === undefined ? "-" : String(((Math.round((radians * 180) / Math.PI) % 360) + 360) % 360);
}

/** Through the water's plane, by the robot's own estimate. */
function speed(id: number): string {
  const nu = live.robots.get(id)?.nu;
  return nu === undefined ? "-" : Math.hypot(nu[0]!, nu[1]!).toFixed(3);
}

/** The mode, and along a path what decides the motion: "tracking, giving way". */
function doing(state: RobotState): string {
  const along = state.mode === "TRACKING" && state.guidance !== "NONE" ? `, ${state.guidance.toLowerCase().replace("_", " ")}` : "";
  return `${MARK[state.mode]} ${state.mode.toLowerCase()}${along}`;
}

function Fact({ name, value, bad }: { name: string; value: string; bad?: boolean | undefined }) {
  return (
    <div class={bad ? "bad" : ""}>
      <dt>{name}</dt>
      <dd>{value}</dd>
    </div>
  );
}

function Tile({ robot, place, s }: { robot: RobotNews; place: number; s: Scene }) {
  now.value; // ages go on, also when nothing comes
  const state = robot.state;
  const stale = isStale(robot, live.sentMs);
  const mm = errorMm(robot.id);
  const chosen = selected.value === robot.id;
  const battery = s.limits.battery_v;
  const own = alarms.value.filter((alarm) => alarm.robot === robot.id);
  const worst = own[0]?.level ?? "";
  return (
    <li
      class={`tile ${stale ? "stale" : worst}${chosen ? " chosen" : ""}`}
      data-robot={robot.id}
      data-mode={state?.mode ?? "NONE"}
      style={`--robot: ${robotColour(place)}`}
    >
      <button
        type="button"
        class="name"
        aria-pressed={chosen}
        onClick={() => {
          selected.value = chosen ? 0 : robot.id;
          drawSoon();
        }}
      >
        <span class="id">{robot.id}</span>
        <span class="mode">
          {state ? doing(state) : "not heard"}
          {state?.armed && <small>, board armed</small>}
        </span>
        <span class="age">{stale ? `${state ? "last heard " : ""}${state ? age(ageMs(robot, live.sentMs)) + " ago" : ""}` : age(ageMs(robot, live.sentMs))}</span>
      </button>
      {state && (
        <dl>
          <Fact name={state.mode === "HOLDING" ? "from its place" : "error"} value={mm === null ? "-" : `${mm.toFixed(mm < 10 ? 1 : 0)} mm`} />
          <Fact name="pose" value={`${state.track.toLowerCase()} ${age(state.pose_age_ms)}`} bad={state.track === "LOST" || state.track === "COAST"} />
          <Fact name="depth" value={`${live.robots.get(robot.id)?.eta[2]?.toFixed(2) ?? "-"} m`} />
          <Fact name="yaw" value={`${degrees(live.robots.get(robot.id)?.eta[3])}°`} />
          <Fact name="speed" value={`${speed(robot.id)} m/s`} />
          <Fact name="step" value={`${(state.step_us / 1e3).toFixed(1)} ms`} bad={s.mode !== "lockstep" && state.step_us > 500e3 * s.period_s} />
          <Fact name="battery" value={`${state.battery_v.toFixed(1)} V`} bad={state.battery_v < battery[2]} />
          <Fact name="board loss" value={`${(100 * state.loss).toFixed(0)} %`} bad={state.loss > 0.05} />
          {state.drag_ratio > 0 && <Fact name="drag, thrust" value={`× ${state.drag_ratio.toFixed(2)}, ${state.thrust_ratio.toFixed(2)}`} />}
          <Fact name="to PWM" value={state.to_pwm_ms > 0 ? `${state.to_pwm_ms.toFixed(0)} ms` : "-"} />
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
  const order = [...state.robots].sort((a, b) => badness(b) - badness(a) || places.get(a.id)! - places.get(b.id)!);
  return (
    <section class={order.length > MANY ? "tiles many" : "tiles"} aria-label="Robots">
      <h2>Robots</h2>
      <ul>
        {order.map((robot) => (
          <Tile key={robot.id} robot={robot} place={places.get(robot.id) ?? 0} s={s} />
        ))}
      </ul>
    </section>
  );
}
