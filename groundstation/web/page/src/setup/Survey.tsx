/** Step 3: points of the pool, clicked; corners of the outline, dragged; the camera's pose. */

import { signal } from "@preact/signals";
import { useEffect } from "preact/hooks";
import { NumberInput } from "../NumberInput";
import { ask, problem, state, type Pixel, type Place, type Point, type State } from "./api";
import { draggedCorner } from "./Masks";
import { handles } from "./Picture";

const AXES = ["x", "y", "z"] as const;
const name = signal("point 1");
const place = signal<Place>([0, 0, 0]); // NaN: nothing is typed
const marker = signal<number | null>(null);
const found = signal<number[]>([]);

function choose(point: { name: string; pool_m: Place; marker_id?: number | null }): void {
  name.value = point.name;
  place.value = [...point.pool_m];
  marker.value = point.marker_id ?? null;
}

function setAxis(i: number, value: number): void {
  place.value = place.value.map((old, k) => (k === i ? value : old)) as Place;
}

function next(points: Point[]): void {
  let k = 1;
  while (points.some((point) => point.name === `point ${k}`) || name.value === `point ${k}`) k++;
  name.value = `point ${k}`;
  marker.value = null;
}

/** Send the point that the fields hold; then offer the next name, unless another one was typed in the meantime. */
async function put(given: object): Promise<void> {
  const [sent, missing] = [name.value, AXES.filter((_, i) => Number.isNaN(place.value[i]!))];
  if (missing.length > 0) {
    problem.value = `${sent}: the place needs ${missing.join(", ")} in m`;
    return;
  }
  await ask("point", { name: sent, pool_m: place.value, ...given });
  if (state.value !== null && name.value === sent) next(state.value.survey.points);
}

export function surveyClick(at: Pixel): void {
  if (marker.value === null) void put({ pixel_px: at });
}

export function surveyDrag(id: string, at: Pixel): void {
  const s = state.value!;
  const known = s.survey.points.find((point) => point.name === id);
  const pool_m = known?.pool_m ?? s.outline_m[id];
  if (pool_m !== undefined) void ask("point", { name: id, pool_m, pixel_px: at });
}

/** Where each point is seen: as clicked, or where its marker was found. */
function seen(s: State): Map<string, Pixel> {
  const all = new Map<string, Pixel>();
  for (const point of s.survey.points) if (point.pixel_px !== null) all.set(point.name, point.pixel_px);
  for (const residual of s.survey.residuals) if (!all.has(residual.name)) all.set(residual.name, residual.seen_px);
  return all;
}

export function SurveyOverlay({ s }: { s: State }) {
  const points = seen(s);
  const bad = new Set(s.survey.residuals.filter((residual) => residual.bad).map((residual) => residual.name));
  const corners = Object.entries(s.outline).filter(([id]) => !points.has(id));
  useEffect(() => {
    handles.value = [...[...points].map(([id, at]) => ({ id, at })), ...corners.map(([id, at]) => ({ id, at }))];
  }, [s]);
  const arm = s.size_px[0] / 90;
  const at = (id: string, where: Pixel): Pixel => (draggedCorner.value?.id === id ? draggedCorner.value.at : where);
  return (
    <>
      {corners.map(([id, where]) => {
        const [u, v] = at(id, where);
        return (
          <circle key={id} class="corner" cx={u} cy={v} r={arm * 0.8}>
            <title>{id}</title>
          </circle>
        );
      })}
      {[...points].map(([id, where]) => {
        const [u, v] = at(id, where);
        return (
          <g key={id} class={bad.has(id) ? "point bad" : "point"}>
            <path d={`M${u - arm} ${v}H${u + arm}M${u} ${v - arm}V${v + arm}`} />
            <text x={u + arm} y={v - arm} font-size={arm * 1.6}>
              {id}
            </text>
          </g>
        );
      })}
    </>
  );
}

function Row({ s, point }: { s: State; point: Point }) {
  const residual = s.survey.residuals.find((one) => one.name === point.name);
  return (
    <tr class={residual?.bad ? "bad" : ""}>
      <td>
        <button type="button" class="plain" onClick={() => choose(point)} title="Choose it, then click where it is">
          {point.name}
        </button>
        {residual?.bad && <b> does not fit</b>}
      </td>
      <td>{point.pool_m.join(", ")}</td>
      <td>{residual ? residual.error_px.toFixed(1) : point.marker_id === null ? "-" : `marker ${point.marker_id}`}</td>
      <td>{residual ? residual.error_mm.toFixed(1) : "-"}</td>
      <td>
        <button type="button" aria-label={`Remove ${point.name}`} onClick={() => void ask("remove-point", { name: point.name })}>
          ✕
        </button>
      </td>
    </tr>
  );
}

/** The form of one point: its place, and then a click in the picture, or the id of a marker that lies there. */
function PointForm({ s }: { s: State }) {
  const corners = Object.keys(s.outline_m);
  return (
    <>
      <div class="row">
        <label class="name">
          Name <input value={name.value} onInput={(event) => (name.value = event.currentTarget.value)} />
        </label>
        <select
          aria-label="A corner of the pool"
          value=""
          onChange={(event) => choose({ name: event.currentTarget.value, pool_m: s.outline_m[event.currentTarget.value]! })}
        >
          <option value="">or a corner ...</option>
          {corners.map((corner) => (
            <option key={corner}>{corner}</option>
          ))}
        </select>
      </div>
      <div class="row">
        {AXES.map((axis, i) => (
          <label key={axis} class="axis">
            {axis}
            <NumberInput
              aria-label={`${axis}, m`}
              step={0.001}
              value={place.value[i]!}
              onNumber={(value) => setAxis(i, value)}
              onEmpty={() => setAxis(i, NaN)}
            />
            m
          </label>
        ))}
      </div>
      <div class="row">
        <button type="button" onClick={() => void ask<number[]>("markers").then((ids) => (found.value = ids ?? []))}>
          Find markers
        </button>
        {found.value.map((id) => (
          <button key={id} type="button" aria-pressed={marker.value === id} onClick={() => void put({ marker_id: id })}>
            is marker {id}
          </button>
        ))}
      </div>
    </>
  );
}

export function Survey() {
  const s = state.value!;
  return (
    <>
      <section>
        <h2>Points of the pool</h2>
        <p class="dim">
          Origin on the surface in the middle of the pool, x along it, y across, z down. Give the place, then click it in the picture, or drag a
          corner of the outline to where it is.
        </p>
        <PointForm s={s} />
        {s.survey.points.length > 0 && (
          <table>
            <thead>
              <tr>
                <th>Point</th>
                <th>x, y, z m</th>
                <th>px</th>
                <th>mm</th>
                <th />
              </tr>
            </thead>
            <tbody>
              {s.survey.points.map((point) => (
                <Row key={point.name} s={s} point={point} />
              ))}
            </tbody>
          </table>
        )}
        <button type="button" class="main" disabled={s.survey.points.length < 4} onClick={() => void ask("fit-pose")}>
          Find the pose
        </button>
        <label class="row">
          <input type="checkbox" checked={s.grid_depth_m !== null} onChange={(event) => void ask("grid", { depth_m: event.currentTarget.checked ? 0.3 : null })} />
          Grid at depth
          <NumberInput
            class="depth"
            aria-label="Depth of the grid, m"
            step={0.1}
            value={s.grid_depth_m ?? 0.3}
            disabled={s.grid_depth_m === null}
            onNumber={(value) => void ask("grid", { depth_m: value })}
          />
          m
        </label>
        {s.survey.report.length > 0 && <pre tabIndex={0}>{s.survey.report.join("\n")}</pre>}
      </section>
    </>
  );
}
