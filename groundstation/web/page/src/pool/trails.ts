/** Where the robots have been: one minute, thinned by distance. */

import { isLocated, onSamples, type Sample, scene } from "../store";

const KEPT_S = 60;
const APART_M = 0.004;
const JUMP_S = 1; // in a recorded run: somebody has sought another time

interface Trail {
  t: number[];
  x: number[];
  y: number[];
  z: number[];
}

export const trails = new Map<number, Trail>();

let recorded: Sample[] = []; // the whole of a recorded run
let lastS = 0;

function add(sample: Sample): void {
  for (const [id, robot] of sample.robots) {
    const state = robot.news.state;
    if (state === undefined || !isLocated(robot) || (state.timing.pose_age_ms ?? Infinity) > 500) continue;
    let trail = trails.get(id);
    const last = trail === undefined ? -1 : trail.t.length - 1;
    if (trail === undefined || (last >= 0 && sample.time_s < trail.t[last]!)) {
      trail = { t: [], x: [], y: [], z: [] }; // the run began again
      trails.set(id, trail);
    }
    const [x, y, z] = [robot.eta[0]!, robot.eta[1]!, robot.eta[2]!];
    const end = trail.t.length - 1;
    const moved = end < 0 || Math.hypot(x - trail.x[end]!, y - trail.y[end]!, z - trail.z[end]!) >= APART_M;
    if (moved) {
      trail.t.push(sample.time_s);
      trail.x.push(x);
      trail.y.push(y);
      trail.z.push(z);
    }
    let old = 0;
    while (old < trail.t.length && sample.time_s - trail.t[old]! > KEPT_S) old++;
    if (old > 0) for (const list of [trail.t, trail.x, trail.y, trail.z]) list.splice(0, old);
  }
}

onSamples(
  (sample) => {
    const sought = Math.abs(sample.time_s - lastS) > JUMP_S || sample.time_s < lastS;
    lastS = sample.time_s;
    if (recorded.length > 0 && sought) {
      trails.clear();
      recorded.filter(({ time_s }) => time_s > sample.time_s - KEPT_S && time_s < sample.time_s).forEach(add);
    }
    add(sample);
  },
  (samples) => {
    trails.clear();
    recorded = scene.peek()?.replay === undefined ? [] : samples;
    if (recorded.length === 0) samples.forEach(add);
  },
);
