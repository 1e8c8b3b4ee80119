/** Places that a person clicks on the map: the formation is to fly over them next, or one robot to one of them. */

import { effect, signal } from "@preact/signals";
import { css, robotColour } from "../colours";
import { order } from "../link";
import { drawSoon, editing, ended, given, scene, selected } from "../store";
import type { View } from "./view";

const MOST = 50; // as many as the station takes

/** The places so far; null: clicks choose robots. */
export const places = signal<[number, number][] | null>(null);

export const placesFor = signal(0); // the robot that is sent alone; 0: the formation

const asked = signal(0); // number of the request for these places; 0: none yet

export function choosePlaces(on: boolean, robot = 0): void {
  places.value = on ? [] : null;
  asked.value = 0;
  placesFor.value = robot;
  drawSoon();
}

/** What nobody sees any more is not being chosen: clicks and Escape would mean it all the same. */
effect(() => {
  const seen = placesFor.value === 0 ? !editing.value && !ended.value : placesFor.value === selected.value;
  if (!seen && places.peek() !== null) choosePlaces(false);
});

/** The reason for which nobody is led to a place; empty for one in the pool. Between robots, walls and islands the planner decides. */
export function notThere(x: number, y: number): string {
  const [length, width] = scene.value?.pool_m ?? [Infinity, Infinity];
  return Math.abs(x) <= length / 2 && Math.abs(y) <= width / 2 ? "" : `(${x}, ${y}) m is outside the pool`;
}

export function addPlace(x: number, y: number): void {
  if (notThere(x, y) !== "") return;
  const place: [number, number] = [Number(x.toFixed(2)), Number(y.toFixed(2))];
  places.value = placesFor.peek() !== 0 ? [place] : [...(places.peek() ?? []), place].slice(0, MOST);
  drawSoon();
}

export function flyThere(): void {
  const chosen = places.peek();
  if (chosen === null || chosen.length === 0) return;
  order("go", chosen, placesFor.peek());
  asked.value = given.peek()[0]?.n ?? 0;
}

/** Places stay until the station has taken them: what is refused can be put right. */
effect(() => {
  const request = given.value.find(({ n }) => n === asked.value);
  if (request?.heard && request.refusal === "") choosePlaces(false);
});

export function drawPlaces(pen: CanvasRenderingContext2D, view: View): void {
  const chosen = places.peek();
  if (chosen === null || chosen.length === 0) return;
  const robot = placesFor.peek();
  const place = scene.peek()?.robots.findIndex(({ id }) => id === robot) ?? -1;
  pen.strokeStyle = pen.fillStyle = place >= 0 ? robotColour(place) : css("--accent");
  pen.lineWidth = 2;
  pen.setLineDash([6, 4]);
  pen.beginPath();
  for (const [x, y] of chosen) pen.lineTo(...view.toScreen(x, y));
  pen.stroke();
  pen.setLineDash([]);
  pen.font = "600 12px system-ui, sans-serif";
  chosen.forEach(([x, y], k) => {
    const [px, py] = view.toScreen(x, y);
    pen.beginPath();
    pen.arc(px, py, 6, 0, 2 * Math.PI);
    pen.fill();
    pen.fillText(robot !== 0 ? `to here: ${robot}` : `${k + 1}`, px + 9, py - 6);
  });
}
