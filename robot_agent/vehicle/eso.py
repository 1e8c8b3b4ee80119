"""Extended state observer (31): pose, velocity and lumped disturbance Gamma, with every delay accounted for.

The state is that at the exposure of the newest pose. From there it is predicted to now, and on to the instant at which a
command given now begins to act, with the wrenches that act meanwhile. Without that, 50 ms at 0.3 m/s are 15 mm, more than all
vision noise. Gains are those of the discrete "current observer" for a bandwidth w (Miklosovic, Radke, Gao 2006). They tend to
b1 = 3w, b2 = 3w^2, b3 = w^3 for short steps and stay stable for long ones, because poses come late and go missing.

The water may stream. For a robot with constant heading, a current c and a side force Gamma_v look the same; for a robot that
turns, a current keeps its direction in the pool while a force of the robot turns along. So the lasting part of Gamma_v is
moved to the current, slowly, along the one direction (v, Gamma_v, c) += (-1, -slope of drag / m_v, 1) dc that changes no
prediction at this heading. In water that streams evenly the model holds for velocities through the water; c only adds to the
robot's motion over ground.
"""

import cmath
import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from robot_agent.vehicle.dynamics import Model, State, Wrench, propagate, propagate_twice
from wire.config.controller import COAST_S, EstimatorConfig
from wire.frames import Array, wrap
from wire.kernels import kernel

S = TypeVar("S")
# Arguments of dynamics.propagate but for the last: model, sway, lag, state, Gamma, current, inputs, their count, instant
Motion = tuple[
    Array, float, float, State, tuple[float, ...], tuple[float, float], NDArray[np.int64], Array, int, int
]  # fmt: skip

NS = 1_000_000_000
COAST_NS = round(COAST_S * 1e9)  # prediction alone is no estimate any more: the agent has been neutral for half of it
GATE_M, GATE_RAD = 0.3, 1.0  # between two poses nothing moves this far: 0.5 m/s x 0.2 s, 1.9 rad/s x 0.2 s, and doubled
GATE_DEPTH_M = 0.15  # the same for depth: 0.26 m/s x 0.2 s, doubled, and 5 cm of pressure under waves
GATE_RADPS = 1.0  # the same for the gyroscope: 0.5 N m turn 0.12 kg m^2 by 0.8 rad/s faster in 0.2 s
GATE_PATIENCE = 5  # samples in a row that contradict the estimate and agree with one another before they are believed
ABSURD = 1e3  # m, rad, rad/s: nothing in a pool measures that much
SENSED_KEPT = 16  # board samples, one per step: reaches back 0.8 s
SENSED_HELD_NS = 150_000_000  # so long a board sample stands for what came after it: three bursts at 20 Hz
INPUTS_KEPT = 256  # more than COAST_NS of the fastest loop
NOTHING = (0.0, 0.0, 0.0, 0.0)  # Gamma


@kernel("Tuple((f8, c16, f8))(f8, c16, f8, f8, f8, f8)")
def split_side_force(
    side: float, current: complex, yaw: float, slope: float, share: float, fastest_mps: float
) -> tuple[float, complex, float]:
    """Division of a side force (m/s^2) between Gamma_v and the current: both anew, and by how much the current grew to the
    side (m/s). The sway velocity through the water falls by as much.

    `slope` is that of the sway drag, `share` the part that goes to the current. A current at its limit grows no further: the
    rest stays a side force.
    """
    drift = share * side / slope
    aside = complex(-math.sin(yaw), math.cos(yaw))
    if abs(current + drift * aside) > fastest_mps:
        along = current.real * aside.real + current.imag * aside.imag  # |current + t aside| = fastest at t = -along +- half
        half = math.sqrt(max(along**2 + fastest_mps**2 - abs(current) ** 2, 0.0))
        drift = min(max(drift, min(-along - half, 0.0)), max(-along + half, 0.0))
    return side - drift * slope, current + drift * aside, drift


@kernel("UniTuple(f8,3)(f8, f8)")
def gains(bandwidth_radps: float, step_s: float) -> tuple[float, float, float]:
    """Innovation gains b1, b2, b3 for pose, velocity and Gamma: all three observer poles at exp(-w dt)."""
    beta = math.exp(-bandwidth_radps * step_s)
    rest = 1.0 - beta
    return 1.0 - beta**3, 1.5 * rest * rest * (1.0 + beta) / step_s, rest**3 / (step_s * step_s)


@kernel("UniTuple(f8,3)(f8, f8)")
def gains_with_rate(bandwidth_radps: float, step_s: float) -> tuple[float, float, float]:
    """Gains b1, b2, b3 if velocity is measured too: pose by the pose error; velocity and Gamma by the velocity error."""
    beta = math.exp(-bandwidth_radps * step_s)
    rest = 1.0 - beta
    return rest, 1.0 - beta * beta, rest * rest / step_s


@kernel("f8(f8[:,::1], f8, f8)")
def sway_slope(model: Array, u: float, v: float) -> float:
    """Rate (1/s) at which sideways motion decays at velocities u, v through the water: slope of the drag, per mass."""
    speed = math.sqrt(u * u + v * v)
    bend = v * v / speed if speed > 0.0 else 0.0
    return float((model[1, 1] + model[2, 1] * (speed + bend)) / model[0, 1])


@kernel(
    "Tuple((UniTuple(f8,11), UniTuple(f8,4), c16))"
    "(f8[:,::1], UniTuple(f8,11), UniTuple(f8,4), c16, UniTuple(f8,3), f8, f8, f8, f8, f8, b1, b1, f8, f8)"
)
def correct(
    model: Array,
    state: State,
    gamma: tuple[float, ...],
    current: complex,
    error: tuple[float, float, float],
    depth_m: float,
    rate_radps: float,
    step_s: float,
    bandwidth_radps: float,
    yaw_bandwidth_radps: float,
    enabled: bool,
    sway: bool,
    current_rate_radps: float,
    fastest_mps: float,
) -> tuple[State, tuple[float, ...], complex]:
    """State, Gamma and current after a pose that differs by `error` (x, y, yaw) from the `state` predicted for it: (31) on
    the pool's axes x, y, z and yaw, `step_s` after the last one.

        eta += b1 e      nu += b2 J^T e      Gamma += b3 J^T e      J^T turns into the body frame

    `depth_m` and `rate_radps` are NaN when not known. Not `enabled`: no Gamma; without `sway` v and Gamma_v stay as they are.
    """
    x, y, z, yaw, u, v, w, r, surge_n, heave_n, yaw_nm = state
    gamma_u, gamma_v, gamma_w, gamma_r = gamma
    b1, b2, b3 = gains(bandwidth_radps, step_s)
    estimates = 1.0 if enabled else 0.0
    b3 *= estimates
    c, s = math.cos(yaw), math.sin(yaw)
    error_u, error_v = c * error[0] + s * error[1], -s * error[0] + c * error[1]
    x, y, u, gamma_u = x + b1 * error[0], y + b1 * error[1], u + b2 * error_u, gamma_u + b3 * error_u
    if sway:
        v += b2 * error_v
        share = -math.expm1(-current_rate_radps * step_s)
        gamma_v, current, drift = split_side_force(
            gamma_v + b3 * error_v, current, yaw, sway_slope(model, u, v), share, fastest_mps
        )
        v -= drift
    if not math.isnan(depth_m):
        error_z = depth_m - z
        z, w, gamma_w = z + b1 * error_z, w + b2 * error_z, gamma_w + b3 * error_z
    if math.isnan(rate_radps):
        b1, b2, b3 = gains(yaw_bandwidth_radps, step_s)
        error_r = error[2]
    else:  # the gyroscope sees the rate at once, the camera keeps the heading; a gyro bias of 2 mrad/s moves it by 0.5 mrad
        b1, b2, b3 = gains_with_rate(yaw_bandwidth_radps, step_s)
        error_r = rate_radps - r
    yaw, r, gamma_r = yaw + b1 * error[2], r + b2 * error_r, gamma_r + estimates * b3 * error_r
    return (x, y, z, yaw, u, v, w, r, surge_n, heave_n, yaw_nm), (gamma_u, gamma_v, gamma_w, gamma_r), current


@dataclass(frozen=True)
class PoseMeasurement:
    """A pose from the localizer, in the pool frame."""

    stamp_ns: int  # middle of the exposure, on the robot's clock
    x_m: float
    y_m: float
    yaw_rad: float


@dataclass(frozen=True)
class StateMeasurement:
    """The newest sensor values. Missing ones are None; the same pose may be given more than once."""

    pose: PoseMeasurement | None = None
    depth_m: float | None = None  # of the robot's centre, from the pressure sensor
    yaw_rate_radps: float | None = None  # gyroscope
    board_ns: int | None = None  # instant of depth and yaw rate; None: now


class Contradiction(Generic[S]):
    """Count of consecutive samples that contradict the estimate. A sample that disagrees with the one before starts a new
    count."""

    def __init__(self, agree: Callable[[S, S], bool]) -> None:
        self._agree = agree
        self._last: S | None = None
        self._count = 0

    def persists(self, sample: S) -> bool:
        """Count one more sample. True if GATE_PATIENCE samples in a row agree; the count then starts anew."""
        self._count = self._count + 1 if self._last is not None and self._agree(self._last, sample) else 1
        self._last = sample
        if self._count < GATE_PATIENCE:
            return False
        self.reset()
        return True

    def reset(self) -> None:
        """Start a new count, after a sample that agrees with the estimate."""
        self._last, self._count = None, 0


@dataclass(frozen=True, eq=False)
class Estimate:
    """The estimated state. Velocities and `disturbance` are in the body frame, `current` in the pool frame."""

    eta: Array  # (4,) now; yaw continuous, not wrapped
    nu: Array  # (4,) now, over ground
    disturbance: Array  # (4,) acceleration that the nominal model does not explain, in water that streams at `current`
    current: complex  # x + iy of the water's own velocity, m/s
    gamma_still_water: Array  # (4,) both together: what a model of still water does not explain
    action: State  # when a command given now begins to act; velocities through the water
    pose_age_s: float
    depth_age_s: float  # of the last depth that did not contradict the estimate; infinite before the first
    leap: str = ""  # what was told and what had been believed, in the step that gave up a believed place for another one
    depth_leap: str = ""  # the same for the depth


class Estimator:
    """One robot's observer. Call `update` once per control step, then `note_wrench` with the wrench that was sent."""

    def __init__(self, model: Model, config: EstimatorConfig, dead_time_s: float, fastest_mps: float = math.inf) -> None:
        """`fastest_mps` limits the estimated current: a robot cannot hold its place in a stronger one."""
        self._model, self._config, self._fastest_mps = model, config, fastest_mps
        self._dead_ns = round(dead_time_s * NS)
        self._acts_ns, self._wrenches = np.zeros(INPUTS_KEPT, dtype=np.int64), np.zeros((INPUTS_KEPT, 3))
        self._inputs = 0  # wrenches, each with the instant from which it acts, in order
        self._sensed: deque[tuple[int, float | None, float | None]] = deque(maxlen=SENSED_KEPT)
        self._state: State | None = None  # at the exposure _at_ns
        self._gamma: tuple[float, ...] = NOTHING
        self._current = 0j
        self._at_ns = 0
        self._other_poses: Contradiction[PoseMeasurement] = Contradiction(lambda a, b: not _exceeds_gate(_moved(a, b)))
        self._other_depths: Contradiction[float] = Contradiction(lambda a, b: abs(a - b) <= GATE_DEPTH_M)
        self._other_rates: Contradiction[float] = Contradiction(lambda a, b: abs(a - b) <= GATE_RADPS)
        self._contradicted_ns = 0  # stamp of the last pose that contradicted
        self._depth_ns: int | None = None  # instant of the last depth that was believed
        self._leap = self._depth_leap = ""

    def tune(self, config: EstimatorConfig) -> None:
        """Use other gains from the next pose on; the estimate stays."""
        self._config = config

    def note_wrench(self, wrench: Wrench | Array, now_ns: int) -> None:
        """Take note of the wrench sent out now. It acts after the thrusters' dead time. Of two at one instant the last
        counts."""
        acts_ns = now_ns + self._dead_ns
        if not self._inputs or self._acts_ns[self._inputs - 1] != acts_ns:
            if self._inputs == INPUTS_KEPT:  # the last one before the state's instant still acts
                acted = int(np.searchsorted(self._acts_ns, self._at_ns, side="right"))
                self._drop_inputs(max(acted - 1, 1))
            self._inputs += 1
        self._acts_ns[self._inputs - 1], self._wrenches[self._inputs - 1] = acts_ns, wrench

    def update(self, measurement: StateMeasurement, now_ns: int) -> Estimate | None:
        """Take in new measurements and return the estimate; None before the first pose and after coasting longer than
        COAST_S."""
        self._leap = self._depth_leap = ""
        self._note_board(measurement, now_ns)
        pose = measurement.pose
        if pose is not None and pose.stamp_ns <= now_ns and _sane(pose.x_m) and _sane(pose.y_m) and _sane(pose.yaw_rad):
            self._correct_with_pose(pose, now_ns)
        if self._state is None or now_ns - self._at_ns > COAST_NS:
            self._state, self._gamma = None, NOTHING
            return None
        now, action = propagate_twice(*self._motion(self._state, self._at_ns), now_ns, now_ns + self._dead_ns)
        nu, gamma_still_water = self._over_ground(now)
        disturbance, age_s = np.array(self._gamma), (now_ns - self._at_ns) / NS
        depth_age_s = (now_ns - self._depth_ns) / NS if self._depth_ns is not None else math.inf
        eta, current = np.array(now[:4]), self._current
        return Estimate(
            eta, nu, disturbance, current, gamma_still_water, action, age_s, depth_age_s, self._leap, self._depth_leap
        )

    def _over_ground(self, state: State) -> tuple[Array, Array]:
        """Return velocities over ground, and Gamma with the acceleration by which the current changes drag at them; (4,)
        each."""
        (u, v, w, r), (gamma_u, gamma_v, gamma_w, gamma_r) = state[4:8], self._gamma
        if self._current:
            carried = self._current * cmath.rect(1.0, -state[3])
            through_u, through_v = self._model.drag(u, v)
            u, v = u + carried.real, v + carried.imag
            over_u, over_v = self._model.drag(u, v)
            gamma_u, gamma_v = gamma_u + over_u - through_u, gamma_v + over_v - through_v
        return np.array((u, v, w, r)), np.array((gamma_u, gamma_v, gamma_w, gamma_r))

    def _note_board(self, measurement: StateMeasurement, now_ns: int) -> None:
        """Store a depth and a yaw rate that pass their gates."""
        at_ns = now_ns if measurement.board_ns is None else measurement.board_ns
        if at_ns > now_ns or (self._sensed and at_ns <= self._sensed[-1][0]):
            return
        depth, rate = measurement.depth_m, measurement.yaw_rate_radps
        depth = depth if depth is not None and _sane(depth) else None
        rate = rate if self._config.use_imu_yaw_rate and rate is not None and _sane(rate) else None
        if depth is not None and not self._accepts_depth(depth, at_ns):
            depth = None
        if rate is not None and not self._accepts_rate(rate):
            rate = None
        if depth is not None:
            self._depth_ns = at_ns
        if depth is not None or rate is not None:
            self._sensed.append((at_ns, depth, rate))

    def _accepts_depth(self, depth_m: float, at_ns: int) -> bool:
        """True if a depth passes the gate. A depth that contradicts the estimate persistently replaces it; heave then starts
        anew."""
        if self._state is None:
            return True
        if self._depth_ns is None:  # the first one: nothing was believed before
            self._sink_to(depth_m)
            return True
        believed_m = self._state[2] + self._state[6] * (at_ns - self._at_ns) / NS
        if abs(depth_m - believed_m) <= GATE_DEPTH_M:
            self._other_depths.reset()
            return True
        if not self._other_depths.persists(depth_m):
            return False
        self._depth_leap = f"the sensor says {depth_m:.2f} m, {believed_m:.2f} m was believed"
        self._sink_to(depth_m)
        self._forget(1)
        return True

    def _sink_to(self, depth_m: float) -> None:
        """Set depth, at rest, and clear the heave disturbance."""
        assert self._state is not None
        x, y, _, yaw, u, v, _, r, *thrust = self._state
        gamma_u, gamma_v, _, gamma_r = self._gamma
        self._state, self._gamma = (x, y, depth_m, yaw, u, v, 0.0, r, *thrust), (gamma_u, gamma_v, 0.0, gamma_r)

    def _accepts_rate(self, rate_radps: float) -> bool:
        """True if a yaw rate passes the gate. A single outlier is left out, a persistent one replaces the estimate."""
        if self._state is None or abs(rate_radps - self._state[7]) <= GATE_RADPS:
            self._other_rates.reset()
            return True
        if not self._other_rates.persists(rate_radps):
            return False
        self._state = (*self._state[:7], rate_radps, *self._state[8:])
        self._forget(2)
        return True

    def _forget(self, column: int) -> None:
        """Drop depths (1) or yaw rates (2) from before a leap, so that none is interpolated across it."""
        kept = [(at_ns, None, rate) if column == 1 else (at_ns, depth, None) for at_ns, depth, rate in self._sensed]
        self._sensed.clear()
        self._sensed.extend(kept)

    def _correct_with_pose(self, pose: PoseMeasurement, now_ns: int) -> None:
        """Correct the state with a new pose that passes the gate; start anew at one that contradicts the estimate
        persistently."""
        if self._state is None:
            if now_ns - pose.stamp_ns <= COAST_NS:
                self._begin(pose)
            return
        if pose.stamp_ns <= max(self._at_ns, self._contradicted_ns):
            return  # seen before, or overtaken by a newer one
        predicted = propagate(*self._motion(self._state, self._at_ns), pose.stamp_ns)
        error = (pose.x_m - predicted[0], pose.y_m - predicted[1], wrap(pose.yaw_rad - predicted[3]))
        if _exceeds_gate(error):
            self._contradicted_ns = pose.stamp_ns
            if self._other_poses.persists(pose):
                told, believed = (pose.x_m, pose.y_m, pose.yaw_rad), (*predicted[:2], wrap(predicted[3]))
                self._leap = f"poses say {_place(told)}, {_place(believed)} was believed"
                self._begin(pose)
            return
        self._other_poses.reset()
        config = self._config
        self._state, self._gamma, self._current = correct(
            self._model.coefficients, predicted, self._gamma, self._current, error, self._sensed_at(1, pose.stamp_ns),
            self._sensed_at(2, pose.stamp_ns), (pose.stamp_ns - self._at_ns) / NS, config.bandwidth_radps,
            config.yaw_bandwidth_radps, config.enabled, config.sway, config.current_rate_radps, self._fastest_mps,
        )  # fmt: skip
        self._at_ns = pose.stamp_ns

    def _begin(self, pose: PoseMeasurement) -> None:
        """Start at rest at a pose. Depth and the heave disturbance have another source and go on."""
        if self._state is None:
            depth = self._sensed_at(1, pose.stamp_ns)
            z, yaw, w = 0.0 if math.isnan(depth) else depth, pose.yaw_rad, 0.0
            thrust: State = (0.0, 0.0, 0.0)
        else:
            _, _, z, yaw, _, _, w, _, *rest = propagate(*self._motion(self._state, self._at_ns), pose.stamp_ns)
            yaw, thrust = yaw + wrap(pose.yaw_rad - yaw), tuple(rest)
        self._state = (pose.x_m, pose.y_m, z, yaw, 0.0, 0.0, w, 0.0, *thrust)
        self._gamma, self._current = (0.0, 0.0, self._gamma[2], 0.0), 0j
        self._at_ns = pose.stamp_ns
        self._other_poses.reset()
        self._other_rates.reset()

    def _sensed_at(self, column: int, at_ns: int) -> float:
        """Return depth (1) or yaw rate (2) at an instant, interpolated between board samples and held at the ends; NaN if
        there is none."""
        later: tuple[int, float] | None = None
        for sample in reversed(self._sensed):
            value = sample[column]
            if value is None:
                continue
            if sample[0] <= at_ns:
                if later is None:
                    return value if at_ns - sample[0] <= SENSED_HELD_NS else math.nan
                return value + (later[1] - value) * (at_ns - sample[0]) / (later[0] - sample[0])
            later = (sample[0], value)
        return later[1] if later is not None else math.nan

    def _drop_inputs(self, count: int) -> None:
        """Forget the oldest wrenches."""
        self._inputs -= count
        for column in (self._acts_ns, self._wrenches):
            column[: self._inputs] = column[count : count + self._inputs]

    def _motion(self, state: State, at_ns: int) -> Motion:
        """Arguments of `propagate` up to the instant of `state`: it predicts with the wrenches that act, without
        correction."""
        model, current = self._model, (self._current.real, self._current.imag)
        return (
            model.coefficients, model.sway, model.lag_s, state, self._gamma, current, self._acts_ns, self._wrenches,
            self._inputs, at_ns,
        )  # fmt: skip


def _moved(a: PoseMeasurement, b: PoseMeasurement) -> tuple[float, float, float]:
    """Difference between two poses: m, m, rad."""
    return b.x_m - a.x_m, b.y_m - a.y_m, wrap(b.yaw_rad - a.yaw_rad)


def _exceeds_gate(moved: tuple[float, float, float]) -> bool:
    """True for a difference that is larger than a robot's motion between two poses."""
    return math.hypot(moved[0], moved[1]) > GATE_M or abs(moved[2]) > GATE_RAD


def _place(pose: tuple[float, ...]) -> str:
    """Text of x, y, yaw."""
    return f"({pose[0]:.2f} m, {pose[1]:.2f} m, {pose[2]:.2f} rad)"


def _sane(value: float) -> bool:
    """True for a number that can be a measurement; false for NaN."""
    return abs(value) < ABSURD
