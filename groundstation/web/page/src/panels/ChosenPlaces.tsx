/** Places to fly to: clicked on the map, or typed by keyboard, x and y in m. */

import { signal } from "@preact/signals";
import { addPlace, choosePlaces, flyThere, notThere, places } from "../pool/places";

const typed = signal("");

/** Two numbers, in whatever way people part them; null for anything else. */
export function placeOf(text: string): [number, number] | null {
  const parts = text.trim().split(/[\s,;]+/);
  const [x, y] = parts.map(Number);
  return parts.length === 2 && parts.every((part) => part !== "") && Number.isFinite(x) && Number.isFinite(y) ? [x!, y!] : null;
}

function TypedPlace() {
  const place = placeOf(typed.value);
  const why = place === null ? "" : notThere(...place);
  return (
    <form
      class="typed"
      onSubmit={(event) => {
        event.preventDefault();
        if (place === null || why !== "") return;
        addPlace(...place);
        typed.value = "";
      }}
    >
      <input aria-label="Place: x and y in m" placeholder="x, y in m" value={typed.value} onInput={(event) => (typed.value = event.currentTarget.value)} autocomplete="off" />
      <button type="submit" disabled={place === null || why !== ""} title={why}>
        Add place
      </button>
      {why !== "" && (
        <span class="reason" role="status">
          {why}
        </span>
      )}
    </form>
  );
}

/** The places chosen so far, with a way to add one, to fly there, and to leave it. */
export function ChosenPlaces({ hint, text, possible }: { hint: string; text: string; possible: boolean }) {
  return (
    <div class="go-places">
      <p class="hint">{hint}</p>
      <TypedPlace />
      <div class="orders">
        <button type="button" class="order" disabled={!possible || !places.value?.length} onClick={flyThere}>
          {text}
        </button>
        <button type="button" class="order" onClick={() => choosePlaces(false)}>
          Cancel
        </button>
      </div>
    </div>
  );
}
