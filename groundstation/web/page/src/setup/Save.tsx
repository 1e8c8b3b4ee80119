/** Step 5: what will be changed in the file, and the click that does it. */

import { signal } from "@preact/signals";
import { useEffect } from "preact/hooks";
import { ask, state } from "./api";

const lines = signal<string[]>([]);

async function look(): Promise<void> {
  lines.value = (await ask<{ lines: string[] }>("difference", {}, true))?.lines ?? [];
}

const kind = (line: string) => (line.startsWith("@@") ? "at" : line.startsWith("+") ? "plus" : line.startsWith("-") ? "minus" : "");

export function Save() {
  const s = state.value!;
  const keys = Object.keys(s.changed);
  useEffect(() => void look(), [JSON.stringify(s.changed)]); // other pages change the same setup
  return (
    <section>
      <h2>
        Save
        <button type="button" onClick={() => void ask("reload").then(look)} title="Somebody else may have changed it">
          Read the file again
        </button>
      </h2>
      <p>
        {keys.length === 0 ? "Nothing to save in " : `Changes of ${keys.join(", ")} in `}
        <code>{s.path}</code>
      </p>
      {lines.value.length > 0 && (
        <pre class="difference" tabIndex={0}>
          {lines.value.map((line, k) => (
            <div key={k} class={kind(line)}>
              {line}
            </div>
          ))}
        </pre>
      )}
      <button type="button" class="main" disabled={keys.length === 0} onClick={() => void ask("save").then(look)}>
        Save
      </button>
      <p class="dim">The old file is kept beside it, with the time in its name.</p>
    </section>
  );
}
