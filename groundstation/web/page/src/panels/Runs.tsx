/** The runs of the folder in which this one lies: search, name, tags, report, and their end. */

import { signal } from "@preact/signals";
import { say } from "../link";
import { ask } from "../Question";
import { browsing, connected, inControl, runs, scene } from "../store";
import type { ListedRun } from "../wire";

const FIGURES = ["Length", "Size"]; // columns of numbers

const wanted = signal(""); // words to search for
const labelled = signal(""); // run whose name and tags are being changed

/** Open or close the list; it is read anew each time. */
export function showRuns(open: boolean): void {
  browsing.value = open;
  labelled.value = "";
  if (open) say({ kind: "runs" });
}

function found({ name, run, tags, date, experiment, mode, verdict, commit }: ListedRun): boolean {
  const text = [name, run, ...tags.map((tag) => `#${tag}`), date, experiment, mode, verdict, commit].join("\n").toLowerCase();
  return wanted.value.toLowerCase().split(/\s+/).every((word) => text.includes(word));
}

function Label({ run }: { run: ListedRun }) {
  return (
    <form
      class="label"
      onSubmit={(event) => {
        event.preventDefault();
        const text = (field: string) => (event.currentTarget.elements.namedItem(field) as HTMLInputElement).value.trim();
        const tags = text("tags").split(/[\s,]+/).map((tag) => tag.replace(/^#/, "")).filter((tag) => tag !== "");
        if (say({ kind: "label", run: run.run, name: text("name"), tags })) labelled.value = "";
      }}
    >
      <input name="name" maxLength={100} defaultValue={run.name} placeholder="Name" aria-label={`Name of ${run.run}`} autocomplete="off" />
      <input name="tags" maxLength={200} defaultValue={run.given.join(" ")} placeholder="tags, with spaces" aria-label={`Tags of ${run.run}`} autocomplete="off" />
      <button type="submit">Keep</button>
      <button type="button" onClick={() => (labelled.value = "")}>
        Cancel
      </button>
    </form>
  );
}

function Row({ run }: { run: ListedRun }) {
  const mine = connected.value && inControl.value;
  const why = mine ? "" : "you are watching: take control first";
  const flying = run.shown && scene.value?.mode !== "replay";
  const passed = run.verdict === "passed" ? "yes" : run.verdict === "failed" ? "no" : "";
  return (
    <tr data-run={run.run} class={run.shown ? "shown" : ""}>
      <td class="which">
        <b>{run.name || run.run}</b> {run.shown && <em>{flying ? "this run" : "shown here"}</em>} {run.tags.map((tag) => `#${tag} `)}
        {run.name !== "" && <small>{run.run}</small>}
        {labelled.value === run.run && <Label run={run} />}
      </td>
      <td>{run.date}</td>
      <td>{[run.experiment, run.mode].filter((text) => text !== "").join(", ")}</td>
      <td class="figure">{run.duration_s > 0 ? `${run.duration_s.toFixed(0)} s` : "–"}</td>
      <td class="figure">{run.size_mb.toFixed(1)} MB</td>
      <td class={passed}>{flying ? "under way" : run.verdict}</td>
      <td class="acts">
        {run.report !== "" && (
          <a href={run.report} target="_blank" rel="noopener">
            Report
          </a>
        )}
        <button type="button" disabled={!mine} title={why || "Name and tags"} onClick={() => (labelled.value = run.run)}>
          Label
        </button>
        <button
          type="button"
          disabled={!mine || run.shown}
          title={run.shown ? "it is shown on this page" : why}
          onClick={() =>
            ask(`Delete ${run.name || run.run} (${run.size_mb.toFixed(1)} MB) with its log and report?`, "Delete", () => say({ kind: "delete", run: run.run }))
          }
        >
          Delete
        </button>
      </td>
    </tr>
  );
}

export function Runs() {
  const list = runs.value;
  if (!browsing.value) return null;
  const shown = list?.runs.filter(found) ?? [];
  return (
    <section class="runs" aria-label="Runs">
      <h2>
        Runs {list !== null && <span class="folder">{list.folder}</span>}
        <button type="button" onClick={() => showRuns(false)} title="Esc">
          Close
        </button>
      </h2>
      <input
        type="search"
        aria-label="Runs with these words"
        placeholder="search: name, #tag, experiment, passed, failed, date"
        value={wanted.value}
        onInput={(event) => (wanted.value = event.currentTarget.value)}
      />
      <p role="status" class={list?.problem ? "reason" : "hint"}>
        {list === null ? "asked" : list.problem || `${shown.length} of ${list.runs.length} runs`}
      </p>
      <div class="table" tabIndex={0} role="group" aria-label="Runs, newest first">
        <table>
          <thead>
            <tr>
              {["Run", "Begun", "Experiment", ...FIGURES, "Verdict"].map((head) => (
                <th key={head} scope="col" class={FIGURES.includes(head) ? "figure" : ""}>
                  {head}
                </th>
              ))}
              <td />
            </tr>
          </thead>
          <tbody>
            {shown.map((run) => (
              <Row key={run.run} run={run} />
            ))}
          </tbody>
        </table>
      </div>
    </section>
  );
}
