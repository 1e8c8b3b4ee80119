/** The connection to the station: comes back by itself, acknowledges every frame it has taken in. */

import { connected, given, refusal, roundTripMs, take } from "./store";
import type { OrderName, Request } from "./wire";
import { read } from "./wire";

const FIRST_RETRY_MS = 250;
const LONGEST_RETRY_MS = 4000;
const NOT_ALLOWED = 4003;
const ROUND_TRIP_EVERY_MS = 1000; // the slowest of this time is shown: to write every one would lay out the page forty times a second

let socket: WebSocket | null = null;
let retryMs = FIRST_RETRY_MS;
let serial = 0;
let stopAsked = 0; // number of an emergency stop that has not been answered; 0: none
let wantsControl = true;
let slowestMs = 0;
let roundTripAtMs = 0;

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
  opened.onopen = () => {
    retryMs = FIRST_RETRY_MS;
    refusal.value = "";
    say({ kind: "hello", token: token() });
    if (wantsControl) say({ kind: "take" });
    if (stopAsked) order("stop");
  };
  opened.onmessage = (message: MessageEvent<ArrayBuffer>) => {
    const received = read(message.data);
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
    connected.value = false;
    if (event.code === NOT_ALLOWED) refusal.value = event.reason || "not allowed";
    setTimeout(connect, retryMs);
    retryMs = Math.min(2 * retryMs, LONGEST_RETRY_MS);
  };
}

/** Say something to the station. Returns whether there was a connection to say it on. */
export function say(request: Request): boolean {
  if (socket?.readyState !== WebSocket.OPEN) return false;
  socket.send(JSON.stringify(request));
  return true;
}

/** Give an order to the whole fleet; what becomes of it appears in `given`. A stop that is not answered, because it cannot be
 * sent now or goes into a connection that is dead and does not know it yet, is sent on return. */
export function order(name: OrderName): void {
  const n = nextSerial();
  if (name === "stop") stopAsked = n;
  give(name, { kind: "order", n, order: name });
}

/** Other gains for the whole fleet; null: those before. */
export function tune(values: Record<string, number> | null, nextLap: boolean): void {
  give(values === null ? "undo" : "gains", { kind: "tune", n: nextSerial(), values, next_lap: nextLap });
}

function give(text: string, request: Request & { n: number }): void {
  const sent = say(request);
  const reason = sent ? "" : "no connection to the station";
  given.value = [{ n: request.n, order: text, outcome: sent ? ("sent" as const) : ("not sent" as const), reason, answers: [] }, ...given.value].slice(0, 8);
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
