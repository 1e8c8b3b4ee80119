/** Another form of the running formation: the station plans it, the map shows the plan, one click flies it. */

import { effect, signal } from "@preact/signals";
import { nextSerial, order, say } from "../link";
import { SHAPES } from "../editor/model";
import { connected, drawSoon, ended, formed, inControl, shown } from "../store";
import type { Snapshot } from "../wire";

export const forming = signal(false); // the panel is open
const shape = signal("");
const spacing = signal("0.9");
const turn = signal("0");
const over = signal("");
const question = signal(0); // number of the newest question

/** The form in the words that terminal and scripts use, too. */
function words(): string {
  const parts = shape.value === "" ? [] : [shape.value, spacing.value];
  if (Number(turn.value) !== 0) parts.push("turn", turn.value);
  if (over.value.trim() !== "") parts.push("over", over.value);
  return parts.join(" ");
}

effect(() => {
  const form = words();
  if (!forming.value || !connected.value || form === "") return;
  question.value = nextSerial();
  say({ kind: "form", n: question.value, form });
});

effect(() => {
  if (forming.value && (ended.value || shown.value?.allowed.includes("formation") === false)) showForm(false);
});

export function showForm(on: boolean): void {
  forming.value = on;
  formed.value = null;
  drawSoon();
}

function Answer() {
  const answer = formed.value;
  if (words() === "") return <p class="hint">Choose a shape, or a turn.</p>;
  if (answer === null || answer.n !== question.value) return <p class="hint">asking the planner …</p>;
  if (!answer.ok) return <p class="reason" role="status">✕ {answer.problems[0]}</p>;
  return (
    <p class="good" role="status">
      ✓ can be flown: closest {answer.clearance_m! > 999 ? "-" : `${answer.clearance_m!.toFixed(2)} m`} (needs {answer.needed_m!.toFixed(2)})
    </p>
  );
}

export function Form({ state }: { state: Snapshot }) {
  const possible = connected.value && inControl.value && state.allowed.includes("formation");
  if (!forming.value) return null;
  const text = (label: string, unit: string, value: typeof turn) => (
    <label>
      {label}
      <input inputMode="decimal" value={value.value} onInput={(event) => (value.value = event.currentTarget.value)} aria-label={`${label}, ${unit}`} /> {unit}
    </label>
  );
  return (
    <form
      class="form"
      aria-label="Another form of the formation"
      onSubmit={(event) => {
        event.preventDefault();
        order("formation", [], 0, words());
        showForm(false);
      }}
    >
      <label>
        shape
        <select value={shape.value} onChange={(event) => (shape.value = event.currentTarget.value)} aria-label="Shape of the formation">
          <option value="">as it is</option>
          {SHAPES.map((name) => (
            <option key={name}>{name}</option>
          ))}
        </select>
      </label>
      {shape.value !== "" && text("spacing", "m", spacing)}
      {text("turn", "degrees", turn)}
      {text("over", "s", over)}
      <Answer />
      <div class="orders">
        <button type="submit" class="order start" disabled={!possible || !formed.value?.ok || formed.value.n !== question.value}>
          Fly this form
        </button>
        <button type="button" class="order" onClick={() => showForm(false)}>
          Cancel
        </button>
      </div>
    </form>
  );
}
