/** Messages as the page gets them (groundstation/web/snapshot.py), and what they mean. Written by `make docs` from
 * shoal/messages/messages.py; edit that. */

import type { Packed } from "./wire";

export type Mode = "DISARMED" | "ARMED" | "TRACKING" | "HOLDING" | "STOPPED" | "FAULT" | "DRIVEN";
export type Guidance = "NONE" | "JOINING" | "ON_PATH" | "GIVING_WAY" | "RETURNING" | "HOLDING" | "DRIVEN";
export type Track = "LOST" | "COAST" | "KCF" | "MARKER";
export type Solve = "NONE" | "SOLVED" | "SHIFTED" | "FAILED";
export type CameraHealth = "ABSENT" | "OK" | "FROZEN" | "BLACK" | "WRONG_SIZE";

/** The result of one control step, as the robot knows it. The header's stamp is the step's instant. */
export interface RobotState {
  mode: Mode;
  fault: string; // Reason why the robot holds, stopped or failed.
  guidance: Guidance; // What decides the robot's motion.
  tuning_id: string; // Id of the gains in use.
  trajectory_s: number; // 0 until it is started.
  trajectory_id: string;
  pulse_us: number[]; // Widths sent to the board: 4 thrusters and 4 ankles, or 8 thrusters.
  track: Track;
  heard: number[]; // Neighbours whose plans are fresh.
  estimate: Estimate | null; // None until the robot knows its place.
  control: Control | null; // None while the robot has no goal: neutral.
  board: BoardReading | null; // Depth less the robot's `depth_offset_m`; None until it was heard.
  timing: StepTiming;
}

/** A robot's estimate of its own motion and of the water. */
export interface Estimate {
  eta: Packed; // Pose.
  nu: Packed; // Velocity over ground.
  disturbance: Packed; // Acceleration that the model in still water does not explain.
  drag_ratio: number | null; // None if it is not learned.
  thrust_ratio: number | null; // None if it is not learned.
}

/** A control step's goal and result. */
export interface Control {
  eta_reference: Packed; // Pose on the trajectory: yaw is the tangent of the path.
  eta_command: Packed; // Pose given to the controller: yaw includes crab angle and correction.
  wrench: Packed; // Within the limits.
  wrench_step: Packed; // Change of the wrench in this step.
  wrench_wanted: Packed; // The law's result before limits.
  wrench_delivered: Packed; // After allocation and limits, by the nominal curve.
  solve: Solve;
  iterations: number;
  slack_m: number; // Depth by which the plan enters the space of another robot.
}

/** The last telemetry of a thruster board, as far as its robot acts on it. Values are finite and within a sensor's range. The robot's link to its board adds its own state (Telemetry of shoal/mavlink/agent_link.py). */
export interface BoardReading {
  heading_rad: number;
  yaw_rate_radps: number; // Rate of the heading; about its own axis, of a board that does not measure its tilt.
  acceleration_mps2: Packed; // Specific force, in the body frame.
  tilt: Packed; // Roll, pitch [rad] and their rates [rad/s]; empty if not measured.
  depth_m: number;
  battery_v: number; // One raw measurement under the present load; meaningless before the first report.
  armed: boolean;
  echo_us: number[]; // Pulses that the board puts out: 4 thrusters, 4 ankles.
  loss: number; // Fraction of the board's messages lost in the last 5 s.
  objection: string; // Reason not to arm, from the board's parameters.
  zero_in_question: boolean; // A person has to confirm the board's depth zero.
}

/** Ages of a step's inputs, and the time that it took. */
export interface StepTiming {
  pose_age_ms: number | null; // None until there was one.
  exposure_to_pwm_ms: number | null; // None until there was a pose.
  step_us: number; // Duration of the whole control step.
  missed_deadlines: number;
  board_age_ms: number | null; // None until it was heard.
  board_round_trip_ms: number;
  board_clock_offset_s: number; // The board's clock minus the robot's clock.
}

/** A robot's position and heading from the camera, at the header's stamp (middle of the exposure). */
export interface Pose {
  x_m: number;
  y_m: number;
  yaw_rad: number;
  covariance: Packed; // Covariance of x, y, yaw: m^2, m rad, rad^2.
  track: Track;
  identity_verified: boolean; // A marker was read since the robot was last near another robot.
  peak: number; // Peak of the correlation, 0 to 1.
  depth_m: number; // Depth of the robot's centre that the refraction was computed with.
}

/** The state of the localizer, once a frame. */
export interface LocalizerStatus {
  camera: CameraHealth;
  frames: number; // Pictures processed.
  dropped: number; // Pictures left out for a newer one.
  frame_ms: number; // Processing time of the last picture.
  frame_age_ms: number; // Time from the exposure to the publication.
  message: string; // The trouble in words.
  robots: number[]; // Robots whose poses in this picture are published.
  obstacles_ns: number; // Stamp of the newest Obstacles before those poses; -1: none yet.
  failed: number; // Pictures skipped after an error.
  out: string[]; // Of several cameras, those that give no poses now.
  moved: boolean; // Check marks show that the camera was moved.
}

/** All obstacles that the camera sees in the pool, in one message: an obstacle that is not in it has gone. */
export interface Obstacles {
  ids: number[]; // Kept while the obstacle is tracked; none is used twice.
  outline: Packed; // Corners x, y in the pool frame, m.
  velocity: Packed; // Over the floor, in the pool frame, m/s.
  depth_m: number; // Assumed: that of the robots' path.
  watched: number; // Share of the pool that can be judged, 0 to 1.
}
