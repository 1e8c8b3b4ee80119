/** Step 4: polygons of the picture in which nothing is looked for. */

import { signal } from "@preact/signals";
import { useEffect } from "preact/hooks";
import { ask, state, type Pixel, type State } from "./api";
import { handles, type Handle } from "./Picture";

const drawing = signal<Pixel[]>([]);
export const draggedCorner = signal<Handle | null>(null);

export function maskClick(at: Pixel): void {
  drawing.value = [...drawing.value, at];
}

/** A corner's id is the mask's and its place in it: "3 0". */
export function maskDrag(id: string, at: Pixel): void {
  const [mask, corner] = id.split(" ").map(Number);
  const found = state.value?.masks.find((one) => one.id === mask);
  if (found) void ask("mask", { id: mask, corners_px: found.corners_px.map((old, k) => (k === corner ? at : old)) });
}

async function close(): Promise<void> {
  if ((await ask("mask", { corners_px: drawing.value })) !== undefined) drawing.value = [];
}

export function MaskOverlay({ s }: { s: State }) {
  const corners = s.masks.flatMap((mask) => mask.corners_px.map((at, k) => ({ id: `${mask.id} ${k}`, at })));
  useEffect(() => {
    handles.value = corners;
  }, [s]);
  const size = s.size_px[0] / 130;
  const at = (id: string, where: Pixel): Pixel => (draggedCorner.value?.id === id ? draggedCorner.value.at : where);
  return (
    <>
      {s.masks.map((mask) => (
        <polygon key={mask.id} class="mask" points={mask.corners_px.map((where, k) => at(`${mask.id} ${k}`, where).join(",")).join(" ")} />
      ))}
      {corners.map(({ id, at: where }) => {
        const [u, v] = at(id, where);
        return <rect key={id} class="corner" x={u - size / 2} y={v - size / 2} width={size} height={size} />;
      })}
      <polyline class="drawing" points={drawing.value.map((where) => where.join(",")).join(" ")} />
      {drawing.value.map(([u, v], k) => (
        <circle key={k} class="corner" cx={u} cy={v} r={size / 2} />
      ))}
    </>
  );
}

export function Masks() {
  const s = state.value!;
  return (
    <section>
      <h2>Masks</h2>
      <p class="dim">
        Nothing is looked for inside: a ladder, the deck. Click corners in the picture, then close the polygon; drag corners of those that are
        there.
      </p>
      <div class="row">
        <button type="button" class="main" disabled={drawing.value.length < 3} onClick={() => void close()}>
          Close the polygon
        </button>
        <button type="button" disabled={drawing.value.length === 0} onClick={() => (drawing.value = drawing.value.slice(0, -1))}>
          Take a corner back
        </button>
      </div>
      <ul class="list">
        {s.masks.map((mask) => (
          <li key={mask.id}>
            mask {mask.id}, {mask.corners_px.length} corners
            <button type="button" aria-label={`Delete mask ${mask.id}`} onClick={() => void ask("mask", { id: mask.id, corners_px: [] })}>
              ✕
            </button>
          </li>
        ))}
      </ul>
      {s.masks.length === 0 && <p class="dim">there is none</p>}
    </section>
  );
}
