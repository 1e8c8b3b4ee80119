/** Another form or another path of the formation: the station plans it, the map shows the plan, one click flies it. Robots at rest
 * fly it with the next start. */

import { computed, effect, type Signal, signal } from "@preact/signals";
import { nextSerial, order, say } from "../link";
import { SHAPES } from "../editor/model";
import { Figures } from "./Figures";
import { connected, drafted, drawSoon, ended, inControl, scene, shown, takes } from "../store";
import type { Snapshot } from "../wire";

type What = "formation" | "path";

export const drafting = signal<"" | What>(""); // the panel that is open
const shape = signal("");
const spacing = signal("");
const triesLeft = signal(0); // spacings that are still tried for a person who has typed none
const turn = signal("0");
const over = signal("");
const places = signal<number[]>([]); // robots in the order of the places; empty: left to the planner
const path = signal(""); // name of an experiment, or the text of a file
const file = signal(""); // its name
const question = signal(0); // number of the newest question

const TRIES = 5; // spacings, WIDER_M apart, from the formation's own on
const WIDER_M = 0.1;
const LARGEST_FILE = 40_000; // characters: what a message to the station holds

/** States before a flight: what is chosen then is flown by Start. */
const AT_REST = ["WAITING", "DONE", "CANCELLED", "FAILED"];

/** What is chosen, in the words that terminal and scripts use, too. */
function words(what: What): string {
  if (what === "path") return path.value;
  const parts = shape.value === "" ? [] : [shape.value, spacing.value];
  if (Number(turn.value) !== 0) parts.push("turn", turn.value);
  if (places.value.length > 0) parts.push("order", places.value.join(","));
  if (over.value.trim() !== "" && parts.length > 0) parts.push("over", over.value);
  return parts.join(" ");
}

const stage = computed(() => shown.value?.mission ?? ""); // the plan begins where robots are: a hold or a start makes it another

effect(() => {
  const what = drafting.value;
  if (what === "" || !connected.value || stage.value === "") return;
  const text = words(what);
  if (text === "") return;
  question.value = nextSerial();
  say({ kind: "draft", n: question.value, order: what, text });
});

effect(() => {
  const what = drafting.value;
  if (what !== "" && (ended.value || shown.value?.allowed.includes(what) === false)) show("");
});

const ownSpacing = (): string => (scene.peek()?.formation.spacing_m ?? 0.8).toFixed(2);

/** Offer a spacing: the formation's own, or the next wider one that can be flown, for on their ways robots come nearer. */
function offerSpacing(): void {
  [spacing.value, triesLeft.value] = [ownSpacing(), shape.peek() === "" ? 0 : TRIES];
}

effect(() => {
  const answer = drafted.value;
  if (drafting.value !== "formation" || answer?.n !== question.peek() || triesLeft.peek() === 0) return;
  triesLeft.value = answer.ok ? 0 : triesLeft.peek() - 1;
  if (!answer.ok) spacing.value = triesLeft.peek() === 0 ? ownSpacing() : (Number(spacing.peek()) + WIDER_M).toFixed(2);
});

function show(what: "" | What): void {
  if (what === "formation") offerSpacing();
  drafting.value = what;
  drafted.value = null;
  drawSoon();
}

/** Opens the panel; what it does in flight needs a hold, says its title. */
export function OtherFlightButton({ what, text, title, state }: { what: What; text: string; title: string; state: Snapshot }) {
  const mine = connected.value && inControl.value;
  const possible = mine && takes(state, what);
  const why = what === "path" && mine && state.allowed.includes("hold") ? "not under way: Hold first" : (state.refused?.[what] ?? "not possible now");
  const open = drafting.value === what;
  return (
    <button type="button" class={`order ${what}`} aria-pressed={open} disabled={!possible && !open} onClick={() => show(open ? "" : what)} title={possible ? title : why}>
      {text}
    </button>
  );
}

function Answer({ what }: { what: What }) {
  const answer = drafted.value;
  if (words(what) === "") return <p class="hint">{what === "path" ? "Choose an experiment: its path and places are flown, with the robots of this run." : "Choose a shape, an order or a turn."}</p>;
  if (answer === null || answer.n !== question.value || (!answer.ok && what === "formation" && triesLeft.value > 0)) return <p class="hint">asking the planner …</p>;
  if (!answer.ok)
    return (
      <>
        <p class="reason" role="status">
          ✕ {answer.problems[0]}
        </p>
        {what === "formation" && <p class="hint">Another spacing, turn or order may do.</p>}
      </>
    );
  return (
    <>
      <p class="good" role="status">
        ✓ can be flown
      </p>
      <Figures figures={answer.figures ?? []} />
    </>
  );
}

function Text({ label, unit, value, onType }: { label: string; unit: string; value: Signal<string>; onType?: () => void }) {
  return (
    <label>
      {label}
      <input inputMode="decimal" value={value.value} onInput={(event) => (onType?.(), (value.value = event.currentTarget.value))} aria-label={`${label}, ${unit}`} /> {unit}
    </label>
  );
}

/** Which robot takes which place. To choose a robot for a place gives its own place to the robot that was there. */
function Order() {
  const ids = scene.value!.robots.map(({ id }) => id);
  if (ids.length < 2) return null;
  const put = (robot: number, place: number) => {
    const next = [...places.value];
    next[next.indexOf(robot)] = next[place]!;
    next[place] = robot;
    places.value = next;
  };
  return (
    <>
      <label>
        places
        <select value={places.value.length > 0 ? "own" : ""} onChange={(event) => (places.value = event.currentTarget.value === "" ? [] : ids)} aria-label="Who takes which place">
          <option value="">shortest ways</option>
          <option value="own">in this order</option>
        </select>
      </label>
      {places.value.map((robot, place) => (
        <label key={place}>
          {place + 1}.
          <select value={robot} onChange={(event) => put(Number(event.currentTarget.value), place)} aria-label={`Robot at place ${place + 1}`}>
            {ids.map((id) => (
              <option key={id} value={id}>
                robot {id}
              </option>
            ))}
          </select>
        </label>
      ))}
    </>
  );
}

function FormFields() {
  return (
    <>
      <label>
        shape
        <select value={shape.value} onChange={(event) => ((shape.value = event.currentTarget.value), offerSpacing())} aria-label="Shape of the formation">
          <option value="">as it is</option>
          {SHAPES.map((name) => (
            <option key={name}>{name}</option>
          ))}
        </select>
      </label>
      {shape.value !== "" && <Text label="spacing" unit="m" value={spacing} onType={() => (triesLeft.value = 0)} />}
      <Text label="turn" unit="degrees" value={turn} />
      <Text label="over" unit="s" value={over} />
      <Order />
    </>
  );
}

async function read(chosen: File | undefined): Promise<void> {
  if (chosen === undefined) return;
  const text = chosen.size > LARGEST_FILE ? "" : await chosen.text();
  [path.value, file.value] = [text, text === "" ? `${chosen.name} is empty, or larger than ${LARGEST_FILE / 1000} kB` : chosen.name];
}

function PathFields() {
  const names = scene.value?.loadable ?? [];
  return (
    <>
      <label>
        experiment
        <select
          value={names.includes(path.value) ? path.value : ""}
          onChange={(event) => ([path.value, file.value] = [event.currentTarget.value, ""])}
          aria-label="Experiment whose path is flown"
        >
          <option value="">{file.value === "" ? "choose" : "own file"}</option>
          {names.map((name) => (
            <option key={name}>{name}</option>
          ))}
        </select>
      </label>
      <label class="file">
        own file
        <input type="file" accept=".toml" onChange={(event) => void read(event.currentTarget.files?.[0])} aria-label="File of an experiment" />
      </label>
      {file.value !== "" && <p class="hint">{file.value}</p>}
    </>
  );
}

export function OtherFlight({ state }: { state: Snapshot }) {
  const what = drafting.value;
  if (what === "") return null;
  const possible = connected.value && inControl.value && takes(state, what);
  const rests = AT_REST.includes(state.mission);
  const noun = what === "path" ? "path" : "form";
  return (
    <form
      class="form"
      aria-label={what === "path" ? "Another path of the formation" : "Another form of the formation"}
      onSubmit={(event) => {
        event.preventDefault();
        order(what, [], 0, words(what), what === "path" ? file.value || path.value : words(what));
        show("");
      }}
    >
      {what === "path" ? <PathFields /> : <FormFields />}
      <div class="orders">
        <button type="submit" class="order start" disabled={!possible || !drafted.value?.ok || drafted.value.n !== question.value} title={rests ? "nobody moves before Start" : ""}>
          {rests ? `Take this ${noun}` : `Fly this ${noun}`}
        </button>
        <button type="button" class="order" onClick={() => show("")}>
          Cancel
        </button>
      </div>
      <Answer what={what} />
      {rests && <p class="hint">Start flies it, from where the robots are now.</p>}
    </form>
  );
}
