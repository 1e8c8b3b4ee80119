"""Detection of a thruster that does not turn the robot as commanded, from the gyroscope. Pure.

Each leg turns the robot as it pushes, and the gyroscope senses that at once. A first-order observer of the yaw rate r,

    r^' = (sum N_k + (m_u - m_v) u v - d(r)) / m_r + (r - r^) / T        residual = m_r (r - r^) / T

gives the unexplained moment, smoothed over T, without differences of a noisy rate. N_k is the commanded moment of leg k
after the thruster's dead time and lag. Drag d is that of the measured rate: r^ follows a robot of half the inertia late, and
with the drag of r^ the residual would not be linear in what is learned. Mass, voltage, drag and curve are never known
exactly, thrusters differ, a gyroscope has a bias, and pulses and rates are delayed. So the dependence of the residual on
each N_k, on d(r), on a constant and on the moment's rate of change is learned in flight; a voltage that changes is new doubt
about all legs alike. A leg that gives less thrust than commanded, none, or the opposite leaves a share of its own N_k in the
residual. likelihood_ratio.py tests at each look whether that is chance, and two looks have to agree; disturbances of the
water do not follow one leg's pulses.

The moment of the water past a hull that is no sphere, (m_u - m_v) u v, is known as well as the observer knows u and v: as a
flight begins, with an unknown current, hardly.

A thruster with almost no command, or one stuck at its present command, cannot be seen: neither moves the robot. The limits are
measured on flights of the article's robot with masses and thrusters off by 30 %, in waves and gusts
(tests/robot_agent/safety/test_thruster_fault_detection.py).
"""

import math
from typing import NamedTuple

import numpy as np

from robot_agent.safety.likelihood_ratio import SPANS_S, LikelihoodRatioTest
from robot_agent.safety.sent_commands import NS, ActingLegs
from robot_agent.vehicle.dynamics import NO_FLOW, FlowMoment
from shoal.config.vehicle import Vehicle
from shoal.frames import Array
from shoal.kernels.decorator import kernel
from shoal.kernels.types import Floats

SMOOTH_S = 0.3  # T: noise of the gyroscope, 3 mrad/s, is then 1.2 mN m; one idle thruster of the article's robot turns with 12
DRAG, RISING, ALWAYS = -3, -2, -1  # among the causes of the residual, after the thrusters
OF_ALL, OF_ONE = 0.3, 0.1  # how far the residual may go with every N_k alike (mass, voltage), and with each (curve, spread),
OF_DRAG, OF_NOTHING_NM = 0.3, 0.004  # with d(r), and with nothing,
LATE_S = 0.02  # and for how late the moment comes, before any of it is known
NOISE_NM = (0.002, 0.0007)  # of the residual: at first, and at least
SAME_S = 2.0 * SMOOTH_S  # residuals closer together say the same,
NOTED_S = 0.09  # and not every one is looked at
SHARE = 0.02  # of each leg's moment: curves are no straight lines, and legs that push against one another each have theirs
UNEVEN_S = 0.005  # steps begin, and pulses leave, a little earlier or later
FLOW_LASTS = math.sqrt(SPANS_S[-1] / SAME_S)  # an error of the water's velocity lasts: a whole span of it counts once
MISSING = (0.6, 2.0)  # of what a leg is told: most of it, up to twice, which is reversed
SURE = 8.0  # evidence: e^8 to one,
SURE_AGAIN = 2  # looks that have to be sure one after the other: a hull that pitches back from full thrust gave 9 at one
LONGEST_NS = NS // 5  # between two steps; after a longer gap the observer begins anew,
APART_NS = NS // 20  # as it does if the board's clock tells otherwise how long it was: what is heard late says nothing of now
EXPONENT = 1.2  # of thrust over voltage (OpenThruster's A2212 data at 10 to 12.6 V)
CHANGED = 0.05  # of the thrust: half a volt of 12. Less is within what a leg may be off, and full load alone is as much
MOST_CHANGED = 0.3  # of the thrust: from a full battery to one at which robots go to neutral
SETTLES_NS = round(SPANS_S[-1] * NS)  # after a change: until then nothing felt since is learned
OUTLIER_RADPS = 1.0  # from the estimated yaw rate; 0.5 N m turn 0.12 kg m^2 by 0.2 rad/s faster in a step at 20 Hz
KEPT = 128  # commands: half of them are more than act within LONGEST_NS of the fastest loop


class YawModel(NamedTuple):
    """The vehicle file's inertia and drag of the yaw."""

    inertia_kg_m2: float
    linear: float  # N m s
    quadratic: float  # N m s^2


class YawRates(NamedTuple):
    """Yaw rates by which the observer advances, rad/s."""

    estimated: float  # r^
    before: float  # the gyroscope's sample before,
    measured: float  # and its newest


@kernel
def observe_turn(
    impulse: Floats, elapsed_s: float, causes: Floats, turn: YawRates, yaw: YawModel, flow_nm: float
) -> tuple[float, float]:
    """Advance the observer of the module by one sample of the gyroscope: returns the estimated yaw rate r^ and the residual
    moment, N m. `impulse` (thrusters,) is what the moments gave meanwhile, N m s; `flow_nm` the moment of the water past the
    hull.

    `causes` (thrusters + 3,), each smoothed over T, are the thrusters' moments, drag, the moment's rate of change, and 1.
    """
    drag = 0.0
    for rate in (turn.before, turn.measured):
        drag += 0.5 * (yaw.linear + yaw.quadratic * abs(rate)) * rate
    smooth, moment, rising = -math.expm1(-elapsed_s / SMOOTH_S), 0.0, 0.0
    for leg in range(len(impulse)):
        push = impulse[leg] / elapsed_s
        change = smooth * (push - causes[leg])
        causes[leg] += change
        moment += push
        rising += change
    predicted = turn.estimated + elapsed_s * (moment + flow_nm - drag) / yaw.inertia_kg_m2
    estimated = predicted + smooth * (turn.measured - predicted)
    others = len(impulse) + 3  # a kernel counts from the front
    causes[others + DRAG] += smooth * (drag - causes[others + DRAG])
    causes[others + RISING] = rising / elapsed_s
    causes[others + ALWAYS] += smooth * (1.0 - causes[others + ALWAYS])
    return estimated, yaw.inertia_kg_m2 * (turn.measured - estimated) / SMOOTH_S


def covariances(thrusters: int) -> tuple[Array, Array]:
    """Two covariances (thrusters + 3, thrusters + 3) of the factors by which the residual goes with each thruster's moment,
    drag, the moment's change, and nothing: the prior one, and that of a change of all thrusters alike."""
    prior = np.diag(np.square([OF_ONE] * thrusters + [OF_DRAG, LATE_S, OF_NOTHING_NM]))
    prior[:thrusters, :thrusters] += OF_ALL**2
    alike = np.diag([1.0] * thrusters + [0.0] * 3)
    alike[:thrusters, :thrusters] = 1.0
    return prior, alike


class ThrusterFaultDetector:
    """Fault detection for one robot's thrusters."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._yaw = YawModel(vehicle.mass.yaw_kg_m2, vehicle.drag.linear[3], vehicle.drag.quadratic[3])
        self._vehicle, self._thrusters = vehicle, vehicle.thruster_count
        self._prior, self._alike = covariances(self._thrusters)
        self.reset()

    def reset(self) -> None:
        """Start anew: thrusters at rest, nothing learned."""
        self._flow = NO_FLOW
        self.broken = False  # stays so until the next reset
        self._moments = ActingLegs(KEPT, self._vehicle)
        self._rate: float | None = None  # r^
        self._measured = 0.0  # the last sample
        self._at_ns = self._board_ns = 0
        self._outlier_ns: int | None = None  # on the board's clock: the sample that was left out last
        self._known_v: float | None = None  # battery's voltage at which legs were as they are known
        self._changed, self._changed_v, self._changed_ns = 0.0, 0.0, 0  # the largest change from there, already doubted
        self._forget_causes()
        self._test = LikelihoodRatioTest(self._prior, *NOISE_NM, SAME_S, self._thrusters, MISSING)

    def _forget_causes(self) -> None:
        """Clear the smoothed causes of the residual."""
        self._causes = np.zeros(self._thrusters + 3)
        self._noted_nm = np.zeros(self._thrusters)  # each leg's moment at the last look
        self._unnoted_s, self._sure = 0.0, 0

    def note_moments(self, level_nm: Array, ankles_rad: Array, now_ns: int) -> None:
        """Take note of pulses that went out: the yaw moment (thrusters,) that each leg gives with its ankle level, and its
        ankle's angle (thrusters,). Of two at one instant the last counts."""
        self._moments.note(level_nm, ankles_rad, now_ns)

    def note_flow(self, flow: FlowMoment) -> None:
        """Take note of the moment by which the water past the hull turns it."""
        self._flow = flow

    def note_voltage(self, voltage_v: float, at_ns: int) -> None:
        """Take note of the battery's voltage, however raw, with its instant. 0: not known.

        A change by more than MOST_CHANGED counts as that much. For SETTLES_NS after a change only one that goes farther from
        the voltage before it counts: readings to and fro let the test begin anew no more often than that, unless each of up
        to MOST_CHANGED / CHANGED goes farther.
        """
        if not 0.0 < voltage_v < math.inf:
            return
        if self._known_v is None:
            self._known_v = self._changed_v = voltage_v
        if at_ns - self._changed_ns > SETTLES_NS:
            self._known_v, self._changed = self._changed_v, 0.0
        changed = min(EXPONENT * abs(math.log(voltage_v) - math.log(self._known_v)), MOST_CHANGED)
        if changed > self._changed + CHANGED:
            self._test.note_change((changed**2 - self._changed**2) * self._alike, at_ns)
            self._changed, self._changed_v, self._changed_ns = changed, voltage_v, at_ns

    def step(self, yaw_rate_radps: float, at_ns: int, board_ns: int) -> None:
        """Take in a yaw rate with its instant on our clock and on the board's clock. A sample that was given before is
        ignored."""
        elapsed_ns, board_elapsed_ns = at_ns - self._at_ns, board_ns - self._board_ns
        if self._rate is None or not 0 <= elapsed_ns <= LONGEST_NS or abs(elapsed_ns - board_elapsed_ns) > APART_NS:
            self._begin(yaw_rate_radps, at_ns, board_ns)
        elif elapsed_ns and not self._leaves_out(yaw_rate_radps - self._rate, board_ns):
            impulse, turn = self._moments.impulse(self._at_ns, at_ns), YawRates(self._rate, self._measured, yaw_rate_radps)
            flow_nm = self._flow.expected_nm
            self._rate, residual = observe_turn(impulse, elapsed_ns / NS, self._causes, turn, self._yaw, flow_nm)
            self._measured, self._at_ns, self._board_ns = yaw_rate_radps, at_ns, board_ns
            self._unnoted_s += elapsed_ns / NS
            if self._unnoted_s > NOTED_S:
                moments = self._causes[: self._thrusters]
                rising = (moments - self._noted_nm) / self._unnoted_s
                rough = math.hypot(
                    SHARE * float(np.abs(moments).sum()),
                    UNEVEN_S * float(np.abs(rising).sum()),
                    FLOW_LASTS * self._flow.deviation_nm,
                )
                self._noted_nm = moments.copy()
                self._test.note_sample(self._causes, residual, rough, self._unnoted_s, at_ns)
                self._unnoted_s = 0.0
                self._sure = self._sure + 1 if self._test.evidence > SURE else 0
                self.broken |= self._sure >= SURE_AGAIN

    def _leaves_out(self, off_radps: float, board_ns: int) -> bool:
        """True for a sample far off the estimated rate, unless the one before it was left out: two in a row count."""
        if abs(off_radps) <= OUTLIER_RADPS:
            self._outlier_ns = None
            return False
        if self._outlier_ns is None:
            self._outlier_ns = board_ns
        return self._outlier_ns == board_ns

    def _begin(self, yaw_rate_radps: float, at_ns: int, board_ns: int) -> None:
        """Start the observer at this sample. Learned parameters are kept across a gap."""
        if self._rate is not None and at_ns > self._at_ns:
            self._moments.impulse(self._at_ns, at_ns)
        self._rate = self._measured = yaw_rate_radps
        self._at_ns, self._board_ns = at_ns, board_ns
        self._forget_causes()
