/** What the plots show: kept in this browser under a name, and shared as an address: ?plots=tracking,state.estimate.nu.0&robot=2. */

import { signal } from "@preact/signals";
import { selected } from "./store";

export const SLOTS = 4;
const DEFAULT = ["tracking", "formation", "inputs", "latency"];

/** Four ids of charts, from whatever was kept or given; an id that is none shows the first chart. */
function complete(ids: unknown): string[] {
  const given = Array.isArray(ids) ? ids.filter((id): id is string => typeof id === "string") : [];
  return DEFAULT.map((id, k) => given[k] || id);
}

function kept(name: string): unknown {
  try {
    return JSON.parse(localStorage.getItem(name) ?? "null");
  } catch {
    return null;
  }
}

const asked = new URLSearchParams(location.search);
export const slots = signal<string[]>(complete(asked.get("plots")?.split(",") ?? kept("plots")));
export const layouts = signal<Record<string, string[]>>((kept("layouts") as Record<string, string[]> | null) ?? {});
if (/^\d+$/.test(asked.get("robot") ?? "")) selected.value = Number(asked.get("robot"));

export function show(ids: unknown): void {
  slots.value = complete(ids);
  localStorage.setItem("plots", JSON.stringify(slots.value));
}

/** Keep the present layout under a name; null: forget it. */
export function keep(name: string, forget = false): void {
  const { [name]: _, ...others } = layouts.peek();
  layouts.value = forget ? others : { ...others, [name]: slots.peek() };
  localStorage.setItem("layouts", JSON.stringify(layouts.value));
}

/** The address that shows the same elsewhere. */
export function link(): string {
  const robot = selected.peek() === 0 ? "" : `&robot=${selected.peek()}`;
  return `${location.origin}${location.pathname}?plots=${slots.peek().join(",")}${robot}`;
}
