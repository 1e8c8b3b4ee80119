/** The top line: what is flown, where the mission stands, who has control, and the emergency stop. */

import { clock } from "../clock";
import { isLight, setTheme } from "../colours";
import { flown, planned } from "../history";
import { order, releaseControl, takeControl } from "../link";
import { ask } from "../Question";
import { mayAlarm, soundOn, toggleSound } from "../sound";
import { browsing, connected, drawSoon, editing, ended, given, inControl, isOut, isStale, live, now, refusal, roundTripMs, scene, shown, stopUnheard, waiting } from "../store";
import { themeSerial } from "./Plots";
import { showRuns } from "./Runs";

const CONNECTING_MS = 5000; // after the page was opened; then it says that nobody answers
const NOTICEABLE = 0.05; // of the pace: smaller differences say nothing

function Control() {
  const s = shown.value;
  if (s === null || !connected.value) return null;
  if (inControl.value) {
    if (scene.value?.mode === "replay") return null; // all may look; control is over names and files alone
    return (
      <button type="button" class="control mine" onClick={releaseControl} title="Give control back, so that another page may take it">
        You have control
      </button>
    );
  }
  const taken = s.holder !== 0;
  return (
    <button
      type="button"
      class="control"
      onClick={() => (taken ? ask("Another page has control. Take it over?", "Take over", () => takeControl(true)) : takeControl(false))}
      title={taken ? "Another page has control; you watch" : "No page has control"}
    >
      {taken ? "Watching - take over" : "Take control"}
    </button>
  );
}

function Link() {
  if (refusal.value) return <span class="link bad">not let in: {refusal.value}</span>;
  if (!connected.value && ended.value) return null; // the state says what the page waits for
  if (!connected.value && scene.value === null) return <span class="link">{now.value > CONNECTING_MS ? "no station answers here yet; trying again" : "connecting …"}</span>;
  if (!connected.value) return <span class="link bad">no connection</span>;
  return (
    <span class="link" title="From the station to this page, drawn, and back">
      link {roundTripMs.value.toFixed(0)} ms
    </span>
  );
}

const MOVES = ["ARMED", "TRACKING", "HOLDING", "DRIVEN"];

function StopButton() {
  const state = shown.value;
  const moves = state?.robots.some((robot) => MOVES.includes(robot.state?.mode ?? "")) ?? false;
  if (scene.value?.mode === "replay" || (ended.value && !moves)) return null; // there is nothing to stop
  const unheard = stopUnheard.value;
  const latched = connected.value && (state?.stop ?? false);
  const robots = (state?.robots ?? []).filter((robot) => state !== null && !isOut(state, robot.id));
  const heard = robots.filter((robot) => !isStale(robot, live.sentMs));
  const silent = now.value >= 0 ? robots.length - heard.length : 0; // ages go on
  const confirmed = latched && heard.length > 0 && heard.every((robot) => robot.state?.mode === "STOPPED");
  const asked = !latched && given.value.some((g) => g.order === "stop" && !g.heard);
  const text = unheard ? "STOP NOT HEARD" : confirmed ? (silent > 0 ? `STOPPED, ${silent} NOT HEARD` : "STOPPED") : latched ? "STOPPING" : asked ? "STOP ASKED" : "EMERGENCY STOP";
  return (
    <button
      type="button"
      class={unheard ? "stop unheard" : latched ? "stop latched" : "stop"}
      onPointerDown={() => order("stop")} // not when it comes up: a hand may have slipped by then
      onClick={(event) => event.detail === 0 && order("stop")} // of a key, or of no pointer at all
      aria-keyshortcuts="Shift+Space Escape"
    >
      {text}
      <small>Shift+Space</small>
    </button>
  );
}

export function Header() {
  const s = scene.value;
  const state = shown.value;
  const mission = ended.value ? "DONE" : connected.value ? (state?.mission ?? "") : "LOST";
  return (
    <header>
      <h1>{s?.title ?? "Shoal"}</h1>
      {state !== null && (
        <span class={`mission-state ${mission.toLowerCase()}`} role="status">
          {ended.value ? waiting.value : connected.value ? recorded(state) + state.mission_text + paused(state) : "last known: " + state.mission_text}
        </span>
      )}
      <span class="stack">
        {s !== null && state !== null && (
          <span class="clock" title="Since the formation's flight began, and when it will be over if nothing holds it up">
            {flown() === null ? "–" : clock(flown()!)}
            {planned() !== null && ` / ${clock(planned()!)}`}
          </span>
        )}
        {connected.value && !ended.value && state !== null && <Pace pace={state.pace ?? null} />}
      </span>
      <span class="gap" />
      <span class="stack">
        <Link />
        {state !== null && state.watchers > 1 && <span class="link">{state.watchers} pages</span>}
      </span>
      <Control />
      {s !== null && s.mode !== "replay" && !ended.value && (
        <button
          type="button"
          aria-pressed={editing.value}
          onClick={() => {
            editing.value = !editing.value;
            drawSoon();
          }}
          title="Edit path and formation for the next run"
        >
          Edit
        </button>
      )}
      <button type="button" aria-pressed={browsing.value} disabled={!connected.value} onClick={() => showRuns(!browsing.value)} title="Runs in this one's folder">
        Runs
      </button>
      <button type="button" aria-pressed={soundOn.value} onClick={() => mayAlarm.value && toggleSound()} title="Alarm sounds. A browser lets a page sound only after a click or a key in it">
        {!soundOn.value ? "Sound off" : mayAlarm.value ? "Sound on" : "Click for sound"}
      </button>
      <button
        type="button"
        onClick={() => {
          setTheme(isLight() ? "dark" : "light");
          themeSerial.value += 1;
          drawSoon();
        }}
        title="Dark or light"
      >
        {themeSerial.value >= 0 && isLight() ? "Dark" : "Light"}
      </button>
      <StopButton />
    </header>
  );
}

/** How fast simulated time goes, where that is not as the clock does. */
function Pace({ pace }: { pace: number | null }) {
  if (pace === null || Math.abs(pace - 1) < NOTICEABLE) return null;
  return (
    <span class="link" title="Simulated seconds a second. Below the pace that was asked for, the machine is busy: the run is slower, and nothing in it is late">
      {pace.toFixed(1)} × real time
    </span>
  );
}

function recorded(state: NonNullable<typeof shown.value>): string {
  return state.replay === undefined || state.mission_text === "recorded" ? "" : "recorded: ";
}

function paused(state: NonNullable<typeof shown.value>): string {
  return state.replay?.rate === 0 ? ", paused" : "";
}
