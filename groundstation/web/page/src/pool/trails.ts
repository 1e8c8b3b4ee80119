/** Where the robots have been: one minute, thinned by distance. */

import { live, onState, scene } from "../store";

const KEPT_S = 60;
const APART_M = 0.004;

export interface Trail {
  t: number[];
  x: number[];
  y: number[];
  z: number[];
}

export const trails = new Map<number, Trail>();

let runOf = "";

onState((state) => {
  const run = scene.peek()?.hash ?? "";
  if (run !== runOf) trails.clear();
  runOf = run;
  for (const news of state.robots) {
    const robot = live.robots.get(news.id);
    if (robot === undefined || news.state === undefined || news.state.pose_age_ms > 500) continue;
    let trail = trails.get(news.id);
    const last = trail === undefined ? -1 : trail.t.length - 1;
    if (trail === undefined || (last >= 0 && state.time_s < trail.t[last]!)) {
      trail = { t: [], x: [], y: [], z: [] }; // the run began again, or was rewound
      trails.set(news.id, trail);
    }
    const [x, y, z] = [robot.eta[0]!, robot.eta[1]!, robot.eta[2]!];
    const end = trail.t.length - 1;
    const moved = end < 0 || Math.hypot(x - trail.x[end]!, y - trail.y[end]!, z - trail.z[end]!) >= APART_M;
    if (moved) {
      trail.t.push(state.time_s);
      trail.x.push(x);
      trail.y.push(y);
      trail.z.push(z);
    }
    let old = 0;
    while (old < trail.t.length && state.time_s - trail.t[old]! > KEPT_S) old++;
    if (old > 0) for (const list of [trail.t, trail.x, trail.y, trail.z]) list.splice(0, old);
  }
});
