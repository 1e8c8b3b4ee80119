"""Extended state observer (31): pose, velocity and lumped disturbance, computed where the delay is accounted for.

The observer lives at the exposure of the newest pose. From there it is predicted to now, and on to the instant at which a
command given now begins to act, with the wrenches that act meanwhile: 50 ms unaccounted at 0.3 m/s is 15 mm, more than all
vision noise. Gains are the discrete "current observer" for a bandwidth w (Miklosovic, Radke, Gao 2006), which tend to
b1 = 3w, b2 = 3w^2, b3 = w^3 for short steps and stay stable for long ones: poses come late and go missing.

The water may stream. To a robot that holds its heading a current c and a side force Gamma_v look the same; to one that turns a
current stands still while a force of its own turns along. So what lasts of Gamma_v is put down to a current, little by little
and along the one direction (v, Gamma_v, c) += (-1, -slope of drag / m_v, 1) dc that changes no prediction at this heading. In
water that streams evenly the model holds as it is for velocities through the water: c only moves the robot along.
"""

import cmath
import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from robot_agent.vehicle.dynamics import Model, State, Wrench
from wire.config.controller import COAST_S
from wire.config.controller import Estimator as EstimatorConfig
from wire.frames import Array, wrap

S = TypeVar("S")

NS = 1_000_000_000
COAST_NS = round(COAST_S * 1e9)  # prediction alone is no estimate any more: the agent has been neutral for half of it
LONGEST_STEP_NS = 50_000_000  # the model's step is first order in the Coriolis terms
GATE_M, GATE_RAD = 0.3, 1.0  # between two poses nothing moves this far: 0.5 m/s x 0.2 s, 1.9 rad/s x 0.2 s, and doubled
GATE_DEPTH_M = 0.15  # the same for depth: 0.26 m/s x 0.2 s, doubled, and 5 cm of pressure under waves
GATE_RADPS = 1.0  # the same for the gyroscope: 0.5 N m turn 0.12 kg m^2 by 0.8 rad/s faster in 0.2 s
GATE_PATIENCE = 5  # samples in a row that contradict the estimate and agree with one another before they are believed
ABSURD = 1e3  # m, rad, rad/s: nothing in a pool measures that much
SENSED_KEPT = 16  # board samples, one per step: reaches back 0.8 s
SENSED_HELD_NS = 150_000_000  # so long a board sample stands for what came after it: three bursts at 20 Hz
INPUTS_KEPT = 256  # more than COAST_NS of the fastest loop


@dataclass(frozen=True)
class PoseMeasurement:
    """A pose from the localizer, in the pool frame."""

    stamp_ns: int  # middle of the exposure, on the robot's clock
    x_m: float
    y_m: float
    yaw_rad: float


@dataclass(frozen=True)
class StateMeasurement:
    """The newest of what was sensed. What is missing is None; a pose that was seen before may be handed in again."""

    pose: PoseMeasurement | None = None
    depth_m: float | None = None  # of the robot's centre, from the pressure sensor
    yaw_rate_radps: float | None = None  # gyroscope
    board_ns: int | None = None  # instant of depth and yaw rate; None: now


class Contradiction(Generic[S]):
    """Samples in a row that contradict the estimate. A sample that does not agree with the one before it begins a new row."""

    def __init__(self, agree: Callable[[S, S], bool]) -> None:
        self._agree = agree
        self._last: S | None = None
        self._count = 0

    def lasts(self, sample: S) -> bool:
        """Count one more. True if there are now enough to be believed; then the count begins anew."""
        self._count = self._count + 1 if self._last is not None and self._agree(self._last, sample) else 1
        self._last = sample
        if self._count < GATE_PATIENCE:
            return False
        self.end()
        return True

    def end(self) -> None:
        """A sample has agreed with the estimate."""
        self._last, self._count = None, 0


@dataclass(frozen=True, eq=False)
class Estimate:
    """What is known of the robot. Velocities and `disturbance` are in the body frame, `current` in the pool's."""

    eta: Array  # (4,) now; yaw continuous, not wrapped
    nu: Array  # (4,) now, over ground
    disturbance: Array  # (4,) acceleration that the nominal model does not explain, in water that streams at `current`
    current: complex  # x + iy of the water's own velocity, m/s
    lumped: Array  # (4,) both together: what a model of still water does not explain
    action: State  # when a command given now begins to act; velocities through the water
    pose_age_s: float
    depth_age_s: float  # of the last depth that did not contradict the estimate; infinite before the first
    leap: str = ""  # what was told and what had been believed, in the step that gave up a believed place for another one
    depth_leap: str = ""  # the same for the depth


class Estimator:
    """One robot's observer. `update` once per control step, then `applied` with the wrench that was sent."""

    def __init__(self, model: Model, config: EstimatorConfig, dead_time_s: float, fastest_mps: float = math.inf) -> None:
        """`fastest_mps`: no current is stronger; what a robot cannot swim against it cannot hold out in either."""
        self._model, self._config, self._fastest_mps = model, config, fastest_mps
        self._dead_ns = round(dead_time_s * NS)
        self._inputs: deque[tuple[int, Wrench]] = deque(maxlen=INPUTS_KEPT)  # (instant from which it acts, wrench)
        self._sensed: deque[tuple[int, float | None, float | None]] = deque(maxlen=SENSED_KEPT)
        self._state: State | None = None  # at the exposure _at_ns
        self._disturbance = [0.0, 0.0, 0.0, 0.0]
        self._current = 0j
        self._at_ns = 0
        self._other_poses: Contradiction[PoseMeasurement] = Contradiction(lambda a, b: not _apart(_moved(a, b)))
        self._other_depths: Contradiction[float] = Contradiction(lambda a, b: abs(a - b) <= GATE_DEPTH_M)
        self._other_rates: Contradiction[float] = Contradiction(lambda a, b: abs(a - b) <= GATE_RADPS)
        self._contradicted_ns = 0  # stamp of the last pose that contradicted
        self._depth_ns: int | None = None  # instant of the last depth that was believed
        self._leap = self._depth_leap = ""

    def tune(self, config: EstimatorConfig) -> None:
        """Other gains from the next pose on; what is known stays known."""
        self._config = config

    def note_wrench(self, wrench: Wrench, now_ns: int) -> None:
        """Take note of the wrench sent out now. It acts after the thrusters' dead time. Of two at one instant the
        last counts."""
        acts_ns = now_ns + self._dead_ns
        if self._inputs and self._inputs[-1][0] == acts_ns:
            self._inputs.pop()
        self._inputs.append((acts_ns, wrench))

    def update(self, measurement: StateMeasurement, now_ns: int) -> Estimate | None:
        """Take in what is new; None before the first pose and after coasting for too long."""
        self._leap = self._depth_leap = ""
        self._note_board(measurement, now_ns)
        pose = measurement.pose
        if pose is not None and pose.stamp_ns <= now_ns and _sane(pose.x_m) and _sane(pose.y_m) and _sane(pose.yaw_rad):
            self._see(pose, now_ns)
        if self._state is None or now_ns - self._at_ns > COAST_NS:
            self._state, self._disturbance = None, [0.0, 0.0, 0.0, 0.0]
            return None
        self._forget_inputs()
        now = self._propagate(self._state, self._at_ns, now_ns)
        action = self._propagate(now, now_ns, now_ns + self._dead_ns)
        nu, lumped = self._over_ground(now)
        disturbance, age_s = np.array(self._disturbance), (now_ns - self._at_ns) / NS
        depth_age_s = (now_ns - self._depth_ns) / NS if self._depth_ns is not None else math.inf
        eta, current = np.array(now[:4]), self._current
        return Estimate(eta, nu, disturbance, current, lumped, action, age_s, depth_age_s, self._leap, self._depth_leap)

    def _over_ground(self, state: State) -> tuple[Array, Array]:
        """Velocities over ground, and the acceleration that the current lends to a robot at them, with Gamma; (4,) each."""
        (u, v, w, r), (extra_u, extra_v, extra_w, extra_r) = state[4:8], self._disturbance
        if self._current:
            carried = self._current * cmath.rect(1.0, -state[3])
            through_u, through_v = self._model.drag(u, v)
            u, v = u + carried.real, v + carried.imag
            over_u, over_v = self._model.drag(u, v)
            extra_u, extra_v = extra_u + over_u - through_u, extra_v + over_v - through_v
        return np.array((u, v, w, r)), np.array((extra_u, extra_v, extra_w, extra_r))

    def _note_board(self, measurement: StateMeasurement, now_ns: int) -> None:
        at_ns = now_ns if measurement.board_ns is None else measurement.board_ns
        if at_ns > now_ns or (self._sensed and at_ns <= self._sensed[-1][0]):
            return
        depth, rate = measurement.depth_m, measurement.yaw_rate_radps
        depth = depth if depth is not None and _sane(depth) else None
        rate = rate if self._config.use_imu_yaw_rate and rate is not None and _sane(rate) else None
        if depth is not None and not self._believes_depth(depth, at_ns):
            depth = None
        if rate is not None and not self._believes_rate(rate):
            rate = None
        if depth is not None:
            self._depth_ns = at_ns
        if depth is not None or rate is not None:
            self._sensed.append((at_ns, depth, rate))

    def _believes_depth(self, depth_m: float, at_ns: int) -> bool:
        """Whether a depth can be the robot's. One that lasts against the estimate replaces it: heave begins anew there."""
        if self._state is None:
            return True
        if self._depth_ns is None:  # the first one: nothing was believed before
            self._sink_to(depth_m)
            return True
        believed_m = self._state[2] + self._state[6] * (at_ns - self._at_ns) / NS
        if abs(depth_m - believed_m) <= GATE_DEPTH_M:
            self._other_depths.end()
            return True
        if not self._other_depths.lasts(depth_m):
            return False
        self._depth_leap = f"the sensor says {depth_m:.2f} m, {believed_m:.2f} m was believed"
        self._sink_to(depth_m)
        self._forget(1)
        return True

    def _sink_to(self, depth_m: float) -> None:
        """Begin heave anew: at rest at a depth."""
        assert self._state is not None
        x, y, _, yaw, u, v, _, r, *thrust = self._state
        self._state, self._disturbance[2] = (x, y, depth_m, yaw, u, v, 0.0, r, *thrust), 0.0

    def _believes_rate(self, rate_radps: float) -> bool:
        """Whether a yaw rate can be the robot's; a glitch is left out, what lasts is taken over."""
        if self._state is None or abs(rate_radps - self._state[7]) <= GATE_RADPS:
            self._other_rates.end()
            return True
        if not self._other_rates.lasts(rate_radps):
            return False
        self._state = (*self._state[:7], rate_radps, *self._state[8:])
        self._forget(2)
        return True

    def _forget(self, column: int) -> None:
        """Depths (1) or yaw rates (2) of before a leap: nothing lies between those and what comes."""
        kept = [(at_ns, None, rate) if column == 1 else (at_ns, depth, None) for at_ns, depth, rate in self._sensed]
        self._sensed.clear()
        self._sensed.extend(kept)

    def _see(self, pose: PoseMeasurement, now_ns: int) -> None:
        if self._state is None:
            if now_ns - pose.stamp_ns <= COAST_NS:
                self._begin(pose)
            return
        if pose.stamp_ns <= max(self._at_ns, self._contradicted_ns):
            return  # seen before, or overtaken by a newer one
        predicted = self._propagate(self._state, self._at_ns, pose.stamp_ns)
        error = (pose.x_m - predicted[0], pose.y_m - predicted[1], wrap(pose.yaw_rad - predicted[3]))
        if _apart(error):
            self._contradicted_ns = pose.stamp_ns
            if self._other_poses.lasts(pose):
                told, believed = (pose.x_m, pose.y_m, pose.yaw_rad), (*predicted[:2], wrap(predicted[3]))
                self._leap = f"poses say {_place(told)}, {_place(believed)} was believed"
                self._begin(pose)
            return
        self._other_poses.end()
        elapsed_s = (pose.stamp_ns - self._at_ns) / NS
        self._state, self._at_ns = self._correct(predicted, error, pose.stamp_ns, elapsed_s), pose.stamp_ns

    def _begin(self, pose: PoseMeasurement) -> None:
        """At rest where a pose is. Depth and what moves it are known from elsewhere: they go on."""
        if self._state is None:
            depth = self._at(1, pose.stamp_ns)
            z, yaw, w = depth if depth is not None else 0.0, pose.yaw_rad, 0.0
            thrust: State = (0.0, 0.0, 0.0)
        else:
            _, _, z, yaw, _, _, w, _, *rest = self._propagate(self._state, self._at_ns, pose.stamp_ns)
            yaw, thrust = yaw + wrap(pose.yaw_rad - yaw), tuple(rest)
        self._state = (pose.x_m, pose.y_m, z, yaw, 0.0, 0.0, w, 0.0, *thrust)
        self._disturbance, self._current = [0.0, 0.0, self._disturbance[2], 0.0], 0j
        self._at_ns = pose.stamp_ns
        self._other_poses.end()
        self._other_rates.end()

    def _correct(self, state: State, error: tuple[float, float, float], at_ns: int, elapsed_s: float) -> State:
        """(31) for pool axes x, y, z and yaw; velocities and disturbances are corrected in the body frame by J^T."""
        x, y, z, yaw, u, v, w, r, *thrust = state
        extra, config = self._disturbance, self._config
        pose, velocity, unknown = gains(config.bandwidth_radps, elapsed_s)
        if not config.enabled:
            unknown = 0.0
        c, s = math.cos(yaw), math.sin(yaw)
        ahead, aside = c * error[0] + s * error[1], -s * error[0] + c * error[1]
        x, y = x + pose * error[0], y + pose * error[1]
        u, extra[0] = u + velocity * ahead, extra[0] + unknown * ahead
        if config.sway:
            v = self._put_down_to_current(u, v + velocity * aside, extra[1] + unknown * aside, yaw, elapsed_s)
        depth = self._at(1, at_ns)
        if depth is not None:
            sunk = depth - z
            z, w, extra[2] = z + pose * sunk, w + velocity * sunk, extra[2] + unknown * sunk
        rate = self._at(2, at_ns)
        if rate is None:
            pose, velocity, unknown = gains(config.yaw_bandwidth_radps, elapsed_s)
            r, slip = r + velocity * error[2], unknown * error[2]
        else:
            # The gyroscope sees the rate at once, the camera keeps the heading; a gyro bias of 2 mrad/s moves it by 0.5 mrad.
            pose, velocity, unknown = gains_with_rate(config.yaw_bandwidth_radps, elapsed_s)
            spun = rate - r
            r, slip = r + velocity * spun, unknown * spun
        extra[3] += slip if config.enabled else 0.0
        return (x, y, z, yaw + pose * error[2], u, v, w, r, *thrust)

    def _put_down_to_current(self, u: float, v: float, side: float, yaw: float, elapsed_s: float) -> float:
        """Share a side force out between Gamma_v and the current; returns the sway velocity through the water. A current as
        strong as any gets no stronger: what would make it so stays a side force."""
        slope = self._model.sway_slope(u, v)
        drift = -math.expm1(-self._config.current_rate_radps * elapsed_s) * side / slope
        aside = cmath.rect(1.0, yaw + 0.5 * math.pi)
        if abs(self._current + drift * aside) > self._fastest_mps:
            along = (self._current * aside.conjugate()).real  # |current + t aside| = fastest at t = -along +- half
            half = math.sqrt(max(along**2 + self._fastest_mps**2 - abs(self._current) ** 2, 0.0))
            drift = min(max(drift, min(-along - half, 0.0)), max(-along + half, 0.0))
        self._disturbance[1] = side - drift * slope
        self._current += drift * aside
        return v - drift

    def _at(self, column: int, at_ns: int) -> float | None:
        """Depth (1) or yaw rate (2) at an instant, interpolated between board samples, held at the ends."""
        later: tuple[int, float] | None = None
        for sample in reversed(self._sensed):
            value = sample[column]
            if value is None:
                continue
            if sample[0] <= at_ns:
                if later is None:
                    return value if at_ns - sample[0] <= SENSED_HELD_NS else None
                return value + (later[1] - value) * (at_ns - sample[0]) / (later[0] - sample[0])
            later = (sample[0], value)
        return later[1] if later is not None else None

    def _forget_inputs(self) -> None:
        while len(self._inputs) > 1 and self._inputs[1][0] <= self._at_ns:
            self._inputs.popleft()

    def _propagate(self, state: State, from_ns: int, to_ns: int) -> State:
        """Predict with the inputs that act in between, no correction."""
        wrench: Wrench = (0.0, 0.0, 0.0)
        for acts_ns, following in self._inputs:
            if acts_ns >= to_ns:
                break
            if acts_ns > from_ns:
                state = self._steps(state, wrench, acts_ns - from_ns)
                from_ns = acts_ns
            wrench = following
        return self._steps(state, wrench, to_ns - from_ns)

    def _steps(self, state: State, wrench: Wrench, duration_ns: int) -> State:
        count = -(-duration_ns // LONGEST_STEP_NS)
        for _ in range(count):
            state = self._model.advance(state, self._disturbance, wrench, duration_ns / count / NS)
        if not self._current:
            return state
        x, y, *rest = state
        return (x + self._current.real * duration_ns / NS, y + self._current.imag * duration_ns / NS, *rest)


def gains(bandwidth_radps: float, step_s: float) -> tuple[float, float, float]:
    """Innovation gains for pose, velocity, disturbance: all three observer poles at exp(-w dt)."""
    beta = math.exp(-bandwidth_radps * step_s)
    rest = 1.0 - beta
    return 1.0 - beta**3, 1.5 * rest * rest * (1.0 + beta) / step_s, rest**3 / (step_s * step_s)


def gains_with_rate(bandwidth_radps: float, step_s: float) -> tuple[float, float, float]:
    """The same where velocity is measured too: pose by the pose's error; velocity and disturbance by the velocity's."""
    beta = math.exp(-bandwidth_radps * step_s)
    rest = 1.0 - beta
    return rest, 1.0 - beta * beta, rest * rest / step_s


def _moved(a: PoseMeasurement, b: PoseMeasurement) -> tuple[float, float, float]:
    """From one pose to another: m, m, rad."""
    return b.x_m - a.x_m, b.y_m - a.y_m, wrap(b.yaw_rad - a.yaw_rad)


def _apart(moved: tuple[float, float, float]) -> bool:
    """Whether this is farther than a robot moves between two poses."""
    return math.hypot(moved[0], moved[1]) > GATE_M or abs(moved[2]) > GATE_RAD


def _place(pose: tuple[float, ...]) -> str:
    """x, y, yaw for people."""
    return f"({pose[0]:.2f} m, {pose[1]:.2f} m, {pose[2]:.2f} rad)"


def _sane(value: float) -> bool:
    """A number that can be a measurement; false for NaN too."""
    return abs(value) < ABSURD
