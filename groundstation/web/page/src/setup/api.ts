/** What the page of `localizer setup` knows, and how it asks: the state is fetched, requests are posted. localizer/setup/session.py. */

import { computed, signal } from "@preact/signals";

export type Pixel = [number, number];
export type Place = [number, number, number];

export interface Verdict {
  good: boolean;
  text: string;
}

export interface Figures {
  histogram: number[];
  dark_share: number;
  bright_share: number;
  focus: number;
  best_focus: number;
  blur_mm: number;
  blur_px: number | null;
  verdicts: Verdict[];
}

export interface Control {
  name: string;
  value: number;
  minimum: number;
  maximum: number;
  step: number;
  default: number;
  choices: [number, string][];
  usable: boolean;
}

export interface Point {
  name: string;
  pool_m: Place;
  pixel_px: Pixel | null;
  marker_id: number | null;
}

interface Residual {
  name: string;
  seen_px: Pixel;
  error_px: number;
  error_mm: number;
  bad: boolean;
}

interface Mask {
  id: number;
  corners_px: Pixel[];
}

export interface State {
  experiment: string;
  source: string;
  trouble: string;
  streams: boolean; // this page is being sent the picture
  said: string[];
  size_px: [number, number];
  rate: Verdict;
  figures: Figures | null;
  controls: Control[];
  no_controls: string;
  grid_depth_m: number | null;
  lens: {
    board: string;
    collecting: boolean;
    said: string;
    seen_px: Pixel[];
    coverage: number[][];
    tilts_deg: Pixel[];
    views: string[];
    missing: string[];
    report: string[];
  };
  survey: { points: Point[]; residuals: Residual[]; report: string[] };
  outline: Record<string, Pixel>;
  outline_m: Record<string, Place>;
  masks: Mask[];
  path: string;
  changed: Record<string, unknown>; // what would be saved, by key
}

const PERIOD_MS = 300;
const ANSWERS_WITHIN_MS = 3000; // a state; later, what is shown is old
const STREAM_AGAIN_MS = 3000; // without the picture, after which it is asked for again
const key = new URLSearchParams(location.hash.slice(1)).get("key") ?? "";
addEventListener("hashchange", () => location.reload()); // the printed address, put into a tab that was open without its key
const page = crypto.randomUUID();

export const state = signal<State | null>(null);
export const problem = signal(""); // of the last request, or of the connection
export const reachable = signal(true);
export const streaming = signal(true); // this page is being sent the picture
const streamNumber = signal(0); // an image whose stream has ended keeps its last picture, and no browser says so: another one is asked for
export const liveAddress = computed(() => `live?key=${encodeURIComponent(key)}&page=${page}&stream=${streamNumber.value}`);
let streamAskedAtMs = performance.now();

async function look(): Promise<void> {
  try {
    const answer = await fetch(`state?page=${page}`, { headers: { "x-key": key }, signal: AbortSignal.timeout(ANSWERS_WITHIN_MS) });
    if (!answer.ok) return lose(await answer.text());
    const [told, isBack] = [(await answer.json()) as State, !reachable.peek()];
    const isMissing = !told.streams && performance.now() - streamAskedAtMs > STREAM_AGAIN_MS;
    if (isMissing || told.streams) streaming.value = told.streams;
    if (isMissing || isBack) {
      streamAskedAtMs = performance.now();
      streamNumber.value += 1;
    }
    if (isBack) problem.value = ""; // of the connection
    state.value = told;
    reachable.value = true;
  } catch {
    lose("localizer setup does not answer: is it running? What was done is kept there, not in this page.");
  }
}

function lose(why: string): void {
  reachable.value = false;
  problem.value = why;
}

export async function watch(): Promise<void> {
  for (;;) {
    await look();
    await new Promise((later) => setTimeout(later, PERIOD_MS));
  }
}

/** Ask for something; undefined when it was refused, which `problem` then tells. What a person has not asked for, `byItself`, leaves
 * the problem of the last request where it is. */
export async function ask<T = unknown>(name: string, given: object = {}, byItself = false): Promise<T | undefined> {
  try {
    const answer = await fetch("do", {
      method: "POST",
      headers: { "x-key": key, "content-type": "application/json" },
      body: JSON.stringify({ do: name, ...given }),
    });
    if (!answer.ok) throw new Error(await answer.text());
    const told = (await answer.json()) as { problem: string; found?: T };
    if (told.problem !== "" || !byItself) problem.value = told.problem;
    await look();
    return told.problem ? undefined : told.found;
  } catch (error) {
    problem.value = String(error instanceof Error ? error.message : error);
    return undefined;
  }
}
