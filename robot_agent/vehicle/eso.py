"""Extended state observer (31): pose, velocity and lumped disturbance Gamma, with every delay accounted for.

The state is that at the exposure of the newest pose. From there it is predicted to now, and on to the instant at which a
command given now begins to act, with the wrenches that act meanwhile. Without that, 50 ms at 0.3 m/s are 15 mm, more than all
vision noise. Gains of heave and yaw are those of the discrete "current observer" for a bandwidth w (Miklosovic, Radke, Gao
2006). They tend to b1 = 3w, b2 = 3w^2, b3 = w^3 for short steps and stay stable for long ones, because poses come late and go
missing.

Those of surge and sway are Kalman's. Process noise of 3 w^2, 3 w^4 and w^6 in pose, velocity and Gamma, times variance and
period of ordinary poses, gives the same poles: on the imaginary axis |s + w|^6 = |s^3|^2 + 3 w^2 |s^2|^2 + 3 w^4 |s|^2
+ w^6. A pose after a gap counts more. If the observer is adaptive, poses that say that they are worse count less, and drag and
thrust per mass are two more states: a slower observer needs the right model. `pace` tells by how much the bandwidth fell.

The water may stream. For a robot with constant heading, a current c and a side force Gamma_v look the same; for a robot that
turns, a current keeps its direction in the pool while a force of the robot turns along. So the lasting part of Gamma_v is
moved to the current, slowly, along the one direction (v, Gamma_v, c) += (-1, -slope of drag / m_v, 1) dc that changes no
prediction at this heading. In water that streams evenly the model holds for velocities through the water; c only adds to the
robot's motion over ground.
"""

import math
from collections.abc import Callable
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from robot_agent.vehicle.dynamics import (
    GATE_M,
    GATE_RAD,
    SENSED_LOOKED_AT,
    STATES,
    Model,
    State,
    Wrench,
    observe,
    propagate,
    sensed_at,
    spread,
    weigh,
)
from robot_agent.vehicle.estimate import Estimate, PoseMeasurement, StateMeasurement
from shoal.config.controller import COAST_S, EstimatorConfig
from shoal.config.vehicle import AXES
from shoal.frames import Array, wrap

S = TypeVar("S")

NS = 1_000_000_000
COAST_NS = round(COAST_S * 1e9)  # prediction alone is no estimate any more: the agent has been neutral for half of it
GATE_DEPTH_M = 0.15  # as GATE_M for depth: 0.26 m/s x 0.2 s, doubled, and 5 cm of pressure under waves
GATE_RADPS = 1.0  # and for the gyroscope: 0.5 N m turn 0.12 kg m^2 by 0.8 rad/s faster in 0.2 s
GATE_PATIENCE = 5  # samples in a row that contradict the estimate and agree with one another before they are believed
ABSURD = 1e3  # m, rad, rad/s: nothing in a pool measures that much
KEPT = 256  # wrenches, and board samples: more wrenches than COAST_NS of the fastest loop
STATE, GAMMA, CURRENT, RATIOS = slice(0, 11), slice(11, 15), slice(15, 17), slice(17, 19)  # of the belief
SWAY_THRUST = -1  # of the belief, N: the state's last number
POSE_M, POSE_S = 0.0015, 0.05  # ordinary poses: standard deviation of x and of y, and period. The bandwidth is for these
WORST_M = 0.05  # and so much a pose is worth at least: it passed the localizer's gate
RATIO, RATIO_PER_SQRT_S = 0.15, 0.01  # standard deviation of drag and thrust per mass at first, and by how much they wander
VARIANCE_S = 1.0  # time constant of the mean variance
STEADY = 400  # poses after which the covariance has settled, for bandwidths from 0.3 rad/s on


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


class Estimator:
    """One robot's observer. Call `update` once per control step, then `note_wrench` with the wrench that was sent."""

    def __init__(self, model: Model, config: EstimatorConfig, dead_time_s: float, fastest_mps: float = math.inf) -> None:
        """`fastest_mps` limits the estimated current: a robot cannot hold its place in a stronger one."""
        self._model, self._fastest_mps = model, fastest_mps
        self._dead_ns = round(dead_time_s * NS)
        self._acts_ns, self._wrenches = np.zeros(KEPT, dtype=np.int64), np.zeros((KEPT, len(AXES)))
        self._inputs = 0  # wrenches, each with the instant from which it acts, in order
        self._sensed_ns, self._sensed = np.zeros(KEPT, dtype=np.int64), np.zeros((KEPT, 2))
        self._samples = 0  # depths and yaw rates, each with its instant, in order; NaN where there was none
        self._board_ns = -1  # instant of the last measurement of the board, accepted or not
        # state, Gamma, current, drag and thrust per mass, and last the side thrust that acts, at the exposure _at_ns
        self._belief = np.zeros(20)
        self._belief[RATIOS] = 1.0
        self._covariance, self._work = np.zeros((8, 8)), np.empty((2, 8, 8))
        self._pose = np.zeros(5)  # that was weighed last, with its variance, believed and told
        self._variance_m2 = POSE_M**2  # of the poses of late
        self._begun = False  # there is a belief
        self._at_ns = 0
        self._other_poses: Contradiction[PoseMeasurement] = Contradiction(_agree)
        self._other_depths: Contradiction[float] = Contradiction(lambda a, b: abs(a - b) <= GATE_DEPTH_M)
        self._other_rates: Contradiction[float] = Contradiction(lambda a, b: abs(a - b) <= self._gate_radps)
        self._gate_radps = GATE_RADPS
        self._contradicted_ns = 0  # stamp of the last pose that contradicted
        self._depth_ns: int | None = None  # instant of the last depth that was believed
        self._leap = self._depth_leap = ""
        self.tune(config)

    def tune(self, config: EstimatorConfig) -> None:
        """Use other gains from the next pose on; the estimate stays."""
        self._uses_yaw_rate, self._adaptive = config.use_imu_yaw_rate, config.adaptive
        w, gamma, sway = config.bandwidth_radps, float(config.enabled), float(config.sway)
        place = 3.0 * w**2 * POSE_M**2 * POSE_S
        learns = float(config.adaptive) * gamma * sway
        self._noise = np.array((
            place, place, place * w**2, sway * place * w**2, gamma * place * w**4 / 3.0, gamma * sway * place * w**4 / 3.0,
            RATIO_PER_SQRT_S**2 * learns, RATIO_PER_SQRT_S**2 * learns,
        ))  # fmt: skip
        self._settings = np.array((
            w, config.yaw_bandwidth_radps, gamma, self._fastest_mps, sway * config.current_rate_radps
        ), dtype=np.float64)  # fmt: skip
        self._steady = self._settled_covariance()
        self._covariance[6:] = self._covariance[:, 6:] = 0.0  # begin to learn anew, or learn no more
        self._covariance[6:, 6:] = RATIO**2 * learns * np.eye(2)

    def _settled_covariance(self) -> Array:
        """Covariance (6, 6) of pose, velocity and Gamma of a robot at rest that is seen in ordinary poses."""
        p, work, belief = np.zeros((8, 8)), np.empty((2, 8, 8)), np.zeros(19)
        belief[RATIOS] = 1.0
        for _ in range(STEADY):
            spread(self._model.nominal, self._model.sway, belief, POSE_S, self._noise, p, work)
            weigh(p, 0.0, 0.0, POSE_M**2, 0.0, work[0], work[1, 0])
        return p[:6, :6].copy()

    def note_wrench(self, wrench: Wrench | Array, now_ns: int) -> None:
        """Take note of the wrench sent out now. It acts after the thrusters' dead time. Of two at one instant the last
        counts."""
        acts_ns = now_ns + self._dead_ns
        if not self._inputs or self._acts_ns[self._inputs - 1] != acts_ns:
            if self._inputs == KEPT:  # the last one before the state's instant still acts
                acted = int(np.searchsorted(self._acts_ns, self._at_ns, side="right"))
                self._inputs = _drop(max(acted - 1, 1), self._acts_ns, self._wrenches)
            self._inputs += 1
        self._acts_ns[self._inputs - 1], self._wrenches[self._inputs - 1, : len(wrench)] = acts_ns, wrench

    def update(self, measurement: StateMeasurement, now_ns: int) -> Estimate | None:
        """Take in new measurements and return the estimate; None before the first pose and after coasting longer than
        COAST_S."""
        self._leap = self._depth_leap = ""
        self._note_board(measurement, now_ns)
        pose = measurement.pose
        if pose is not None and not (pose.stamp_ns <= now_ns and _sane(pose.x_m) and _sane(pose.y_m) and _sane(pose.yaw_rad)):
            pose = None
        if not self._begun and pose is not None and now_ns - pose.stamp_ns <= COAST_NS:
            self._begin(pose)
        if pose is not None and pose.stamp_ns <= max(self._at_ns, self._contradicted_ns):
            pose = None  # seen before, or overtaken by a newer one
        if not self._begun or (pose is None and self._has_coasted(now_ns)):
            self._forget()
            return None
        now, action = np.empty((4, 4)), np.zeros(STATES)
        passes = self._observe(pose, now_ns, now, action)
        if pose is not None and passes:
            share = -math.expm1((self._at_ns - pose.stamp_ns) / (VARIANCE_S * NS))
            self._variance_m2 += share * (self._variance_of(pose) - self._variance_m2)
            self._at_ns = pose.stamp_ns
            self._other_poses.reset()
        elif pose is not None and self._leaps_to(pose):
            self._observe(None, now_ns, now, action)
        if self._has_coasted(now_ns):
            self._forget()
            return None
        eta, nu, disturbance, gamma_still_water = now
        x_mps, y_mps = self._belief[CURRENT].tolist()
        drag_ratio, thrust_ratio = self._belief[RATIOS].tolist() if self._adaptive else (0.0, 0.0)
        depth_age_s = (now_ns - self._depth_ns) / NS if self._depth_ns is not None else math.inf
        return Estimate(
            eta, nu, disturbance, complex(x_mps, y_mps), gamma_still_water, action, (now_ns - self._at_ns) / NS, depth_age_s,
            self._leap, self._depth_leap, drag_ratio, thrust_ratio, (POSE_M**2 / self._variance_m2) ** (1.0 / 6.0),
        )  # fmt: skip

    def _observe(self, pose: PoseMeasurement | None, now_ns: int, now: Array, action: Array) -> bool:
        """Run `dynamics.observe`. False if the pose does not pass the gate."""
        model, at_ns, stamp_ns = self._model, self._at_ns, self._at_ns
        if pose is not None:
            self._pose[:], stamp_ns = (pose.x_m, pose.y_m, pose.yaw_rad, self._variance_of(pose), _told(pose)), pose.stamp_ns
        return observe(
            model.nominal, model.coefficients, model.sway, model.lag_s, self._settings, self._noise, self._belief,
            self._covariance, self._work, self._acts_ns, self._wrenches, self._inputs, self._sensed_ns, self._sensed,
            self._samples, self._pose, stamp_ns, at_ns, now_ns, now_ns + self._dead_ns, now, action,
        )  # fmt: skip

    def _variance_of(self, pose: PoseMeasurement) -> float:
        """Variance of x and y as it is believed: that of ordinary poses, or as it is told if the observer is adaptive."""
        return _told(pose) if self._adaptive else POSE_M**2

    def _has_coasted(self, now_ns: int) -> bool:
        """True if the last pose is too old for an estimate."""
        return now_ns - self._at_ns > COAST_NS

    def _forget(self) -> None:
        """Clear the estimate until the next pose."""
        self._begun = False
        self._belief[GAMMA] = 0.0

    def _note_board(self, measurement: StateMeasurement, now_ns: int) -> None:
        """Store a depth and a yaw rate that pass their gates."""
        at_ns = now_ns if measurement.board_ns is None else measurement.board_ns
        if at_ns > now_ns or at_ns <= self._board_ns:
            return
        self._board_ns = at_ns
        depth, rate = measurement.depth_m, measurement.yaw_rate_radps
        if depth is not None and not (_sane(depth) and self._accepts_depth(depth, at_ns)):
            depth = None
        if rate is not None and not (self._uses_yaw_rate and _sane(rate) and self._accepts_rate(rate)):
            rate = None
        if depth is not None:
            self._depth_ns = at_ns
        if depth is not None or rate is not None:
            if self._samples == KEPT:
                self._samples = _drop(KEPT - SENSED_LOOKED_AT, self._sensed_ns, self._sensed)
            row = self._sensed[self._samples]
            row[0], row[1] = math.nan if depth is None else depth, math.nan if rate is None else rate
            self._sensed_ns[self._samples] = at_ns
            self._samples += 1

    def _accepts_depth(self, depth_m: float, at_ns: int) -> bool:
        """True if a depth passes the gate. A depth that contradicts the estimate persistently replaces it; heave then starts
        anew."""
        if not self._begun:
            return True
        if self._depth_ns is None:  # the first one: nothing was believed before
            self._sink_to(depth_m)
            return True
        believed_m = float(self._belief[2] + self._belief[6] * (at_ns - self._at_ns) / NS)
        if abs(depth_m - believed_m) <= GATE_DEPTH_M:
            self._other_depths.reset()
            return True
        if not self._other_depths.persists(depth_m):
            return False
        self._depth_leap = f"the sensor says {depth_m:.2f} m, {believed_m:.2f} m was believed"
        self._sink_to(depth_m)
        self._sensed[: self._samples, 0] = math.nan  # none is interpolated across the leap
        return True

    def _sink_to(self, depth_m: float) -> None:
        """Set depth, at rest, and clear the heave disturbance."""
        self._belief[2], self._belief[6], self._belief[GAMMA][2] = depth_m, 0.0, 0.0

    def _accepts_rate(self, rate_radps: float) -> bool:
        """True if a yaw rate passes the gate. A single outlier is left out, a persistent one replaces the estimate."""
        if not self._begun or abs(rate_radps - self._belief[7]) <= self._gate_radps:
            self._other_rates.reset()
            return True
        if not self._other_rates.persists(rate_radps):
            return False
        self._belief[7] = rate_radps
        self._sensed[: self._samples, 1] = math.nan  # none is interpolated across the leap
        return True

    def _leaps_to(self, pose: PoseMeasurement) -> bool:
        """Take note of a pose outside the gate; start anew there, and return True, if such poses persist."""
        self._contradicted_ns = pose.stamp_ns
        if not self._other_poses.persists(pose):
            return False
        predicted = self._predicted(pose.stamp_ns)
        reported, believed = (pose.x_m, pose.y_m, pose.yaw_rad), (*predicted[:2], wrap(predicted[3]))
        self._leap = f"poses say {_place(reported)}, {_place(believed)} was believed"
        self._begin(pose)
        return True

    def _begin(self, pose: PoseMeasurement) -> None:
        """Start at rest at a pose. Depth and the heave disturbance have another source and go on."""
        if not self._begun:
            depth = sensed_at(self._sensed_ns, self._sensed, self._samples, 0, pose.stamp_ns)
            z, yaw, w = 0.0 if math.isnan(depth) else depth, pose.yaw_rad, 0.0
            thrust: State = (0.0, 0.0, 0.0, 0.0)
        else:
            _, _, z, yaw, _, _, w, _, *rest = self._predicted(pose.stamp_ns)
            yaw, thrust = yaw + wrap(pose.yaw_rad - yaw), tuple(rest)
        self._belief[STATE] = (pose.x_m, pose.y_m, z, yaw, 0.0, 0.0, w, 0.0, *thrust[:3])
        self._belief[SWAY_THRUST] = thrust[3]
        self._belief[GAMMA] = (0.0, 0.0, self._belief[GAMMA][2], 0.0)
        self._belief[CURRENT] = 0.0
        self._covariance[:6] = self._covariance[:, :6] = 0.0  # what is known of drag and thrust stays
        self._covariance[:6, :6] = self._steady
        self._at_ns, self._begun = pose.stamp_ns, True
        self._other_poses.reset()
        self._other_rates.reset()

    def _predicted(self, to_ns: int) -> State:
        """State at an instant after the belief's, without correction."""
        model, (state, gamma, current) = self._model, (self._belief[part].tolist() for part in (STATE, GAMMA, CURRENT))
        return propagate(
            model.coefficients, model.sway, model.lag_s, (*state, self._belief.item(SWAY_THRUST)), tuple(gamma),
            tuple(current), self._acts_ns, self._wrenches, self._inputs, self._at_ns, to_ns,
        )  # fmt: skip


def _drop(count: int, instants_ns: NDArray[np.int64], rows: Array) -> int:
    """Forget the oldest `count` of KEPT rows. Returns how many are left."""
    for column in (instants_ns, rows):
        column[: KEPT - count] = column[count:]
    return KEPT - count


def _told(pose: PoseMeasurement) -> float:
    """Variance of x and y that a pose tells: none is better than ordinary, or worse than WORST_M. One that is no number says
    nothing good."""
    return min(max(pose.variance_m2, POSE_M**2), WORST_M**2) if math.isfinite(pose.variance_m2) else WORST_M**2


def _agree(a: PoseMeasurement, b: PoseMeasurement) -> bool:
    """True if a robot can have moved from the one pose to the other between two exposures."""
    return math.hypot(b.x_m - a.x_m, b.y_m - a.y_m) <= GATE_M and abs(wrap(b.yaw_rad - a.yaw_rad)) <= GATE_RAD


def _place(pose: tuple[float, ...]) -> str:
    """Text of x, y, yaw."""
    return f"({pose[0]:.2f} m, {pose[1]:.2f} m, {pose[2]:.2f} rad)"


def _sane(value: float) -> bool:
    """True for a number that can be a measurement; false for NaN."""
    return abs(value) < ABSURD
