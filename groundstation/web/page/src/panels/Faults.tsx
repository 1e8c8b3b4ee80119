/** Break something in a simulated run, now: what a lecture shows, and what a test repeats. Real robots have no such panel. */

import { signal } from "@preact/signals";
import { order } from "../link";
import { connected, ended, inControl, lines, scene, selected, shown } from "../store";
import { placeOf } from "./ChosenPlaces";

const thruster = signal(1);
const during = signal(""); // seconds; empty: for ever
const place = signal("0, 0");

interface Fault {
  text: string;
  title: string;
  words(robot: number, output: number): string;
  ofRobot: boolean;
}

const FAULTS: Fault[] = [
  { text: "Kill thruster", title: "it gives no thrust any more", words: (robot, output) => `thruster ${robot}/${output} dead`, ofRobot: true },
  { text: "Weaken thruster", title: "it gives half of its thrust", words: (robot, output) => `thruster ${robot}/${output} weak 0.5`, ofRobot: true },
  { text: "Hide marker", title: "the plate is gone from its back", words: (robot) => `marker ${robot} lost`, ofRobot: true },
  { text: "Cut board link", title: "nothing passes between its computer and its thruster board", words: (robot) => `link ${robot} cut`, ofRobot: true },
  { text: "Kill radio", title: "nothing passes between its computer and the fleet: no pose, no plan, no request", words: (robot) => `radio ${robot} dead`, ofRobot: true },
  { text: "Sag battery", title: "it loses 1.5 V", words: (robot) => `battery ${robot} sag`, ofRobot: true },
  { text: "Freeze camera", title: "the same picture again and again", words: () => "camera frozen", ofRobot: false },
  { text: "Gust", title: "the water moves along x at 0.05 m/s", words: () => "water gust 0.05", ofRobot: false },
];

/** What a hand broke and is still broken, by the simulator's own lines in the log. */
function broken(): string[] {
  const found = new Set<string>();
  for (const { source, text } of lines.value) {
    if (source !== "sim-bridge") continue;
    if (text.startsWith("fault over: ")) found.delete(text.slice(12));
    else if (text.startsWith("fault: ")) found.add(text.slice(7));
  }
  return [...found];
}

export function Faults() {
  const [state, s] = [shown.value, scene.value];
  if (state === null || s === null || s.mode === "replay" || ended.value || !state.present.includes("sim-bridge")) return null;
  const robot = selected.value || s.robots[0]!.id;
  const output = s.outputs.includes(thruster.value) ? thruster.value : s.outputs[0]!;
  const possible = connected.value && inControl.value;
  const seconds = during.value.trim() === "" ? "" : ` for ${during.value.trim()}`;
  const make = (words: string) => order("fault", [], 0, words + seconds);
  const at = placeOf(place.value);
  const now = broken();
  return (
    <details class="faults">
      <summary>
        <h2>Break something {now.length > 0 && <span class="reason">({now.join(", ")})</span>}</h2>
      </summary>
      <div class="form">
        <label>
          thruster of robot {robot}
          <select value={output} onChange={(event) => (thruster.value = Number(event.currentTarget.value))} aria-label="Which thruster breaks">
            {s.outputs.map((k) => (
              <option key={k}>{k}</option>
            ))}
          </select>
        </label>
        <label>
          for
          <input inputMode="decimal" placeholder="ever" value={during.value} onInput={(event) => (during.value = event.currentTarget.value)} aria-label="How long it stays broken, s" /> s
        </label>
      </div>
      <div class="orders">
        {FAULTS.map(({ text, title, words, ofRobot }) => (
          <button key={text} type="button" class="order" disabled={!possible} title={title} onClick={() => make(words(robot, output))}>
            {text}
            {ofRobot && ` ${robot}`}
          </button>
        ))}
        <button type="button" class="order" disabled={!possible || at === null} title="a red ball lies there" onClick={() => make(`ball ${at![0]},${at![1]} drops`)}>
          Drop a ball
        </button>
        <button type="button" class="order start" disabled={!possible} title="all that was broken from here or a terminal is whole again" onClick={() => order("fault", [], 0, "repair")}>
          Repair all
        </button>
      </div>
      <div class="typed">
        <input value={place.value} onInput={(event) => (place.value = event.currentTarget.value)} aria-label="Where the ball drops: x and y in m" />
        <span class="hint">x, y in m of the ball</span>
      </div>
    </details>
  );
}
