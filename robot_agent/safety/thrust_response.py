"""Response of a robot's place to its thrust: is it held fast, or is its marker turned? Pure.

The push of the thrusters, X / m along the heading of the poses, is known from what was sent. What the poses show of it is a
complex gain g: in the pool, with places and velocities as x + iy,

    p' = v    v' = a + g f - d D(v)    f = (X / m) e^(i yaw)    D: the hull's drag at the speed over ground, per mass

a is what else accelerates the robot (a current, a cable), d the drag over the vehicle file's. A Kalman filter with the states
p, v, a, g, d learns all of them from the poses alone, so no belief of the controller's observer enters. |g| is thrust per mass
over the file's. Its angle is 0, unless the robot looks another way than its marker says: a marker turned by phi turns the push
by -phi. As in the observer (vehicle/filter_bank.py) nobody knows how restless the water is, so there are several filters, and
the poses tell which is right.

A robot that is held fast stands, whatever its thrusters do. One that holds its place against a current stands as well, but its
thrust is the same, or changes slowly. So the test is by the change of thrust: the way that it should have moved the robot by
since it stands, against the way by which it moved. Thrust that lasts is forgotten in BALANCED_S: it may be balanced. The yaw
moment and the heading are tested alike: a robot that turns first gives no other thrust, and one that is held does not turn.
"""

import cmath
import math
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from robot_agent.safety.sent_commands import NS, ActingThrust
from shoal.config.vehicle import Vehicle
from shoal.frames import wrap
from shoal.kernels.decorator import kernel
from shoal.kernels.types import Floats

Complexes = Annotated[NDArray[np.complex128], 2]
ComplexCube = Annotated[NDArray[np.complex128], 3]

STATES = 5
P, V, A, G, D = range(STATES)
RESTLESS = (1e-5, 2e-4, 4e-3, 4e-2)  # m^2/s^3: by how much v changes by itself: 3 mm/s in a second at rest, 20 cm/s in waves
KIND_LASTS = 0.005  # share of the weights that is dealt out anew at each pose
LEAST_WEIGHT = 1e-6
AT_REST_MPS = 0.05  # standard deviation of v at first, and
FIRST_GAIN, FIRST_DRAG = 0.7, 0.5  # of g and d: vehicle files are -50 to +100 % off. Of a it is full thrust
THRUST_SHARE, PASSES_S = 0.03, 0.1  # as in vehicle/kalman.py: of thrust, what comes and goes, and for how long it stays
FORCE_SHARE = 0.02  # of full thrust: by how much a changes in a second
GAIN_LASTS_S = 300.0  # a marker may be knocked in flight
DRAG_PER_S = 0.001  # variance
OUTLIER = 5.0  # deviations: a pose farther off counts as if it were so much worse
LONGEST_NS = NS  # between two poses; after a longer gap all begins anew

TURNED_RAD = 0.07  # 4 degrees: no marker is glued on worse: less is no finding
SURE = 3.0  # standard deviations beyond that,
SURE_S = 0.3  # for so long
PUSHES = 0.3  # of the thrust that should act: with less, its direction means nothing

STANDS = 5.0  # standard deviations of a pose: a robot that stands stays within, and within
STANDS_M = 0.002
STANDS_STILL_S, STANDS_RAD = 0.25, 0.1  # and does not turn: what a robot with a broken thruster does
WEAK = 0.5  # of the push: the file may be wrong about mass by +100 %
HELD = 2.5  # the way that thrust should have moved it, over the way that counts as none
BALANCED_S = 1.4  # time constant
RAMP_PER_S = 0.04  # of full thrust: by how much a force may change that the robot holds its place against
KEPT = 256  # commands: half of them are more than act between two poses


class Push(NamedTuple):
    """Causes of a robot's motion between two poses."""

    acceleration: complex  # f
    thrust_mps2: float  # full thrust
    linear_per_s: float  # drag: linear v + quadratic |v| v
    quadratic_per_m: float
    elapsed_s: float


class ResponseFilters(NamedTuple):
    """The filters with their memory, changed in place."""

    restless: Floats  # (filters,)
    weight: Floats  # (filters,) their sum is 1
    mean: Complexes  # (filters, STATES)
    covariance: ComplexCube  # (filters, STATES, STATES), E[e e^H]
    work: ComplexCube  # (2, STATES, STATES), overwritten


class Response(NamedTuple):
    """The gain g of all filters together, its standard deviation along one axis, and the velocity over ground."""

    gain: complex
    deviation: float
    velocity: complex


@kernel(part=True)
def advance_filter(x: Complexes, p: ComplexCube, j: int, restless: float, push: Push, work: ComplexCube) -> None:
    """Move the j-th filter on by `push.elapsed_s`."""
    f, half, dt, a = work[0], work[1], push.elapsed_s, push.acceleration
    v, d = x[j, V], x[j, D]
    slope = push.linear_per_s + push.quadratic_per_m * abs(v)
    kept = math.exp(-dt / GAIN_LASTS_S)
    # F, the derivative of the state after by the state before
    f[:] = 0.0
    for i in range(STATES):
        f[i, i] = 1.0
    f[V, V], f[V, A], f[V, G], f[V, D] = 1.0 - dt * d * slope, dt, dt * a, -dt * slope * v
    f[P, V], f[P, A] = dt - 0.5 * dt * dt * d * slope, 0.5 * dt * dt
    f[P, G], f[P, D] = 0.5 * dt * dt * a, -0.5 * dt * dt * slope * v
    f[G, G] = kept
    # the mean
    change = dt * (x[j, A] + x[j, G] * a - d * slope * v)
    x[j, P] += dt * v + 0.5 * dt * change
    x[j, V] = v + change
    x[j, G] = 1.0 + kept * (x[j, G] - 1.0)
    # the covariance: F P F^H + Q
    for i in range(STATES):
        for k in range(STATES):
            total = 0.0j
            for m in range(STATES):
                total += f[i, m] * p[j, m, k]
            half[i, k] = total
    for i in range(STATES):
        for k in range(STATES):
            total = 0.0j
            for m in range(STATES):
                total += half[i, m] * f[k, m].conjugate()
            p[j, i, k] = total
    rough = THRUST_SHARE * abs(a)
    noise = 2.0 * dt * (restless + 2.0 * PASSES_S * rough * rough)  # of two axes
    p[j, V, V] += noise
    p[j, P, V] += 0.5 * dt * noise
    p[j, V, P] += 0.5 * dt * noise
    p[j, P, P] += dt * dt / 3.0 * noise
    p[j, A, A] += 2.0 * dt * (FORCE_SHARE * push.thrust_mps2) ** 2
    p[j, G, G] += 2.0 * FIRST_GAIN**2 * (1.0 - kept * kept)
    p[j, D, D] += 2.0 * DRAG_PER_S * dt


@kernel
def follow_response(filters: ResponseFilters, push: Push, place: complex, variance_m2: float) -> Response:
    """Move all filters on to a pose, correct and weigh them."""
    x, p, weight, gain = filters.mean, filters.covariance, filters.weight, filters.work[0, 0]
    best, count = -math.inf, len(filters.weight)
    likelihood = np.empty(count)
    for j in range(count):
        advance_filter(x, p, j, filters.restless[j], push, filters.work)
        news = place - x[j, P]
        s = max(p[j, P, P].real + 2.0 * variance_m2, abs(news) ** 2 / OUTLIER**2)
        for i in range(STATES):
            gain[i] = p[j, i, P] / s
        for i in range(STATES):
            x[j, i] += gain[i] * news
            for k in range(STATES):
                p[j, i, k] -= gain[i] * gain[k].conjugate() * s
        likelihood[j] = -(abs(news) ** 2) / s - math.log(s)
        best = max(best, likelihood[j])
    total = 0.0
    for j in range(count):
        prior_weight = (1.0 - KIND_LASTS) * weight[j] + KIND_LASTS / count
        weight[j] = max(prior_weight * math.exp(likelihood[j] - best), LEAST_WEIGHT)
        total += weight[j]
    mean, velocity, spread = 0j, 0j, 0.0
    for j in range(count):
        weight[j] /= total
        mean += weight[j] * x[j, G]
        velocity += weight[j] * x[j, V]
    for j in range(count):
        spread += weight[j] * (p[j, G, G].real + abs(x[j, G] - mean) ** 2)
    return Response(mean, math.sqrt(max(0.5 * spread, 0.0)), velocity)


class Axis(NamedTuple):
    """An axis of a vehicle: of the place, in m, or of the heading, in rad."""

    strongest: float  # acceleration by all of its thrust, 1/s^2
    fades_s: float  # time constant in which drag ends a motion
    least: float  # less is no motion


class Standstill:
    """For how long a robot has stood on one axis, and the way that its thrust should have moved it by since."""

    def __init__(self, axis: Axis) -> None:
        self._lasts_s = min(BALANCED_S, axis.fades_s)  # of thrust, and of the speed that it should have given
        self._balanced_way, self._least = WEAK * RAMP_PER_S * axis.strongest * self._lasts_s**3, axis.least
        self.room = axis.least
        self.begin(0j, 0j)

    def begin(self, place: complex, acceleration: complex) -> None:
        """Begin anew, here."""
        self._place, self._balanced = place, acceleration
        self._speed, self._way, self.stands_s, self.pushed = 0j, 0j, 0.0, 0.0

    def step(self, place: complex, deviation: float, acceleration: complex, elapsed_s: float) -> None:
        """Take in a pose and the push f since the last one."""
        self.room = self._least + STANDS * deviation
        if abs(place - self._place) > self.room:
            self.begin(place, acceleration)
        share = min(elapsed_s / self._lasts_s, 1.0)
        self._balanced += share * (acceleration - self._balanced)
        change = (acceleration - self._balanced) * elapsed_s
        self._way += (self._speed + 0.5 * change) * elapsed_s - share * self._way
        self._speed += change - share * self._speed
        self.stands_s += elapsed_s
        self.pushed = WEAK * abs(self._way)

    @property
    def is_held(self) -> bool:
        """True if it stands although its thrust should have moved it."""
        return self.pushed > HELD * self.room + self._balanced_way


class ThrustResponse:
    """Response of one robot to its thrust."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._mass_kg = vehicle.mass.surge_kg
        self._push = Push(
            0j, vehicle.limits.wrench[0] / self._mass_kg, vehicle.drag.linear[0] / self._mass_kg,
            vehicle.drag.quadratic[0] / self._mass_kg, 0.0,
        )  # fmt: skip
        count = len(RESTLESS)
        self._filters = ResponseFilters(
            np.array(RESTLESS), np.empty(count), np.empty((count, STATES), np.complex128),
            np.empty((count, STATES, STATES), np.complex128), np.empty((2, STATES, STATES), np.complex128),
        )  # fmt: skip
        limits, drag, self._inertia = vehicle.limits.wrench, vehicle.drag.linear, vehicle.mass.yaw_kg_m2
        self._place_axis = Axis(limits[0] / self._mass_kg, self._mass_kg / drag[0], STANDS_M)
        self._heading_axis = Axis(limits[2] / self._inertia, self._inertia / drag[3], STANDS_RAD)
        self._acting = ActingThrust(2, KEPT, vehicle.thruster)
        self.reset()

    def reset(self) -> None:
        """Begin anew at the next pose. What was sent is known on."""
        self._at_ns: int | None = None
        self._yaw_rad, self._sure_s = 0.0, 0.0
        self.response = Response(1.0 + 0j, FIRST_GAIN, 0j)
        self.place, self.heading = Standstill(self._place_axis), Standstill(self._heading_axis)

    def note_thrust(self, surge_n: float, yaw_nm: float, now_ns: int) -> None:
        """Take note of surge force and yaw moment of pulses that went out. Of two at one instant the last counts."""
        self._acting.note((surge_n, yaw_nm), now_ns)

    def note_pose(self, stamp_ns: int, place: complex, yaw_rad: float, variance_m2: float) -> None:
        """Take in a pose. One that was given before is ignored."""
        at_ns, self._at_ns = self._at_ns, max(stamp_ns, self._at_ns or stamp_ns)
        if at_ns is not None and stamp_ns <= at_ns:
            return
        if at_ns is None or stamp_ns - at_ns > LONGEST_NS:
            self._acting.impulse(stamp_ns - LONGEST_NS, stamp_ns)
            self.reset()
            self._begin(stamp_ns, place, yaw_rad, variance_m2)
            return
        elapsed_s = (stamp_ns - at_ns) / NS
        middle_rad = self._yaw_rad + 0.5 * wrap(yaw_rad - self._yaw_rad)
        surge_ns, yaw_nms = self._acting.impulse(at_ns, stamp_ns).tolist()
        acceleration = surge_ns / (elapsed_s * self._mass_kg) * cmath.exp(1j * middle_rad)
        self._yaw_rad = yaw_rad
        push = self._push._replace(acceleration=acceleration, elapsed_s=elapsed_s)
        self.response = follow_response(self._filters, push, place, variance_m2)
        self._note_standstill(place, math.sqrt(variance_m2), acceleration, yaw_nms / (elapsed_s * self._inertia), elapsed_s)
        self._sure_s = self._sure_s + elapsed_s if self.turn_evidence > 1.0 else 0.0

    def _begin(self, stamp_ns: int, place: complex, yaw_rad: float, variance_m2: float) -> None:
        """Set all filters to a robot at rest at this pose, whose thrust and drag are those of the vehicle file."""
        self._at_ns, self._yaw_rad = stamp_ns, yaw_rad
        deviation_m = math.sqrt(variance_m2)
        deviations = [deviation_m, AT_REST_MPS, self._push.thrust_mps2, FIRST_GAIN, FIRST_DRAG]
        self._filters.weight[:] = 1.0 / len(RESTLESS)
        self._filters.mean[:] = np.array([place, 0.0, 0.0, 1.0, 1.0])  # in the order of P, V, A, G, D
        self._filters.covariance[:] = 2.0 * np.diag(np.square(deviations))
        self._note_standstill(place, deviation_m, 0j, 0.0, 0.0)

    def _note_standstill(self, place: complex, deviation_m: float, push: complex, turning: float, elapsed_s: float) -> None:
        """Take in a pose, with the accelerations by thrust since the last one. Only a robot that stands can be held."""
        direction = cmath.rect(1.0, self._yaw_rad)  # as far from another one as the angle between them
        self.place.step(place, deviation_m, push, elapsed_s)
        if self.place.stands_s == elapsed_s:
            self.heading.begin(direction, turning)
        self.heading.step(direction, 0.0, turning, elapsed_s)

    @property
    def turn_evidence(self) -> float:
        """Evidence that the marker is turned on its hull: the angle between thrust and acceleration beyond TURNED_RAD, in SURE
        standard deviations. Above 1 it is sure; 0 while the thrust explains no motion."""
        size, deviation = abs(self.response.gain), self.response.deviation
        if size < PUSHES + SURE * deviation:
            return 0.0
        gains = self._filters.mean[:-1, G].tolist()  # waves in step with the thrust by chance do not turn all of them alike
        return (min(abs(cmath.phase(gain)) for gain in gains) - TURNED_RAD) * size / (SURE * deviation)

    @property
    def stands_still(self) -> bool:
        """True if it has neither moved nor turned for STANDS_STILL_S."""
        return self.heading.stands_s >= self.place.stands_s > STANDS_STILL_S

    @property
    def marker_turned_rad(self) -> float:
        """By how much the marker is turned, once that is sure; else 0."""
        return -cmath.phase(self.response.gain) if self._sure_s >= SURE_S else 0.0

    @property
    def held_fast(self) -> str:
        """Evidence that the robot is held fast; empty if it is not."""
        if self.place.is_held:
            return (
                f"it has moved by less than {1e3 * self.place.room:.0f} mm in {self.place.stands_s:.1f} s, "
                f"though its thrust should have moved it by {1e3 * self.place.pushed:.0f} mm"
            )
        if self.heading.is_held:
            return (
                f"it has turned by less than {math.degrees(self.heading.room):.0f} degrees in {self.heading.stands_s:.1f} s, "
                f"though its thrust should have turned it by {math.degrees(self.heading.pushed):.0f} degrees"
            )
        return ""
