"""People and a script that interrupt one another, and robots that are late, dead, restarted, led away or out of radio.

Any order of requests, over hours of simulated time; tests/groundstation/mission/invariants.py says what must hold throughout.
tests/faults/test_interruptions.py does the same to real processes.
"""

import copy
import secrets
import time
from collections import Counter
from functools import cache
from typing import ClassVar

import numpy as np
import pytest
from hypothesis import seed, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule, run_state_machine_as_test

from groundstation.mission.obstacle_monitor import ObstacleSet
from groundstation.mission.state_machine import (
    FLEET_REQUESTS,
    IN_FLIGHT,
    TERMINAL,
    MissionState,
    order_named,
    rejection_reason,
)
from shoal.config.experiment import dump_experiment
from shoal.messages.messages import CommandKind, DriveVelocity, Mode
from tests.groundstation.mission.invariants import STOPPED_WITHIN_S, Invariants
from tests.groundstation.mission.judged_run import RunRecord
from tests.groundstation.mission.simulated_fleet import (
    CIRCLE,
    PLACES,
    PLANNING_NS,
    SPEED_MPS,
    STEP_NS,
    THREE,
    TWO,
    Driving,
    SimulatedFleet,
    an_experiment,
    armed,
)

PEOPLE = ("page A", "page B", "terminal", "script")
KEY = "controller.nmpc.turning_m"
PLACES_M = ((0.0, 1.9), (2.6, 1.6), (-2.6, -1.6), (2.4, -1.2))
MIDDLES_M = ((0.8, 0.4), (-0.8, 0.4), (1.4, -0.6), (-1.2, -0.8))  # for the formation's centre
OUTAGES_S = (0.1, 0.4, 1.0, 2.5, 5.0, 20.0)
OTHER_PATHS = {"beside": "[0.4,-0.6],[1.4,-0.6],[1.4,0.0]", "above": "[-0.6,0.8],[0.9,0.8]"}
FORMS = ("line 0.8", "column 0.9", "column 1.2 over 5", "line 0.7 turn 45", "scale 1.3", "turn 90", "order 2,1", "order 3,1,2")
ENDS = (CommandKind.DISARM, CommandKind.END, CommandKind.STOP)
FLEET_ORDERS = [order_named(name) for name in FLEET_REQUESTS]
BETWEEN_NS = 17_000_000  # a request comes so much later within its cycle than the one before
SAMPLED = 12  # one in so many arrivals in a state of the mission is followed by a STOP, beside what goes on


@cache
def another_path(robots: int, name: str) -> str:
    """Text of a request to fly another experiment's path."""
    path = f'{{kind="waypoints",points_m=[{OTHER_PATHS[name]}],speed_mps=0.1,depth_m=0.4}}'
    text = dump_experiment(an_experiment("go-on", THREE if robots == 3 else TWO, path, 12))
    return text.replace('name = "pool"', f'name = "{name}"')


class Interruptions(RuleBasedStateMachine):
    """Requests and mishaps, with time between them."""

    arrivals: ClassVar[dict[MissionState, int]] = {}  # of all examples
    figures: ClassVar[Counter[str]] = Counter()  # the same: how much was tried

    pool: SimulatedFleet
    watched: Invariants
    record: RunRecord

    @initialize(
        lost=st.sampled_from(("go-on", "hold", "close-up", "abort")),
        robots=st.sampled_from((THREE, TWO)),
        path=st.sampled_from((CIRCLE, PLACES)),
        automatic=st.booleans(),
        begins=st.sampled_from((CommandKind.START, CommandKind.TEST, CommandKind.NONE)),
        leaves=st.booleans(),
        speed_mps=st.sampled_from((SPEED_MPS, 0.05)),
    )
    def begin(
        self, lost: str, robots: str, path: str, automatic: bool, begins: CommandKind, leaves: bool, speed_mps: float
    ) -> None:
        self.pool = SimulatedFleet(an_experiment(lost, robots, path), automatic, give_up_s=40.0 if automatic else None)
        self.watched = Invariants(self.pool)
        self.record = RunRecord(self.pool)
        self.before: MissionState | None = None
        self.requests = 0
        self.pool.on_cycle = self.look
        self.leaves = leaves  # the station itself ends the run, by Ctrl-C
        self.ids = list(self.pool.robots)
        self.pool.robots[1].speed_mps = speed_mps
        self.figures["examples"] += 1
        self.pool.run(1.0)
        if begins is not CommandKind.NONE and not automatic:
            self.ask("script", begins, 0)
            self.pool.run(6.0)

    @invariant()
    def count(self) -> None:
        """Count a request, a mishap or a wait."""
        self.figures["steps"] += 1

    def ask(self, who: str, order: CommandKind, robot: int, place_m: tuple[float, float] | None = None, text: str = "") -> str:
        """A request of `who`; `text`: of a PATH the name of its experiment, of a FORMATION the form. Returns the reason of a
        refusal."""
        pool = self.pool
        before = pool.mission.state
        self.requests += 1
        now_ns = pool.now_ns + self.requests * BETWEEN_NS % STEP_NS  # people do not wait for a cycle
        sent = another_path(len(self.ids), text) if order is CommandKind.PATH else text
        refused, number = pool.core.request(order, pool.seen_at(now_ns), now_ns, (place_m,) if place_m else (), robot, sent)
        assert bool(number) is not bool(refused), f"ANSWER: {order.name} of {who}: number {number}, {refused!r}"
        assert not refused or order is not CommandKind.STOP, f"STOP: refused in {before.name}: {refused}"
        if number:
            self.watched.begin(number, order, robot, place_m, text)
        if number and before in TERMINAL | {MissionState.WAITING}:
            self.watched.begin_run()
        return refused

    def look(self) -> None:
        """Check what must hold in every cycle; and sometimes, in a copy of the pool, what a STOP would do in it."""
        self.watched.check()
        state = self.pool.mission.state
        if state is self.before:
            return
        self.before = state
        count = self.arrivals[state] = self.arrivals.get(state, 0) + 1
        if count % SAMPLED == 1:
            self.watched.violated = True
            self.try_stop(copy.deepcopy(self.pool, {id(same): same for same in (self.pool.experiment, self, self.record)}))
            self.watched.violated = False

    @staticmethod
    def try_stop(pool: SimulatedFleet) -> None:
        """A person presses STOP: it is taken, and every robot that can hear stops."""
        pool.on_cycle, pool.on_beat, pool.on_state = lambda: None, lambda beat: None, lambda robot, state, arrives: None
        state = pool.mission.state.name
        refused, _ = pool.core.request(CommandKind.STOP, pool.fleet, pool.now_ns)
        assert not refused, f"STOP: refused in {state}: {refused}"
        hearing = [r for r in pool.robots.values() if r.alive and r.radio.deaf_until_ns <= pool.now_ns]
        pool.run(STOPPED_WITHIN_S)
        moving = [f"robot {r.id} is {r.mode.name}" for r in hearing if r.mode is not Mode.STOPPED]
        assert not moving, f"STOP: in {state}: {'; '.join(moving)}"

    # --- requests

    @rule(who=st.sampled_from(PEOPLE), order=st.sampled_from(FLEET_ORDERS))
    def request(self, who: str, order: CommandKind) -> None:
        """Any request, possible or not."""
        self.ask(who, order, 0)

    @rule(who=st.sampled_from(PEOPLE), k=st.integers(0, 11))
    def request_as_shown(self, who: str, k: int) -> None:
        """A request that the page shows as possible, but for those that end everything."""
        state = self.pool.mission.state
        possible = [o for o in FLEET_ORDERS if o not in ENDS and not rejection_reason(o, state)]
        if possible:
            self.ask(who, possible[k % len(possible)], 0)

    @rule(who=st.sampled_from(PEOPLE), seconds=st.sampled_from((0.1, 2.0)))
    def hold_and_resume(self, who: str, seconds: float) -> None:
        self.ask(who, CommandKind.HOLD, 0)
        self.pool.run(seconds)
        self.ask(who, CommandKind.RESUME, 0)

    @rule(
        who=st.sampled_from(PEOPLE),
        order=st.sampled_from((CommandKind.RETURN, CommandKind.PATH, CommandKind.GO)),
        k=st.integers(0, 2),
        cycles=st.integers(1, 2),
    )
    def hold_behind_resume(self, who: str, order: CommandKind, k: int, cycles: int) -> None:
        """From a hold: resume, hold at once, and ask for something else, within the radio's delay; plans are quick."""
        self.ask(who, CommandKind.HOLD, 0)
        self.pool.run(3.0)
        self.pool.planning_ns = STEP_NS
        for robot in self.pool.robots.values():
            robot.radio.delay_ns = max(robot.radio.delay_ns, 100_000_000)
        for order in (CommandKind.RESUME, CommandKind.HOLD):
            self.ask(who, order, 0)
            for _ in range(cycles):
                self.pool.step()
        place_m = PLACES_M[k] if order is CommandKind.GO else None
        self.ask(
            who, order, self.ids[k % len(self.ids)] if place_m else 0, place_m, "beside" if order is CommandKind.PATH else ""
        )
        self.pool.run(1.0)
        self.pool.planning_ns = PLANNING_NS

    @rule(who=st.sampled_from(PEOPLE), place_m=st.sampled_from(MIDDLES_M))
    def lead_elsewhere(self, who: str, place_m: tuple[float, float]) -> None:
        """Another path for the whole formation."""
        self.ask(who, CommandKind.GO, 0, place_m)

    @rule(who=st.sampled_from(PEOPLE), path=st.sampled_from(tuple(OTHER_PATHS)), holds=st.booleans())
    def fly_another_path(self, who: str, path: str, holds: bool) -> None:
        """Another experiment's path: from a hold at once, at rest with the next start."""
        if holds:
            self.ask(who, CommandKind.HOLD, 0)
            self.pool.run(3.0)
        self.ask(who, CommandKind.PATH, 0, text=path)

    @rule(who=st.sampled_from(PEOPLE), form=st.sampled_from(FORMS), holds=st.booleans())
    def take_form(self, who: str, form: str, holds: bool) -> None:
        """Another form: in flight, from a hold, or at rest for the next start."""
        if holds:
            self.ask(who, CommandKind.HOLD, 0)
            self.pool.run(3.0)
        self.ask(who, CommandKind.FORMATION, 0, text=form)

    @rule(who=st.sampled_from(PEOPLE), forms=st.tuples(*2 * [st.sampled_from(FORMS)]), seconds=st.sampled_from((1.5, 5.0)))
    def take_forms(self, who: str, forms: tuple[str, str], seconds: float) -> None:
        """A form from a hold, and another from a hold on the way into it."""
        for form in forms:
            self.take_form(who, form, True)
            self.pool.run(seconds)

    @rule(who=st.sampled_from(PEOPLE), form=st.sampled_from(FORMS), k=st.integers(0, 2))
    def take_form_without_one(self, who: str, form: str, k: int) -> None:
        """A form from a hold; and a robot dies once that is planned."""
        self.take_form(who, form, True)
        self.pool.run(1e-9 * self.pool.planning_ns + 0.2)
        self.die(k)
        self.pool.run(12.0)

    @rule(who=st.sampled_from(PEOPLE), form=st.sampled_from(FORMS))
    def take_form_on_the_way_home(self, who: str, form: str) -> None:
        """A return that is held before it has its plan, and a form."""
        for k in range(len(self.ids)):
            self.arm_one(who, k)
        self.ask(who, CommandKind.RETURN, 0)
        self.pool.run(0.2)
        self.take_form(who, form, True)

    @rule(
        who=st.sampled_from(PEOPLE),
        order=st.sampled_from((CommandKind.ARM, CommandKind.HOLD, CommandKind.DISARM)),
        k=st.integers(0, 2),
    )
    def request_of_one(self, who: str, order: CommandKind, k: int) -> None:
        self.ask(who, order, self.ids[k % len(self.ids)])

    @rule(who=st.sampled_from(PEOPLE), place_m=st.sampled_from(PLACES_M), k=st.integers(0, 2))
    def send_one(self, who: str, place_m: tuple[float, float], k: int) -> None:
        """Send a robot to a place; one that is disarmed is armed first."""
        self.ask(who, CommandKind.GO, self.arm_one(who, k), place_m)

    @rule(who=st.sampled_from(PEOPLE), place_m=st.sampled_from(PLACES_M), k=st.integers(0, 2))
    def send_one_unseen(self, who: str, place_m: tuple[float, float], k: int) -> None:
        """Send a robot that the camera loses on its way: it holds there by itself."""
        self.send_one(who, place_m, k)
        self.pool.run(4.0)
        self.hide(k, 0.1)
        self.pool.run(1.0)

    @rule(who=st.sampled_from(PEOPLE), k=st.integers(0, 2), switched_off=st.booleans())
    def take_robot_out(self, who: str, k: int, switched_off: bool) -> None:
        """Take a robot out of the water, disarmed where people can, switched off or as it is."""
        robot = self.ids[k % len(self.ids)]
        if not self.ask(who, CommandKind.DISARM, robot):
            self.pool.run(0.5)
        if not self.ask(who, CommandKind.OUT, robot) and switched_off:
            self.pool.robots[robot].alive = False

    @rule(who=st.sampled_from(PEOPLE), k=st.integers(0, 2))
    def note_robot_out(self, who: str, k: int) -> None:
        """Say of a robot, whatever it does, that it is out of the water."""
        self.ask(who, CommandKind.OUT, self.ids[k % len(self.ids)])

    @rule(who=st.sampled_from(PEOPLE), k=st.integers(0, 2))
    def put_robot_back(self, who: str, k: int) -> None:
        self.ask(who, CommandKind.BACK_IN, self.ids[k % len(self.ids)])

    def arm_one(self, who: str, k: int) -> int:
        """Arm a robot that is disarmed. Returns its id."""
        robot = self.ids[k % len(self.ids)]
        if self.pool.robots[robot].mode is Mode.DISARMED and not self.ask(who, CommandKind.ARM, robot):
            self.pool.run(0.5)
        return robot

    @rule(
        who=st.sampled_from(PEOPLE),
        surge_mps=st.sampled_from((0.1, -0.1)),
        seconds=st.sampled_from((0.2, 1.0, 3.0)),
        k=st.integers(0, 2),
        lets_go=st.booleans(),
    )
    def drive(self, who: str, surge_mps: float, seconds: float, k: int, lets_go: bool) -> None:
        """Drive a robot; then let go, or be gone. One that is disarmed is armed first."""
        robot = self.arm_one(who, k)
        until_ns = self.pool.now_ns + round(seconds * 1e9)
        self.pool.driving[robot] = Driving(DriveVelocity(surge_mps=surge_mps), until_ns, lets_go)

    @rule(value=st.sampled_from((0.02, 0.04, None)), next_lap=st.booleans())
    def change_gains(self, value: float | None, next_lap: bool) -> None:
        pool, values = self.pool, None if value is None else {KEY: value}
        _, number = pool.core.request_gains(values, next_lap, pool.fleet, pool.now_ns)
        if number:
            self.watched.begin(number, CommandKind.TUNE)

    @rule(who=st.sampled_from(PEOPLE))
    def fly(self, who: str) -> None:
        """Mend all robots, and fly, where the fleet does not."""
        if self.pool.mission.state in IN_FLIGHT:
            return
        self.mend()
        self.pool.run(1.0)
        if self.pool.mission.state is MissionState.STOPPED and not self.ask(who, CommandKind.CLEAR_STOP, 0):
            self.pool.run(1.0)
        for order in (CommandKind.RESUME, CommandKind.START, CommandKind.RETURN):
            if not self.ask(who, order, 0):
                self.pool.run(5.0)
                break

    # --- mishaps

    @rule(seconds=st.sampled_from(OUTAGES_S), k=st.integers(0, 2), way=st.sampled_from(("both", "deaf", "mute")))
    def lose_radio(self, seconds: float, k: int, way: str) -> None:
        radio, until_ns = self.pool.robots[self.ids[k % len(self.ids)]].radio, self.pool.now_ns + round(seconds * 1e9)
        radio.deaf_until_ns = until_ns if way != "mute" else radio.deaf_until_ns
        radio.mute_until_ns = until_ns if way != "deaf" else radio.mute_until_ns

    @rule(who=st.sampled_from(PEOPLE), seconds=st.sampled_from((1.0, 2.5)), k=st.integers(0, 2))
    def stop_beside(self, who: str, seconds: float, k: int) -> None:
        """STOP, and clear the stop, while a robot is out of radio: it comes back as it was."""
        self.lose_radio(seconds, k, "both")
        self.pool.run(0.5 * seconds)
        self.ask(who, CommandKind.STOP, 0)
        self.pool.run(0.3 * seconds)
        self.ask(who, CommandKind.CLEAR_STOP, 0)

    @rule(delay_s=st.sampled_from((0.0, 0.02, 0.1, 0.3)), k=st.integers(0, 2))
    def be_late(self, delay_s: float, k: int) -> None:
        self.pool.robots[self.ids[k % len(self.ids)]].radio.delay_ns = round(delay_s * 1e9)

    @rule(k=st.integers(0, 2))
    def die(self, k: int) -> None:
        self.pool.robots[self.ids[k % len(self.ids)]].alive = False

    @rule(k=st.integers(0, 2))
    def restart(self, k: int) -> None:
        self.pool.robots[self.ids[k % len(self.ids)]].restart(self.pool.now_ns)

    @rule(k=st.integers(0, 2), works=st.booleans())
    def board(self, k: int, works: bool) -> None:
        self.pool.robots[self.ids[k % len(self.ids)]].board_works = works

    @rule(k=st.integers(0, 2), seconds=st.sampled_from((0.1, 1.0)))
    def hide(self, k: int, seconds: float) -> None:
        """A robot that is not seen holds by itself."""
        self.pool.robots[self.ids[k % len(self.ids)]].unseen_until_ns = self.pool.now_ns + round(seconds * 1e9)

    @rule(k=st.integers(0, 2), seconds=st.sampled_from((0.1, 1.0, 8.0)))
    def blind(self, k: int, seconds: float) -> None:
        """A robot cannot tell whether obstacles are there."""
        self.pool.robots[self.ids[k % len(self.ids)]].blind_until_ns = self.pool.now_ns + round(seconds * 1e9)

    @rule(k=st.integers(0, 2), seconds=st.sampled_from((0.1, 1.0, 8.0)))
    def send_foreign_poses(self, k: int, seconds: float) -> None:
        """Two programs publish a robot's poses."""
        self.pool.robots[self.ids[k % len(self.ids)]].foreign_until_ns = self.pool.now_ns + round(seconds * 1e9)

    @rule(k=st.integers(0, 2), speed_mps=st.sampled_from((0.05, SPEED_MPS)))
    def weaken(self, k: int, speed_mps: float) -> None:
        """A robot that does not keep up with its path."""
        self.pool.robots[self.ids[k % len(self.ids)]].speed_mps = speed_mps

    @rule(place_m=st.sampled_from(MIDDLES_M), radius_m=st.sampled_from((0.1, 0.4)))
    def drift_in(self, place_m: tuple[float, float], radius_m: float) -> None:
        """Something lies in the pool."""
        self.pool.obstacles = ObstacleSet((1,), np.array([[*place_m, radius_m]]))

    @rule()
    def take_out(self) -> None:
        self.pool.obstacles = ObstacleSet()

    # --- time

    @rule(seconds=st.sampled_from((0.05, 0.3, 1.0, 3.0, 12.0, 30.0)))
    def wait(self, seconds: float) -> None:
        self.pool.run(seconds)

    def teardown(self) -> None:
        if hasattr(self, "pool"):
            try:
                self.end_well()
            finally:
                self.figures["seconds"] += round(self.pool.now_ns * 1e-9)

    def end_well(self) -> None:
        """All robots are well again: people bring the fleet to rest, and it can start anew."""
        if self.watched.violated:
            return
        self.pool.driving.clear()
        self.mend()
        self.pool.run(2.0)
        self.record.judge()
        if self.pool.core.ended or (self.leaves and self.pool.mission.state is not MissionState.STOPPED):
            self.leave()
        else:
            self.recover()

    def mend(self) -> None:
        """Let every robot be well and in reach, and the pool free."""
        self.pool.obstacles = ObstacleSet()
        for robot in self.pool.robots.values():
            if not robot.alive:
                robot.restart(self.pool.now_ns)
            robot.radio.deaf_until_ns = robot.radio.mute_until_ns = 0
            robot.blind_until_ns = min(robot.blind_until_ns, self.pool.now_ns)
            robot.foreign_until_ns = min(robot.foreign_until_ns, self.pool.now_ns)
            robot.radio.delay_ns, robot.board_works, robot.speed_mps = 20_000_000, True, SPEED_MPS

    def leave(self) -> None:
        """A station that ends leaves no robot armed."""
        pool = self.pool
        for _ in range(100):
            if pool.core.bring_to_rest(pool.fleet, pool.now_ns):
                break
            pool.step()
        self.ask("terminal", CommandKind.END, 0)
        pool.run(2.0)
        left = [f"robot {r.id} is {r.mode.name}" for r in pool.robots.values() if armed(r)]
        assert not left, f"LEAVES: {'; '.join(left)}, the mission {pool.mission.state.name}"

    def recover(self) -> None:
        """Requests that the station itself names lead from any state to a fleet that returns and ends."""
        pool = self.pool
        if pool.mission.state is not MissionState.STOPPED:
            assert self.ask("page A", CommandKind.STOP, 0) == ""
            pool.run(3.0)
        refused = self.ask("page A", CommandKind.CLEAR_STOP, 0)
        assert refused == "", f"RECOVERY: CLEAR_STOP: {refused}"
        pool.run(3.0)
        assert {r.mode for r in pool.robots.values()} == {Mode.DISARMED}, "RECOVERY: not all are disarmed"
        for robot in sorted(self.watched.out):
            refused = self.ask("page A", CommandKind.BACK_IN, robot)
            assert refused == "", f"RECOVERY: BACK_IN: {refused}"
        pool.run(0.1)
        refused = self.ask("page A", CommandKind.RETURN, 0)
        for _ in range(150):
            pool.run(1.0)
            if pool.mission.state in TERMINAL:
                break
        assert refused == "" and pool.mission.state is MissionState.DONE, f"RECOVERY: RETURN: {refused} {pool.mission.reason}"


@pytest.mark.long
def test_any_order_of_requests_and_mishaps() -> None:
    """Twenty-five examples at least, and more until they have led everywhere."""
    Interruptions.arrivals.clear()
    never = list(MissionState)
    for number in range(10):
        run_state_machine_as_test(
            seed(number)(Interruptions),
            settings=settings(max_examples=25, stateful_step_count=40, deadline=None, derandomize=False, database=None),
        )
        never = [state for state in MissionState if state not in Interruptions.arrivals]
        if not never:
            break
    assert not never, "the requests and mishaps are too few: they lead nowhere else"


@pytest.mark.slow
def test_any_order_of_requests_and_mishaps_for_ten_minutes() -> None:
    """New examples in every run. The seed of a failure is printed: `seed(...)(Interruptions)` finds it again."""
    Interruptions.figures.clear()
    end_s = time.monotonic() + 600.0
    while time.monotonic() < end_s:
        number = secrets.randbits(32)
        print(f"seed {number}")
        run_state_machine_as_test(
            seed(number)(Interruptions),
            settings=settings(max_examples=25, stateful_step_count=50, deadline=None, derandomize=False, database=None),
        )
    figures = Interruptions.figures
    hours = figures["seconds"] / 3600.0
    print(f"{figures['examples']} examples, {figures['steps']} steps, {hours:.1f} hours of simulated time")
