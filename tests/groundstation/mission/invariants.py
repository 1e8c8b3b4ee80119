"""Invariants of the station and its robots, whatever people ask for, looked at in every cycle of a simulated fleet.

Each violation is an AssertionError that begins with the name of the invariant. What a robot did is read from the robot itself,
never from the station's view of it.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from groundstation.mission.gain_update import GainStage
from groundstation.mission.objections import MOVING
from groundstation.mission.request_progress import KEPT
from groundstation.mission.state_machine import (
    COMMITTED,
    IN_FLIGHT,
    JOINING,
    NOMINAL,
    TERMINAL,
    MissionState,
    rejection_reason,
)
from groundstation.planning.segment import PlanSegment
from groundstation.telemetry import preflight
from tests.groundstation.mission.simulated_fleet import STEP_NS, SimulatedFleet, SimulatedRobot, armed
from wire.messages.messages import Mode, Order, Outcome, Progress

LED_WITHIN_S = 3.0  # a moving robot in reach without anybody who leads it
NAMED_WITHIN_S = 3.0  # an armed robot that nobody leads, to the people at the page
STOPPED_WITHIN_S = 3.0  # of a STOP, or of a robot's return into reach of a stopped station
RECENT = 40  # cycles: an outcome may be that much older than the truth, by the radio's delay and one patience of an order
OVER_WITHIN_S = 20.0  # of a request that waits for robots in reach; longer than a stage's patience of 10 s and an abort's
TRAVEL_WITHIN_S = 400.0  # of a request that is done when robots have arrived somewhere
PAUSE_WITHIN_S = 15.0  # in which RESUME becomes possible, when every robot is fit
JUMP_S = 2.0  # of progress from one cycle to the next: a robot that drops out may have been the slowest
NEAR_M = 0.15  # of the place that a robot was sent to
AT_REST = TERMINAL | {MissionState.WAITING, MissionState.STOPPED}
TRAVELS = frozenset({Order.GO, Order.RETURN, Order.REJOIN, Order.START})
WAITS_FOR_FLIGHT = frozenset({Order.TUNE})


@dataclass
class _Followed:
    """A request under way: since when in cycles, and for how long it has waited for robots in reach alone."""

    place_m: tuple[float, float] | None
    only: int
    waited_s: float = 0.0


@dataclass
class Invariants:
    """The checks, and what they remember."""

    pool: SimulatedFleet
    reach_since_ns: dict[int, int] = field(default_factory=dict)
    unled_s: dict[int, float] = field(default_factory=dict)
    unnamed_s: dict[int, float] = field(default_factory=dict)
    unstopped_s: dict[int, float] = field(default_factory=dict)
    modes: dict[int, deque[Mode | None]] = field(default_factory=dict)
    followed: dict[int, _Followed] = field(default_factory=dict)
    over: dict[int, Progress] = field(default_factory=dict)
    progress_s: float = 0.0
    flown_s: float = 0.0  # the farthest that any robot has truly come along the roster's trajectory
    lap_s: float = 0.0
    paused_s: float = 0.0
    waiting_gains_s: float = 0.0
    violated: bool = False

    def __post_init__(self) -> None:
        self.modes = {r: deque(maxlen=RECENT) for r in self.pool.robots}
        self.pool.on_cycle = self.check

    def begin(self, number: int, only: int = 0, place_m: tuple[float, float] | None = None) -> None:
        """Follow a request that was taken."""
        self.followed.setdefault(number, _Followed(place_m, only))

    def begin_run(self) -> None:
        """Count progress and laps anew: a request began a run."""
        self.progress_s = self.flown_s = self.lap_s = 0.0

    def check(self) -> None:
        """All invariants, once a cycle."""
        self.violated = True  # until all have been looked at
        for robot in self.pool.robots.values():
            self.modes[robot.id].append(robot.mode if robot.alive else None)
            if not self.pool.reach(robot.id):
                self.reach_since_ns[robot.id] = self.pool.now_ns
            else:
                self.reach_since_ns.setdefault(robot.id, self.pool.now_ns)
        self.every_moving_robot_is_led()
        self.every_armed_robot_is_somebodys()
        self.a_stop_reaches_every_robot()
        self.progress_is_the_formations()
        self.laps_are_the_formations()
        self.outcomes_are_true()
        self.requests_end()
        self.every_state_has_a_way_out()
        self.violated = False

    def in_reach_s(self, robot: int) -> float:
        """Time for which station and robot have heard one another."""
        return (self.pool.now_ns - self.reach_since_ns.get(robot, self.pool.now_ns)) * 1e-9

    # --- the invariants

    def every_moving_robot_is_led(self) -> None:
        """No robot in reach moves for long without a mission or a person that leads it."""
        mission, single = self.pool.mission, self.pool.single
        for robot in self.pool.robots.values():
            flown = mission.state in COMMITTED | JOINING and robot.id in mission.roster.active
            moves = robot.alive and robot.mode in MOVING and self.pool.reach(robot.id)
            led = flown or robot.id in single.led
            self.unled_s[robot.id] = self.unled_s.get(robot.id, 0.0) + STEP_NS * 1e-9 if moves and not led else 0.0
            assert self.unled_s[robot.id] <= LED_WITHIN_S, (
                f"LED: robot {robot.id} is {robot.mode.name} for {LED_WITHIN_S:g} s, the mission {mission.state.name}"
                f" ({mission.reason}), led by nobody"
            )

    def every_armed_robot_is_somebodys(self) -> None:
        """An armed robot in reach is the mission's or a person's, or a request is possible that disarms it."""
        mission, single = self.pool.mission, self.pool.single
        for robot in self.pool.robots.values():
            flown = mission.state not in AT_REST and robot.id in mission.roster.active
            unled = armed(robot) and self.pool.reach(robot.id) and not flown and robot.id not in single.led
            refused = rejection_reason(Order.DISARM, mission.state) or mission.objection(Order.DISARM, self.pool.fleet)
            missed = unled and (refused or mission.state is MissionState.STOPPED)
            self.unnamed_s[robot.id] = self.unnamed_s.get(robot.id, 0.0) + STEP_NS * 1e-9 if missed else 0.0
            assert self.unnamed_s[robot.id] <= NAMED_WITHIN_S, (
                f"LED: robot {robot.id} is {robot.mode.name}, the mission {mission.state.name}, and DISARM: {refused}"
            )

    def a_stop_reaches_every_robot(self) -> None:
        """While the station is stopped, every robot that can hear is stopped."""
        for robot in self.pool.robots.values():
            hears = robot.alive and self.pool.now_ns >= robot.radio.deaf_until_ns
            missed = self.pool.mission.state is MissionState.STOPPED and hears and robot.mode is not Mode.STOPPED
            self.unstopped_s[robot.id] = self.unstopped_s.get(robot.id, 0.0) + STEP_NS * 1e-9 if missed else 0.0
            assert self.unstopped_s[robot.id] <= STOPPED_WITHIN_S, f"STOP: robot {robot.id} is {robot.mode.name}"

    def progress_is_the_formations(self) -> None:
        """Progress does not leap, and is nowhere that no robot has come on the roster's trajectory."""
        mission, plans = self.pool.mission, self.pool.mission.plans
        for robot in self.pool.robots.values():
            if robot.alive and robot.mode is Mode.TRACKING and self.flies(robot, mission.segment):
                self.flown_s = max(self.flown_s, robot.clock.reached_s)
        if plans.progress_s == 0.0:
            self.progress_s = self.flown_s = 0.0
        if mission.state in IN_FLIGHT | {MissionState.PAUSED}:
            leap_s = plans.progress_s - self.progress_s
            assert abs(leap_s) <= JUMP_S, f"PROGRESS: leaps by {leap_s:.2f} s in {mission.state.name}"
            assert plans.progress_s <= self.flown_s + 0.1, (
                f"PROGRESS: {plans.progress_s:.2f} s, and no robot has come farther than {self.flown_s:.2f} s"
            )
        self.progress_s = plans.progress_s

    def flies(self, robot: SimulatedRobot, segment: PlanSegment) -> bool:
        """True if a robot has loaded its trajectory of the mission's plan."""
        mission = self.pool.mission
        planned = [mission.roster.trajectory(s, robot.id) for s in (segment, mission.plans.next)]
        return robot.clock.id in [trajectory.id for trajectory in planned if trajectory is not None]

    def laps_are_the_formations(self) -> None:
        """The table of laps loses no time within a run: who flies alone neither clears it nor adds to it."""
        rows = self.pool.core.laps.laps()
        lap_s = sum(row.time_s for row in rows)
        if self.pool.mission.state in COMMITTED and self.flown_s > 1.0 and len(rows) < 10:
            assert lap_s >= self.lap_s - 1.0, f"LAPS: the table loses {self.lap_s - lap_s:.2f} s of {self.lap_s:.2f} s flown"
        self.lap_s = lap_s

    def outcomes_are_true(self) -> None:
        """A request that is done was done by the robots, and what was left in motion is not called held."""
        known = self.pool.core.requests.recent
        kept = {outcome.request for outcome in known}
        flood = max(kept, default=0) - max(self.over, default=0) >= KEPT  # so many in one cycle push others out
        for number, progress in self.over.items():
            forgotten = number not in kept and progress is Progress.UNDER_WAY and not flood
            assert not forgotten, f"ENDS: request {number} is forgotten under way"
        if flood:
            self.over = {number: progress for number, progress in self.over.items() if number in kept}
        for outcome in known:
            self.followed.setdefault(outcome.request, _Followed(None, 0))
            before = self.over.get(outcome.request, Progress.UNDER_WAY)
            self.over[outcome.request] = outcome.progress
            if before is Progress.UNDER_WAY and outcome.progress is Progress.DONE:
                untrue = self._untrue(outcome)
                assert not untrue, f"OUTCOME: request {outcome.request}, {outcome.order.name}, is DONE, but {untrue}"
            if before is Progress.UNDER_WAY and outcome.progress is Progress.FAILED:
                assert outcome.reason, f"OUTCOME: request {outcome.request}, {outcome.order.name}, failed without a reason"
                wrongly = outcome.order is Order.STOP and self._stopped_for_long()
                assert not wrongly, f"OUTCOME: STOP failed ({outcome.reason}), but all have stopped"

    def _stopped_for_long(self) -> bool:
        """True if every robot has been stopped and heard for as long as is remembered."""
        robots = self.pool.robots.values()
        return all(self._always(r, Mode.STOPPED) and self.in_reach_s(r.id) > RECENT * STEP_NS * 1e-9 for r in robots)

    def _untrue(self, outcome: Outcome) -> str:
        followed = self.followed.get(outcome.request)
        if followed is None:
            return ""
        robots = [self.pool.robots[followed.only]] if followed.only else list(self.pool.robots.values())
        heard = [r for r in robots if self.in_reach_s(r.id) > 1.0]
        order, active = outcome.order, self.pool.mission.roster.active
        if order is Order.HOLD:
            return self._never(Mode.HOLDING, [r for r in heard if armed(r)])
        if order is Order.STOP:
            return self._never(Mode.STOPPED, heard)
        if order is Order.DISARM or order is Order.END:
            return "; ".join(f"robot {r.id} is {r.mode.name}" for r in heard if armed(r) and not self._was_rest(r))
        if order is Order.CLEAR_STOP:
            return "; ".join(f"robot {r.id} is STOPPED" for r in heard if self._always(r, Mode.STOPPED))
        if order is Order.GO and followed.place_m is not None and followed.only:
            away_m = float(np.hypot(*(robots[0].eta[:2] - followed.place_m)))
            return "" if away_m <= NEAR_M else f"robot {robots[0].id} is {away_m:.2f} m from where it was sent"
        if order in (Order.START, Order.RESUME):
            return self._never(Mode.TRACKING, [r for r in heard if r.id in active])
        if order is Order.RETURN:
            starts = self.pool.starts
            away = [r for r in heard if np.hypot(*(r.eta[:2] - starts[r.id][:2])) > NEAR_M]
            return "; ".join(f"robot {r.id} is not at its start" for r in away)
        if order is Order.TUNE:
            ids = {r.tuning_id for r in heard if r.id in active}
            return f"gains differ: {sorted(ids)}" if len(ids) > 1 else ""
        return ""

    def _never(self, mode: Mode, robots: Sequence[SimulatedRobot]) -> str:
        return "; ".join(f"robot {r.id} is {r.mode.name}" for r in robots if mode not in self.modes[r.id])

    def _always(self, robot: SimulatedRobot, mode: Mode) -> bool:
        return all(m is mode for m in self.modes[robot.id])

    def _was_rest(self, robot: SimulatedRobot) -> bool:
        return any(m in (Mode.DISARMED, Mode.STOPPED, Mode.FAULT) for m in self.modes[robot.id])

    def requests_end(self) -> None:
        """No request is under way for long, but for robots that nobody can reach."""
        for outcome in self.pool.core.requests.recent:
            followed = self.followed.get(outcome.request)
            if followed is None or outcome.progress is not Progress.UNDER_WAY:
                continue
            lost = any(self.in_reach_s(robot) < OVER_WITHIN_S for robot in outcome.waiting)
            if outcome.order is Order.TUNE:
                # a change for the next lap waits while the formation holds; a robot that nobody hears must end it
                flies = self.pool.mission.state in IN_FLIGHT | AT_REST
                followed.waited_s += STEP_NS * 1e-9 if flies else 0.0
                limit_s = (self.pool.core.tuner.lap_s or 0.0) + OVER_WITHIN_S
            else:
                followed.waited_s = 0.0 if lost else followed.waited_s + STEP_NS * 1e-9
                limit_s = TRAVEL_WITHIN_S if outcome.order in TRAVELS else OVER_WITHIN_S
            assert followed.waited_s <= limit_s, (
                f"ENDS: request {outcome.request}, {outcome.order.name}, is under way for {limit_s:g} s and waits for "
                f"{outcome.waiting} {outcome.why}; the mission {self.pool.mission.state.name}"
            )

    def every_state_has_a_way_out(self) -> None:
        """A remedy that the station names is possible; a robot that is fit can come back; all can start again."""
        mission, fleet = self.pool.mission, self.pool.fleet
        if mission.state in AT_REST:
            texts = [mission.reason, *preflight(self.pool.experiment, fleet)]
            for text in texts:
                refused = rejection_reason(Order.CLEAR_STOP, mission.state)
                assert "clear the stop" not in text or not refused, f"WAY OUT: {text!r}, but {refused}"
        if mission.state in TERMINAL:
            refused = rejection_reason(Order.START, mission.state)
            assert not refused, f"WAY OUT: all rest, but {refused}"
        if mission.state in (MissionState.FAILED, MissionState.CANCELLED):
            assert mission.reason, f"REASON: {mission.state.name} without one"
        fit = [r for r in mission.roster.lost if self.in_reach_s(r) > 1.0 and self._fit(r)]
        if fit and mission.state in NOMINAL | {MissionState.PAUSED} and not mission.segment.is_return:
            refused = mission.objection(Order.REJOIN, fleet)
            assert not refused, f"WAY OUT: robot {fit[0]} is fit, but REJOIN: {refused}"
        well = all(self.in_reach_s(r) > 1.0 and self._fit(r) for r in mission.roster.active)
        idle = mission.state is MissionState.PAUSED and well and not self.pool.single.led
        self.paused_s = self.paused_s + STEP_NS * 1e-9 if idle else 0.0
        if self.paused_s > PAUSE_WITHIN_S:
            refused = mission.objection(Order.RESUME, fleet)
            assert not refused, f"WAY OUT: PAUSED, but RESUME: {refused}"
        waits = self.pool.core.tuner.status().stage is not GainStage.IDLE and mission.state in IN_FLIGHT | AT_REST
        self.waiting_gains_s = self.waiting_gains_s + STEP_NS * 1e-9 if waits else 0.0
        limit_s = (self.pool.core.tuner.lap_s or 0.0) + OVER_WITHIN_S
        assert self.waiting_gains_s <= limit_s, f"WAY OUT: gains are {self.pool.core.tuner.status().stage.value} for ever"

    def _fit(self, robot: int) -> bool:
        seen = self.pool.fleet[robot]
        return not preflight(self.pool.experiment, {robot: seen}, exclude=("thrusters",)) and seen.mode is not Mode.DRIVEN
