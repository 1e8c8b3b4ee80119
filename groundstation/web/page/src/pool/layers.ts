/** What the map shows; a person's choice is remembered. */

import { signal } from "@preact/signals";

export const LAYERS = {
  camera: "camera picture",
  trails: "trails",
  reference: "reference and path",
  horizon: "predicted horizon",
  safety: "safety circles",
  covariance: "pose uncertainty (3 sigma)",
  constraints: "active collision constraints",
  disturbance: "estimated disturbance",
  thrusters: "thruster bars",
  obstacles: "obstacles",
  formation: "formation links",
} as const;

export type Layer = keyof typeof LAYERS;

function remembered(): Record<Layer, boolean> {
  const all = Object.fromEntries(Object.keys(LAYERS).map((name) => [name, true])) as Record<Layer, boolean>;
  try {
    return { ...all, ...(JSON.parse(localStorage.getItem("layers") ?? "{}") as Partial<Record<Layer, boolean>>) };
  } catch {
    return all;
  }
}

export const layers = signal(remembered());
export const follow = signal(false);

export function toggle(layer: Layer): void {
  layers.value = { ...layers.value, [layer]: !layers.value[layer] };
  localStorage.setItem("layers", JSON.stringify(layers.value));
}
