"""A robot that flew alone before the run: the run's time is the formation's, wherever a log is gone through."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from groundstation.logs.reader import open_log, read_log
from groundstation.logs.recorder import Recorder
from groundstation.web.replay_backend import ReplayBackend
from shoal.config.experiment import dump_experiment, load_experiment
from shoal.errors import ConfigError
from shoal.messages import topics
from shoal.messages.codec import Header, encode
from shoal.messages.messages import Mode, RobotState, StepInputs
from sim_bridge.in_process.resume import Moment, lines_until, moment_of, prepared

STEP_NS = 50_000_000
ALONE_S, FLOWN_S = 5.0, 2.0


def states() -> Iterator[RobotState]:
    """Five seconds alone to another place, and then two of the run."""
    for trajectory, lasts_s in (("alone-x", ALONE_S), ("p1", FLOWN_S)):
        for k in range(round(lasts_s * 1e9) // STEP_NS):
            yield RobotState(mode=Mode.TRACKING, trajectory_id=trajectory, trajectory_s=(k + 1) * STEP_NS * 1e-9)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    text = dump_experiment(load_experiment("pool"))
    (tmp_path / "experiment.toml").write_text(text)
    recorder = Recorder(tmp_path / "run.mcap", text, {"mode": "lockstep"})
    for k, state in enumerate(states()):
        header = Header(1, k + 1, k * STEP_NS)
        recorder.put(topics.STATE, f"shoal/{topics.STATE.key(1)}", header, encode(state), header.stamp_ns)
    recorder.close()
    return tmp_path


def test_a_replay_begins_with_the_run(run: Path) -> None:
    with ReplayBackend(run) as replay:
        assert replay.snapshot()["replay"]["time_s"] == pytest.approx(ALONE_S)


def moment(run: Path, robots: list[int], at_s: float, flight: int | None = None) -> Moment:
    return moment_of(read_log(run / "run.mcap"), robots, at_s, flight)


def test_a_moment_is_found_though_the_first_robot_did_not_come_so_far(run: Path) -> None:
    """It was led away, or was lost, and the others went on."""
    with open_log(run) as log, pytest.raises(ConfigError, match="holds no inputs of robot 2 before 1 s"):
        list(lines_until(log, moment(run, [2, 1], 1.0), 2))
    with pytest.raises(ConfigError, match=r"flight 1: at 4 s there is nothing: robot 1 came to 2\.00 s"):
        moment(run, [2, 1], 4.0)


def test_a_moment_of_the_run_is_none_of_the_flight_before_it(run: Path) -> None:
    with pytest.raises(ConfigError, match=r"at 4 s there is nothing: robot 1 came to 2\.00 s"):
        moment(run, [1], 4.0)


def test_a_moment_behind_the_flights_end_is_refused(run: Path) -> None:
    """As where --duration makes the flight shorter: nothing would be flown, and that be judged."""
    with pytest.raises(ConfigError, match=r"the moment is at 1 s, and the flight ends there or before \(duration_s = 1\)"):
        prepared(load_experiment("pool", ["duration_s=1"]), run, moment(run, [1], 1.0))


def test_a_moment_of_a_hold_is_the_one_at_which_the_robot_goes_on(tmp_path: Path) -> None:
    """Without a station nothing would resume it: it would hold to the end of the flight."""
    holds, flies = Mode.HOLDING, Mode.TRACKING
    states = [(flies, 0.95), (flies, 1.0), (holds, 1.05), (holds, 1.05), (flies, 1.1), (flies, 1.1), (flies, 1.15)]
    recorder = Recorder(tmp_path / "run.mcap", "", {})
    for k, (mode, flown_s) in enumerate(states):
        for topic, message in (
            (topics.INPUTS, StepInputs(step=k)),
            (topics.STATE, RobotState(mode=mode, trajectory_s=flown_s)),
        ):
            header = Header(1, 2 * k + (topic is topics.STATE), k * STEP_NS)
            recorder.put(topic, f"shoal/{topic.key(1)}", header, encode(message), header.stamp_ns)
    recorder.close()
    for at_s, steps in ((1.0, 2), (1.02, 6), (1.1, 6), (1.12, 7)):
        with open_log(tmp_path) as log:
            lines = [line for line in lines_until(log, moment(tmp_path, [1], at_s), 1) if line.topic is topics.STATE]
        assert len(lines) == steps, at_s


def test_a_moment_is_one_of_the_flight_that_is_named(tmp_path: Path) -> None:
    """Two flights in one log: 3 s, a pause in which the robot stands at the beginning again, and 2 s."""
    tracks, stands = Mode.TRACKING, Mode.ARMED
    clocks = [*((tracks, 0.05 * k) for k in range(1, 61)), *[(stands, 0.0)] * 40, *((tracks, 0.05 * k) for k in range(1, 41))]
    recorder = Recorder(tmp_path / "run.mcap", "", {})
    for k, (mode, flown_s) in enumerate(clocks):
        header = Header(1, k + 1, k * STEP_NS)
        state = RobotState(mode=mode, trajectory_s=flown_s)
        recorder.put(topics.STATE, f"shoal/{topics.STATE.key(1)}", header, encode(state), header.stamp_ns)
    recorder.close()
    assert [moment(tmp_path, [1], 1.0, flight).stamp_ns for flight in (1, 2, None)] == [k * STEP_NS for k in (19, 119, 119)]
    assert moment(tmp_path, [1], 1.0, 1).until_ns == 100 * STEP_NS
    with pytest.raises(ConfigError, match=r"flight 2: at 2.5 s there is nothing: robot 1 came to 2\.00 s"):
        moment(tmp_path, [1], 2.5)
    with pytest.raises(ConfigError, match=r"--flight 3: the log holds 2"):
        moment(tmp_path, [1], 1.0, 3)
