/** Preflight, orders and what became of them. */

import { order } from "../link";
import { connected, given, inControl, scene, shown } from "../store";
import type { OrderName, Snapshot } from "../wire";

interface Button {
  order: OrderName;
  text: string;
  keys: string;
  checked?: boolean;
}

const BUTTONS: Button[] = [
  { order: "arm", text: "Arm", keys: "Shift+A", checked: true },
  { order: "start", text: "Start", keys: "Shift+S", checked: true },
  { order: "hold", text: "Hold", keys: "H" },
  { order: "resume", text: "Resume", keys: "Shift+R" },
  { order: "disarm", text: "Disarm", keys: "Shift+D" },
];

/** Shown while the mission takes them. */
const SOMETIMES: Button[] = [
  { order: "load", text: "Load again", keys: "" },
  { order: "clear-stop", text: "Clear stop", keys: "" },
  { order: "return", text: "Return to start", keys: "Shift+B" },
  { order: "rejoin", text: "Rejoin", keys: "" },
  { order: "test", text: "Test thrusters", keys: "" }, // preflight may be waiting for just this one: the station judges
];

function whyNot(state: Snapshot, button: Button): string {
  if (!connected.value) return "no connection to the station";
  if (!inControl.value) return "you are watching: take control first";
  if (!state.allowed.includes(button.order)) return `not possible while ${state.phase_text}`;
  if (button.checked && state.preflight.length > 0) return "preflight is not complete";
  return "";
}

function Preflight({ state }: { state: Snapshot }) {
  const robots = scene.value?.robots ?? [];
  const needed = ["WAITING", "LOADING", "ARMING", "DONE", "FAILED"].includes(state.phase);
  if (!needed) return null;
  const reasons = new Map<number, string[]>();
  for (const line of state.preflight) {
    const match = /^robot (\d+): (.*)$/.exec(line);
    if (match) reasons.set(Number(match[1]), [...(reasons.get(Number(match[1])) ?? []), match[2]!]);
  }
  const ready = robots.length - reasons.size;
  return (
    <div class="preflight">
      <h3>
        Preflight: {ready} of {robots.length} ready
      </h3>
      <ul>
        {robots
          .filter(({ id }) => robots.length <= 6 || reasons.has(id))
          .map(({ id }) => (
            <li key={id} class={reasons.has(id) ? "no" : "yes"}>
              <b>{reasons.has(id) ? "✕" : "✓"}</b> robot {id} {reasons.get(id)?.join("; ") ?? "ready"}
            </li>
          ))}
      </ul>
    </div>
  );
}

function Given() {
  if (given.value.length === 0) return null;
  return (
    <ol class="given" aria-label="Orders given from here" aria-live="polite">
      {given.value.slice(0, 4).map((g) => (
        <li key={g.n} class={g.outcome.replace(" ", "-")}>
          <b>{g.order}</b> {g.outcome}
          {g.reason && `: ${g.reason}`}
          {g.answers.length > 0 && (
            <span class="answers">
              {g.answers.map((a) => (
                <span key={a.robot} class={a.ok ? "yes" : "no"} title={a.reason}>
                  {a.ok ? "✓" : "✕"} {a.robot}
                  {!a.ok && ` ${a.reason}`}
                </span>
              ))}
            </span>
          )}
        </li>
      ))}
    </ol>
  );
}

/** After a stop: who has confirmed, by name. Stays until the stop is cleared. */
function Stopped({ state }: { state: Snapshot }) {
  if (!state.stop) return null;
  const waiting = state.robots.filter((r) => r.state?.mode !== "STOPPED");
  return (
    <div class="stopped" role="alert">
      <h3>Emergency stop</h3>
      <ul>
        {state.robots.map((robot) => {
          const done = robot.state?.mode === "STOPPED";
          return (
            <li key={robot.id} class={done ? "yes" : "no"}>
              <b>{done ? "✓" : "…"}</b> robot {robot.id} {done ? "confirms: stopped" : "has not confirmed"}
            </li>
          );
        })}
      </ul>
      <button
        type="button"
        disabled={!inControl.value || !connected.value}
        title={inControl.value ? "" : "take control first"}
        onClick={() => confirm("Clear the emergency stop? Robots stay disarmed until they are armed again.") && order("clear-stop")}
      >
        Clear stop{waiting.length > 0 ? ` (${waiting.length} not confirmed)` : ""}
      </button>
    </div>
  );
}

/** Orders that are taken now, and do nothing that is not done. A stop from before the station was started is cleared here; its own, above. */
function idle(order: OrderName, state: Snapshot): boolean {
  if (order === "clear-stop") return state.stop || state.robots.every((robot) => robot.state?.mode !== "STOPPED");
  return order === "load" && state.phase === "WAITING";
}

function OrderButton({ button, state }: { button: Button; state: Snapshot }) {
  const reason = whyNot(state, button);
  return (
    <button
      type="button"
      class={`order ${button.order}`}
      disabled={reason !== ""}
      onClick={() => order(button.order)}
      title={reason || button.keys}
      {...(button.keys ? { "aria-keyshortcuts": button.keys } : {})}
    >
      {button.text}
    </button>
  );
}

export function Mission() {
  const state = shown.value;
  if (state === null || scene.value?.mode === "replay") return null;
  return (
    <section class="mission" aria-label="Mission">
      <h2>Mission</h2>
      <Stopped state={state} />
      {state.reason && state.phase !== "WAITING" && <p class="reason">{state.reason}</p>}
      <Preflight state={state} />
      <div class="orders">
        {BUTTONS.map((button) => (
          <OrderButton key={button.order} button={button} state={state} />
        ))}
      </div>
      <div class="orders sometimes">
        {SOMETIMES.filter(({ order }) => state.allowed.includes(order) && !idle(order, state)).map((button) => (
          <OrderButton key={button.order} button={button} state={state} />
        ))}
      </div>
      <Given />
    </section>
  );
}
