/** The one clock that people read, on page, terminal, report and log alike: 0 is the instant at which the formation's flight began,
 * what was before is negative. Inside, times are those of the station. */

import { shown } from "./store";

/** When the flight began, by the station's clock; null while nothing has been started. */
export function began(): number | null {
  return shown.value?.began_s ?? null;
}

/** Seconds since the flight began, or another one; null while nothing has been started. */
export function since(time_s: number, begun = began()): number | null {
  return begun === null ? null : time_s - begun;
}

/** A time for people: seconds of the flight; before any flight the time of day, or nothing where time is simulated. */
export function moment(time_s: number, begun = began()): string {
  const s = since(time_s, begun);
  if (s !== null) return `${Number(s.toFixed(1)) + 0} s`;
  return time_s > 1e8 ? new Date(time_s * 1e3).toTimeString().slice(0, 8) : "–";
}

/** Minutes and seconds. */
export function clock(seconds: number): string {
  const whole = Math.floor(Math.abs(seconds));
  return `${seconds < 0 && whole > 0 ? "−" : ""}${Math.floor(whole / 60)}:${String(whole % 60).padStart(2, "0")}`;
}

/** Round values of the clock between two times of the station, `step` apart at least; before any flight, counted from `high`. */
export function ticks(low: number, high: number, step: number): number[] {
  const begun = began() ?? high;
  const found: number[] = [];
  for (let k = Math.ceil((low - begun) / step); k * step <= high - begun; k += 1) found.push(begun + k * step);
  return found;
}
