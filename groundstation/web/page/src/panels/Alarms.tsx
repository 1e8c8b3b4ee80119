/** What is amiss now, worst first, and the log. */

import { acknowledgeAlarms, silenced } from "../sound";
import { alarms, lines } from "../store";

const MARK = { critical: "▲", warning: "◆", notice: "●" };
const LEVEL = ["", "debug", "info", "warning", "error", "fatal"];

/** A stamp for people: the time of day, or in simulated time the seconds. */
export function moment(time_s: number): string {
  return time_s > 1e8 ? new Date(time_s * 1e3).toTimeString().slice(0, 8) : `${Number(time_s.toFixed(1))} s`;
}

export function Alarms() {
  const current = alarms.value;
  const loud = current.some((alarm) => alarm.level === "critical" && !silenced.value.has(alarm.key));
  return (
    <section class="alarms" aria-label="Alarms">
      <h2>
        Alarms {current.length > 0 && `(${current.length})`}
        {loud && (
          <button type="button" onClick={acknowledgeAlarms} title="M">
            Silence
          </button>
        )}
      </h2>
      <ul aria-live="assertive">
        {current.length === 0 && <li class="none">none</li>}
        {current.map((alarm) => (
          <li key={alarm.key} class={alarm.level}>
            <b>{MARK[alarm.level]}</b> {alarm.robot > 0 && `robot ${alarm.robot}: `}
            {alarm.text}
          </li>
        ))}
      </ul>
    </section>
  );
}

export function Log() {
  const newest = lines.value.slice(-60).reverse();
  return (
    <section class="log" aria-label="Log">
      <h2>Log</h2>
      <ol tabIndex={0} aria-label="Lines of the log, newest first">
        {newest.map((line, k) => (
          <li key={lines.value.length - k} class={LEVEL[line.level]}>
            <time>{moment(line.time_s)}</time> <b>{line.source}</b> {line.text}
          </li>
        ))}
      </ol>
    </section>
  );
}
