/** The end of a run: verdict, cause, figures, requirements, and what may follow. Shown as soon as the run is recorded. */

import { nextSerial, say } from "../link";
import { choice, chosen, connected, drawSoon, editing, inControl, scene, shown } from "../store";
import type { RunEnd } from "../wire";

const LOOKS: Record<string, [mark: string, look: string]> = { passed: ["✓", "ok"], failed: ["✕", "bad"] };
const MET = { yes: "✓", no: "✕", "not reached": "–" };

/** Ask the program for what comes after this run. */
export function after(what: "again" | "edited" | "close", edit?: object): void {
  choice.value = { n: nextSerial(), what, problems: null };
  say({ kind: "after", n: choice.value.n, what, ...(edit === undefined ? {} : { edit }) });
}

function Verdict({ end }: { end: RunEnd }) {
  const [mark, look] = LOOKS[end.verdict] ?? ["–", ""];
  return (
    <div class={`verdict ${look}`} aria-live="polite">
      <b>
        {mark} {end.verdict}
      </b>
      {end.cause !== "" && <p class="cause">{end.cause}</p>}
      {end.injected !== "" && <p>Injected before: {end.injected}.</p>}
      {end.outcome !== "" && <p>{end.outcome}.</p>}
    </div>
  );
}

function Figures({ figures: { heads, rows } }: { figures: RunEnd["figures"] }) {
  if (heads.length === 0) return null;
  return (
    <table aria-label="Errors in mm">
      <thead>
        <tr>
          <td>mm</td>
          {heads.map((head) => (
            <th key={head} colSpan={2} scope="colgroup">
              {head}
            </th>
          ))}
        </tr>
        <tr>
          <td />
          {heads.flatMap((head) => ["x", "y"].map((axis) => <th key={head + axis} scope="col">{axis}</th>))}
        </tr>
      </thead>
      <tbody>
        {rows.map(({ name, cells }) => (
          <tr key={name}>
            <th scope="row">{name}</th>
            {cells.flatMap((pair, group) => pair.map((cell, axis) => <td key={`${group}/${axis}`}>{cell}</td>))}
          </tr>
        ))}
      </tbody>
    </table>
  );
}

function Requirements({ end }: { end: RunEnd }) {
  if (end.requirements.length === 0 || end.verdict === "not judged") return null;
  const met = end.requirements.filter((one) => one.met === "yes").length;
  return (
    <details open={end.verdict === "failed"}>
      <summary>
        {met} of {end.requirements.length} requirements met
      </summary>
      <ul>
        {end.requirements.map(({ text, met }) => (
          <li key={text} class={met === "yes" ? "yes" : "no"}>
            <b>{MET[met]}</b> {text}
          </li>
        ))}
      </ul>
    </details>
  );
}

/** A button for what may follow; only the page in control may choose. */
function Choice({ what, text, title }: { what: "again" | "close"; text: string; title: string }) {
  if (!scene.value?.offers?.includes(what)) return null;
  return (
    <button type="button" class={`order ${what === "again" ? "start" : ""}`} disabled={!inControl.value || chosen.value} title={inControl.value ? title : "take control first"} onClick={() => after(what)}>
      {text}
    </button>
  );
}

function Buttons() {
  const s = scene.value;
  const replay = s?.replay;
  if (s === null || replay === undefined) return null;
  const at = shown.value?.replay;
  const from = at !== undefined && at.time_s < replay.end_s - 0.1 ? at.time_s : replay.begin_s;
  return (
    <div class="orders">
      <button type="button" class="order" disabled={!connected.value} title="Play the recorded run; Space" onClick={() => say({ kind: "seek", time_s: from, rate: 1 })}>
        Replay
      </button>
      <Choice what="again" text="Fly again" title="The same experiment with the same options, into a new folder" />
      {s.offers?.includes("edited") && (
        <button
          type="button"
          class="order"
          aria-pressed={editing.value}
          disabled={!connected.value}
          title="Change path, formation and pool on the map, then fly that"
          onClick={() => {
            editing.value = !editing.value;
            drawSoon();
          }}
        >
          Edit and fly
        </button>
      )}
      <Choice what="close" text="Close" title="End the program that shows this run" />
    </div>
  );
}

/** Below the buttons. Not beside an edit, which would begin below what is in sight. */
function Details({ end, run }: { end: RunEnd | null; run: string }) {
  return (
    <>
      {end && <Figures figures={end.figures} />}
      {end && <Requirements end={end} />}
      {end?.notes.map((note) => (
        <p key={note} class="hint">
          {note}
        </p>
      ))}
      {run && (
        <p class="folder">
          <code>{run}</code>
        </p>
      )}
    </>
  );
}

export function End() {
  const s = scene.value;
  if (s?.replay === undefined || (!s.end && s.offers?.length === 0)) return null;
  const problems = [...(s.problem ? [s.problem] : []), ...(choice.value?.problems ?? [])];
  return (
    <section class="end" aria-label="End of the run">
      <h2>End of the run</h2>
      {s.end ? <Verdict end={s.end} /> : <p class="verdict">no result: the log could not be judged</p>}
      {problems.map((problem) => (
        <p key={problem} class="reason" role="alert">
          {problem}
        </p>
      ))}
      <Buttons />
      {!editing.value && <Details end={s.end ?? null} run={s.run ?? ""} />}
    </section>
  );
}
