/** A plot as a figure for a paper: drawn anew by what reports have for it (report/templates/paper.js), in ink on white. */

import { began, since } from "../clock";
import { paperColour } from "../colours";
import type { Chart } from "../history";

/** Curves of a chart in a span of the station's time. */
export interface Shown {
  chart: Chart;
  times: ArrayLike<number>;
  columns: ArrayLike<number | null>[];
  places: number[]; // of each curve's robot, or its own: of the colour
  dashes: number[][];
  from_s: number;
  to_s: number;
}

/** As the report's menus have them. */
export const CHOICES: [what: string, text: string][] = [
  ["pdf-1", "PDF, one column"], ["pdf-2", "PDF, two columns"], ["svg-1", "SVG, one column"], ["svg-2", "SVG, two columns"], ["png-1", "PNG, one column"], ["png-2", "PNG, two columns"], ["csv", "CSV"],
]; // prettier-ignore

/** Save what a plot shows. `what`: one of CHOICES. */
export async function savePlot(shown: Shown, what: string): Promise<void> {
  const { chart, times, from_s, to_s } = shown;
  await import("../../../../report/templates/paper.js");
  const flown = began() !== null;
  const at = (time_s: number) => (flown ? since(time_s)! : time_s - to_s);
  const rows = Array.from({ length: times.length }, (_, k) => k).filter((k) => times[k]! >= from_s && times[k]! <= to_s);
  const lines = chart.curves.map((curve, k) => ({
    label: curve.name,
    colour: paperColour(shown.places[k]!),
    dash: shown.dashes[k]!,
    x: rows.map((row) => at(times[row]!)),
    y: rows.map((row) => shown.columns[k]![row] ?? null),
  }));
  const marks = chart.limit === undefined ? [] : chart.both ? [chart.limit, -chart.limit] : [chart.limit];
  const xLabel = flown ? "time since the start [s]" : "time before now [s]";
  const drawing = { xLabel, from: at(from_s), to: at(to_s), panels: [{ label: `${chart.title} [${chart.unit}]`, marks, lines }] };
  const name = chart.title.toLowerCase().replace(/[^a-z0-9]+/g, "-").replace(/^-|-$/g, "");
  await window.paper!.save(drawing, name, what);
}
