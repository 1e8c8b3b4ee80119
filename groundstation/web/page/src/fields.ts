/** Every number that a robot says of itself, as a field that can be plotted. */

import type { Packed, RobotState } from "./wire";

export interface Field {
  title: string;
  unit: string;
  of(state: RobotState): number | undefined;
}

const POSE: [string, string][] = [["x", "m"], ["y", "m"], ["depth", "m"], ["yaw", "rad"]]; // prettier-ignore
const VELOCITY: [string, string][] = [["surge", "m/s"], ["sway", "m/s"], ["heave", "m/s"], ["yaw rate", "rad/s"]]; // prettier-ignore
const ACCELERATION: [string, string][] = [["surge", "m/s²"], ["sway", "m/s²"], ["heave", "m/s²"], ["yaw", "rad/s²"]]; // prettier-ignore
const WRENCH: [string, string][] = [["surge", "N"], ["heave", "N"], ["yaw", "N m"], ["sway", "N"]]; // prettier-ignore
const PULSES: [string, string][] = Array.from({ length: 8 }, (_, k) => [k < 4 ? `thruster ${k + 1}` : `ankle ${k - 3}`, "us"]);

type PackedKey = { [K in keyof RobotState]: RobotState[K] extends Packed ? K : never }[keyof RobotState];
type NumberKey = { [K in keyof RobotState]: RobotState[K] extends number ? K : never }[keyof RobotState];

const PACKED: [PackedKey, string, [string, string][]][] = [
  ["eta", "Estimated", POSE],
  ["reference", "Reference", POSE],
  ["command", "Command", POSE],
  ["nu", "Velocity", VELOCITY],
  ["disturbance", "Disturbance", ACCELERATION],
  ["wrench", "Wrench asked for", WRENCH],
  ["delivered", "Wrench delivered", WRENCH],
];
const NUMBERS: [NumberKey, string, string][] = [
  ["t_s", "Time along the trajectory", "s"],
  ["depth_m", "Measured depth", "m"],
  ["battery_v", "Battery", "V"],
  ["pose_age_ms", "Age of the pose", "ms"],
  ["to_pwm_ms", "Exposure to PWM", "ms"],
  ["board_age_ms", "Age of the board's word", "ms"],
  ["round_trip_ms", "Round trip to the board", "ms"],
  ["loss", "Board messages lost", ""],
  ["step_us", "Control step", "us"],
  ["iterations", "Solver iterations", ""],
  ["missed", "Missed deadlines", ""],
  ["drag_ratio", "Learned drag per mass, × the file's", ""],
  ["thrust_ratio", "Learned thrust per mass, × the file's", ""],
  ["slack_m", "Plan in another's space", "m"],
];

/** One number of a packed array: its bytes lie where float32 may not be read. */
function at(packed: Packed, k: number): number | undefined {
  return 4 * k + 4 <= packed.byteLength ? new DataView(packed.buffer, packed.byteOffset).getFloat32(4 * k, true) : undefined;
}

/** By the id that a layout names: `eta.0`, `battery_v`. */
export const FIELDS = new Map<string, Field>([
  ...PACKED.flatMap(([key, title, parts]) =>
    parts.map(([part, unit], k): [string, Field] => [`state.${key}.${k}`, { title: `${title}: ${part}`, unit, of: (state) => at(state[key], k) }]),
  ),
  ...(["pulse_us", "echo_us"] as const).flatMap((key) =>
    PULSES.map(([part, unit], k): [string, Field] => [
      `state.${key}.${k}`,
      { title: `${key === "pulse_us" ? "Pulse" : "Echo"}: ${part}`, unit, of: (state) => state[key][k] },
    ]),
  ),
  ...NUMBERS.map(([key, title, unit]): [string, Field] => [`state.${key}`, { title, unit, of: (state) => state[key] }]),
]);
