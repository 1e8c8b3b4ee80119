"""A recorded run back on the bus: what was seen and said, at its pace, and nothing that could move a robot."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from groundstation.__main__ import cli
from groundstation.logs.bus_replay import SEEN_AND_SAID, chosen, send
from groundstation.logs.reader import LogFile, open_log
from groundstation.logs.recorder import Recorder
from robot_agent.agent import Agent
from robot_agent.inputs import Inputs
from shoal.bus.bus import Bus
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.messages import topics
from shoal.messages.codec import Header, encode
from shoal.messages.messages import Command, CommandKind, CommandTaken, Plan, Pose, StationHeartbeat, StepInputs, Tick
from shoal.messages.topics import TOPICS, Topic
from shoal.runtime.runtime import Stop
from tests.groundstation.synthetic import Script, write_run

pytestmark = pytest.mark.real_time

SECOND = 1_000_000_000
Heard = tuple[str, Header, bytes, float]


class Fake:
    """Time that passes when somebody sleeps."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def clock_s(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    write_run(folder, Script(duration_s=4.0))
    return folder


@pytest.fixture
def log(run: Path) -> Iterator[LogFile]:
    with open_log(run) as opened:
        yield opened


def listen(hub: MemoryHub, fake: Fake) -> list[Heard]:
    messages: list[Heard] = []
    ear = MemoryTransport(hub)
    for topic in TOPICS:
        for prefix in ("shoal", "replay/shoal"):
            ear.subscribe(
                f"{prefix}/{topic.key()}",
                topic.qos,
                lambda key, payload, header: messages.append((key, Header.decode(header, "", ""), payload, fake.now_s)),
            )
    return messages


def replay(log: LogFile, rate: float, begin_s: float = 0.0, end_s: float = 1e9) -> list[Heard]:
    hub, fake = MemoryHub(), Fake()
    messages = listen(hub, fake)
    bus = Bus(MemoryTransport(hub), "replay/shoal")
    sent = send(bus, chosen(log, begin_s, end_s), rate, Stop(install=False), fake.clock_s, fake.sleep)
    assert sent == len(messages)
    return messages


@pytest.mark.parametrize("rate", [0.5, 1.0, 8.0])
def test_bytes_stamps_and_pace_are_those_of_the_log(log: LogFile, rate: float) -> None:
    recorded = list(log.messages(lambda topic, _: topic in SEEN_AND_SAID))
    messages = replay(log, rate)
    assert [(h.stamp_ns, payload) for _, h, payload, _ in messages] == [(x.header.stamp_ns, x.payload) for x in recorded]
    assert [key for key, *_ in messages] == [f"replay/shoal/{x.topic.key(x.robot or None)}" for x in recorded]
    for (_, _, _, at_s), line in zip(messages, recorded, strict=True):
        assert at_s - 100.0 == pytest.approx((line.arrived_ns - recorded[0].arrived_ns) / SECOND / rate, abs=1e-6)


def test_a_part_of_it(log: LogFile) -> None:
    stamps = [header.stamp_ns for _, header, _, _ in replay(log, 1.0, 8.0, 9.0)]
    assert min(stamps) - log.start_ns > 7.9 * SECOND and max(stamps) - log.start_ns < 9.1 * SECOND


def test_replay_publishes_no_topic_that_moves_a_robot(tmp_path: Path) -> None:
    """Of a log with everything in it, also with what no recorder of ours would put there."""
    heartbeat, command = StationHeartbeat("hash"), Command(CommandKind.START, 1)
    moving: dict[Topic, object] = {
        topics.HEARTBEAT: heartbeat,
        topics.COMMANDS: CommandTaken(0, 0, 1, 1, 1, command=command),
        topics.INPUTS: StepInputs(0, heartbeat=heartbeat),
        topics.TICK: Tick(1, 0, 0, (1,), (0,)),
        topics.EXPOSED: Tick(1, 0, 0, (1,)),
        topics.TRAJECTORY: topics.TRAJECTORY.type("t", 0.05),
    }
    experiment = write_run(tmp_path, Script(duration_s=1.0))
    (tmp_path / "run.mcap").unlink()
    recorder = Recorder(tmp_path / "run.mcap", "", {})
    for k, (topic, message) in enumerate([*moving.items(), (topics.PLAN, Plan(0.05)), (topics.POSE, Pose(0.0, 0.0, 0.0))]):
        recorder.put(topic, f"shoal/{topic.key(1)}", Header(9, 1, k), encode(message), k)  # type: ignore[arg-type]
    recorder.put(topics.STATE, "shoal/robot/1/command", Header(9, 1, 9), encode(command), 9)
    recorder.close()
    with open_log(tmp_path) as log:
        messages = replay(log, 1.0)
    assert [key for key, *_ in messages] == ["replay/shoal/robot/1/plan", "replay/shoal/robot/1/pose"]
    assert not set(moving) & set(SEEN_AND_SAID)
    # and with all that goes out a robot still hears no station: it refuses to be armed
    agent = Agent(experiment, 1)
    agent.step(Inputs(), SECOND)
    assert "does not come from the station" in agent.handle_command(Header(9, 1, 0), command, Inputs().station, SECOND).reason


def test_every_topic_is_either_replayed_or_left_out_by_its_kind() -> None:
    """A new topic is not replayed until somebody has thought about it."""
    motion = {topics.HEARTBEAT, topics.TRAJECTORY, topics.TUNING, topics.INPUTS, topics.COMMANDS, topics.FAULT}
    assert set(TOPICS) == set(SEEN_AND_SAID) | motion | {topics.TICK, topics.EXPOSED, topics.FRAME}


def test_no_program_joins_a_replay() -> None:
    for arguments in (["run", "pool", "--fleet", "replay/shoal"], ["mission", "start", "--fleet", "replay/shoal"]):
        done = CliRunner().invoke(cli, arguments)
        assert done.exit_code == 2
        assert "recorded run" in done.output


def test_sending_ends_at_a_stop(log: LogFile) -> None:
    stop, fake = Stop(install=False), Fake()
    hub = MemoryHub()

    def sleep(seconds: float) -> None:
        fake.sleep(seconds)
        if fake.now_s > 102.0:
            stop.request()

    sent = send(Bus(MemoryTransport(hub), "replay/shoal"), chosen(log, 0.0, 1e9), 1.0, stop, fake.clock_s, sleep)
    assert 0 < sent < len(list(chosen(log, 0.0, 1e9))) / 2
