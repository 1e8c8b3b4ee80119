/** Alarms that are heard. Made of two tones each; nothing is loaded. */

import { effect, signal } from "@preact/signals";
import { alarms, scene } from "./store";
import type { Alarm } from "./wire";

const AGAIN_MS = 3000;

export const soundOn = signal(localStorage.getItem("sound") !== "off");
export const silenced = signal<ReadonlySet<string>>(new Set()); // acknowledged causes

let audio: AudioContext | null = null;
export const mayAlarm = signal(false); // a browser lets a page sound only after a click or a key

/** At every touch: a browser that has let the page sound may take it away again, as when the computer sleeps. */
function begin(): void {
  if (audio === null) {
    audio = new AudioContext();
    audio.onstatechange = () => (mayAlarm.value = audio?.state === "running");
  }
  if (audio.state !== "running") void audio.resume().catch(() => undefined);
}

for (const touch of ["click", "keydown"] as const) addEventListener(touch, begin);

export function toggleSound(): void {
  soundOn.value = !soundOn.value;
  localStorage.setItem("sound", soundOn.value ? "on" : "off");
}

function tone(frequency: number, atS: number, lastsS: number): void {
  if (audio === null) return;
  const [source, gain] = [audio.createOscillator(), audio.createGain()];
  const start = audio.currentTime + atS;
  source.frequency.value = frequency;
  gain.gain.setValueAtTime(0, start);
  gain.gain.linearRampToValueAtTime(0.15, start + 0.02);
  gain.gain.linearRampToValueAtTime(0, start + lastsS);
  source.connect(gain).connect(audio.destination);
  source.start(start);
  source.stop(start + lastsS);
}

const TONES = { critical: [880, 660, 880], warning: [660, 520], notice: [] };

const known = new Set<string>();

/** A cause at its level: one that grows worse is another. */
export function causeOf({ level, key }: Alarm): string {
  return `${level} ${key}`;
}

effect(() => {
  const current = alarms.value;
  const causes = new Set(current.map(causeOf));
  for (const key of known) if (!causes.has(key)) known.delete(key);
  const gone = [...silenced.peek()].some((key) => !causes.has(key)); // what comes again was not silenced
  if (gone) silenced.value = new Set([...silenced.peek()].filter((key) => causes.has(key)));
  const fresh = current.filter((alarm) => !known.has(causeOf(alarm)));
  for (const alarm of fresh) known.add(causeOf(alarm));
  const worst = fresh.find((alarm) => alarm.level === "critical") ?? fresh[0];
  if (worst !== undefined) sound(worst.level);
});

/** Of a recorded run nothing sounds: it is over. */
function sound(level: keyof typeof TONES): void {
  if (soundOn.peek() && scene.peek()?.replay === undefined) TONES[level].forEach((frequency, k) => tone(frequency, 0.16 * k, 0.15));
}

/** A critical cause sounds again until it is acknowledged or gone. */
setInterval(() => {
  if (alarms.peek().some((alarm) => alarm.level === "critical" && !silenced.peek().has(causeOf(alarm)))) sound("critical");
}, AGAIN_MS);

export function acknowledgeAlarms(): void {
  silenced.value = new Set(alarms.peek().map(causeOf));
}
