"""Invariants of the station and its robots, whatever people ask for, looked at in every cycle of a simulated fleet.

Each violation is an AssertionError that begins with the name of the invariant. What a robot did is read from the robot itself,
and what people asked for from the people, never from the station's view of either.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations, pairwise

import numpy as np

from groundstation.mission.command_dispatcher import MOVING
from groundstation.mission.gain_update import GainStage
from groundstation.mission.mission import JOIN_WITHIN_S
from groundstation.mission.request_progress import KEPT
from groundstation.mission.single_robot import CONFIRMS, DISARMING
from groundstation.mission.state_machine import (
    COMMITTED,
    IN_FLIGHT,
    JOINING,
    NOMINAL,
    PLANNING,
    TERMINAL,
    WATER,
    MissionState,
    rejection_reason,
)
from groundstation.planning.segment import PlanSegment, sample
from groundstation.telemetry import preflight
from shoal.frames import Array
from shoal.messages.messages import ALONE, CommandKind, Mode, Outcome, Progress
from tests.groundstation.mission.simulated_fleet import STEP_NS, SimulatedFleet, SimulatedRobot, armed

LED_WITHIN_S = 3.0  # a moving robot in reach without anybody who leads it
NAMED_WITHIN_S = 3.0  # an armed robot that nobody leads, to the people at the page
UNPOWERED_WITHIN_S = 3.0  # a robot in reach that a person took out of the water
STOPPED_WITHIN_S = 3.0  # of a STOP, or of a robot's return into reach of a stopped station
RECENT = 40  # cycles: an outcome may be that much older than the truth, by the radio's delay and one patience of an order
OVER_WITHIN_S = 20.0  # of a request that waits for robots in reach; longer than a stage's patience of 10 s and an abort's
TRAVEL_WITHIN_S = 400.0  # of a request that is done when robots have arrived somewhere
PAUSE_WITHIN_S = 15.0  # in which RESUME becomes possible, when every robot is fit
JUMP_S = 2.0  # of progress from one cycle to the next
NEAR_M = 0.15  # of its start
AT_REST = TERMINAL | {MissionState.WAITING, MissionState.STOPPED}
ARMS = frozenset(
    {CommandKind.ARM, CommandKind.START, CommandKind.TEST, CommandKind.RETURN, CommandKind.REJOIN}
)  # requests for which robots are armed
RESTS = frozenset(
    {CommandKind.STOP, CommandKind.CLEAR_STOP, CommandKind.DISARM}
)  # after these none is armed, until another request
ON_ITS_WAY_S = 1.5  # a command to a robot that has been restarted since it was sent
BEHIND_S = 1.0  # of the progress, after the slowest robot
SIGHT_S = 1.0  # after which a robot that was blind, or had foreign poses, counts as well: late radio
FORM_M = 0.02  # of a place in the formation
LATE_S = 0.5  # beside the time after which a robot without its station holds by itself: late radio, and a cycle of each
TRAVELS = frozenset({CommandKind.GO, CommandKind.RETURN, CommandKind.REJOIN, CommandKind.START})


def offsets_asked_for(form: str, slots_m: Sequence[Array]) -> Array:
    """Places (n, 2) of one slot from another in a form that is asked for, in m; either may be the one. `slots_m`: before."""
    words = form.split()
    values = dict(pairwise(words))  # of each word the one behind it
    offsets_m = np.array([b - a for a, b in combinations(slots_m, 2)])
    if words[0] in ("line", "column"):
        spacing_m = float(values[words[0]]) * np.arange(1.0, len(slots_m))
        offsets_m = np.outer(spacing_m, [1.0, 0.0] if words[0] == "line" else [0.0, 1.0])
    angle_rad = np.radians(float(values.get("turn", 0.0)))
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    turned: Array = float(values.get("scale", 1.0)) * offsets_m @ np.array([[cos, sin], [-sin, cos]])
    return turned


@dataclass
class _Followed:
    """A request under way: since when in cycles, and for how long it has waited for robots in reach alone."""

    order: CommandKind
    place_m: tuple[float, float] | None
    only: int
    since_ns: int
    flown: dict[int, str]  # by robot: the trajectory that it had
    text: str = ""  # of a PATH the name of its experiment, of a FORMATION the form
    offsets_m: Array = field(default_factory=lambda: np.zeros((0, 2)))  # of one slot from another, as asked for
    alone: bool = True  # nobody has asked for anything since
    was_driven: bool = False  # the robot has followed a DRIVE since
    waited_s: float = 0.0


@dataclass
class Invariants:
    """The checks, and what they remember."""

    pool: SimulatedFleet
    reach_since_ns: dict[int, int] = field(default_factory=dict)
    unled_s: dict[int, float] = field(default_factory=dict)
    unnamed_s: dict[int, float] = field(default_factory=dict)
    unstopped_s: dict[int, float] = field(default_factory=dict)
    unrested_s: dict[int, float] = field(default_factory=dict)
    powered_out_s: dict[int, float] = field(default_factory=dict)
    out: set[int] = field(default_factory=set)  # robots that people took out of the water
    driven_ns: dict[int, int] = field(default_factory=dict)  # by robot: the last velocity that a person gave
    arms_ns: dict[int, int] = field(default_factory=dict)  # by robot: the last request for which it may be armed
    rests: set[int] = field(default_factory=set)  # robots that a STOP or DISARM is the last request of
    unarmed_ns: dict[int, int] = field(default_factory=dict)  # by robot: when it was last seen without power
    modes: dict[int, deque[Mode | None]] = field(default_factory=dict)
    ids: dict[int, deque[str]] = field(default_factory=dict)  # of the trajectories that robots had
    state: MissionState = MissionState.WAITING
    has_ended: bool = False  # a run has, however: none begins by itself after that
    followed: dict[int, _Followed] = field(default_factory=dict)
    over: dict[int, Progress] = field(default_factory=dict)
    progress_s: float = 0.0
    counted: dict[int, tuple[int, float]] = field(default_factory=dict)  # by robot that counts: when, and its clock
    joined: bool = False  # robots began to fly, and progress has not moved since
    apart_s: float = 0.0
    flown_s: float = 0.0  # the farthest that any robot has truly come along the roster's trajectory
    lap_s: float = 0.0
    flight: int = 0  # number of the path and run that the laps are of
    paused_s: float = 0.0
    waiting_gains_s: float = 0.0
    homeward: bool = False  # people have asked for a return from rest, and for no other path since
    has_flown: bool = False  # a flight that is not the way home, since the last start
    flight_ended: MissionState | None = None  # how that flight did
    violated: bool = False

    def __post_init__(self) -> None:
        self.modes = {r: deque(maxlen=RECENT) for r in self.pool.robots}
        self.ids = {r: deque(maxlen=RECENT) for r in self.pool.robots}
        self.pool.on_cycle = self.check

    def begin(
        self, number: int, order: CommandKind, only: int = 0, place_m: tuple[float, float] | None = None, text: str = ""
    ) -> None:
        """Follow a request that was taken."""
        for other in self.followed.values():
            other.alone = other.alone and bool(only and other.only and only != other.only)
        flown = {robot.id: robot.clock.id for robot in self.pool.robots.values()}
        self.followed.setdefault(number, _Followed(order, place_m, only, self.pool.now_ns, flown, text))
        if order is CommandKind.FORMATION:
            ends = [trajectory.eta[-1, :2] for trajectory in self.pool.mission.segment.trajectories.values()]
            self.followed[number].offsets_m = offsets_asked_for(text, ends)
        if order is CommandKind.RETURN and self.state in AT_REST:
            self.homeward = True
        elif order is CommandKind.PATH:
            self.homeward = False
        if order is CommandKind.PATH:
            self.has_flown = False
        ends_a_run = self.pool.mission.state is MissionState.ENDING
        if order in WATER:
            self.out = self.out | {only} if order is CommandKind.OUT else self.out - {only}
            return
        if order is CommandKind.TUNE or (order is CommandKind.END and not ends_a_run):
            return
        concerned = {only} if only else set(self.pool.robots)
        self.rests = self.rests | concerned if order in RESTS or ends_a_run else self.rests - concerned
        self.joined = self.joined or order is CommandKind.RESUME  # a HOLD may follow within the cycle
        if order in ARMS:
            self.arms_ns |= dict.fromkeys(concerned, self.pool.now_ns)

    def begin_run(self) -> None:
        """Count progress and laps anew: a request began a run."""
        self.progress_s = self.flown_s = self.lap_s = 0.0

    def check(self) -> None:
        """All invariants, once a cycle."""
        self.violated = True  # until all have been looked at
        self._follow_people()
        for robot in self.pool.robots.values():
            self.modes[robot.id].append(robot.mode if robot.alive else None)
            self.ids[robot.id].append(robot.clock.id)
            if not self.pool.reach(robot.id):
                self.reach_since_ns[robot.id] = self.pool.now_ns
            else:
                self.reach_since_ns.setdefault(robot.id, self.pool.now_ns)
        self.every_moving_robot_is_led()
        self.every_leader_has_a_request()
        self.every_armed_robot_is_somebodys()
        self.robots_are_armed_by_request_alone()
        self.robots_rest_when_told()
        self.robots_out_of_the_water_have_no_power()
        self.a_stop_reaches_every_robot()
        self.progress_is_the_formations()
        self.laps_are_the_formations()
        self.the_way_home_is_flown_alone()
        self.the_verdict_is_of_the_flight()
        self.outcomes_are_true()
        self.requests_end()
        self.every_state_has_a_way_out()
        self.violated = False

    def _follow_people(self) -> None:
        """Take in what people ask for without a request: they drive, and an automatic mission starts once all are fit."""
        pool, now_ns = self.pool, self.pool.now_ns
        for robot in pool.driving:
            self.driven_ns[robot] = now_ns
            self.rests.discard(robot)
            for followed in self.followed.values():
                followed.alone = followed.alone and (followed.order is CommandKind.DRIVE or followed.only not in (0, robot))
        self.has_ended = self.has_ended or pool.mission.state in TERMINAL
        by_itself = pool.automatic and not self.has_ended
        if by_itself and self.state is MissionState.WAITING and pool.mission.state is MissionState.LOADING:
            self.arms_ns = dict.fromkeys(pool.robots, now_ns)
        self.state = pool.mission.state
        for outcome in pool.core.requests.recent:
            if outcome.request in self.followed:
                continue
            is_asked = outcome.order in (CommandKind.DRIVE, CommandKind.HOLD)  # HOLD: the station leaves
            assert is_asked, f"ENDS: nobody asked for {outcome.order.name}"
            only = [*outcome.waiting, *outcome.confirmed][0] if outcome.order is CommandKind.DRIVE else 0
            self.followed[outcome.request] = _Followed(outcome.order, None, only, now_ns, {})
        for followed in self.followed.values():
            followed.was_driven |= bool(followed.only) and pool.robots[followed.only].mode is Mode.DRIVEN

    def _asked_of(self, robot: int) -> set[CommandKind]:
        """Requests of one robot alone that are under way, for all that people know."""
        under_way = [o.request for o in self.pool.core.requests.recent if o.progress is Progress.UNDER_WAY]
        return {self.followed[number].order for number in under_way if self.followed[number].only == robot}

    def in_reach_s(self, robot: int) -> float:
        """Time for which station and robot have heard one another."""
        return (self.pool.now_ns - self.reach_since_ns.get(robot, self.pool.now_ns)) * 1e-9

    # --- the invariants

    def every_moving_robot_is_led(self) -> None:
        """No robot in reach moves for long without a mission or a person that leads it."""
        mission = self.pool.mission
        for robot in self.pool.robots.values():
            if robot.mode is Mode.DRIVEN:
                led = self.driven_ns.get(robot.id) == self.pool.now_ns
            elif robot.clock.id.startswith(ALONE):
                led = CommandKind.GO in self._asked_of(robot.id)
            else:
                flies = mission.state in (COMMITTED | JOINING) - PLANNING - {MissionState.PAUSED}
                led = flies and robot.id in mission.roster.active
            moves = robot.alive and robot.mode in MOVING and self.pool.reach(robot.id)
            self.unled_s[robot.id] = self.unled_s.get(robot.id, 0.0) + STEP_NS * 1e-9 if moves and not led else 0.0
            assert self.unled_s[robot.id] <= LED_WITHIN_S, (
                f"LED: robot {robot.id} is {robot.mode.name} for {LED_WITHIN_S:g} s, the mission {mission.state.name}"
                f" ({mission.reason}), led by nobody"
            )

    def every_leader_has_a_request(self) -> None:
        """A robot is a person's while a request for it alone is under way, and no longer."""
        leaders = {robot for robot in self.pool.robots if self._asked_of(robot)}
        assert self.pool.single.led == leaders, f"LED: people lead {set(self.pool.single.led)}, and asked for {leaders}"

    def every_armed_robot_is_somebodys(self) -> None:
        """An armed robot in reach is the mission's or a person's, or a request is possible that disarms it."""
        mission, single = self.pool.mission, self.pool.single
        for robot in self.pool.robots.values():
            flown = mission.state not in AT_REST and robot.id in mission.roster.active
            unled = armed(robot) and self.pool.reach(robot.id) and not flown and robot.id not in single.led
            refused = rejection_reason(CommandKind.DISARM, mission.state) or mission.objection(
                CommandKind.DISARM, self.pool.fleet
            )
            missed = unled and (refused or mission.state is MissionState.STOPPED)
            self.unnamed_s[robot.id] = self.unnamed_s.get(robot.id, 0.0) + STEP_NS * 1e-9 if missed else 0.0
            assert self.unnamed_s[robot.id] <= NAMED_WITHIN_S, (
                f"LED: robot {robot.id} is {robot.mode.name}, the mission {mission.state.name}, and DISARM: {refused}"
            )

    def robots_are_armed_by_request_alone(self) -> None:
        """A robot that lost its power is armed again only when somebody has asked for that since."""
        for robot in self.pool.robots.values():
            if not armed(robot):
                self.unarmed_ns.setdefault(robot.id, self.pool.now_ns)
                continue
            since_ns = self.unarmed_ns.pop(robot.id, None)
            asked_ns = self.arms_ns.get(robot.id, 0)
            late_s = (since_ns - asked_ns) * 1e-9 if since_ns is not None else 0.0
            assert late_s <= ON_ITS_WAY_S, (
                f"ARMS: robot {robot.id} is {robot.mode.name}; it was disarmed {late_s:.2f} s after anybody asked for that"
            )

    def robots_rest_when_told(self) -> None:
        """After STOP and DISARM no robot in reach is armed, until somebody asks for something else."""
        for robot in self.pool.robots.values():
            missed = robot.id in self.rests and armed(robot) and self.pool.reach(robot.id)
            self.unrested_s[robot.id] = self.unrested_s.get(robot.id, 0.0) + STEP_NS * 1e-9 if missed else 0.0
            assert self.unrested_s[robot.id] <= STOPPED_WITHIN_S, (
                f"RESTS: robot {robot.id} is {robot.mode.name}, the mission {self.pool.mission.state.name}"
            )

    def robots_out_of_the_water_have_no_power(self) -> None:
        """No robot in reach that a person took out of the water is armed, and none of them takes part."""
        assert not self.out & set(self.pool.mission.roster.active), f"OUT: {self.out} are out, and are counted on"
        for robot in self.pool.robots.values():
            missed = robot.id in self.out and armed(robot) and self.pool.reach(robot.id)
            self.powered_out_s[robot.id] = self.powered_out_s.get(robot.id, 0.0) + STEP_NS * 1e-9 if missed else 0.0
            assert self.powered_out_s[robot.id] <= UNPOWERED_WITHIN_S, (
                f"OUT: robot {robot.id} is {robot.mode.name}, the mission {self.pool.mission.state.name}"
            )

    def a_stop_reaches_every_robot(self) -> None:
        """While the station is stopped, every robot that can hear is stopped."""
        for robot in self.pool.robots.values():
            hears = robot.alive and self.pool.now_ns >= robot.radio.deaf_until_ns
            missed = self.pool.mission.state is MissionState.STOPPED and hears and robot.mode is not Mode.STOPPED
            self.unstopped_s[robot.id] = self.unstopped_s.get(robot.id, 0.0) + STEP_NS * 1e-9 if missed else 0.0
            assert self.unstopped_s[robot.id] <= STOPPED_WITHIN_S, f"STOP: robot {robot.id} is {robot.mode.name}"

    def progress_is_the_formations(self) -> None:
        """Progress does not leap, and is nowhere that no robot has come on the roster's trajectory. Where the slowest robot
        drops out it is that of the others, who may be far ahead: they flew on where it did not hear RESUME."""
        mission, plans = self.pool.mission, self.pool.mission.plans
        for robot in self.pool.robots.values():
            if robot.alive and robot.mode in (Mode.TRACKING, Mode.HOLDING) and self.flies(robot, mission.segment):
                self.flown_s = max(self.flown_s, robot.clock.reached_s)
        if plans.progress_s == 0.0 and mission.state not in JOINING | IN_FLIGHT | {MissionState.PAUSED}:  # a new plan
            self.progress_s = self.flown_s = 0.0
        slowest_is_out = self.slowest_is_out()
        rests = self.joined or mission.state in JOINING | {MissionState.PAUSED}
        if rests and plans.progress_s > self.flown_s and self.away_m(plans.progress_s) <= self.away_m(self.flown_s):
            self.flown_s = plans.progress_s  # robots go on from where they have come to rest
        if mission.state in IN_FLIGHT | {MissionState.PAUSED}:
            leap_s = plans.progress_s - self.progress_s
            most_s = max(JUMP_S, JOIN_WITHIN_S) if self.joined else JUMP_S  # a late one begins where the others are
            leaps = abs(leap_s) > most_s and not (leap_s > 0.0 and slowest_is_out)
            assert not leaps, f"PROGRESS: leaps by {leap_s:.2f} s in {mission.state.name}"
            assert plans.progress_s <= self.flown_s + 0.1, (
                f"PROGRESS: {plans.progress_s:.2f} s, and no robot has come farther than {self.flown_s:.2f} s"
            )
            self.joined = self.joined and leap_s == 0.0
        self.joined = self.joined or mission.state in JOINING
        self.progress_s = plans.progress_s
        active = [self.pool.robots[r] for r in mission.roster.active]
        whole = all(r.mode is Mode.TRACKING and self.flies(r, mission.segment) and self.in_reach_s(r.id) > 1.0 for r in active)
        if active and whole and mission.state in IN_FLIGHT:
            slowest_s = min(r.clock.reached_s for r in active)
            apart = abs(plans.progress_s - slowest_s) > BEHIND_S
            self.apart_s = self.apart_s + STEP_NS * 1e-9 if apart else 0.0
            assert self.apart_s <= BEHIND_S, f"PROGRESS: {plans.progress_s:.2f} s, and the slowest is at {slowest_s:.2f} s"
        else:
            self.apart_s = 0.0

    def slowest_is_out(self) -> bool:
        """True if the robot that had come no farther than the progress counted just now, and counts no more."""
        mission, now_ns = self.pool.mission, self.pool.now_ns
        for robot in self.pool.robots.values():
            if robot.id in mission.roster.active and self.flies(robot, mission.segment):
                self.counted[robot.id] = now_ns, robot.clock.reached_s
        return any(
            0 < now_ns - last_ns <= RECENT * STEP_NS and clock_s <= self.progress_s + 0.1
            for last_ns, clock_s in self.counted.values()
        )

    def away_m(self, progress_s: float) -> float:
        """The largest true distance of a robot of the formation from its place at a progress."""
        trajectories = self.pool.mission.roster.trajectories(self.pool.mission.segment)
        places = {robot: sample(flown, np.array([progress_s])).eta[0] for robot, flown in trajectories.items()}
        away_m = [np.linalg.norm(place[:3] - self.pool.robots[robot].eta[:3]) for robot, place in places.items()]
        return float(max(away_m, default=0.0))

    def flies(self, robot: SimulatedRobot, segment: PlanSegment) -> bool:
        """True if a robot has loaded its trajectory of the mission's plan."""
        mission = self.pool.mission
        planned = [mission.roster.trajectory(s, robot.id) for s in (segment, mission.plans.next)]
        return robot.clock.id in [trajectory.id for trajectory in planned if trajectory is not None]

    def laps_are_the_formations(self) -> None:
        """The table of laps loses no time within a run: who flies alone neither clears it nor adds to it. A robot that did
        not hear HOLD, and flew on alone until it held by itself, goes back to where the others are, and so does its lap."""
        rows = self.pool.core.laps.laps()
        lap_s, flight = sum(row.time_s for row in rows), self.pool.mission.plans.laps.flight
        if flight != self.flight and self.pool.mission.flying(self.pool.fleet):  # another path has a table of its own
            self.lap_s, self.flight = 0.0, flight
        if self.pool.mission.state in COMMITTED and self.flown_s > 1.0 and len(rows) < 10:
            lost_s, most_s = self.lap_s - lap_s, self.pool.experiment.safety.station_hold_s + LATE_S
            assert lost_s <= most_s, f"LAPS: the table loses {lost_s:.2f} s of {self.lap_s:.2f} s flown"
        self.lap_s = lap_s

    def the_way_home_is_flown_alone(self) -> None:
        """After a RETURN from rest robots fly nowhere but home, until somebody asks for another path."""
        mission = self.pool.mission
        self.homeward = self.homeward and mission.state not in AT_REST
        astray = self.homeward and mission.state in IN_FLIGHT and not mission.segment.is_return
        assert not astray, f"HOME: {mission.state.name} on the path, and the last request was RETURN"

    def the_verdict_is_of_the_flight(self) -> None:
        """A session is judged by how its last flight ended, and by no way home, test or cleared stop after that."""
        mission = self.pool.mission
        if mission.state is MissionState.LOADING:
            self.has_flown = False
        if mission.state in NOMINAL and not mission.segment.is_return:
            self.has_flown, self.flight_ended = True, None
        elif mission.state in AT_REST - {MissionState.WAITING} and self.flight_ended is None:
            self.flight_ended = mission.state
        if self.has_flown:
            verdict = mission.verdict.name if mission.verdict is not None else "none"
            ended = self.flight_ended.name if self.flight_ended is not None else "none"
            assert verdict == ended, f"VERDICT: {verdict}, but the flight ended as {ended}"

    def outcomes_are_true(self) -> None:
        """A request that is done was done by the robots, and what was left in motion is not called held."""
        outcomes = self.pool.core.requests.recent
        kept = {outcome.request for outcome in outcomes}
        forgotten = [n for n, progress in self.over.items() if progress is Progress.UNDER_WAY and n not in kept]
        ended = [o for o in outcomes if o.progress is not self.over.get(o.request, Progress.UNDER_WAY)]
        # a script that makes so many requests in one cycle pushes out those that it has replaced
        assert not forgotten or len(ended) >= KEPT, f"ENDS: requests {forgotten} are forgotten, and their ends were never told"
        self.over = {n: progress for n, progress in self.over.items() if n in kept}
        for outcome in outcomes:
            before = self.over.get(outcome.request, Progress.UNDER_WAY)
            self.over[outcome.request] = outcome.progress
            if before is Progress.UNDER_WAY and outcome.progress is Progress.DONE:
                untrue = self._untrue(outcome)
                assert not untrue, f"OUTCOME: request {outcome.request}, {outcome.order.name}, is DONE, but {untrue}"
            if before is Progress.UNDER_WAY and outcome.progress is Progress.FAILED:
                assert outcome.reason, f"OUTCOME: request {outcome.request}, {outcome.order.name}, failed without a reason"
                wrongly = self._wrongly_failed(outcome)
                assert not wrongly, f"OUTCOME: {outcome.order.name} failed ({outcome.reason}), but {wrongly}"

    def _wrongly_failed(self, outcome: Outcome) -> str:
        """Evidence that a request was done though it is told that it failed; empty if there is none. A robot may still hold
        or be armed as was asked when the mission begins to disarm all: then only a DISARM is done."""
        followed, robots = self.followed[outcome.request], list(self.pool.robots.values())
        if outcome.order is CommandKind.STOP:
            return "all have stopped" if all(self._stays(r, Mode.STOPPED) for r in robots) else ""
        if outcome.order is CommandKind.FORMATION:
            # robots that rest set out for their new places, and these are as far from the old ones all the way
            needless = "no way from here" in outcome.reason and any(each in outcome.reason for each in ("limit", "at once"))
            return "a form taken at rest asks for no other motion" if needless else ""
        modes = CONFIRMS.get(CommandKind.HOLD if outcome.order is CommandKind.DRIVE else outcome.order)
        if not followed.only or not followed.alone or modes is None:
            return ""
        if outcome.order is CommandKind.DRIVE and not followed.was_driven:  # it held before
            return ""
        if outcome.order is not CommandKind.DISARM and self.pool.mission.state in DISARMING:  # it holds, but not for long
            return ""
        robot = self.pool.robots[followed.only]
        return f"robot {robot.id} is {robot.mode.name}" if any(self._stays(robot, mode) for mode in modes) else ""

    def _untrue(self, outcome: Outcome) -> str:
        """Part of a request that is told to be done and is not; empty if all is."""
        followed = self.followed[outcome.request]
        robots = [self.pool.robots[followed.only]] if followed.only else list(self.pool.robots.values())
        in_reach = [r for r in robots if self.in_reach_s(r.id) > 1.0]
        order, active = outcome.order, [r for r in in_reach if r.id in self.pool.mission.roster.active]
        if order is CommandKind.HOLD:
            # one that is out of the formation and was only armed puts out no thrust, and may stay so
            return self._never([r for r in in_reach if armed(r) and (r in active or r.mode is not Mode.ARMED)], Mode.HOLDING)
        if order is CommandKind.DRIVE:
            return self._never(in_reach, Mode.HOLDING)
        if order is CommandKind.ARM:
            return self._never(in_reach if followed.only else active, Mode.ARMED, Mode.HOLDING)
        if order is CommandKind.LOAD:
            return "; ".join(f"robot {r.id} has no plan" for r in active if not self._had_plan(r))
        if order is CommandKind.STOP:  # one that is out of the water, without power, is sent it, and not waited for
            return self._never([r for r in in_reach if r.id not in self.out or armed(r)], Mode.STOPPED)
        if order is CommandKind.DISARM or order is CommandKind.END:
            return "; ".join(f"robot {r.id} is {r.mode.name}" for r in in_reach if armed(r) and not self._was_rest(r))
        if order is CommandKind.CLEAR_STOP:
            inside = [r for r in in_reach if r.id not in self.out]
            return "; ".join(f"robot {r.id} is STOPPED" for r in inside if self._stays(r, Mode.STOPPED))
        if order is CommandKind.GO and followed.place_m is not None and followed.only:
            away_m = float(np.hypot(*(robots[0].eta[:2] - followed.place_m)))
            there = away_m <= self.pool.experiment.safety.off_path_m
            return "" if there else f"robot {robots[0].id} is {away_m:.2f} m from where it was sent"
        if order is CommandKind.TEST:
            return "; ".join(f"robot {r.id} has passed none" for r in active if r.passed_ns <= followed.since_ns)
        if order in (CommandKind.START, CommandKind.RESUME):
            return self._never(active, Mode.TRACKING)
        if order is CommandKind.PATH and (other := self.pool.mission.plans.flown.name) != followed.text:
            return f"the path is that of {other}"
        if order is CommandKind.FORMATION and (elsewhere := self._not_in_form(followed, active)):
            return elsewhere
        if order in (CommandKind.PATH, CommandKind.FORMATION) and self.pool.mission.state in AT_REST:
            return ""
        if order in (CommandKind.GO, CommandKind.REJOIN, CommandKind.PATH, CommandKind.FORMATION):
            same = [r for r in active if all(flown == followed.flown[r.id] for flown in self.ids[r.id])]
            return self._never(active, Mode.TRACKING) or "; ".join(f"robot {r.id} has its old path" for r in same)
        if order is CommandKind.RETURN:
            starts = self.pool.mission.plans.starts  # of the path that was flown
            inside = [r for r in in_reach if r.id not in self.out]
            away = [r for r in inside if np.hypot(*(r.eta[:2] - starts[r.id][:2])) > NEAR_M or not self._was_rest(r)]
            return "; ".join(f"robot {r.id} is not at its start, or is {r.mode.name}" for r in away)
        if order in WATER:
            wrong = (followed.only in self.pool.mission.roster.out) is not (order is CommandKind.OUT)
            return f"robot {followed.only} is counted otherwise" if wrong and followed.alone else ""
        if order is CommandKind.TUNE:
            # a stopped robot takes no gains, and the request's outcome names it
            ids = {r.tuning_id for r in active if r.mode is not Mode.STOPPED or r.id not in outcome.waiting}
            return f"gains differ: {sorted(ids)}" if len(ids) > 1 else ""
        raise AssertionError(f"{order.name}: no truth is known of it")

    def _not_in_form(self, followed: _Followed, active: Sequence[SimulatedRobot]) -> str:
        """Two robots that end elsewhere beside one another than the form says; at rest by the plan for the next start."""
        planned = self.pool.mission.roster.trajectories(self.pool.mission.segment)
        rests = self.pool.mission.state in AT_REST
        flown = {r.id: planned[r.id] if rests else r.clock.trajectory for r in active if r.id in planned}
        ends_m = {robot: trajectory.eta[-1, :2] for robot, trajectory in flown.items() if trajectory is not None}
        for a, b in combinations(ends_m, 2):
            offset_m = ends_m[b] - ends_m[a]
            off_m = np.linalg.norm(np.vstack([followed.offsets_m - offset_m, followed.offsets_m + offset_m]), axis=1)
            if off_m.min() > FORM_M:
                return f"in {followed.text!r} robot {b} ends at {offset_m.round(2)} m from robot {a}"
        return ""

    def _never(self, robots: Sequence[SimulatedRobot], *modes: Mode) -> str:
        return "; ".join(f"robot {r.id} is {r.mode.name}" for r in robots if not any(m in modes for m in self.modes[r.id]))

    def _stays(self, robot: SimulatedRobot, mode: Mode) -> bool:
        """True if a robot has been in reach and in a mode for as long as is remembered."""
        return all(m is mode for m in self.modes[robot.id]) and self.in_reach_s(robot.id) > RECENT * STEP_NS * 1e-9

    def _had_plan(self, robot: SimulatedRobot) -> bool:
        trajectory = self.pool.mission.roster.trajectory(self.pool.mission.segment, robot.id)
        return trajectory is not None and trajectory.id in self.ids[robot.id]

    def _was_rest(self, robot: SimulatedRobot) -> bool:
        return any(m in (Mode.DISARMED, Mode.STOPPED, Mode.FAULT) for m in self.modes[robot.id])

    def requests_end(self) -> None:
        """No request is under way for long, but for robots that nobody can reach."""
        for outcome in self.pool.core.requests.recent:
            if outcome.progress is not Progress.UNDER_WAY:
                continue
            followed = self.followed[outcome.request]
            lost = any(self.in_reach_s(robot) < OVER_WITHIN_S for robot in outcome.waiting)
            if outcome.order is CommandKind.TUNE:
                # a change for the next lap waits while the formation holds; a robot that nobody hears must end it
                flies = self.pool.mission.state in IN_FLIGHT | AT_REST
                followed.waited_s += STEP_NS * 1e-9 if flies else 0.0
                limit_s = getattr(self.pool.mission.plans.flown.path, "lap_s", 0.0) + OVER_WITHIN_S
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
                refused = rejection_reason(CommandKind.CLEAR_STOP, mission.state)
                assert "clear the stop" not in text or not refused, f"WAY OUT: {text!r}, but {refused}"
        if mission.state in TERMINAL:
            refused = rejection_reason(CommandKind.START, mission.state)
            assert not refused, f"WAY OUT: all rest, but {refused}"
        if mission.state in (MissionState.FAILED, MissionState.CANCELLED):
            assert mission.reason, f"REASON: {mission.state.name} without one"
        fit = [r for r in mission.roster.lost if r not in self.out and self.in_reach_s(r) > 1.0 and self._fit(r)]
        fit = fit if all(self._sees(r) for r in mission.roster.active) else []  # the others are to fly on
        if fit and mission.state in NOMINAL | {MissionState.PAUSED} and not mission.segment.is_return:
            refused = mission.objection(CommandKind.REJOIN, fleet)
            assert not refused, f"WAY OUT: robot {fit[0]} is fit, but REJOIN: {refused}"
        well = all(self.in_reach_s(r) > 1.0 and self._fit(r) for r in mission.roster.active)
        idle = mission.state is MissionState.PAUSED and well and not self.pool.single.led
        self.paused_s = self.paused_s + STEP_NS * 1e-9 if idle else 0.0
        if self.paused_s > PAUSE_WITHIN_S:
            refused = mission.objection(CommandKind.RESUME, fleet)
            assert not refused, f"WAY OUT: PAUSED, but RESUME: {refused}"
        waits = self.pool.core.tuner.status().stage is not GainStage.IDLE and mission.state in IN_FLIGHT | AT_REST
        self.waiting_gains_s = self.waiting_gains_s + STEP_NS * 1e-9 if waits else 0.0
        limit_s = getattr(mission.plans.flown.path, "lap_s", 0.0) + OVER_WITHIN_S
        assert self.waiting_gains_s <= limit_s, f"WAY OUT: gains are {self.pool.core.tuner.status().stage.value} for ever"

    def _sees(self, robot: int) -> bool:
        """True if a robot in reach has known for a while where it is, and what is in its way."""
        body = self.pool.robots[robot]
        since_s = (self.pool.now_ns - max(body.blind_until_ns, body.foreign_until_ns)) * 1e-9
        return min(since_s, self.in_reach_s(robot)) > SIGHT_S

    def _fit(self, robot: int) -> bool:
        view = self.pool.fleet[robot]
        return not preflight(self.pool.experiment, {robot: view}, exclude=("thrusters",)) and view.mode is not Mode.DRIVEN
