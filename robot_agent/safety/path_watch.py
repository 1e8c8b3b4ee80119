"""The path watch: holds a robot with power to the bounds of its guidance state, and names what is wrong. Pure. Never off.

In every state the robot has to be where its plan, told LOOK_S ago, said that it would be now. The margin is what unknown
forces and errors of the model may do in that time: a share of the way that full thrust makes, and the estimate's own
uncertainty. On its path it has to stay within `safety.off_path_m` (path_deviation.py), on the way there its error may not
grow beyond that, and every way there has its time (guidance_states.py).

Three causes are found by themselves, earlier than their effect on the path: a robot that is held fast, a marker that is turned
(both thrust_response.py), and a current or another force that is stronger than the robot: for a second it takes as much as
full thrust, the thrust is near its limit, and the error grows, though the robot does not brake. (One that has overshot its
path moves away from it, slower every moment.)
"""

import cmath
import math
from collections import deque
from typing import NamedTuple

from robot_agent.control.controller import ControlOutput
from robot_agent.control.nonlinear.tuning import horizon_s
from robot_agent.guidance.driving import FOLLOWS_S
from robot_agent.safety.guidance_states import AWAY, STATES, STEADY_S, GuidanceFacts, StayLimits, next_state
from robot_agent.safety.modes import POWERED
from robot_agent.safety.path_deviation import ARRIVED, PathDeviationMonitor
from robot_agent.safety.thrust_response import ThrustResponse
from robot_agent.vehicle.estimate import Observation
from shoal.config.experiment import Experiment
from shoal.frames import Array
from shoal.messages.messages import Control, Guidance, Mode

NS = 1_000_000_000
LOOK_S = 1.0  # between a prediction and its test: thrust has acted, and little has been learned since
MODEL_SHARE = 0.35  # of the way by full thrust in LOOK_S: mass wrong by +100 % is 0.25 at most, gusts and reversals 0.15
DEVIATIONS = 4.0  # of the estimate's own uncertainty
SAME = 0.25  # of the margin: by how much what is flown may change meanwhile
LASTS_S = 0.5
GROWS_S = 1.0  # an error beyond its bound on the way to the path
STRONGER_S = 1.0
STRONGER = 0.95  # of full thrust: what a current takes. At 0.8 of the robot's speed it takes 0.64
NEAR_FULL = 0.8  # of full thrust: what is given meanwhile
GROWING = 0.05  # of the robot's speed: growth of the error, and what a robot that brakes loses meanwhile
SLOWEST = 0.05  # of the robot's speed: with less to spare no path can be joined (tests/flights/cells.py: 0.95 at most)
LEANING = 0.5  # of the evidence that stops a robot: enough to name a likely cause


class WatchFinding(NamedTuple):
    """Reason to stop, a key of `modes.REACTIONS`, and what there is to say besides. Both empty: there is none."""

    reason: str = ""
    detail: str = ""


NO_FINDING = WatchFinding()


class _Foreseen(NamedTuple):
    """Place of the robot at an instant, and its reference, as the plan foresaw them."""

    due_ns: int
    place: complex
    reference: complex


class _Moment(NamedTuple):
    """Moment at which the test for a stronger current looks."""

    at_ns: int
    force: float  # that the model does not explain, of full thrust
    thrust: float  # of full thrust
    off_m: float
    velocity_mps: complex  # over ground, in the pool


class _Step(NamedTuple):
    """A control step with a goal, of a robot that knows its place."""

    output: ControlOutput
    observation: Observation
    control: Control
    off_m: float  # from the goal
    elapsed_s: float  # since the step before
    now_ns: int


class PathWatch:
    """Watch over one robot. Without `plan_period_s`, the period of its plans, it foresees nothing: only leaving the path and
    the guidance state are told."""

    def __init__(self, experiment: Experiment, plan_period_s: float = 0.0) -> None:
        vehicle, self._limit_m = experiment.vehicle, experiment.safety.off_path_m
        self._look_rows = LOOK_S / plan_period_s if plan_period_s else 0.0  # of a plan, in LOOK_S; 0: foresees nothing
        self._thrust_mps2 = vehicle.limits.wrench[0] / vehicle.mass.surge_kg
        self._thrust_n, self._fastest_mps = vehicle.limits.wrench[0], vehicle.limits.speed_mps
        self._plan_period_s = plan_period_s
        self._deviation = PathDeviationMonitor(self._limit_m)
        self._turn_round_s = 0.5 * horizon_s(vehicle)  # so long after the last thing in the way it still gives way
        self.response = ThrustResponse(vehicle)
        # The response is known of hulls that slide aside when they turn, and have thrust along one axis only
        self._knows_response = experiment.controller.estimator.sway and not vehicle.limits.has_sway
        self.state = Guidance.NONE
        self.reset()

    def reset(self) -> None:
        """Start anew, in another mode."""
        self._deviation.reset()
        self.finding = NO_FINDING  # stays until the next reset
        self._foreseen: deque[_Foreseen] = deque()
        self._moments: deque[_Moment] = deque()
        self._way: deque[tuple[int, float]] = deque()  # instants and distances from the reference
        self._surprised_s = 0.0  # for which the robot has not been where its plans said
        self._growing_s = 0.0  # for which it has been farther off than its way back explains
        self._stayed_s, self._lasted_s = 0.0, 0.0  # in states off the path, and in the present state
        self._join_s, self._entry_m = 0.0, 0.0  # time allowed for the way back, and its length at first
        self._clear_s = 0.0  # for which nothing has been in the way
        self._avoids = False  # something is in the way at this step
        self._at_ns: int | None = None
        self.force = 0.0  # that the model does not explain in the last second, as a share of full thrust,
        self._now = 0.0  # and the most that it may be now

    @property
    def has_left(self) -> bool:
        """True if the robot has left its path."""
        return self._deviation.left

    def step(self, output: ControlOutput, mode: Mode, now_ns: int) -> None:
        """Take in a control step's result, in the mode from now on."""
        elapsed_s = 0.0 if self._at_ns is None else (now_ns - self._at_ns) / NS
        self._at_ns = now_ns
        observation, control = output.observation, output.control
        place = path = led = 0j
        if observation is not None:
            place = path = complex(observation.eta[0], observation.eta[1])
            led = place + cmath.rect(FOLLOWS_S, observation.eta.item(3)) * complex(observation.nu[0], observation.nu[1])
        if control is not None:
            path = complex(control.eta_reference[0], control.eta_reference[1])
        if mode is not Mode.DRIVEN:
            self._deviation.step(place, path, output.is_free, output.path_is_blocked, now_ns)
        elif not self._look_rows:  # the reference leads: what counts is where the robot would be by then
            self._deviation.step(led, path, output.is_free, output.path_is_blocked, now_ns)
        off_m = abs(place - path)
        self._change_state(output, mode, off_m, elapsed_s)
        if observation is not None and observation.leap:
            self.response.reset()
            self._foreseen.clear()
        if self._look_rows and mode in POWERED and not self.finding.reason and observation is not None and control is not None:
            step = _Step(output, observation, control, off_m, elapsed_s, now_ns)
            self.finding = self._find(step)

    def _change_state(self, output: ControlOutput, mode: Mode, off_m: float, elapsed_s: float) -> None:
        """Enter the next guidance state, and begin the times anew that belong to it."""
        before, is_away = self.state, off_m > ARRIVED * self._limit_m
        self._avoids = output.path_is_blocked or (output.avoids and is_away)
        in_way = self._avoids or (output.avoids and before is Guidance.GIVING_WAY)
        self._clear_s = 0.0 if in_way else self._clear_s + elapsed_s
        self._stayed_s += elapsed_s
        self._lasted_s += elapsed_s
        gives_way = self._avoids or (before is Guidance.GIVING_WAY and self._clear_s < self._turn_round_s)
        facts = GuidanceFacts(mode, gives_way, self._deviation.is_on_path, self._lasted_s >= STEADY_S)
        self.state = next_state(before, facts)
        if self.state is not before:
            self._lasted_s = 0.0
        begins = self.state is not before and not {self.state, before} <= AWAY
        if begins:
            self._stayed_s = self._join_s = 0.0
        if begins or self._avoids:
            self._entry_m, self._growing_s = off_m, 0.0

    def _find(self, step: _Step) -> WatchFinding:
        """The first bound that is passed."""
        strong = self._stronger_force(step)
        held, turned_rad = self.response.held_fast, self.response.marker_turned_rad
        if strong and self.response.turn_evidence > 1.0:  # the same force, but it goes with the thrust
            turned_rad = -cmath.phase(self.response.response.gain)
        if held and self._knows_response:
            return WatchFinding("held fast", held)
        if turned_rad and self._knows_response:
            about = f"by about {abs(math.degrees(turned_rad)):.0f} degrees: its thrust acts in another direction"
            return WatchFinding("marker turned", about)
        if strong:
            return WatchFinding("current too strong", strong)
        if self._is_surprised(step):
            return WatchFinding("does not follow its plan", self.likely_cause)
        return self._overdue(step)

    def _stronger_force(self, step: _Step) -> str:
        """Evidence that a force is stronger than the robot; empty if none is."""
        estimate, off_m, now_ns = step.observation.estimate, step.off_m, step.now_ns
        # This moment's force and thrust, as shares of full thrust, and the mean of those of the last seconds
        thrust_ratio = 1.0 if estimate.thrust_ratio is None else estimate.thrust_ratio
        surge_mps2, sway_mps2, *_ = estimate.disturbance
        force = math.hypot(surge_mps2, sway_mps2) / (self._thrust_mps2 * thrust_ratio)
        thrust = abs(step.control.wrench_delivered[0]) / self._thrust_n
        velocity_mps = cmath.rect(1.0, estimate.eta.item(3)) * complex(estimate.nu[0], estimate.nu[1])
        self._moments.append(_Moment(now_ns, force, thrust, off_m, velocity_mps))
        while len(self._moments) > 2 and self._moments[1].at_ns <= now_ns - STRONGER_S * NS:
            self._moments.popleft()
        self.force = sum(m.force for m in self._moments) / len(self._moments)
        mean_thrust = sum(m.thrust for m in self._moments) / len(self._moments)
        self._now = max(self.force, force, (abs(step.observation.current) / self._fastest_mps) ** 2)
        # Whether the robot goes away from its reference all the same, and no more slowly than at first
        first = self._moments[0]
        lasted_s = (now_ns - first.at_ns) / NS
        growing_mps = GROWING * self._fastest_mps
        away = complex(*(step.observation.eta[:2] - step.control.eta_reference[:2]).tolist())
        brakes = ((velocity_mps - first.velocity_mps) * away.conjugate()).real < -growing_mps * off_m
        is_carried_off = off_m - first.off_m > growing_mps * lasted_s and not brakes
        is_weak = self.force < STRONGER or mean_thrust < NEAR_FULL
        if lasted_s < STRONGER_S or is_weak or not is_carried_off:
            return ""
        force_percent, thrust_percent = 100.0 * self.force, 100.0 * mean_thrust
        return f"it takes {force_percent:.0f} % of full thrust and carries the robot off; {thrust_percent:.0f} % is given"

    def _is_surprised(self, step: _Step) -> bool:
        """True if the robot is not where its plan said, for LASTS_S, though what it was to fly has stayed the same."""
        output, now_ns = step.output, step.now_ns
        place, due_ns = complex(*step.observation.eta[:2].tolist()), now_ns + round(LOOK_S * NS)
        self._foreseen.append(_Foreseen(due_ns, self._ahead(output.plan_eta), self._ahead(output.plan_reference)))
        due = None
        while self._foreseen[0].due_ns <= now_ns:
            due = self._foreseen.popleft()
        if due is None:
            return False
        deviations = step.observation.deviations
        unsure_m = DEVIATIONS * (deviations.place_m + deviations.ground_mps * LOOK_S) if deviations is not None else 0.0
        margin_m = MODEL_SHARE * 0.5 * self._thrust_mps2 * LOOK_S**2 + unsure_m
        command = complex(step.control.eta_command[0], step.control.eta_command[1])
        is_same = abs(command - due.reference) < SAME * margin_m  # no other order, path or way around others meanwhile
        self._surprised_s = self._surprised_s + step.elapsed_s if is_same and abs(place - due.place) > margin_m else 0.0
        return self._surprised_s >= LASTS_S

    def _ahead(self, poses: Array) -> complex:
        """Place LOOK_S ahead in a plan (rows, 4)."""
        after = min(int(self._look_rows), len(poses) - 2)
        share = self._look_rows - after
        x, y = ((1.0 - share) * poses[after, :2] + share * poses[after + 1, :2]).tolist()
        return complex(x, y)

    def _overdue(self, step: _Step) -> WatchFinding:
        """A stay that is too long, or an error that grows on the way to the path."""
        output, off_m, current_mps = step.output, step.off_m, abs(step.observation.current)
        path_mps = math.hypot(*(output.plan_reference[1, :2] - output.plan_reference[0, :2]).tolist()) / self._plan_period_s
        horizon_s = self._plan_period_s * (len(output.plan_eta) - 1)
        spare_mps = max(self._fastest_mps - path_mps - current_mps, SLOWEST * self._fastest_mps)
        self._join_s = max(self._join_s, 2.0 * self._entry_m / spare_mps + 2.0 * horizon_s)
        is_away = off_m > ARRIVED * self._limit_m
        nears = self._nears(step, horizon_s)
        if self._stayed_s > STATES[self.state].longest_s(StayLimits(self._join_s)) and is_away:
            if self.state in AWAY:
                return WatchFinding("gives way for too long", f"{self._stayed_s:.0f} s")
            if self.state is Guidance.JOINING and not nears:
                return WatchFinding("not in time on its path", f"not on it after {self._stayed_s:.0f} s{self._because}")
        if self.state in (Guidance.JOINING, Guidance.GIVING_WAY, Guidance.RETURNING) and not self._avoids:
            most_m = self._entry_m + self._limit_m + horizon_s * (path_mps + current_mps)
            self._growing_s = self._growing_s + step.elapsed_s if off_m > most_m else 0.0
            if self._growing_s >= GROWS_S:
                grown = f"off it by {off_m:.2f} m, {self._entry_m:.2f} m when it set out"
                return WatchFinding("not in time on its path", grown + self._because)
        return NO_FINDING

    def _nears(self, step: _Step, span_s: float) -> bool:
        """True if in the last `span_s` the robot has come nearer as quickly as one that can just join its path."""
        self._way.append((step.now_ns, step.off_m))
        while len(self._way) > 2 and self._way[1][0] <= step.now_ns - span_s * NS:
            self._way.popleft()
        begin_ns, far_m = self._way[0]
        return far_m - step.off_m > SLOWEST * self._fastest_mps * (step.now_ns - begin_ns) / NS

    @property
    def _because(self) -> str:
        return f": {self.likely_cause}" if self.likely_cause else ""

    @property
    def likely_cause(self) -> str:
        """The cause to which the evidence so far points; empty if to none."""
        if not self._look_rows:
            return ""
        response = self.response
        if self._knows_response and (response.stands_still or response.place.pushed > response.place.room):
            return "it does not move: it may be held fast, or its thrusters do not push"
        if self._knows_response and response.turn_evidence > LEANING:
            turned = abs(math.degrees(cmath.phase(response.response.gain)))
            return f"thrust acts in another direction: its marker may be turned by about {turned:.0f} degrees"
        if self._now > LEANING:
            return "the current, or another force, takes more than half of its thrust"
        return ""
