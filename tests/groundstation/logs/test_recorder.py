"""The recorder against mcap's own readers: what went in comes out, after a clean end, kill -9, any cut, and a full disk."""

import itertools
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap_protobuf.decoder import DecoderFactory

from groundstation.logs.reader import is_complete
from groundstation.logs.recorder import FLUSH_PERIOD_S, MAX_PENDING_BYTES, Recorder, check_room
from groundstation.logs.repair import recover
from groundstation.logs.run_folders import delete_run
from shoal.bus.bus import Bus
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.errors import ConfigError
from shoal.messages import topics
from shoal.messages.codec import Header, decode, encode
from shoal.messages.messages import Event, Plan, Pose, Preview, Video
from shoal.messages.topics import Topic
from sim_bridge.sil.ports import free_port
from tests.groundstation.small_log import SECOND, pose, record_poses, sequences
from tests.waiting import eventually

pytestmark = pytest.mark.long


def test_recorded_messages_and_metadata_read_back_unchanged(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    record_poses(path, 50)
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        messages = list(reader.iter_messages())
        decoded = [item.decoded_message for item in reader.iter_decoded_messages()]
        attachment = next(iter(reader.iter_attachments()))
        metadata = {item.name: item.metadata for item in reader.iter_metadata()}
    for k, (schema, channel, message) in enumerate(messages):
        assert schema is not None
        assert (schema.name, schema.encoding, channel.topic) == ("fleet.Pose", "protobuf", "shoal/robot/1/pose")
        assert (message.sequence, message.publish_time, message.log_time) == (k + 1, k * SECOND // 20, k * SECOND // 20 + 1000)
        assert message.data == encode(pose(k))
        assert decode(Pose, message.data, "log", "pose").x_m == pytest.approx(0.01 * k)
        # a viewer that knows nothing of us decodes by the schema in the file
        assert decoded[k].x_m == pytest.approx(0.01 * k)
    assert len(messages) == 50
    assert (attachment.name, attachment.data) == ("experiment.toml", b"name = 'pool'\n")
    assert metadata["run"] == {"mode": "lockstep", "seed": "3"}
    assert metadata["recorder"]["dropped"] == "0"


def test_foxglove_schemas_carry_their_dependencies(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    recorder = Recorder(path, "", {})
    recorder.put(topics.EVENT, "shoal/event", Header(1, 1, SECOND), encode(Event(3, "agent-1", "pose lost"), SECOND), SECOND)
    recorder.put(topics.PREVIEW, "shoal/camera/preview", Header(2, 1, SECOND), encode(Preview(b"jpeg"), SECOND), SECOND)
    recorder.close()
    with path.open("rb") as file:
        decoded = [
            item.decoded_message for item in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
        ]
    assert decoded[0].message == "pose lost"
    assert decoded[0].timestamp.seconds == 1
    assert decoded[1].data == b"jpeg"


def test_a_restarted_sender_gets_a_channel_of_its_own(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    recorder = Recorder(path, "", {})
    for session in (0xA, 0xB):
        recorder.put(topics.POSE, "shoal/robot/1/pose", Header(session, 1, 0), encode(pose(0)), 0)
    recorder.close()
    with path.open("rb") as file:
        sessions = [channel.metadata["session"] for _, channel, _ in make_reader(file).iter_messages()]
    assert sorted(sessions) == ["a", "b"]


def test_headers_outside_mcaps_ranges_do_not_stop_the_log(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    recorder = Recorder(path, "", {})
    recorder.put(topics.POSE, "shoal/robot/1/pose", Header(1, 1, -5), encode(pose(0)), -1)
    recorder.put(topics.POSE, "shoal/robot/1/pose", Header(1, 2, 5), b"\xff not protobuf", 5)
    recorder.close()
    assert recorder.error == ""
    assert sequences(path) == [1, 2]


def test_put_from_many_threads_loses_nothing(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    recorder = Recorder(path, "", {})

    def sender(robot: int) -> None:
        for k in range(500):
            recorder.put(topics.POSE, f"shoal/robot/{robot}/pose", Header(robot, k + 1, k), encode(pose(k)), k)

    threads = [threading.Thread(target=sender, args=(robot,)) for robot in range(1, 5)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    recorder.close()
    assert sorted(sequences(path)) == sorted([*range(1, 501)] * 4)


def test_messages_before_the_end_are_recorded(tmp_path: Path) -> None:
    """Gathered from the bus: the last messages too, though nobody has looked for them yet. What comes later is not."""
    hub, path = MemoryHub(), tmp_path / "run.mcap"
    sender, recorder = Bus(MemoryTransport(hub)), Recorder(path, "", {})
    receiver = Bus(MemoryTransport(hub))
    recorder.gather([receiver.collect(topics.POSE), receiver.collect(topics.EVENT)], lambda header: header.stamp_ns + 5)
    for k in range(200):
        sender.publish(topics.POSE, pose(k), k, robot=1 + k % 3)
        sender.publish(topics.EVENT, Event(2, "agent-1", "line"), k)
    recorder.close()
    sender.publish(topics.POSE, pose(200), 200, robot=1)
    with path.open("rb") as file:
        messages = [(c.topic, m.publish_time, m.log_time) for _, c, m in make_reader(file).iter_messages()]
    assert sorted(messages) == sorted(
        (key, k, k + 5) for k in range(200) for key in (f"shoal/robot/{1 + k % 3}/pose", "shoal/event")
    )


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_source_of_messages_that_fails_stops_the_log_and_says_so(tmp_path: Path) -> None:
    def source() -> Iterator[tuple[Topic, str, Header, bytes]]:
        raise MemoryError("no room for a message")

    recorder = Recorder(tmp_path / "run.mcap", "", {})
    recorder.gather([source], lambda header: header.stamp_ns)
    recorder.close()
    assert recorder.error == "log stopped: MemoryError: no room for a message"


def test_a_lockstep_log_ends_with_a_whole_step(tmp_path: Path) -> None:
    """Of the last step some robots have told and some have not: of that none is in the log, of all others everything."""
    recorder = Recorder(tmp_path / "run.mcap", "", {})
    recorder.whole_until_ns = -1
    for k in range(4):
        for robot in (1, 2) if k < 3 else (1,):
            recorder.put(
                topics.PLAN, f"shoal/robot/{robot}/plan", Header(robot, k, k * SECOND), encode(Plan(0.05)), k * SECOND
            )
        recorder.put(topics.POSE, "shoal/robot/2/pose", Header(3, k, k * SECOND), encode(pose(k)), k * SECOND)
        recorder.whole_until_ns = (k - 1) * SECOND
        time.sleep(0.4 * FLUSH_PERIOD_S)  # some of it is written meanwhile
    recorder.whole_until_ns = 2 * SECOND
    recorder.close()
    with (tmp_path / "run.mcap").open("rb") as file:
        messages = sorted((channel.topic, message.sequence) for _, channel, message in make_reader(file).iter_messages())
    assert messages == sorted(
        [(f"shoal/robot/{robot}/plan", k) for robot in (1, 2) for k in range(3)]
        + [("shoal/robot/2/pose", k) for k in range(4)]
    )
    assert recorder.dropped == 0


def test_messages_beyond_the_memory_limit_are_dropped_and_counted(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    recorder = Recorder(path, "", {})
    half = bytes(MAX_PENDING_BYTES // 2 + 1)
    # the writer thread takes messages at once unless it is held up here
    recorder._write_pending = lambda: None  # type: ignore[method-assign]  # as while the disk hangs
    recorder.put(topics.PREVIEW, "shoal/camera/preview", Header(1, 1, 0), half, 0)
    assert recorder.error == ""
    recorder.put(topics.PREVIEW, "shoal/camera/preview", Header(1, 2, 0), half, 0)
    assert recorder.dropped == 1
    assert recorder.error == "1 messages are lost: the disk does not take them as fast as they come"
    recorder.close()


def test_messages_after_the_end_are_not_recorded(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "run.mcap", "", {})
    recorder.close()
    recorder.close()
    recorder.put(topics.POSE, "shoal/robot/1/pose", Header(1, 1, 0), encode(pose(0)), 0)
    assert (recorder.dropped, recorder.error) == (0, "")
    assert sequences(tmp_path / "run.mcap") == []


def test_a_missing_folder_is_refused_at_once(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="No such file"):
        Recorder(tmp_path / "missing" / "run.mcap", "", {})


CHILD = """
import sys, time
from pathlib import Path
from groundstation.logs.recorder import Recorder
from shoal.messages import topics
from shoal.bus.bus import Bus
from shoal.messages.codec import Header, encode
from shoal.messages.messages import Preview
import random
recorder = Recorder(Path(sys.argv[1]), "name = 'pool'", {})
noise = random.Random(1)
for k in range(1, 100_000):
    payload = encode(Preview(noise.randbytes(1000)), 0)
    recorder.put(topics.PREVIEW, "shoal/camera/preview", Header(1, k, 0), payload, time.monotonic_ns())
    sys.stdout.write(f"{k} {time.monotonic_ns()}\\n")
    sys.stdout.flush()
    time.sleep(0.01)
"""


def test_kill_9_loses_less_than_a_second(tmp_path: Path) -> None:
    """100 kB/s, killed at random moments: one second may be lost."""
    rng = random.Random(11)
    paths = [tmp_path / f"{k}.mcap" for k in range(4)]
    children = [
        subprocess.Popen([sys.executable, "-c", CHILD, str(path)], stdout=subprocess.PIPE, text=True) for path in paths
    ]
    put: list[list[tuple[int, int]]] = []
    for child in children:
        assert child.stdout is not None
        head = list(itertools.islice(child.stdout, 60 + rng.randrange(80)))  # then kill: 0.6 to 1.4 s of log
        child.send_signal(signal.SIGKILL)
        head += [line for line in child.stdout if line.endswith("\n")]
        child.wait()
        put.append([(int(sequence), int(at)) for sequence, at in (line.split() for line in head)])
    for path, lines in zip(paths, put, strict=True):
        assert recover(path)
        numbers = sequences(path)
        assert numbers == list(range(1, len(numbers) + 1))
        last_put_ns = lines[-1][1]
        first_lost = next((at for sequence, at in lines if sequence > len(numbers)), last_put_ns)
        assert (last_put_ns - first_lost) / 1e9 <= 1.0


FULL = """
import resource, sys, time
from pathlib import Path
from groundstation.logs.recorder import Recorder
from shoal.messages import topics
from shoal.bus.bus import Bus
from shoal.messages.codec import Header, encode
from shoal.messages.messages import Preview
import random
resource.setrlimit(resource.RLIMIT_FSIZE, (500_000, 500_000))
recorder = Recorder(Path(sys.argv[1]), "name = 'pool'", {})
noise = random.Random(1)
for k in range(1, 10_000):
    recorder.put(topics.PREVIEW, "shoal/camera/preview", Header(1, k, 0), encode(Preview(noise.randbytes(20_000)), 0), k)
    if recorder.error:
        break
    time.sleep(0.05)
dropped = recorder.dropped
recorder.put(topics.PREVIEW, "shoal/camera/preview", Header(1, k + 1, 0), b"", k)
recorder.close()
print(k, recorder.dropped - dropped, recorder.error)
"""


def test_a_full_disk_stops_only_the_log(tmp_path: Path) -> None:
    """A file-size limit fails writes as a full disk does, half-way through a write."""
    path = tmp_path / "run.mcap"
    done = subprocess.run([sys.executable, "-c", FULL, str(path)], capture_output=True, text=True, timeout=60, check=True)
    last, dropped_after, error = done.stdout.split(maxsplit=2)
    assert "log stopped: File too large" in error
    assert int(dropped_after) == 1
    assert done.stderr == ""
    assert not is_complete(path)
    assert path.stat().st_size < 500_000  # the half-written record is gone
    assert recover(path)
    numbers = sequences(path)
    assert numbers == list(range(1, len(numbers) + 1))
    assert 2 <= len(numbers) < int(last)


def test_put_returns_at_once_while_the_disk_hangs(tmp_path: Path) -> None:
    """The writer waits for the disk without holding the lock that `put` takes."""
    recorder = Recorder(tmp_path / "run.mcap", "", {})
    hanging, release = threading.Event(), threading.Event()

    def hang() -> None:
        hanging.set()
        release.wait(30.0)

    # the recorder opens its file itself, so a disk that hangs can only be put in here
    recorder._output.sync = hang  # type: ignore[method-assign]
    assert hanging.wait(30.0)
    for k in range(100):  # would block for ever if the lock were held
        recorder.put(topics.POSE, "shoal/robot/1/pose", Header(1, k + 1, k), encode(pose(k)), time.time_ns())
    release.set()
    recorder.close()
    assert recorder.dropped == 0


def test_a_filling_disk_drops_pictures_first_with_a_warning(tmp_path: Path) -> None:
    """Messages go on into the log; room that comes back later changes nothing."""
    path, free = tmp_path / "run.mcap", [10_000]
    recorder = Recorder(path, "", {}, stop_pictures_below=1000, free_bytes=lambda folder: free[0])

    def put(k: int) -> None:
        recorder.put(topics.VIDEO, "shoal/camera/video", Header(1, k, k), encode(Video(b"film"), k), k)
        recorder.put(topics.POSE, "shoal/robot/1/pose", Header(1, k, k), encode(pose(k)), k)

    put(1)
    time.sleep(2.5 * FLUSH_PERIOD_S)
    assert recorder.warning == ""
    free[0] = 999
    deadline = time.monotonic() + 2.0  # as soon as this somebody must know
    while not recorder.warning and time.monotonic() < deadline:
        time.sleep(0.01)
    assert "pictures are not recorded any longer: 0.00 GB" in recorder.warning
    put(2)
    free[0] = 10_000
    time.sleep(1.5 * FLUSH_PERIOD_S)
    put(3)
    recorder.close()
    assert (recorder.error, recorder.dropped) == ("", 0)
    with path.open("rb") as file:
        messages = [(channel.topic, message.sequence) for _, channel, message in make_reader(file).iter_messages()]
    assert sorted(messages) == [("shoal/camera/video", 1), *(("shoal/robot/1/pose", k) for k in (1, 2, 3))]


def test_no_run_begins_without_room_for_its_log(tmp_path: Path) -> None:
    check_room(tmp_path, 0.0)
    with pytest.raises(ConfigError, match=r"GB free, a run needs 1e\+06 \(recording.min_free_gb\)"):
        check_room(tmp_path, 1e6)
    command = [
        sys.executable,
        "-m",
        "groundstation",
        "run",
        "pool",
        "--no-web",
        "--set",
        "recording.min_free_gb=1e6",
    ]
    listen = ["--listen", f"tcp/127.0.0.1:{free_port()}", "--run-dir", str(tmp_path / "run")]
    done = subprocess.run([*command, *listen], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2
    assert "recording.min_free_gb" in done.stderr
    assert not (tmp_path / "run" / "run.mcap").exists()


def test_the_end_comes_behind_the_last_message(tmp_path: Path) -> None:
    """A log cut anywhere before its end lacks the note that it is whole."""
    record_poses(tmp_path / "run.mcap", 20)
    with (tmp_path / "run.mcap").open("rb") as file:
        kinds = [type(record).__name__ for record in StreamReader(file, emit_chunks=True).records]
    assert kinds.index("DataEnd") - 1 == len(kinds) - 1 - kinds[::-1].index("Metadata")
    assert kinds[: kinds.index("DataEnd") - 1].count("Chunk") == kinds.count("Chunk") == 1


def test_a_log_that_is_deleted_under_its_recorder_is_missed_while_the_run_goes_on(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "run.mcap", "", {})
    (tmp_path / "run.mcap").unlink()
    assert eventually(lambda: "was deleted" in recorder.error, 30.0)
    recorder.close()
    assert not list(tmp_path.iterdir())


def test_a_run_whose_log_has_stopped_is_not_deleted_while_it_flies(tmp_path: Path) -> None:
    folder = tmp_path / "pool-20260101-120000"
    folder.mkdir()
    recorder = Recorder(folder / "run.mcap", "", {})
    failed = threading.Event()

    def fail() -> None:
        failed.set()
        raise OSError(28, "No space left on device")

    # the recorder opens its file itself, so a disk that fails can only be put in here
    recorder._output.sync = fail  # type: ignore[method-assign]
    assert failed.wait(30.0) and eventually(lambda: bool(recorder.error), 30.0)
    with pytest.raises(ConfigError, match="its run still goes on"):
        delete_run(folder)
    recorder.close()
    delete_run(folder)
    assert not folder.exists()
