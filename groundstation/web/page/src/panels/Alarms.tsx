/** What is amiss now, worst first, and the log. */

import { signal } from "@preact/signals";
import { moment } from "../clock";
import { acknowledgeAlarms, causeOf, silenced } from "../sound";
import { robotNames, together } from "../robot/names";
import { alarms, lines, scene, shown } from "../store";
import type { LogLine } from "../wire";

const MARK = { critical: "▲", warning: "◆", notice: "●" };
const LEVEL = ["", "debug", "info", "warning", "error", "fatal"];

export function Alarms() {
  const current = alarms.value;
  const loud = scene.value?.replay === undefined && current.some((alarm) => alarm.level === "critical" && !silenced.value.has(causeOf(alarm)));
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
        {together(current, ({ level, text }) => `${level} ${text}`).map(([alarm, ...others]) => (
          <li key={alarm.key} class={alarm.level}>
            <b>{MARK[alarm.level]}</b> {alarm.robot > 0 && `${robotNames([alarm, ...others].map(({ robot }) => robot))}: `}
            {alarm.text}
          </li>
        ))}
      </ul>
    </section>
  );
}

const robotShown = signal(""); // its number; empty: all
const levelShown = signal(0);
const textShown = signal("");

function LogFilter() {
  return (
    <div class="log-filter">
      <select aria-label="Lines of which robot" value={robotShown.value} onChange={(event) => (robotShown.value = event.currentTarget.value)}>
        <option value="">all robots</option>
        {scene.value?.robots.map(({ id }) => (
          <option key={id} value={id}>
            robot {id}
          </option>
        ))}
      </select>
      <select aria-label="From which level on" value={levelShown.value} onChange={(event) => (levelShown.value = Number(event.currentTarget.value))}>
        <option value={0}>all levels</option>
        <option value={3}>warnings</option>
        <option value={4}>errors</option>
      </select>
      <input
        type="search"
        aria-label="Lines with this text"
        placeholder="search"
        value={textShown.value}
        onInput={(event) => (textShown.value = event.currentTarget.value)}
      />
    </div>
  );
}

function wanted({ level, source, text }: LogLine): boolean {
  const of = robotShown.value;
  const robot = of === "" || source === `agent-${of}` || new RegExp(`\\brobot ${of}\\b`).test(text);
  return robot && level >= levelShown.value && `${source} ${text}`.toLowerCase().includes(textShown.value.toLowerCase());
}

export function Log() {
  const until = scene.value?.replay === undefined ? Infinity : (shown.value?.time_s ?? 0); // of a recorded run all lines are known
  const newest = lines.value.filter((line) => line.time_s <= until && wanted(line)).slice(-60).reverse();
  return (
    <section class="log" aria-label="Log">
      <h2>Log</h2>
      <LogFilter />
      <ol tabIndex={0} aria-label="Lines of the log, newest first">
        {newest.map((line, k) => (
          <li key={lines.value.length - k} class={LEVEL[line.level]}>
            <time>{moment(line.time_s, line.began_s)}</time> <b>{line.source}</b> {line.text}
          </li>
        ))}
      </ol>
    </section>
  );
}
