"""Extended state observer (31): pose, velocity and lumped disturbance Gamma, with every delay accounted for.

The state is that at the exposure of the newest pose. From there it is predicted to now, and on to the instant at which a
command given now begins to act, with the wrenches that act meanwhile. Without that, 50 ms at 0.3 m/s are 15 mm, more than all
vision noise. Gains are those of the discrete "current observer" for a bandwidth w (Miklosovic, Radke, Gao 2006). They tend to
b1 = 3w, b2 = 3w^2, b3 = w^3 for short steps and stay stable for long ones, because poses come late and go missing.

For a robot with constant heading, a current and a side force Gamma_v look the same. This observer takes all for forces of the
robot; kalman.py tells them apart. What both share, and the nonlinear observer builds on, is `Estimator`: inputs, delays, gates
and leaps.
"""

import math
from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from robot_agent.vehicle.dynamics import STATES, Commands, Model, MotionModel, PerAxis4, State, State12, Wrench, propagate
from robot_agent.vehicle.estimate import Observation, PoseMeasurement, StateMeasurement
from shoal.config.controller import COAST_S, EstimatorConfig
from shoal.config.vehicle import AXES
from shoal.frames import TURN, Array, wrap
from shoal.kernels.decorator import kernel
from shoal.kernels.types import Floats, Ints, Table
from shoal.messages.messages import Estimate

S = TypeVar("S")

NS = 1_000_000_000
COAST_NS = round(COAST_S * 1e9)  # prediction alone is no estimate any more: the agent has been neutral for half of it
GATE_M, GATE_RAD = 0.3, 1.0  # between two poses nothing moves this far: 0.5 m/s x 0.2 s, 1.9 rad/s x 0.2 s, and doubled
GATE_DEPTH_M = 0.15  # as GATE_M for depth: 0.26 m/s x 0.2 s, doubled, and 5 cm of pressure under waves
GATE_RADPS = 1.0  # and for the gyroscope: 0.5 N m turn 0.12 kg m^2 by 0.8 rad/s faster in 0.2 s
GATE_PATIENCE = 5  # samples in a row that contradict the estimate and agree with one another before they are believed
ABSURD = 1e3  # m, rad, rad/s: nothing in a pool measures that much
KEPT = 256  # wrenches, and board samples: more wrenches than COAST_NS of the fastest loop
SENSED_LOOKED_AT = 100  # board samples, one per step: reaches back COAST_NS in the fastest loop
SENSED_HELD_NS = 150_000_000  # so long a board sample stands for what came after it: three bursts at 20 Hz
NUMBERS = 18  # of the belief: state 11, Gamma 4, current 2, and last the side thrust that acts, N
STATE, GAMMA, CURRENT, SWAY_THRUST = slice(0, 11), slice(11, 15), slice(15, 17), -1


class EsoSettings(NamedTuple):
    """Settings of the extended state observer."""

    bandwidth_radps: float  # of x, y, z
    yaw_bandwidth_radps: float
    estimates: float  # 1; 0: no Gamma


class Samples(NamedTuple):
    """Depths and yaw rates, each with its instant, in order; NaN where there was none."""

    sensed_ns: Ints
    sensed: Table  # (samples, 2)
    taken: int  # so many of them


class Sighting(NamedTuple):
    """A pose with its variances."""

    x_m: float
    y_m: float
    yaw_rad: float
    variance_m2: float
    variance_rad2: float
    stamp_ns: int  # not later than `Instants.at_ns`: there is none


class Instants(NamedTuple):
    """Instants of a step: of the belief, now, and when a command given now acts."""

    at_ns: int
    now_ns: int
    acts_ns: int


@kernel(part=True)
def state_of(numbers: Floats) -> State12:
    """State (12,) of a belief: pose, velocity and acting thrust; that of sway is the belief's last number."""
    return (
        numbers[0], numbers[1], numbers[2], numbers[3], numbers[4], numbers[5], numbers[6], numbers[7], numbers[8], numbers[9],
        numbers[10], numbers[len(numbers) - 1],
    )  # fmt: skip


@kernel(part=True)
def gamma_of(numbers: Floats) -> PerAxis4:
    """Gamma of a belief."""
    return numbers[11], numbers[12], numbers[13], numbers[14]


@kernel(part=True)
def gains(bandwidth_radps: float, step_s: float) -> tuple[float, float, float]:
    """Innovation gains b1, b2, b3 for pose, velocity and Gamma: all three observer poles at exp(-w dt)."""
    beta = math.exp(-bandwidth_radps * step_s)
    rest = 1.0 - beta
    return 1.0 - beta**3, 1.5 * rest * rest * (1.0 + beta) / step_s, rest**3 / (step_s * step_s)


@kernel(part=True)
def gains_with_rate(bandwidth_radps: float, step_s: float) -> tuple[float, float, float]:
    """Gains b1, b2, b3 if velocity is measured too: pose by the pose error; velocity and Gamma by the velocity error."""
    beta = math.exp(-bandwidth_radps * step_s)
    rest = 1.0 - beta
    return rest, 1.0 - beta * beta, rest * rest / step_s


@kernel
def sensed_at(samples: Samples, column: int, at_ns: int) -> float:
    """Depth (column 0) or yaw rate (1) at an instant, from the last SENSED_LOOKED_AT samples: interpolated, held at the ends;
    NaN if there is none, or the newest is SENSED_HELD_NS older."""
    sensed_ns, sensed, count = samples.sensed_ns, samples.sensed, samples.taken
    later_ns, later = 0, math.nan
    for i in range(count - 1, max(count - SENSED_LOOKED_AT, 0) - 1, -1):
        value = float(sensed[i, column])
        if math.isnan(value):
            continue
        if sensed_ns[i] <= at_ns:
            if math.isnan(later):
                return value if at_ns - sensed_ns[i] <= SENSED_HELD_NS else math.nan
            return float(value + (later - value) * (at_ns - sensed_ns[i]) / (later_ns - sensed_ns[i]))
        later_ns, later = sensed_ns[i], value
    return later


@kernel(part=True)
def passes_gate(there: State12, sighting: Sighting) -> tuple[bool, float, float, float]:
    """True if a pose is not farther off than GATE_M and GATE_RAD; and its errors in x, y and yaw against the state there."""
    turned = np.fmod(sighting.yaw_rad - there[3], TURN)
    turned = turned - TURN if turned >= math.pi else turned + TURN if turned < -math.pi else turned
    ex, ey = sighting.x_m - there[0], sighting.y_m - there[1]
    return math.hypot(ex, ey) <= GATE_M and abs(turned) <= GATE_RAD, ex, ey, turned


@kernel(part=True)
def correct(
    settings: EsoSettings, sway: float, numbers: Floats, error: tuple[float, float, float], depth_m: float, rate_radps: float,
    step_s: float,
) -> None:  # fmt: skip
    """Correction (31), `step_s` after the last one: eta += b1 e, nu += b2 J' e, Gamma += b3 J' e. `error` is that of x, y and
    yaw; depth and yaw rate are NaN where they are not known."""
    ex, ey, turned = error
    estimates = settings.estimates
    b1, b2, b3 = gains(settings.bandwidth_radps, step_s)
    cos, sin = math.cos(numbers[3]), math.sin(numbers[3])
    ahead, aside = cos * ex + sin * ey, sway * (cos * ey - sin * ex)
    numbers[0] += b1 * ex
    numbers[1] += b1 * ey
    numbers[4] += b2 * ahead
    numbers[5] += b2 * aside
    numbers[11] += estimates * b3 * ahead
    numbers[12] += estimates * b3 * aside
    if not math.isnan(depth_m):
        error_z = depth_m - numbers[2]
        numbers[2] += b1 * error_z
        numbers[6] += b2 * error_z
        numbers[13] += estimates * b3 * error_z
    if math.isnan(rate_radps):
        b1, b2, b3 = gains(settings.yaw_bandwidth_radps, step_s)
        error_r = turned
    else:  # the gyroscope sees the rate at once, the camera keeps the heading; a gyro bias of 2 mrad/s moves it by 0.5 mrad
        b1, b2, b3 = gains_with_rate(settings.yaw_bandwidth_radps, step_s)
        error_r = rate_radps - numbers[7]
    numbers[3] += b1 * turned
    numbers[7] += b2 * error_r
    numbers[14] += estimates * b3 * error_r


@kernel
def observe(
    motion: MotionModel,
    settings: EsoSettings,
    numbers: Floats,
    commands: Commands,
    samples: Samples,
    sighting: Sighting,
    instants: Instants,
    results: Table,
) -> bool:
    """One step of the observer: the belief (NUMBERS,), corrected by a pose if there is a later one, and predicted to now and
    on to when a command given now acts.

    `results` (2, 12): the state now, and then. False, and the belief stays, if the pose does not pass the gate.
    """
    at_ns, stamp_ns, passes, still = instants.at_ns, sighting.stamp_ns, True, (0.0, 0.0)
    if stamp_ns > at_ns:
        there = propagate(motion, state_of(numbers), gamma_of(numbers), still, commands, at_ns, stamp_ns)
        passes, ex, ey, turned = passes_gate(there, sighting)
        if passes:
            for i in range(11):
                numbers[i] = there[i]
            numbers[len(numbers) - 1] = there[STATES - 1]
            depth_m, rate_radps = sensed_at(samples, 0, stamp_ns), sensed_at(samples, 1, stamp_ns)
            correct(settings, motion.sway, numbers, (ex, ey, turned), depth_m, rate_radps, (stamp_ns - at_ns) * 1e-9)
            at_ns = stamp_ns
    gamma = gamma_of(numbers)
    here = propagate(motion, state_of(numbers), gamma, still, commands, at_ns, instants.now_ns)
    then = propagate(motion, here, gamma, still, commands, instants.now_ns, instants.acts_ns)
    for i in range(STATES):
        results[0, i], results[1, i] = here[i], then[i]
    return passes


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

    numbers = NUMBERS  # of the belief

    def __init__(self, model: Model, config: EstimatorConfig, dead_time_s: float) -> None:
        self._model = model
        self._dead_ns = round(dead_time_s * NS)
        self._acts_ns, self._wrenches = np.zeros(KEPT, dtype=np.int64), np.zeros((KEPT, len(AXES)))
        self._inputs = 0  # wrenches, each with the instant from which it acts, in order
        self._sensed_ns, self._sensed = np.zeros(KEPT, dtype=np.int64), np.zeros((KEPT, 2))
        self._samples = 0  # depths and yaw rates, each with its instant, in order; NaN where there was none
        self._board_ns = -1  # instant of the last measurement of the board, accepted or not
        self._belief = np.zeros(self.numbers)  # at the exposure _at_ns
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
        self._uses_yaw_rate = config.use_imu_yaw_rate
        self._settings = EsoSettings(config.bandwidth_radps, config.yaw_bandwidth_radps, float(config.enabled))

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

    def update(self, measurement: StateMeasurement, now_ns: int) -> Observation | None:
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
            self._at_ns = pose.stamp_ns
            self._other_poses.reset()
        elif pose is not None and self._leaps_to(pose):
            self._observe(None, now_ns, now, action)
        if self._has_coasted(now_ns):
            self._forget()
            return None
        eta, nu, disturbance, gamma_still_water = now
        x_mps, y_mps = self._belief[CURRENT].tolist()
        depth_age_s = (now_ns - self._depth_ns) / NS if self._depth_ns is not None else math.inf
        return Observation(
            Estimate(eta, nu, gamma_still_water), disturbance, complex(x_mps, y_mps), action, (now_ns - self._at_ns) / NS,
            depth_age_s, self._leap, self._depth_leap,
        )  # fmt: skip

    def _observe(self, pose: PoseMeasurement | None, now_ns: int, now: Array, action: Array) -> bool:
        """One step of the equations. Writes `now` (4, 4), the rows eta; nu over ground; Gamma; and Gamma with the acceleration
        by which the current changes drag; and `action` (12,), the state when a command given now acts, its velocities through
        the water. False if the pose does not pass the gate."""
        results = np.empty((2, STATES))
        sighting = Sighting(0.0, 0.0, 0.0, 0.0, 0.0, self._at_ns)
        if pose is not None:
            sighting = Sighting(pose.x_m, pose.y_m, pose.yaw_rad, 0.0, 0.0, pose.stamp_ns)
        passes = observe(
            self._model.motion, self._settings, self._belief, self._commands(), self._sensed_samples(), sighting,
            Instants(self._at_ns, now_ns, now_ns + self._dead_ns), results,
        )  # fmt: skip
        now[0], now[1], now[2:], action[:] = results[0, :4], results[0, 4:8], self._belief[GAMMA], results[1]
        return passes

    def _commands(self) -> Commands:
        return Commands(self._acts_ns, self._wrenches, self._inputs)

    def _sensed_samples(self) -> Samples:
        return Samples(self._sensed_ns, self._sensed, self._samples)

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
            depth = sensed_at(self._sensed_samples(), 0, pose.stamp_ns)
            z = 0.0 if math.isnan(depth) else depth
            yaw, w = pose.yaw_rad, 0.0
            surge_n = heave_n = yaw_nm = sway_n = 0.0
        else:
            _, _, z, yaw, _, _, w, _, surge_n, heave_n, yaw_nm, sway_n = self._predicted(pose.stamp_ns)
            yaw += wrap(pose.yaw_rad - yaw)
        self._belief[STATE] = (pose.x_m, pose.y_m, z, yaw, 0.0, 0.0, w, 0.0, surge_n, heave_n, yaw_nm)
        self._belief[SWAY_THRUST] = sway_n
        self._belief[GAMMA] = (0.0, 0.0, self._belief[GAMMA][2], 0.0)
        self._belief[CURRENT] = 0.0
        self._at_ns, self._begun = pose.stamp_ns, True
        self._other_poses.reset()
        self._other_rates.reset()

    def _predicted(self, to_ns: int) -> State:
        """State at an instant after the belief's, without correction."""
        state, gamma, current = (tuple(self._belief[part].tolist()) for part in (STATE, GAMMA, CURRENT))
        whole = (*state, self._belief.item(SWAY_THRUST))
        return propagate(self._model.motion, whole, gamma, current, self._commands(), self._at_ns, to_ns)


def _drop(count: int, instants_ns: NDArray[np.int64], rows: Array) -> int:
    """Forget the oldest `count` of KEPT rows. Returns how many are left."""
    for column in (instants_ns, rows):
        column[: KEPT - count] = column[count:]
    return KEPT - count


def _agree(a: PoseMeasurement, b: PoseMeasurement) -> bool:
    """True if a robot can have moved from the one pose to the other between two exposures."""
    return math.hypot(b.x_m - a.x_m, b.y_m - a.y_m) <= GATE_M and abs(wrap(b.yaw_rad - a.yaw_rad)) <= GATE_RAD


def _place(pose: tuple[float, ...]) -> str:
    """Text of x, y, yaw."""
    return f"({pose[0]:.2f} m, {pose[1]:.2f} m, {pose[2]:.2f} rad)"


def _sane(value: float) -> bool:
    """True for a number that can be a measurement; false for NaN."""
    return abs(value) < ABSURD
