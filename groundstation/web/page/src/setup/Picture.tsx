/** The live picture with what lies over it, a magnifier, and clicks and drags in pixels of the camera. */

import { signal } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import { liveAddress, reachable, state, streaming, type Pixel, type State } from "./api";
import { LensOverlay } from "./Lens";
import { draggedCorner, MaskOverlay, maskClick, maskDrag } from "./Masks";
import { SurveyOverlay, surveyClick, surveyDrag } from "./Survey";
import { step } from "./steps";

const MAGNIFIED = 8; // screen pixels for each of the camera's
const LENS_PX = 21; // of the camera, odd: one is in the middle
const TOUCH_PX = 14; // screen pixels within which a handle is taken

/** A thing that can be dragged, and where it is. */
export interface Handle {
  id: string;
  at: Pixel;
}

export const handles = signal<Handle[]>([]);
const pointer = signal<Pixel | null>(null);
const held = signal<string | null>(null);

function pixelOf(event: PointerEvent, view: SVGSVGElement, size: Pixel): Pixel {
  const box = view.getBoundingClientRect();
  const u = ((event.clientX - box.left) / box.width) * size[0] - 0.5;
  const v = ((event.clientY - box.top) / box.height) * size[1] - 0.5;
  return [Math.min(Math.max(u, 0), size[0] - 1), Math.min(Math.max(v, 0), size[1] - 1)];
}

function nearest(at: Pixel, reach: number): string | null {
  const found = handles.value
    .map((handle) => ({ id: handle.id, apart: Math.hypot(handle.at[0] - at[0], handle.at[1] - at[1]) }))
    .filter((handle) => handle.apart <= reach)
    .sort((a, b) => a.apart - b.apart);
  return found[0]?.id ?? null;
}

function Magnifier({ picture }: { picture: HTMLImageElement | null }) {
  const canvas = useRef<HTMLCanvasElement>(null);
  const at = pointer.value;
  const side = LENS_PX * MAGNIFIED;
  useEffect(() => {
    const pen = canvas.current?.getContext("2d");
    if (!pen || !picture || !at || picture.naturalWidth === 0) return;
    pen.imageSmoothingEnabled = false;
    pen.clearRect(0, 0, side, side);
    const half = LENS_PX / 2;
    pen.drawImage(picture, at[0] + 0.5 - half, at[1] + 0.5 - half, LENS_PX, LENS_PX, 0, 0, side, side);
    pen.strokeStyle = "#ff3b30";
    pen.beginPath();
    pen.moveTo(side / 2, 0);
    pen.lineTo(side / 2, side);
    pen.moveTo(0, side / 2);
    pen.lineTo(side, side / 2);
    pen.stroke();
  });
  if (!at) return null;
  return (
    <figure class="magnifier">
      <canvas ref={canvas} width={side} height={side} />
      <figcaption>
        {at[0].toFixed(1)}, {at[1].toFixed(1)}
      </figcaption>
    </figure>
  );
}

function Overlay({ s }: { s: State }) {
  if (step.value === "Lens") return <LensOverlay s={s} />;
  if (step.value === "Survey") return <SurveyOverlay s={s} />;
  return <MaskOverlay s={s} />;
}

export function Picture() {
  const image = useRef<HTMLImageElement>(null);
  const view = useRef<SVGSVGElement>(null);
  const s = state.value;
  if (s === null) return <section class="view" aria-label="Live picture" />;
  const [width, height] = s.size_px;
  const pointing = step.value === "Survey" || step.value === "Masks";
  const drag = step.value === "Survey" ? surveyDrag : maskDrag;
  const click = step.value === "Survey" ? surveyClick : maskClick;
  const trouble = !reachable.value ? "no answer" : streaming.value ? s.trouble : "not live: the picture does not come";
  const move = (event: PointerEvent) => {
    pointer.value = pixelOf(event, view.current!, s.size_px);
    if (held.value !== null) draggedCorner.value = { id: held.value, at: pointer.value };
  };
  const release = () => {
    held.value = null;
    draggedCorner.value = null;
  };
  return (
    <section class={trouble !== "" ? "view lost" : "view"} aria-label="Live picture">
      <div class="frame" style={`aspect-ratio: ${width} / ${height}`}>
        <img ref={image} src={liveAddress.value} alt="What the camera sees now" />
        <svg
          ref={view}
          viewBox={`-0.5 -0.5 ${width} ${height}`}
          class={pointing ? "pointing" : ""}
          onPointerDown={(event) => {
            if (!pointing) return;
            event.preventDefault();
            view.current!.setPointerCapture(event.pointerId);
            pointer.value = pixelOf(event, view.current!, s.size_px);
            held.value = nearest(pointer.value, (TOUCH_PX * width) / view.current!.getBoundingClientRect().width);
          }}
          onPointerMove={(event) => pointing && move(event)}
          onPointerUp={(event) => {
            if (!pointing) return;
            move(event);
            if (held.value === null) click(pointer.value!);
            else drag(held.value, pointer.value!);
            release();
          }}
          onPointerCancel={release}
          onPointerLeave={() => held.value === null && (pointer.value = null)}
        >
          <Overlay s={s} />
        </svg>
        {trouble !== "" && (
          <p class="trouble" role="alert">
            {trouble}
          </p>
        )}
      </div>
      {pointing && <Magnifier picture={image.current} />}
    </section>
  );
}
