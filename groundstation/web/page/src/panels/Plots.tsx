/** Four plots, each of what its heading says, of the flight, or the last minute before it; drag to zoom, double click to see the
 * flight again, once more to see all; pause to look in peace. */

import { signal } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import uPlot from "uplot";
import "uplot/dist/uPlot.min.css";
import { began, moment, ticks } from "../clock";
import { css, robotColour } from "../colours";
import { idOf } from "../fields";
import { type Chart, charts, column, fieldChart, flight, record, times } from "../history";
import { keep, layouts, link, show, SLOTS, slots } from "../layout";
import { placeOf } from "../pool/path";
import { ask } from "../Question";
import { live, scene, selected } from "../store";
import type { Scene } from "../wire";
import { CHOICES, savePlot } from "./save";

const DRAW_EVERY_MS = 200;
const MANY_EVERY_MS = 500; // fifty curves cost as much as the map
const FALLBACK = [0, 1, 2, 3, 4, 5, 6, 7];

export const themeSerial = signal(0);
export const paused = signal(false);
const view = signal<"flight" | "all" | "part">("flight"); // of all plots: times that they show

function options(s: Scene, chart: Chart, width: number, height: number): uPlot.Options {
  const axis = { stroke: css("--dim"), grid: { stroke: css("--grid"), width: 1 }, ticks: { show: false }, font: "11px system-ui" };
  return {
    width,
    height,
    cursor: { sync: { key: "run" }, drag: { x: true, y: false } },
    legend: { live: true, isolate: true },
    scales: { x: { time: false }, y: { range: (_, low, high) => range(chart, low, high) } },
    axes: [
      { ...axis, size: 22, gap: 2, space: 50, splits: (_, __, low, high, step) => ticks(low, high, step), values: (plot, at) => at.map((t) => tick(t, plot.scales["x"]!.max!)) },
      { ...axis, size: 44, gap: 2 },
    ],
    series: [
      { label: "t", value: (_, t) => (t === null || t === undefined ? "" : moment(t)) },
      ...chart.curves.map((curve, k) => ({
        label: curve.name,
        stroke: robotColour(curve.robot === undefined ? FALLBACK[k % 8]! : placeOf(s, curve.robot)),
        width: 1.5,
        ...dashOf(s, curve),
        points: { show: false },
        value: (_: uPlot, v: number | null | undefined) => (v === null || v === undefined ? "-" : v.toFixed(Math.abs(v) < 10 ? 2 : 0)),
      })),
    ],
    hooks: {
      draw: [
        (plot) => {
          drawLimit(plot, chart);
          drawPresent(plot);
        },
      ],
    },
  };
}

/** The label of a tick. Before any flight, time is counted back from the end of the axis. */
function tick(time_s: number, end_s: number): string {
  return began() === null ? `${Math.round(time_s - end_s)} s` : moment(time_s);
}

const DASHES = [[], [8, 3], [2, 3], [9, 3, 2, 3]]; // beside the colour: not everybody tells colours apart, and no print does

function dashOf(s: Scene, curve: Chart["curves"][number]): { dash?: number[] } {
  const dash = curve.dash ?? (curve.robot === undefined ? [] : DASHES[placeOf(s, curve.robot) % DASHES.length]!);
  return dash.length > 0 ? { dash } : {};
}

function range(chart: Chart, low: number | null, high: number | null): [number, number] {
  if (low === null || high === null || (low === 0 && high === 0)) return chart.both ? [-1, 1] : [0, 1];
  const [from, to] = chart.both || chart.id === "disturbance" || chart.id === "battery" ? [low, high] : [0, high];
  const room = 0.08 * Math.max(to - from, chart.id === "battery" ? 0.2 : 1e-3 + 0.2 * Math.abs(to));
  return [from === 0 && low >= 0 ? 0 : from - room, to + room];
}

function drawLimit(plot: uPlot, chart: Chart): void {
  if (chart.limit === undefined) return;
  const pen = plot.ctx;
  pen.save();
  pen.strokeStyle = css("--critical");
  pen.setLineDash([4, 4]);
  pen.lineWidth = devicePixelRatio;
  for (const value of chart.both ? [chart.limit, -chart.limit] : [chart.limit]) {
    const y = plot.valToPos(value, "y", true);
    if (y < plot.bbox.top || y > plot.bbox.top + plot.bbox.height) continue;
    pen.beginPath();
    pen.moveTo(plot.bbox.left, y);
    pen.lineTo(plot.bbox.left + plot.bbox.width, y);
    pen.stroke();
  }
  pen.restore();
}

/** The newest row; in a recorded run the one at the time at which the map stands. */
function presentRow(): number {
  const at = live.snapshot?.replay?.time_s ?? Infinity;
  const next = times.findIndex((t) => t > at);
  return (next < 0 ? times.length : next) - 1;
}

/** In a recorded run, of which the whole is shown: the time at which the map stands. */
function drawPresent(plot: uPlot): void {
  const at = live.snapshot?.replay;
  if (at === undefined) return;
  const x = plot.valToPos(at.time_s, "x", true);
  if (x < plot.bbox.left || x > plot.bbox.left + plot.bbox.width) return;
  const pen = plot.ctx;
  pen.save();
  pen.strokeStyle = css("--accent");
  pen.lineWidth = devicePixelRatio;
  pen.beginPath();
  pen.moveTo(x, plot.bbox.top);
  pen.lineTo(x, plot.bbox.top + plot.bbox.height);
  pen.stroke();
  pen.restore();
}

function Plot({ slot }: { slot: number }) {
  const ref = useRef<HTMLDivElement>(null);
  const drawn = useRef<uPlot | null>(null);
  const s = scene.value;
  const chosen = selected.value || (s?.robots[0]?.id ?? 0);
  const all = s === null ? [] : charts(s, chosen);
  const wanted = slots.value[slot] ?? "";
  const chart = all.find(({ id }) => id === wanted) ?? (s === null ? undefined : fieldChart(s, wanted)) ?? all[0];
  useEffect(() => {
    const box = ref.current;
    if (s === null || chart === undefined || box === null) return;
    const data = (): uPlot.AlignedData => {
      record(chart, chosen); // each time: another run begins without it
      return [times, ...chart.curves.map((curve) => column(chart, curve, chosen))];
    };
    const many = chart.curves.length > 8;
    const legend = () => box.querySelector<HTMLElement>(".u-legend")?.offsetHeight ?? 20;
    const size = () => ({ width: box.clientWidth, height: Math.max(80, box.clientHeight - (many ? 2 : legend() + 4)) });
    const plot = new uPlot({ ...options(s, chart, size().width, size().height), ...(many ? { legend: { show: false } } : {}) }, data(), box);
    drawn.current = plot;
    const rescale = (what = view.peek()) => {
      const [first_s, last_s] = [plot.data[0][0], plot.data[0].at(-1)];
      if (what === "part" || first_s === undefined || last_s === undefined) return;
      const [min, max] = what === "all" && first_s < last_s ? [first_s, last_s] : flight(first_s, last_s);
      plot.setScale("x", { min, max });
    };
    const forget = view.subscribe(rescale);
    plot.over.addEventListener("mouseup", () => (view.value = plot.select.width > 2 ? "part" : view.peek()));
    plot.over.addEventListener("dblclick", () => (view.value = view.peek() === "flight" ? "all" : "flight"));
    const timer = setInterval(() => {
      if (paused.peek() || document.hidden) return;
      plot.setData(data(), false);
      rescale();
      if (plot.cursor.idx == null) plot.setLegend({ idx: presentRow() }); // the values of now, where nobody points at others
    }, many ? MANY_EVERY_MS : DRAW_EVERY_MS);
    const watch = new ResizeObserver(() => plot.setSize(size()));
    watch.observe(box);
    if (!many) watch.observe(plot.root.querySelector(".u-legend")!); // it takes a second line where curves have long names
    return () => {
      clearInterval(timer);
      forget();
      watch.disconnect();
      plot.destroy();
    };
  }, [s, chart?.id, chosen, themeSerial.value]);
  if (s === null || chart === undefined) return null;
  const save = (what: string) => {
    const plot = drawn.current;
    if (plot === null || plot.data[0].length === 0) return;
    const [times, ...columns] = plot.data as [number[], ...(number | null)[][]];
    const places = chart.curves.map((curve, k) => (curve.robot === undefined ? FALLBACK[k % 8]! : placeOf(s, curve.robot)));
    const dashes = chart.curves.map((curve) => dashOf(s, curve).dash ?? []);
    const { min, max } = plot.scales["x"]!;
    void savePlot({ chart, times, columns, places, dashes, from_s: min ?? times[0]!, to_s: max ?? times.at(-1)! }, what);
  };
  const choose = (id: string) => show(slots.value.map((old, k) => (k === slot ? id : old)));
  return (
    <figure class="plot">
      <figcaption>
        <select aria-label={`What plot ${slot + 1} shows`} title={chart.title} value={chart.id} onChange={(event) => choose(event.currentTarget.value)}>
          {all.map(({ id, title }) => (
            <option key={id} value={id}>
              {title}
            </option>
          ))}
          <optgroup label="Any field">
            {(s?.fields ?? []).map((field) => (
              <option key={field.path} value={idOf(field)}>
                {field.title}
              </option>
            ))}
          </optgroup>
        </select>
        <span class="unit">{chart.unit}</span>
        <select
          class="save-as"
          aria-label={`Save plot ${slot + 1}: ${chart.title}`}
          title="Save this plot"
          value=""
          onChange={(event) => {
            save(event.currentTarget.value);
            event.currentTarget.value = "";
          }}
        >
          <option value="">⤓</option>
          {CHOICES.map(([what, text]) => (
            <option key={what} value={what}>
              {text}
            </option>
          ))}
        </select>
      </figcaption>
      <div class="canvas" ref={ref} role="img" aria-label={`${chart.title} over time, ${chart.unit}`} />
    </figure>
  );
}

const copied = signal(false);

/** Layouts of this browser, and the address of the present one. */
function Layouts() {
  const act = (choice: string) => {
    const [verb, name] = [choice[0], choice.slice(1)];
    if (verb === "=") show(layouts.peek()[name]);
    else if (verb === "-") keep(name, true);
    else if (verb === "+") ask("Name of this layout", "Save", (given) => given.trim() && keep(given.trim()), "");
    else void navigator.clipboard.writeText(link()).then(() => (copied.value = true), () => ask("The address of this layout", "Close", () => undefined, link()));
  };
  const names = Object.keys(layouts.value);
  return (
    <select
      aria-label="Layouts of the plots"
      value=""
      onChange={(event) => {
        copied.value = false;
        act(event.currentTarget.value);
        event.currentTarget.value = "";
      }}
    >
      <option value="">{copied.value ? "Link copied" : "Layout"}</option>
      {names.map((name) => (
        <option key={name} value={`=${name}`}>
          {name}
        </option>
      ))}
      <option value="+">Save as …</option>
      <option value="@">Copy link</option>
      {names.map((name) => (
        <option key={`-${name}`} value={`-${name}`}>
          Forget {name}
        </option>
      ))}
    </select>
  );
}

export function Plots() {
  return (
    <section class="plots" aria-label="Plots">
      <div class="plot-tools">
        <Layouts />
        <button type="button" class="pause" aria-pressed={paused.value} onClick={() => (paused.value = !paused.value)}>
          {paused.value ? "Paused" : "Pause"}
        </button>
      </div>
      {Array.from({ length: SLOTS }, (_, slot) => (
        <Plot key={slot} slot={slot} />
      ))}
    </section>
  );
}
