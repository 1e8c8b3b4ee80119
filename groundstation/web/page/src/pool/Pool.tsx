/** The map: the canvas, and the mouse, fingers and keys on it. */

import { signal } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import { css, robotColour } from "../colours";
import { drafting } from "../panels/OtherFlight";
import { drawEdit, editDrag, editDrop, editGrab } from "../editor/canvas";
import { chooseCamera } from "../link";
import { camera, choose, drawSoon, drafted, drawWith, editing, isLocated, live, now, pictureAgeMs, scene, selected, shown } from "../store";
import { drawPool } from "./draw";
import { follow, LAYERS, type Layer, layers, toggle } from "./layers";
import { addPlace, drawPlaces, places } from "./places";
import { drawPath, placeOf } from "./path";
import { View } from "./view";
import type { Deep } from "../three/three";

const view = new View();
const deepOpen = signal(false);
const cursor = signal<[number, number] | null>(null);
let sceneFitted = "";

/** The 3-D view while it is open. Its code is fetched when it is first asked for. */
const deep = signal<Deep | null>(null);

/** Fit the pool, and follow nothing. */
export function fitView(): void {
  const s = scene.peek();
  if (s === null) return;
  follow.value = false;
  view.touched = false;
  view.fit(s.pool_m[0], s.pool_m[1]);
  drawSoon();
}

export function zoomBy(factor: number): void {
  view.zoom(factor, view.width / 2, view.height / 2);
  drawSoon();
}

let size: [number, number] = [1, 1]; // of the canvas: to ask for it at every frame would make the browser lay out the page

function place(canvas: HTMLCanvasElement): void {
  const ratio = devicePixelRatio;
  const [width, height] = size;
  const pixels: [number, number] = [Math.round(width * ratio), Math.round(height * ratio)];
  if (canvas.width !== pixels[0] || canvas.height !== pixels[1]) [canvas.width, canvas.height] = pixels;
  const s = scene.peek();
  const resized = view.width !== width || view.height !== height;
  view.width = width;
  view.height = height;
  if (s !== null && (s.hash !== sceneFitted || (resized && !view.touched))) {
    sceneFitted = s.hash;
    view.fit(s.pool_m[0], s.pool_m[1]);
  }
}

function followSelected(): void {
  const chosen = live.robots.get(selected.peek());
  const robots = (chosen !== undefined ? [chosen] : [...live.robots.values()]).filter(isLocated);
  if (!follow.peek() || robots.length === 0) return;
  view.x = robots.reduce((sum, robot) => sum + robot.eta[0]!, 0) / robots.length;
  view.y = robots.reduce((sum, robot) => sum + robot.eta[1]!, 0) / robots.length;
}

function pick(px: number, py: number): number {
  const s = scene.peek();
  if (s === null) return 0;
  for (const [id, robot] of live.robots) {
    const [x, y] = view.toScreen(robot.eta[0]!, robot.eta[1]!);
    if (isLocated(robot) && Math.hypot(px - x, py - y) < Math.max(14, s.hull_m * view.scale)) return id;
  }
  return 0;
}

/** Dragging, pinching and picking. Pointers cover mouse, pen and fingers alike. */
function handle(canvas: HTMLCanvasElement): () => void {
  const down = new Map<number, [number, number]>();
  let moved = 0;
  const at = (event: PointerEvent | WheelEvent): [number, number] => [event.offsetX, event.offsetY];
  const listeners = new AbortController();
  const on = <K extends keyof HTMLElementEventMap>(name: K, listener: (event: HTMLElementEventMap[K]) => void) =>
    canvas.addEventListener(name, listener, { signal: listeners.signal, passive: false });
  on("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    down.set(event.pointerId, at(event));
    moved = 0;
    if (editing.peek() && down.size === 1) editGrab(view, ...at(event));
  });
  on("pointermove", (event) => {
    const [px, py] = at(event);
    cursor.value = view.toPool(px, py);
    const before = down.get(event.pointerId);
    if (before === undefined) return;
    down.set(event.pointerId, [px, py]);
    if (editing.peek() && down.size === 1 && editDrag(view, px, py)) {
      drawSoon();
      return;
    }
    const [dx, dy] = [px - before[0], py - before[1]];
    moved += Math.hypot(dx, dy);
    if (down.size === 1) view.pan(dx, dy);
    else pinch(down, event.pointerId, before);
    if (moved > 4) follow.value = false;
    drawSoon();
  });
  const up = (event: PointerEvent) => {
    if (!down.delete(event.pointerId)) return;
    if (editing.peek() && editDrop()) return;
    if (moved < 4 && event.type === "pointerup" && places.peek() !== null) addPlace(...view.toPool(...at(event)));
    else if (moved < 4 && event.type === "pointerup" && !editing.peek()) {
      const found = pick(...at(event));
      if (found !== 0) choose(found, event.shiftKey || event.ctrlKey || event.metaKey);
      else if (selected.peek() !== 0) choose(selected.peek());
    }
  };
  on("pointerup", up);
  on("pointercancel", up);
  on("pointerleave", () => (cursor.value = null));
  on("wheel", (event) => {
    event.preventDefault();
    view.zoom(Math.exp(-event.deltaY * (event.ctrlKey ? 0.01 : 0.0015)), ...at(event));
    drawSoon();
  });
  on("dblclick", () => places.peek() === null && fitView());
  return () => listeners.abort();
}

function pinch(down: Map<number, [number, number]>, id: number, before: [number, number]): void {
  const current = down.get(id);
  const other = [...down].find(([key]) => key !== id)?.[1];
  if (current === undefined || other === undefined) return;
  const was = Math.hypot(before[0] - other[0], before[1] - other[1]);
  const is = Math.hypot(current[0] - other[0], current[1] - other[1]);
  if (was > 1) view.zoom(is / was, (current[0] + other[0]) / 2, (current[1] + other[1]) / 2);
}

function DeepView() {
  const ref = useRef<HTMLDivElement>(null);
  useEffect(() => {
    let gone = false;
    import("../three/three").then(({ openDeep }) => {
      if (!gone && ref.current !== null) deep.value = openDeep(ref.current);
      drawSoon();
    });
    return () => {
      gone = true;
      deep.value?.close();
      deep.value = null;
    };
  }, []);
  return <div class="deep" ref={ref} role="img" aria-label="The pool in three dimensions; drag turns it" />;
}

/** How a layer looks on the map: the menu is its legend. */
function Sample({ of }: { of: Layer }) {
  const line = SAMPLES[of];
  if (line === undefined) return <svg width="26" height="12" aria-hidden="true" />;
  return (
    <svg width="26" height="12" aria-hidden="true" fill="none" stroke="currentcolor" stroke-width="2">
      {line}
    </svg>
  );
}

const SAMPLES: Partial<Record<Layer, preact.JSX.Element>> = {
  reference: <path d="M17 6a5 5 0 1 0 -10 0a5 5 0 1 0 10 0h8" />,
  horizon: <path d="M1 9C8 9 12 4 20 4m0 0a1.5 1.5 0 1 0 3 0a1.5 1.5 0 1 0 -3 0" />,
  safety: <path d="M13 1a5 5 0 1 0 .1 0" stroke-dasharray="3 2" />,
  trails: <path d="M1 9C8 9 14 3 25 3" opacity=".6" />,
  covariance: <ellipse cx="13" cy="6" rx="9" ry="4" stroke-width="1.2" />,
  disturbance: <path d="M2 6h18m0 0l-5 -4m5 4l-5 4" />,
  thrusters: <path d="M3 6h20" stroke-width="5" />,
};

function LayerMenu() {
  return (
    <details class="layers">
      <summary title="What the map shows">Layers</summary>
      <div class="menu">
        {(Object.keys(LAYERS) as Layer[]).map((name) => (
          <label key={name}>
            <input
              type="checkbox"
              checked={layers.value[name]}
              onChange={() => {
                toggle(name);
                drawSoon();
              }}
            />
            <Sample of={name} />
            {LAYERS[name]}
          </label>
        ))}
      </div>
    </details>
  );
}

/** The next camera's picture, after the last one the first's. */
export function showNextCamera(): void {
  const cameras = scene.peek()?.cameras ?? [];
  const place = cameras.findIndex(({ name }) => name === camera.peek()?.name);
  if (cameras.length > 1) chooseCamera(cameras[(place + 1) % cameras.length]!.name);
}

/** The choice of the camera whose picture lies under the map, where there are several. */
function CameraChoice() {
  const cameras = scene.value?.cameras ?? [];
  if (cameras.length < 2) return null;
  const out = shown.value?.localizer?.out ?? [];
  return (
    <select
      aria-label="Camera whose picture is shown"
      title="camera whose picture is shown (C)"
      value={camera.value?.name}
      onChange={(event) => chooseCamera(event.currentTarget.value)}
    >
      {cameras.map(({ name }) => (
        <option key={name} value={name}>
          {out.includes(name) ? `${name} (out)` : name}
        </option>
      ))}
    </select>
  );
}

function PictureAge() {
  now.value; // re-read the clock
  const [s, from] = [scene.value, camera.value];
  if (from?.underlay === null) return <span class="picture-age old">picture not shown: the camera moves</span>;
  const of = from?.name ? ` of ${from.name}` : "";
  if (s === null || live.picture === null) return <span class="picture-age old">no camera picture{of}</span>;
  const age = pictureAgeMs();
  const old = age > s.picture_stale_s * 1e3;
  return <span class={old ? "picture-age old" : "picture-age"}>picture{of} {(age / 1e3).toFixed(1)} s{old ? " old" : ""}</span>;
}

function Cursor() {
  const at = cursor.value;
  return <span class="cursor">{at === null ? "" : `x ${at[0].toFixed(2)}  y ${at[1].toFixed(2)} m`}</span>;
}

export function Pool() {
  const ref = useRef<HTMLCanvasElement>(null);
  useEffect(() => {
    const canvas = ref.current!;
    const pen = canvas.getContext("2d", { alpha: false })!;
    drawWith(() => {
      const s = scene.peek();
      place(canvas);
      followSelected();
      pen.setTransform(devicePixelRatio, 0, 0, devicePixelRatio, 0, 0);
      drawPool(pen, view);
      canvas.dataset.paths = live.paths.map(({ id }) => id).join(" ");
      if (editing.peek()) drawEdit(pen, view);
      if (drafting.peek() !== "" && s !== null) drafted.peek()?.paths?.forEach((path) => drawPath(pen, view, path, robotColour(placeOf(s, path.robot)), 1, [7, 5]));
      drawPlaces(pen, view);
      deep.peek()?.draw();
      if (live.snapshot !== null) {
        live.drawnStampMs = live.snapshot.stamp_ms;
        window.shoal?.drawn?.(live.snapshot.stamp_ms, live.pictureStampMs);
      }
    });
    const measure = () => {
      size = [canvas.clientWidth, canvas.clientHeight];
      drawSoon();
    };
    const watch = new ResizeObserver(measure);
    measure();
    watch.observe(canvas);
    const stop = handle(canvas);
    drawSoon();
    return () => {
      watch.disconnect();
      stop();
    };
  }, []);
  useEffect(() => drawSoon(), [scene.value, css("--water")]);
  return (
    <section class="pool" aria-label="Map of the pool">
      <canvas ref={ref} role="img" aria-label="The pool seen from above, with every robot; the same is told in the list of robots" />
      {deepOpen.value && <DeepView />}
      <div class="map-tools">
        <CameraChoice />
        <LayerMenu />
        <button type="button" onClick={() => zoomBy(1.25)} aria-label="zoom in" title="zoom in (+)">+</button>
        <button type="button" onClick={() => zoomBy(0.8)} aria-label="zoom out" title="zoom out (-)">−</button>
        <button type="button" onClick={fitView} title="show the whole pool (F)">Fit</button>
        <button
          type="button"
          aria-pressed={follow.value}
          onClick={() => {
            follow.value = !follow.value;
            drawSoon();
          }}
          title="keep the chosen robot, or the fleet, in the middle (G)"
        >
          Follow
        </button>
        <button type="button" aria-pressed={deepOpen.value} onClick={() => (deepOpen.value = !deepOpen.value)} title="see how deep they are">
          3-D
        </button>
      </div>
      <div class="map-foot">
        {!deepOpen.value && <PictureAge />}
        <Cursor />
      </div>
    </section>
  );
}
