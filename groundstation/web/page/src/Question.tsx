/** Questions of the page to a person, drawn in it: browsers' own dialogs stop the page, its keys and the stop button with it. */

import { effect, signal } from "@preact/signals";
import { connected } from "./store";

interface Asked {
  text: string;
  yes: string; // what the button says that does it
  then: (answer: string) => void;
  answer?: string; // asked for a text: what stands there at first
}

export const question = signal<Asked | null>(null);

/** Ask, and do `then` on yes. A question that is open already gives way: nobody answers what is not seen. */
export function ask(text: string, yes: string, then: (answer: string) => void, answer?: string): void {
  question.value = { text, yes, then, ...(answer === undefined ? {} : { answer }) };
}

/** Close an open question without an answer. Returns whether there was one. */
export function closeQuestion(): boolean {
  const open = question.peek() !== null;
  question.value = null;
  return open;
}

effect(() => {
  if (!connected.value) question.value = null; // what was asked about may be otherwise by then
});

export function Question() {
  const asked = question.value;
  if (asked === null) return null;
  return (
    <div class="question" role="alertdialog" aria-label={asked.text} key={asked.text}>
      <form
        onSubmit={(event) => {
          event.preventDefault();
          const answer = new FormData(event.currentTarget).get("answer");
          closeQuestion();
          asked.then(typeof answer === "string" ? answer : "");
        }}
      >
        <label>
          {asked.text}
          {asked.answer !== undefined && <input name="answer" value={asked.answer} autocomplete="off" ref={(field) => field?.select()} />}
        </label>
        <button
          type="button"
          onClick={closeQuestion}
          ref={(button) => {
            if (asked.answer === undefined) button?.focus();
          }}
        >
          Cancel
        </button>
        <button type="submit">{asked.yes}</button>
      </form>
    </div>
  );
}
