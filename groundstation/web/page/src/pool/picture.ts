/** Lays the camera's picture under the map: each cell of the station's mesh is an affine piece of it. */

import { camera, live, scene } from "../store";
import { floats } from "../wire";

const MOST_PX_PER_M = 170; // of the straightened picture; the preview of the pool scene has about 140
const MOST_PX = 800; // across: no preview has more
const OVERLAP_PX = 0.6; // neighbouring pieces, or one sees the seams

interface Mesh {
  columns: number;
  rows: number;
  pxPerM: number;
  pool: Float32Array;
  picture: Float32Array;
}

let mesh: Mesh | null = null;
let meshOf = "";
const flat = document.createElement("canvas");
let flatSerial = -1;

function theMesh(): Mesh | null {
  const [s, from] = [scene.peek(), camera.peek()];
  if (s === null || from === undefined || `${s.hash} ${from.name}` === meshOf) return mesh;
  meshOf = `${s.hash} ${from.name}`;
  flatSerial = -1;
  const u = from.underlay;
  if (u === null) {
    mesh = null;
  } else {
    const pool = floats(u.pool);
    const pxPerM = Math.min(MOST_PX_PER_M, MOST_PX / (pool[pool.length - 2]! - pool[0]!));
    mesh = { pxPerM, columns: u.columns, rows: pool.length / 2 / u.columns, pool, picture: floats(u.picture) };
  }
  return mesh;
}

/** The straightened picture and the pool rectangle [x, y, width, height] that it covers; null while there is none. */
export function straightened(): { image: HTMLCanvasElement; at: [number, number, number, number] } | null {
  const m = theMesh();
  const image = live.picture;
  if (m === null || image === null) return null;
  const last = m.pool.length - 2;
  const [x0, y0, x1, y1] = [m.pool[0]!, m.pool[1]!, m.pool[last]!, m.pool[last + 1]!];
  if (flatSerial !== live.pictureSerial) {
    flatSerial = live.pictureSerial;
    flat.width = Math.round((x1 - x0) * m.pxPerM);
    flat.height = Math.round((y1 - y0) * m.pxPerM);
    straighten(m, image, flat.getContext("2d")!, x0, y0);
  }
  return { image: flat, at: [x0, y0, x1 - x0, y1 - y0] };
}

function straighten(m: Mesh, image: ImageBitmap, to: CanvasRenderingContext2D, x0: number, y0: number): void {
  for (let row = 0; row + 1 < m.rows; row++) {
    for (let column = 0; column + 1 < m.columns; column++) {
      const k = 2 * (row * m.columns + column);
      const below = k + 2 * m.columns;
      const left = (m.pool[k]! - x0) * m.pxPerM;
      const top = (m.pool[k + 1]! - y0) * m.pxPerM;
      const width = (m.pool[k + 2]! - m.pool[k]!) * m.pxPerM;
      const height = (m.pool[below + 1]! - m.pool[k + 1]!) * m.pxPerM;
      const [u, v] = [m.picture[k]! * image.width, m.picture[k + 1]! * image.height];
      const du = [m.picture[k + 2]! * image.width - u, m.picture[below]! * image.width - u] as const;
      const dv = [m.picture[k + 3]! * image.height - v, m.picture[below + 1]! * image.height - v] as const;
      const det = du[0] * dv[1] - du[1] * dv[0];
      const outside = u < -image.width || u > 2 * image.width || v < -image.height || v > 2 * image.height;
      if (outside || Math.abs(det) < 1e-6) continue;
      // the affine map that takes the picture's parallelogram to this cell
      const a = (width * dv[1]) / det;
      const c = (-width * du[1]) / det;
      const b = (-height * dv[0]) / det;
      const d = (height * du[0]) / det;
      to.save();
      to.beginPath();
      to.rect(left - OVERLAP_PX, top - OVERLAP_PX, width + 2 * OVERLAP_PX, height + 2 * OVERLAP_PX);
      to.clip();
      to.transform(a, b, c, d, left - a * u - c * v, top - b * u - d * v);
      to.drawImage(image, 0, 0);
      to.restore();
    }
  }
}
