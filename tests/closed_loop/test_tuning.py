"""Gains changed in flight: the real agents in the water, the station's tuner at the other end of their orders."""

from collections.abc import Callable, Mapping

import numpy as np
import pytest

from groundstation.formation_clock import FormationPlans
from groundstation.mission.command_dispatcher import CommandResult
from groundstation.mission.gain_update import GainStage, GainUpdater
from groundstation.mission.lap_statistics import FlownLaps, LapStatistics
from groundstation.mission.timetable import START_IN_S
from groundstation.telemetry import Fleet, RobotView
from shoal.config.experiment import Experiment, load_experiment
from shoal.config.scene import Circle
from shoal.frames import Array
from shoal.messages.codec import Header
from shoal.messages.live_gains import tunable_parameters, tuning
from shoal.messages.messages import Command, CommandKind, Mode, Reply, RobotState, required
from tests.closed_loop.dry_pool import DryPool

pytestmark = pytest.mark.long

SHORT_LAPS = ("path.lap_s=25", "duration_s=100")
B = {  # of every part of the controller one
    "controller.estimator.bandwidth_radps": 3.0,
    "controller.mpc.q_formation.0": 0.5,
    "controller.mpc.q_formation.1": 0.4,
    "controller.mpc.q_formation.2": 0.3,
    "controller.mpc.q_formation.3": 0.2,
    "controller.nmpc.heading_m": 0.02,
    "controller.nmpc.arm_m": 0.3,
    "controller.nmpc.turning_m": 0.02,
    "controller.nmpc.hold_turning_m": 0.06,
}


FILED = (
    *(f"{key}={value}" for key, value in B.items() if not key[-1].isdecimal()),
    "controller.mpc.q_formation=[0.5, 0.4, 0.3, 0.2]",
)


def pool(*settings: str) -> Experiment:
    return load_experiment("pool", [*SHORT_LAPS, *settings])


class TuningLab:
    """A pool, and the part of a station that deals with gains. A robot in `mute` hears nothing."""

    def __init__(self, experiment: Experiment) -> None:
        self.pool = DryPool(experiment)
        self.tuner = GainUpdater(self.pool.experiment)
        path = experiment.path
        assert isinstance(path, Circle)
        self.flown, self.laps = FlownLaps(path.lap_s, end_s=experiment.duration_s), LapStatistics()
        self.mute: set[int] = set()
        self.answers: list[CommandResult] = []
        self._sent = 1000

    def fleet(self) -> Fleet:
        ids = self.pool.experiment.robot_ids
        return {r: RobotView(robot.states[-1], 0.0) for r, robot in zip(ids, self.pool.robots, strict=True)}

    def send(self, command: Command) -> Reply:
        if command.robot in self.mute:
            return Reply(command.robot, False, "no answer within 0.5 s", silent=True)
        self._sent += 1
        now_ns, agent = self.pool.now_ns, self.pool.robots[self.pool.experiment.robot_ids.index(command.robot)].agent
        return agent.handle_command(Header(1, self._sent, now_ns), command, self.pool.station(), now_ns)

    def step(self) -> None:
        self.pool.step()
        commands = self.tuner.step(self.fleet(), self.answers, self.pool.now_ns)
        self.answers = [CommandResult(command, self.send(command)) for command in commands]
        self.laps.update(self.flying(), self.flown)

    def flying(self) -> dict[int, RobotState]:
        states = {r: view.state for r, view in self.fleet().items() if view.state is not None}
        return {r: state for r, state in states.items() if FormationPlans().under_way(state)}

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / 0.05)):
            self.step()

    def request(self, values: Mapping[str, float], next_lap: bool = False) -> str:
        return self.tuner.request(values, self.fleet(), self.pool.now_ns, self.flying(), self.flown if next_lap else None)

    def states(self, robot: int = 0) -> list[RobotState]:
        return self.pool.robots[robot].states

    def take_off(self) -> None:
        for order in (CommandKind.LOAD, CommandKind.ARM, CommandKind.START):
            for robot, trajectory in self.pool.trajectories.items():
                loaded = trajectory if order is CommandKind.LOAD else None
                reply = self.send(
                    Command(
                        order,
                        robot,
                        1.0,
                        self.pool.experiment.hash,
                        trajectory.id,
                        trajectory=loaded,
                        start_ns=self.pool.now_ns + 200_000_000,
                    )
                )
                assert reply.accepted, reply.reason


def ids(lab: TuningLab) -> list[set[str]]:
    return [{robot.states[-1].tuning_id for robot in lab.pool.robots}]


def wrenches(states: list[RobotState]) -> Array:
    """The wrenches (steps, 3); zeros while the thrusters stand still."""
    return np.array([np.zeros(3) if state.control is None else state.control.wrench for state in states])


def until(lab: TuningLab, done: Callable[[], bool], within_s: float) -> None:
    for _ in range(round(within_s / 0.05)):
        if done():
            return
        lab.step()
    raise AssertionError(f"not within {within_s} s: {lab.tuner.status()}")


def test_gains_set_by_order_fly_as_those_of_the_file() -> None:
    """Every parameter there is, set before the first pose: bit for bit the flight whose experiment file holds these values."""
    assert set(B) == {parameter.key for parameter in tunable_parameters(pool().controller)}
    ordered, filed = TuningLab(pool()), TuningLab(pool(*FILED))
    for robot, trajectory in ordered.pool.trajectories.items():
        assert trajectory.id == filed.pool.trajectories[robot].id
    for lab in (ordered, filed):
        lab.pool.camera_works = False
    ordered.run(0.1)
    assert ordered.request(B) == ""
    until(ordered, lambda: ordered.tuner.status().flown.id == tuning(filed.pool.experiment.controller).id, 2.0)
    filed.run(ordered.pool.now_ns * 1e-9)
    for lab in (ordered, filed):
        lab.pool.camera_works = True
        lab.run(0.5)
        lab.take_off()
        lab.run(6.0)
    for robot in (0, 1):
        a, b = (wrenches(lab.states(robot)) for lab in (ordered, filed))
        assert np.abs(b).max() > 0.5
        np.testing.assert_array_equal(a, b)
    plain = TuningLab(pool())
    plain.run(1.0)
    plain.take_off()
    plain.run(6.0)
    assert np.abs(wrenches(plain.states())[-20:] - wrenches(filed.states())[-20:]).max() > 0.01


def test_a_change_in_flight_takes_effect_at_one_instant_and_leads_to_the_other_flight() -> None:
    """Up to the change nothing differs from the flight without it; long after, the robots push as they do with B from the
    beginning: the observer's, the guidance's and the solver's memories have taken it up."""
    changed, before, after = TuningLab(pool()), TuningLab(pool()), TuningLab(pool(*FILED))
    for lab in (changed, before, after):
        lab.run(1.0)
        lab.take_off()
        lab.run(5.0)
    assert changed.request(B) == ""
    for lab in (changed, before, after):
        lab.run(14.0)
    wanted = tuning(after.pool.experiment.controller).id
    at = [next(k for k, state in enumerate(changed.states(robot)) if state.tuning_id == wanted) for robot in (0, 1)]
    assert at[0] == at[1] and 0.05 * at[0] < 6.0 + START_IN_S + 0.2
    for robot in (0, 1):
        b, a, c = (wrenches(lab.states(robot)) for lab in (before, after, changed))
        np.testing.assert_array_equal(c[: at[0]], b[: at[0]])
        assert np.abs(c[at[0] + 5] - b[at[0] + 5]).max() > 1e-3
        late = slice(-100, None)  # the same noise: what is left is what a current's estimate forgets slowly
        assert np.abs(c[late] - a[late]).mean() < 0.4 * np.abs(b[late] - a[late]).mean()


def test_gains_stay_when_a_value_is_bad_or_one_robot_refuses() -> None:
    lab = TuningLab(pool())
    flown = tuning(pool().controller).id
    lab.run(1.0)
    assert "controller.mpc.q_formation.0 = -1.0" in lab.request({"controller.mpc.q_formation.0": -1.0})
    assert "cannot be changed in flight" in lab.request({"controller.period_s": 0.1})
    assert lab.request({"controller.mpc.q_formation.0": 0.15}) == "this is what is flown already"
    lab.mute = {2}
    assert lab.request({"controller.mpc.q_formation.0": 2.0}) == ""
    assert "under way" in lab.request({"controller.mpc.q_formation.0": 3.0})
    until(lab, lambda: lab.tuner.status().stage is GainStage.IDLE, 5.0)
    assert lab.tuner.status().reason == "robot 2 does not answer; nothing was changed"
    lab.run(1.0)
    assert {state.tuning_id for robot in (0, 1) for state in lab.states(robot)} == {flown}


def test_a_robot_that_changed_its_gains_changes_back_when_another_does_not_follow() -> None:
    lab = TuningLab(pool())
    flown = tuning(pool().controller).id
    lab.run(1.0)
    assert lab.request({"controller.mpc.q_formation.0": 2.0}) == ""
    until(lab, lambda: lab.tuner.status().stage is GainStage.ADOPTING, 1.0)
    lab.mute = {2}
    until(lab, lambda: lab.states(0)[-1].tuning_id != flown, 2.0)
    until(lab, lambda: lab.tuner.status().stage is GainStage.IDLE, 6.0)
    lab.run(1.0)
    assert lab.states(0)[-1].tuning_id == lab.states(1)[-1].tuning_id == flown
    assert lab.tuner.status().reason == "robot 2 does not answer; the others go back"


def test_a_set_for_the_next_lap_waits_for_it_and_its_laps_are_told_apart() -> None:
    lab = TuningLab(pool())
    lab.run(1.0)
    a = lab.tuner.status().flown.id
    assert "not every robot is on its trajectory" in lab.request({"controller.mpc.q_formation.0": 2.0}, next_lap=True)
    lab.take_off()
    lab.run(20.0)
    assert lab.request({"controller.mpc.q_formation.0": 2.0}, next_lap=True) == ""
    until(lab, lambda: lab.tuner.status().stage is GainStage.WAITING, 1.0)
    lab.run(2.0)
    assert lab.tuner.undo(lab.fleet(), lab.pool.now_ns) == ""  # another thought
    until(lab, lambda: lab.tuner.status().stage is GainStage.IDLE, 2.0)
    assert lab.request({"controller.mpc.q_formation.0": 4.0}, next_lap=True) == ""
    lab.run(20.0)
    b = lab.tuner.status().flown.id
    for robot in (0, 1):
        states = [state for state in lab.states(robot) if state.mode is Mode.TRACKING]
        assert all((state.tuning_id == b) == (state.trajectory_s >= 25.0) for state in states)
    assert lab.tuner.undo(lab.fleet(), lab.pool.now_ns) == ""
    lab.run(12.0)
    assert [state.tuning_id for state in (lab.states(0)[-1], lab.states(1)[-1])] == [a, a]
    laps = lab.laps.laps()
    assert [(lap.number, lap.tuning_id) for lap in laps] == [(1, a), (2, b), (2, a), (3, a)]
    assert abs(laps[0].time_s - 25.0) < 0.2 and abs(laps[1].time_s + laps[2].time_s - 25.0) < 0.2
    for lap in laps:
        errors = [
            np.linalg.norm(required(state.estimate).eta[:3] - required(state.control).eta_reference[:3])
            for robot in (0, 1)
            for state in lab.states(robot)
            if state.trajectory_s // 25.0 == lap.number - 1 and state.tuning_id == lap.tuning_id and state.trajectory_s > 0.0
        ]
        np.testing.assert_allclose(lap.rms_m, np.sqrt(np.mean(np.square(errors))), rtol=1e-3)
        np.testing.assert_allclose(lap.max_m, np.max(errors))


def waiting_for_a_lap() -> TuningLab:
    """In flight, with a set of gains that is to count from the next lap on."""
    lab = TuningLab(pool())
    lab.run(1.0)
    lab.take_off()
    lab.run(5.0)
    assert lab.request({"controller.mpc.q_formation.0": 2.0}, next_lap=True) == ""
    until(lab, lambda: lab.tuner.status().stage is GainStage.WAITING, 1.0)
    return lab


def test_leaving_the_run_drops_gains_that_wait_for_a_lap() -> None:
    lab = waiting_for_a_lap()
    for robot in (1, 2):
        assert lab.send(Command(CommandKind.DISARM, robot)).accepted
    lab.run(2.0)
    assert "left the run before the lap began" in lab.tuner.status().reason
    lab.take_off()
    lab.run(28.0)
    assert {state.tuning_id for state in lab.states()} == {tuning(pool().controller).id}


def test_the_remaining_robots_drop_gains_that_wait_for_a_lap() -> None:
    """All robots together, or none: it had accepted the set, and would have changed alone."""
    lab = waiting_for_a_lap()
    assert lab.send(Command(CommandKind.DISARM, 2)).accepted
    lab.run(24.0)
    assert lab.states()[-1].mode is Mode.TRACKING and lab.states()[-1].trajectory_s > 26.0
    assert {state.tuning_id for state in lab.states()} == {tuning(pool().controller).id}
    assert lab.tuner.status().reason == "robot 2 left the run before the lap began; the others go back"


def test_a_robot_that_was_restarted_gets_the_fleets_gains() -> None:
    lab = TuningLab(pool())
    lab.run(1.0)
    assert lab.request({"controller.mpc.q_formation.0": 2.0}) == ""
    lab.run(2.0)
    wanted = lab.tuner.status().flown.id
    fresh = DryPool(pool())
    lab.pool.robots[1] = fresh.robots[1]
    lab.run(0.1)
    assert lab.states(1)[-1].tuning_id != wanted
    lab.run(4.0)
    assert [lab.states(robot)[-1].tuning_id for robot in (0, 1)] == [wanted, wanted]
