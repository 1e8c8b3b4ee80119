/** The connection to the station: comes back by itself, acknowledges every frame it has taken in.
 *
 * The station says something at least four times a second. Silence means that the station hangs, or that what is between is dead
 * and the browser does not know it yet: then this page is not connected, and after a while it tries another connection. */

import { connected, ended, forgetPicture, given, live, now, refusal, roundTripMs, take, wantedCamera } from "./store";
import type { Edit, OrderName, Request } from "./wire";
import { read } from "./wire";

const FIRST_RETRY_MS = 250;
const LONGEST_RETRY_MS = 4000;
export const SILENT_MS = 1000; // four states that did not come
const ANOTHER_AFTER_MS = 4000; // of silence; the station keeps our control for 5 s
const LOOK_EVERY_MS = 100;
const CATCH_UP_MS = 60; // after this page itself was held up: what has come meanwhile is read first
const MOST_GIVEN = 8;
const [TOO_MANY, NOT_ALLOWED] = [4001, 4003];
const ROUND_TRIP_EVERY_MS = 1000; // the slowest of this time is shown: to write every one would lay out the page forty times a second

let socket: WebSocket | null = null;
let retryMs = FIRST_RETRY_MS;
let serial = 0;
let stopAsked = 0; // number of an emergency stop that has not been answered; 0: none
let wantsControl = true;
let slowestMs = 0;
let roundTripAtMs = 0;
let heardAtMs = 0; // when the last frame came
const page = Array.from(crypto.getRandomValues(new Uint32Array(4)), (part) => part.toString(16)).join("-"); // told at every connection: we are the same

/** The token travels behind the address's #, which no server and no log ever sees. */
function token(): string {
  const given = new URLSearchParams(location.hash.slice(1)).get("token");
  if (given !== null) {
    sessionStorage.setItem("token", given);
    history.replaceState(null, "", location.pathname);
  }
  return sessionStorage.getItem("token") ?? "";
}

export function connect(): void {
  const address = new URL("live", location.href);
  address.protocol = location.protocol === "https:" ? "wss:" : "ws:";
  address.hash = "";
  const opened = new WebSocket(address);
  opened.binaryType = "arraybuffer";
  socket = opened;
  heardAtMs = performance.now();
  opened.onopen = () => {
    if (opened !== socket) return;
    refusal.value = "";
    say({ kind: "hello", token: token(), page, camera: wantedCamera.peek() });
    if (wantsControl) say({ kind: "take" });
    if (stopAsked) sendStop();
  };
  opened.onmessage = (message: MessageEvent<ArrayBuffer>) => {
    if (opened !== socket) return; // of a connection that was given up
    const received = read(message.data);
    retryMs = FIRST_RETRY_MS;
    heardAtMs = performance.now();
    connected.value = true;
    slowestMs = Math.max(slowestMs, received.roundTripMs);
    if (performance.now() - roundTripAtMs > ROUND_TRIP_EVERY_MS) {
      roundTripAtMs = performance.now();
      [roundTripMs.value, slowestMs] = [slowestMs, 0];
    }
    if (received.frame.k === "reply" && received.frame.n === stopAsked) stopAsked = 0;
    take(received.frame);
    say({ kind: "ack", n: received.n });
  };
  opened.onclose = (event) => {
    if (opened !== socket) return;
    connected.value = false;
    if (event.code === NOT_ALLOWED || event.code === TOO_MANY) refusal.value = event.reason || "not allowed";
    again();
  };
}

function again(): void {
  socket = null;
  setTimeout(connect, retryMs);
  retryMs = Math.min(2 * retryMs, ended.peek() ? 4 * FIRST_RETRY_MS : LONGEST_RETRY_MS); // after a run's end somebody waits for the page
}

/** How long the station has said nothing, in ms. */
function silentMs(): number {
  return performance.now() - heardAtMs;
}

function judge(): void {
  if (silentMs() <= SILENT_MS) return;
  connected.value = false;
  now.value = performance.now();
  if (silentMs() <= ANOTHER_AFTER_MS || socket === null) return;
  const dead = socket;
  again();
  dead.close(); // its end may take minutes: nobody waits for it
}

setInterval(() => {
  if (silentMs() > SILENT_MS) setTimeout(judge, CATCH_UP_MS);
}, LOOK_EVERY_MS);

/** Say something to the station. Returns whether there was a connection to say it on. */
export function say(request: Request): boolean {
  if (socket?.readyState !== WebSocket.OPEN) return false;
  socket.send(JSON.stringify(request));
  return true;
}

/** Show another camera's picture, here and in this browser's next pages. */
export function chooseCamera(name: string): void {
  wantedCamera.value = name;
  localStorage.setItem("camera", name);
  forgetPicture();
  say({ kind: "camera", camera: name });
}

/** Ask something of the whole fleet, or of one robot; what becomes of it appears in `given`, `shown` for `text`. A stop that is not answered, because it cannot be
 * sent now or goes into a connection that is dead and does not know it yet, is sent on return. */
export function order(name: OrderName, via: [number, number][] = [], robot = 0, text = "", shown = text, edit?: Edit): void {
  if (name === "stop" && stopAsked) {
    sendStop(); // pressed again: the same request
    return;
  }
  const n = nextSerial();
  if (name === "stop") stopAsked = n;
  const said = shown !== "" ? `${name} ${shown}` : robot === 0 ? name : `${name} ${robot}`;
  give(said, { kind: "order", n, order: name, via_m: via, robot, text, ...(edit === undefined ? {} : { edit }), seen_ms: seenMs() });
}

function sendStop(): void {
  say({ kind: "order", n: stopAsked, order: "stop", seen_ms: 0 });
}

/** Other gains for the whole fleet; null: those before. */
export function tune(values: Record<string, number> | null, nextLap: boolean): void {
  give(values === null ? "undo" : "gains", { kind: "tune", n: nextSerial(), values, next_lap: nextLap, seen_ms: seenMs() });
}

/** The station's clock as of what this page shows: an order that is long on its way is not done. */
function seenMs(): number {
  return live.snapshot?.clock_ms ?? 0;
}

function give(text: string, request: Request & { n: number }): void {
  say(request);
  const one = { n: request.n, order: text, atMs: performance.now(), heard: false, refusal: "", request: 0, outcome: null };
  given.value = [one, ...given.value].filter((g, k) => k < MOST_GIVEN || (g.order === "stop" && !g.heard)); // a stop that nobody has heard is said so until somebody has
}

export function takeControl(over: boolean): void {
  wantsControl = true;
  say({ kind: "take", over });
}

export function releaseControl(): void {
  wantsControl = false;
  say({ kind: "release" });
}

export function nextSerial(): number {
  serial += 1;
  return serial;
}
