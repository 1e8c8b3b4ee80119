/** Preflight, orders and what became of them. */

import { order, say } from "../link";
import { OtherFlight, OtherFlightButton } from "./OtherFlight";
import { ChosenPlaces } from "./ChosenPlaces";
import { choosePlaces, places, placesFor } from "../pool/places";
import { ask } from "../Question";
import { numbers, robotNames, together } from "../robot/names";
import { connected, ended, type Given as Request, given, inControl, isOut, isStale, live, now, scene, shown, stopUnheard, takes, unanswered } from "../store";
import type { OrderName, RobotNews, Snapshot } from "../wire";

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

/** Each in its own place, always: no button appears where another one just was. */
const OTHERS: Button[] = [
  { order: "load", text: "Load again", keys: "" },
  { order: "return", text: "Return to start", keys: "Shift+B" },
  { order: "rejoin", text: "Rejoin", keys: "" },
  { order: "test", text: "Test thrusters", keys: "" }, // preflight may be waiting for just this one: the station judges
];
const CLEAR: Button = { order: "clear-stop", text: "Clear stop", keys: "" }; // the last: where it appears, there is nothing else

/** States in which a run is over. */
const OVER = ["DONE", "CANCELLED", "FAILED"];

function whyNot(state: Snapshot, button: Button): string {
  if (!connected.value) return "no connection to the station";
  if (!inControl.value) return "you are watching: take control first";
  if (!state.allowed.includes(button.order) || idle(button.order, state)) return `not possible while ${state.mission_text}`;
  const refused = state.refused?.[button.order];
  if (refused !== undefined) return refused;
  if (button.checked && state.preflight.length > 0) return "preflight is not complete";
  return "";
}

function Preflight({ state }: { state: Snapshot }) {
  const robots = (scene.value?.robots ?? []).filter(({ id }) => !isOut(state, id));
  const needed = ["WAITING", "LOADING", "ARMING", ...OVER].includes(state.mission);
  if (!needed) return null;
  const reasons = new Map<number, string[]>();
  for (const { robot, text } of state.preflight) reasons.set(robot, [...(reasons.get(robot) ?? []), text]);
  const ready = robots.length - reasons.size;
  return (
    <div class="preflight">
      <h3>
        Preflight: {ready} of {robots.length} ready
      </h3>
      <ul>
        {together(robots.map(({ id }) => ({ id, why: reasons.get(id)?.join("; ") })), ({ why }) => why ?? "").map(([{ id, why }, ...others]) => (
          <li key={id} class={why !== undefined ? "no" : "yes"}>
            <b>{why !== undefined ? "✕" : "✓"}</b> {robotNames([id, ...others.map((other) => other.id)])} {why ?? "ready"}
          </li>
        ))}
      </ul>
    </div>
  );
}

/** How a request stands, in a word or two, and how it looks. */
function standing(g: Request): [text: string, look: string] {
  if (!g.heard) {
    if (!unanswered(g)) return ["asked", ""];
    const text = "no answer: the station may not have heard it";
    return [g.order === "stop" ? `${text}; it is sent again` : text, "refused"];
  }
  if (g.refusal !== "") return [`refused: ${g.refusal}`, "refused"];
  const outcome = g.outcome;
  if (outcome === null) return ["sent", ""];
  if (outcome.progress === "FAILED") return [`failed${outcome.reason && `: ${outcome.reason}`}`, "refused"];
  if (outcome.progress === "UNDER_WAY") return ["under way", ""];
  return [outcome.confirmed.length > 0 ? `confirmed by ${numbers(outcome.confirmed)}` : "done", "done"];
}

function Given() {
  now.value; // time goes on for what is not answered
  if (given.value.length === 0) return null;
  return (
    <ol class="given" aria-label="Orders given from here" aria-live="polite">
      {given.value.slice(0, 4).map((g) => {
        const [text, look] = standing(g);
        return (
          <li key={g.n} class={look}>
            <b>{g.order}</b> {text}{" "}
            {g.outcome !== null && g.outcome.progress !== "DONE" && (
              <span class="answers">
                {g.outcome.confirmed.map((robot) => (
                  <span key={robot} class="yes">
                    ✓ {robot}{" "}
                  </span>
                ))}
                {g.outcome.waiting.map(({ robot, why }) => (
                  <span key={robot} class="no" title={why}>
                    {g.outcome?.progress === "UNDER_WAY" ? "…" : "✕"} {robot} {why}{" "}
                  </span>
                ))}
              </span>
            )}
          </li>
        );
      })}
    </ol>
  );
}

/** A stop of this page without an answer. */
function Unheard() {
  return (
    <div class="stopped" role="alert">
      <h3>Emergency stop not heard</h3>
      <p>The station has not answered: no robot may have been told. The stop is sent again as soon as the station is back.</p>
    </div>
  );
}

/** After a stop: who has confirmed, by name. Stays until the stop is cleared. */
function Confirmations({ state }: { state: Snapshot }) {
  now.value; // who is no longer heard confirms nothing
  const stopped = (robot: RobotNews) => robot.state?.mode === "STOPPED" && connected.value && !isStale(robot, live.sentMs);
  const robots = state.robots.filter((robot) => !isOut(state, robot.id) || !isStale(robot, live.sentMs));
  const waiting = robots.filter((robot) => !stopped(robot));
  return (
    <div class="stopped" role="alert">
      <h3>Emergency stop</h3>
      <ul>
        {[...waiting, ...robots.filter(stopped)].map((robot) => {
          const done = stopped(robot);
          const once = robot.state?.mode === "STOPPED";
          return (
            <li key={robot.id} class={done ? "yes" : "no"}>
              <b>{done ? "✓" : "…"}</b> robot {robot.id} {done ? "confirms: stopped" : once ? "was stopped, and is not heard now" : "has not confirmed"}
            </li>
          );
        })}
      </ul>
      <button
        type="button"
        disabled={!inControl.value || !connected.value}
        title={inControl.value ? "" : "take control first"}
        onClick={() => ask("Clear the emergency stop? Robots stay disarmed until they are armed again.", "Clear", () => order("clear-stop"))}
      >
        Clear stop{waiting.length > 0 ? ` (${waiting.length} not confirmed)` : ""}
      </button>
      <p class="hint">The run goes on after Clear stop: Return to start, then Start. End run shows its verdict and its replay.</p>
    </div>
  );
}

/** What became of an emergency stop. */
export function Stopped() {
  const state = shown.value;
  if (state === null || scene.value?.mode === "replay" || ended.value) return null;
  return (
    <>
      {stopUnheard.value && <Unheard />}
      {state.stop && <Confirmations state={state} />}
    </>
  );
}

const LIVE = ["ARMED", "TRACKING", "HOLDING", "DRIVEN"];

/** The end of the run: asked twice while anything may still move. */
function End({ state }: { state: Snapshot }) {
  const reason = !connected.value ? "no connection to the station" : !inControl.value ? "you are watching: take control first" : "";
  const moves = state.robots.some((robot) => LIVE.includes(robot.state?.mode ?? ""));
  return (
    <button
      type="button"
      class="order end"
      disabled={reason !== ""}
      title={reason || "Disarm everybody, write the log to its end, and stop the station"}
      onClick={() => (moves ? ask("Robots are armed. Disarm all of them and end the run?", "Disarm and end", () => order("end")) : order("end"))}
    >
      End run
    </button>
  );
}

function Folder({ state }: { state: Snapshot }) {
  const run = scene.value?.run;
  if (!run || !(ended.value || OVER.includes(state.mission))) return null;
  return (
    <p class="folder">
      {ended.value ? "The run is over; it is in" : "The run is being written to"} <code>{run}</code>
      {ended.value ? "; in a moment this page shows its verdict, figures and replay" : ". End run shows its verdict, figures and replay; Return to start, then Start flies again"}
    </p>
  );
}

/** Between the end of a run and its report: nothing can be asked for. */
function Over({ state }: { state: Snapshot }) {
  return (
    <section class="mission" aria-label="Mission">
      <h2>Mission</h2>
      {state.reason && <p class="reason">{state.reason}</p>}
      <Folder state={state} />
      <Given />
    </section>
  );
}

/** Orders that are taken now, and do nothing that is not done. A stop from before the station was started is cleared here; its own, above. */
function idle(order: OrderName, state: Snapshot): boolean {
  if (order === "clear-stop") return state.stop || state.robots.every((robot) => robot.state?.mode !== "STOPPED");
  return order === "load" && state.mission === "WAITING";
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

/** Leads the running formation to places that are clicked on the map, or typed. */
function GoButton({ state }: { state: Snapshot }) {
  const open = places.value !== null && placesFor.value === 0;
  const possible = connected.value && inControl.value && takes(state, "go");
  return (
    <button
      type="button"
      class="order go"
      aria-pressed={open}
      disabled={!possible && !open}
      onClick={() => choosePlaces(!open)}
      title={possible ? "Choose places for the formation to fly over" : state.refused?.go || "not possible now"}
    >
      Go to…
    </button>
  );
}

function Go({ state }: { state: Snapshot }) {
  const chosen = placesFor.value === 0 ? places.value : null;
  const possible = connected.value && inControl.value && takes(state, "go");
  if (chosen === null) return null;
  const hint = chosen.length === 0 ? "Click on the map, or type: one place or more." : chosen.map(([x, y]) => `${x}, ${y} m`).join(" → ");
  return <ChosenPlaces hint={hint} text="Fly there" possible={possible} />;
}

/** A line for the run's log, with the time at which it was written. */
function Remark() {
  return (
    <form
      class="remark"
      onSubmit={(event) => {
        event.preventDefault();
        const field = event.currentTarget.elements.namedItem("remark") as HTMLInputElement;
        const text = field.value.trim();
        if (text !== "" && say({ kind: "remark", text })) field.value = "";
      }}
    >
      <input name="remark" maxLength={200} placeholder="Remark for the log; #word is a tag" aria-label="Remark for the log" autocomplete="off" />
      <button type="submit">Add</button>
    </form>
  );
}

export function Mission() {
  const state = shown.value;
  if (state === null || scene.value?.mode === "replay") return null;
  if (ended.value) return <Over state={state} />;
  return (
    <section class="mission" aria-label="Mission">
      <h2>Mission</h2>
      <div class="orders">
        {BUTTONS.map((button) => (
          <OrderButton key={button.order} button={button} state={state} />
        ))}
      </div>
      <div class="orders sometimes">
        {OTHERS.map((button) => (
          <OrderButton key={button.order} button={button} state={state} />
        ))}
        <GoButton state={state} />
        <OtherFlightButton what="formation" text="Formation…" title="Another shape, spacing, turn or order of the formation" state={state} />
        <OtherFlightButton what="path" text="Path…" title="The path of another experiment, flown by the robots of this run" state={state} />
        <End state={state} />
        {state.allowed.includes("clear-stop") && !idle("clear-stop", state) && <OrderButton button={CLEAR} state={state} />}
      </div>
      <Go state={state} />
      <OtherFlight state={state} />
    </section>
  );
}

/** What is told of the mission. Below all buttons: it comes and goes, and none of them may move under a hand. */
export function MissionNews() {
  const state = shown.value;
  if (state === null || scene.value?.mode === "replay" || ended.value) return null;
  return (
    <section class="mission" aria-label="News of the mission">
      {state.reason && !["WAITING", "STOPPED"].includes(state.mission) && <p class="reason">{state.reason}</p>}
      <Folder state={state} />
      {state.flown && state.flown !== scene.value?.name && <p class="hint">Path: {state.flown}</p>}
      <Preflight state={state} />
      <Remark />
      <Given />
    </section>
  );
}
