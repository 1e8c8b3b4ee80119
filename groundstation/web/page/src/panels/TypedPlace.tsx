/** A place that is typed instead of clicked: x and y in m, by keyboard. */

import { signal } from "@preact/signals";
import { addPlace } from "../pool/places";

const typed = signal("");

/** Two numbers, in whatever way people part them; null for anything else. */
export function placeOf(text: string): [number, number] | null {
  const parts = text.trim().split(/[\s,;]+/);
  const [x, y] = parts.map(Number);
  return parts.length === 2 && parts.every((part) => part !== "") && Number.isFinite(x) && Number.isFinite(y) ? [x!, y!] : null;
}

export function TypedPlace() {
  const place = placeOf(typed.value);
  return (
    <form
      class="typed"
      onSubmit={(event) => {
        event.preventDefault();
        if (place === null) return;
        addPlace(...place);
        typed.value = "";
      }}
    >
      <input aria-label="Place: x and y in m" placeholder="x, y in m" value={typed.value} onInput={(event) => (typed.value = event.currentTarget.value)} autocomplete="off" />
      <button type="submit" disabled={place === null}>
        Add place
      </button>
    </form>
  );
}
