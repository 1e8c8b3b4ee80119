"""The recorder under the load of a fleet: 20 robots at 20 Hz and the camera's film. Its share of a core, what did not get into
the log, what SIGKILL costs, and whether a robot's control notices it: the time from a pose's sending to the pulses that answer
it, steps that came late, and poses that no step answered.

    python -m benchmarks recorder                  # two minutes
    python -m benchmarks.groundstation.recorder --kills 200      # the kills of the requirement, four at a time (3 minutes)

Beside it the writer that Foxglove's SDK brings (Rust, bytes handed over from the same callbacks), and no recorder at all: the
station's process as router only.
"""

import contextlib
import mmap
import multiprocessing
import random
import resource
import signal
import struct
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Annotated, Any

import foxglove
import numpy as np
import typer
from mcap.records import Channel, Message
from mcap_protobuf.schema import build_file_descriptor_set

from benchmarks.harness import Row
from benchmarks.shoal.fleet_load import ROBOTS, VARIANTS, load
from groundstation.logs.reader import valid_records
from groundstation.logs.recorder import Recorder
from groundstation.logs.repair import recover
from groundstation.planning import planner
from groundstation.station.process import record_everything
from robot_agent.agent import Agent
from robot_agent.inputs import Inputs, StampedPose, StationView
from shoal.bus.bus import Bus
from shoal.bus.endpoint import Endpoint
from shoal.bus.zenoh_transport import ZenohTransport
from shoal.config.experiment import load_experiment
from shoal.messages import topics
from shoal.messages.codec import Header, protobuf_class
from shoal.messages.messages import BoardReading, Pose, Track
from shoal.messages.topics import Role, Topic
from shoal.runtime.runtime import WallClock
from sim_bridge.sil.ports import free_port

RATE_HZ = 20
CONTROLLED = 99  # the robot whose control is measured: what it says of itself
SETTLE_S, MEASURE_S = 2.0, 10.0
DRAIN_S = 1.0  # after the last message, before the log is closed
ROUNDS = 2  # of all ways of recording, in turn: what else the machine does then meets all of them
LATE_MS = 25.0  # half a control period: a step's budget
KILLS, AT_ONCE = 12, 4
KILL_AFTER_S = (1.5, 3.0)  # of recording: several flushes, at any phase of the next

# --- three processes: who sends, who records (or only routes), and one robot's control beside them


def _send(address: str, pipe: Connection, stop: Any) -> None:
    """As in a fleet each robot has a session of its own, and one is everybody else's. Tells when it begins, and in the end how
    many messages it sent."""
    messages, clock = load(), WallClock()
    with contextlib.ExitStack() as open_:
        buses = {r: open_.enter_context(Bus(ZenohTransport(Endpoint(address)))) for r in (None, *range(1, ROBOTS + 1))}

        def send(period: Iterable[tuple[Topic, int | None, bytes]]) -> None:
            for topic, robot, payload in period:
                buses[robot if Role.ROBOT in topic.writers else None].forward(topic, payload, clock.now_ns(), robot)

        send(messages[0])
        time.sleep(SETTLE_S)  # until router and publishers know of one another: those before do not count
        pipe.send("begins")
        begin_s, k = time.monotonic(), 0
        while not stop.is_set():
            send(messages[k % VARIANTS])
            k += 1
            time.sleep(max(begin_s + k / RATE_HZ - time.monotonic(), 0.0))
        time.sleep(DRAIN_S)  # what lies in its own queues is sent, too
        pipe.send(k * len(messages[0]))


def _foxglove_writer(bus: Bus, path: Path) -> Callable[[], None]:
    """Foxglove's own MCAP writer behind the same subscriptions."""
    context = foxglove.Context()
    writer = foxglove.open_mcap(path, context=context)
    channels: dict[str, Any] = {}

    def raw(topic: Topic, key: str, header: Header, payload: bytes) -> None:
        if key not in channels:
            cls = protobuf_class(topic.type)
            files = build_file_descriptor_set(cls).SerializeToString()
            schema = foxglove.Schema(name=cls.DESCRIPTOR.full_name, encoding="protobuf", data=files)
            channels[key] = foxglove.Channel(key, schema=schema, message_encoding="protobuf", context=context)
        channels[key].log(payload, log_time=time.time_ns())

    for topic in topics.TOPICS:
        if topic.recorded:
            bus.subscribe(topic, None, raw)
    return writer.close


def _record(address: str, kind: str, folder: str, pipe: Connection) -> None:
    """Be the router, and perhaps record. Tells its CPU time over the measurement, which another begins, and how many messages
    of the senders are in the log, but for those of the first period."""
    with Bus(ZenohTransport(Endpoint(address, router=True))) as bus:
        path = Path(folder) / "run.mcap"
        close: Callable[[], None] | None = None
        if kind == "ours":
            recorder = Recorder(path, "", {}, stop_pictures_below=1)
            record_everything(bus, recorder, WallClock())
            close = recorder.close
        elif kind == "foxglove-sdk":
            close = _foxglove_writer(bus, path)
        pipe.send("ready")
        pipe.recv()
        begin = resource.getrusage(resource.RUSAGE_SELF)
        time.sleep(MEASURE_S)
        end = resource.getrusage(resource.RUSAGE_SELF)
        pipe.send(end.ru_utime - begin.ru_utime + end.ru_stime - begin.ru_stime)
        pipe.recv()
        if close is not None:
            close()
        pipe.send(_senders_messages(path) if path.exists() else 0)


def _senders_messages(path: Path) -> int:
    """The number of messages in a log, less the first on each key, which was sent before the measurement."""
    channels: dict[int, str] = {}
    count = 0
    for record in valid_records(path):
        if isinstance(record, Channel):
            channels[record.id] = record.topic
        elif isinstance(record, Message):
            count += channels[record.channel_id] != f"shoal/{topics.STATE.key(CONTROLLED)}"
    return count - len(set(channels.values()) - {f"shoal/{topics.STATE.key(CONTROLLED)}"})


def _control(address: str, pipe: Connection, stop: Any) -> None:
    """One robot's control loop on what goes round. Tells when it is ready, and in the end the time of each step in ms, from
    the pose's sending to the pulses, and how many poses no step answered."""
    experiment = load_experiment("pool")
    agent, clock = Agent(experiment, 1), WallClock()
    planner.plan(experiment)
    took_ms: list[float] = []
    sequences: list[int] = []
    with Bus(ZenohTransport(Endpoint(address))) as bus:
        poses = bus.inbox(topics.POSE, Pose, 1)
        newest = None
        pipe.send("ready")
        while not stop.is_set():
            if not bus.wait(lambda last=newest: poses.newest_header() is not last, 0.2):  # type: ignore[misc]
                continue
            newest, received = poses.newest_header(), poses.newest()
            if received is None:
                continue
            now_ns = clock.now_ns()
            pose = Pose(0.3, 0.2, 0.1, received.message.covariance, Track.MARKER, True, 0.9, 0.3)
            inputs = Inputs(
                StampedPose(pose, now_ns), BoardReading(board_ms=1, arrival_ns=now_ns), StationView(1, now_ns, 0.0)
            )
            state = agent.step(inputs, now_ns).state
            took_ms.append((clock.now_ns() - received.header.stamp_ns) * 1e-6)
            sequences.append(received.header.sequence)
            bus.publish(topics.STATE, state, now_ns, CONTROLLED)
    pipe.send((took_ms[1:], sequences[-1] - sequences[1] + 1 - len(sequences[1:])))  # the first came before the measurement


@dataclass(frozen=True)
class Measured:
    """Figures of one way of recording."""

    share: float  # of a core
    sent: int
    recorded: int
    control_ms: list[float]
    unanswered: int  # poses


def measure(kind: str) -> Measured:
    """Run the three processes."""
    processes = multiprocessing.get_context("spawn")
    stop, address = processes.Event(), f"tcp/127.0.0.1:{free_port()}"
    pipes = [processes.Pipe() for _ in range(3)]
    (recorder, at_recorder), (sender, at_sender), (control, at_control) = pipes
    with tempfile.TemporaryDirectory() as folder:
        recording = processes.Process(target=_record, args=(address, kind, folder, at_recorder))
        recording.start()
        recorder.recv()
        controlling = processes.Process(target=_control, args=(address, at_control, stop))
        controlling.start()
        control.recv()
        sending = processes.Process(target=_send, args=(address, at_sender, stop))
        sending.start()
        for at_child in (at_recorder, at_control, at_sender):
            at_child.close()  # so that a child that fails is told of here, and not waited for
        recorder.send(sender.recv())
        cpu_s = recorder.recv()
        stop.set()
        sent, (control_ms, unanswered) = sender.recv(), control.recv()
        recorder.send("close")
        recorded = recorder.recv()
        for process in (recording, controlling, sending):
            process.join(10.0)
    return Measured(cpu_s / MEASURE_S, sent, recorded, control_ms, unanswered)


# --- SIGKILL


def _until_killed(path: str, shared: str) -> None:
    """Record the same load at its pace, telling in shared memory when the last message was handed over."""
    messages = load()
    with Path(shared).open("r+b") as file, mmap.mmap(file.fileno(), 8) as memory:
        recorder = Recorder(Path(path), "", {}, stop_pictures_below=1)
        begin_s, k = time.monotonic(), 0
        while True:
            for topic, robot, payload in messages[k % VARIANTS]:
                now_ns = time.monotonic_ns()
                recorder.put(topic, f"shoal/{topic.key(robot)}", Header(1, k, now_ns), payload, now_ns)
                memory[:] = struct.pack("<q", now_ns)
            k += 1
            time.sleep(max(begin_s + k / RATE_HZ - time.monotonic(), 0.0))


def kill_once(seed: int) -> float:
    """Seconds of log that a kill at a random moment costs."""
    processes = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as folder:
        path, shared = Path(folder) / "run.mcap", Path(folder) / "last"
        shared.write_bytes(bytes(8))
        child = processes.Process(target=_until_killed, args=(str(path), str(shared)))
        child.start()
        while not struct.unpack("<q", shared.read_bytes())[0]:
            time.sleep(0.01)
        time.sleep(random.Random(seed).uniform(*KILL_AFTER_S))
        assert child.pid is not None
        child.kill()
        child.join()
        assert child.exitcode == -signal.SIGKILL
        last_ns = struct.unpack("<q", shared.read_bytes())[0]
        recover(path)
        kept_ns = max(record.log_time for record in valid_records(path) if isinstance(record, Message))
        return float(last_ns - kept_ns) * 1e-9


def kills(count: int) -> Row:
    """Losses over many kills."""
    with ThreadPoolExecutor(AT_ONCE) as pool:
        lost_s = list(pool.map(kill_once, range(count)))
    return Row.of("recorder", "lost by SIGKILL", "ours", "s", lost_s)


def run(count: int = KILLS) -> Iterator[Row]:
    """Share of a core, what is missing, control beside it, kills."""
    kinds = ("no recorder", "ours", "foxglove-sdk")
    rounds = [{kind: measure(kind) for kind in kinds} for _ in range(ROUNDS)]

    def row(case: str, kind: str, unit: str, values: Iterable[float]) -> Row:
        return Row.of("recorder", case, kind, unit, values)

    case = f"{ROBOTS} robots at {RATE_HZ} Hz, film"
    for kind in kinds:
        yield row(f"{case}: station's process", kind, "% of a core", [100.0 * counts[kind].share for counts in rounds])
    for kind in kinds[1:]:
        shares = [100.0 * (counts[kind].share - counts["no recorder"].share) for counts in rounds]
        yield row(f"{case}: of it recording", kind, "% of a core", shares)
    for kind in kinds[1:]:
        missing = [100.0 * (1.0 - counts[kind].recorded / counts[kind].sent) for counts in rounds]
        yield row("messages not recorded", kind, "%", missing)
    for kind in kinds:
        times_ms = [ms for counts in rounds for ms in counts[kind].control_ms]
        yield row("control beside it, pose sent to pulses", kind, "ms", times_ms)
    for kind in kinds:
        late = [100.0 * float(np.mean(np.array(counts[kind].control_ms) > LATE_MS)) for counts in rounds]
        yield row(f"control beside it, steps over {LATE_MS:g} ms", kind, "%", late)
    for kind in kinds:
        unanswered = [float(counts[kind].unanswered) for counts in rounds]
        yield row("control beside it, poses without a step", kind, "1", unanswered)
    yield kills(count)


def main(count: Annotated[int, typer.Option("--kills", help="How many.")] = 200) -> None:
    """Run only the kills."""
    row = kills(count)
    print(
        f"{row.n} kills: lost {row.p50:.2f} s in the median, {row.p99:.2f} s at the 99th percentile, {row.max:.2f} s at worst"
    )


if __name__ == "__main__":
    typer.run(main)
