/** Numbers of a robot's state by their paths, `state.control.wrench.0`: the station says which there are (shoal/messages/labels.py). */

import type { RobotState } from "./messages";
import type { Field, Scene } from "./wire";

const HEAD = "state.";

export function idOf(field: Field): string {
  return HEAD + field.path;
}

export function fieldOf(s: Scene, id: string): Field | undefined {
  return s.fields.find((field) => idOf(field) === id);
}

/** The number at a path. Undefined where the state has no such part. */
export function valueAt(state: RobotState, path: string): number | undefined {
  let value: unknown = state;
  for (const name of path.split(".")) {
    if (value instanceof Uint8Array) value = packedAt(value, Number(name));
    else value = (value as Record<string, unknown> | null | undefined)?.[name];
  }
  return typeof value === "number" ? value : undefined;
}

/** One number of a packed array: its bytes lie where float32 may not be read. */
function packedAt(packed: Uint8Array, k: number): number | undefined {
  return 4 * k + 4 <= packed.byteLength ? new DataView(packed.buffer, packed.byteOffset).getFloat32(4 * k, true) : undefined;
}
