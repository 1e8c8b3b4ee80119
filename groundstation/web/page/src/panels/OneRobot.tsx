/** The chosen robot alone: arm, hold, disarm, drive it, send it to a place, or take it out of the water, while the others hold or
 * fly. */

import { useEffect } from "preact/hooks";
import { order } from "../link";
import { Motion } from "./Tiles";
import { ChosenPlaces } from "./ChosenPlaces";
import { choosePlaces, places, placesFor } from "../pool/places";
import { driven, hold, letGo, pace, startDriving, stopDriving } from "../robot/drive";
import { also, connected, inControl, isOut, isStale, live, scene, selected, shown, undriven } from "../store";
import type { OrderName, Snapshot } from "../wire";

const FLIES = ["ARMED", "TRACKING", "HOLDING", "DRIVEN"];
const ORDERS: { order: OrderName; text: string; modes: string[] }[] = [
  { order: "arm", text: "Arm", modes: ["DISARMED"] },
  { order: "hold", text: "Hold", modes: FLIES },
  { order: "disarm", text: "Disarm", modes: [...FLIES, "FAULT"] },
];
/** Once a robot is led alone in flight it is out of the formation. */
const IN_FORMATION = ["RUNNING", "SLOWED", "DEGRADED"];

const PAD: { name: string; text: string; share: readonly [number, number, number] }[] = [
  { name: "left", text: "↶ A", share: [0, 0, -1] },
  { name: "ahead", text: "▲ W", share: [1, 0, 0] },
  { name: "right", text: "↷ D", share: [0, 0, 1] },
  { name: "up", text: "up Q", share: [0, -1, 0] },
  { name: "astern", text: "▼ S", share: [-1, 0, 0] },
  { name: "down", text: "down E", share: [0, 1, 0] },
];

const pointer = (event: PointerEvent): string => `pointer ${event.pointerId}`;

/** Buttons to drive with. Whoever drives sees them: when they go, so does what is held. */
function Pad() {
  useEffect(() => stopDriving, []);
  return (
    <div class="drive">
      <div class="pad">
        {PAD.map(({ name, text, share }) => (
          <button
            key={name}
            type="button"
            aria-label={`Drive ${name}`}
            onPointerDown={(event) => {
              event.currentTarget.setPointerCapture(event.pointerId);
              hold(pointer(event), share);
            }}
            onPointerUp={(event) => letGo(pointer(event))}
            onPointerCancel={(event) => letGo(pointer(event))}
            onLostPointerCapture={(event) => letGo(pointer(event))}
            onContextMenu={(event) => event.preventDefault()}
          >
            {text}
          </button>
        ))}
      </div>
      <label>
        pace {(100 * pace.value).toFixed(0)} % of its limits
        <input type="range" min={0.1} max={1} step={0.05} value={pace.value} onInput={(event) => (pace.value = event.currentTarget.valueAsNumber)} />
      </label>
      <p class="hint">Hold a key, a button or a gamepad's stick. It stops short of walls and robots, and holds when you let go.</p>
    </div>
  );
}

/** Why a robot cannot be led by hand; empty: it can be. */
function notLed(mode: string): string {
  if (!connected.value) return "no connection to the station";
  if (!inControl.value) return "you are watching: take control first";
  if (FLIES.includes(mode)) return "";
  return mode === "DISARMED" ? "arm it first" : "not before it is cleared and armed";
}

function SendButton({ robot, why }: { robot: number; why: string }) {
  const open = places.value !== null && placesFor.value === robot;
  return (
    <button type="button" class="order" aria-pressed={open} disabled={why !== "" && !open} onClick={() => choosePlaces(!open, robot)} title={why || "Choose a place on the map"}>
      Send {robot} to…
    </button>
  );
}

/** The place to which a robot is sent. Apart from the other buttons: none of them moves when it opens. */
function Send({ robot, possible }: { robot: number; possible: boolean }) {
  const chosen = placesFor.value === robot ? places.value : null;
  if (chosen === null) return null;
  const text = chosen.length === 0 ? `Send robot ${robot}` : `Send robot ${robot} to (${chosen[0]!.join(", ")}) m`;
  return <ChosenPlaces hint="Click on the map, or type." text={text} possible={possible} />;
}

/** Several robots that are chosen: each does it, on its own. */
function Several({ state, ids }: { state: Snapshot; ids: number[] }) {
  const possible = connected.value && inControl.value;
  const fit = (modes: string[]) => ids.filter((id) => modes.includes(state.robots.find((robot) => robot.id === id)?.state?.mode ?? ""));
  /** Whether no other robot flies: then it is asked of the fleet, which cannot be left by its last robot. */
  const whole = (name: OrderName) => {
    const modes = name === "hold" ? ["TRACKING"] : FLIES;
    return name !== "arm" && state.allowed.includes(name) && !state.robots.some(({ id, state: told }) => !ids.includes(id) && modes.includes(told?.mode ?? ""));
  };
  return (
    <section class="one-robot" aria-label={`Robots ${ids.join(", ")}`}>
      <h2>Robots {ids.join(", ")}</h2>
      <div class="orders">
        {ORDERS.map(({ order: name, text, modes }) => (
          <button key={name} type="button" class="order" disabled={!possible || fit(modes).length === 0} onClick={() => (whole(name) ? order(name) : fit(modes).forEach((id) => order(name, [], id)))}>
            {text} these {ids.length}
          </button>
        ))}
      </div>
      <p class="hint">Shift+click takes robots in and out. Driving and sending are for one robot.</p>
    </section>
  );
}

export function OneRobot() {
  const state: Snapshot | null = shown.value;
  const robot = state?.robots.find(({ id }) => id === selected.value);
  if (state === null || robot === undefined || scene.value?.mode === "replay") return null;
  if (also.value.size > 0) return <Several state={state} ids={[robot.id, ...also.value].sort((a, b) => a - b)} />;
  const mode = robot.state?.mode ?? "";
  const possible = connected.value && inControl.value;
  const why = notLed(mode);
  const flies = why === "";
  const led = state.led.find((found) => found.robot === robot.id);
  const drives = driven.value === robot.id;
  const out = isOut(state, robot.id);
  const powered = FLIES.includes(mode) && !isStale(robot, live.sentMs);
  return (
    <section class="one-robot" aria-label={`Robot ${robot.id} alone`}>
      <h2>Robot {robot.id} alone</h2>
      <div class="orders">
        {ORDERS.map(({ order: name, text, modes }) => (
          <button key={name} type="button" class="order" disabled={!possible || !modes.includes(mode) || (name === "arm" && out)} onClick={() => order(name, [], robot.id)}>
            {text} {robot.id}
          </button>
        ))}
        <button
          type="button"
          class="order"
          aria-pressed={drives}
          disabled={!flies && !drives}
          onClick={() => (drives ? stopDriving() : startDriving(robot.id))}
          title={drives ? "Leave it: it holds, and keys drive nobody" : why || "By keys (W A S D or arrows, Q up, E down), buttons or a gamepad"}
        >
          Drive {robot.id}
        </button>
        <button
          type="button"
          class="order"
          disabled={!possible || out || powered}
          onClick={() => order("out", [], robot.id)}
          title={powered ? "disarm it first" : "A person has taken it out of the water: nobody keeps clear of it from now on, and no run counts on it"}
        >
          {robot.id} is out of the water
        </button>
        <button type="button" class="order" disabled={!possible || !out} onClick={() => order("back-in", [], robot.id)} title="It is in the water again, and takes part">
          {robot.id} is back in
        </button>
        <SendButton robot={robot.id} why={why} />
      </div>
      <Send robot={robot.id} possible={flies} />
      {drives && <Motion robot={robot} />}
      {drives && <Pad />}
      {undriven.value !== "" && drives && <p class="reason" role="status">{undriven.value}</p>}
      {led !== undefined && <p class="hint" role="status">{led.text}</p>}
      {IN_FORMATION.includes(state.mission) && mode === "TRACKING" && <p class="hint">Led alone now, it leaves the formation until Rejoin.</p>}
    </section>
  );
}
