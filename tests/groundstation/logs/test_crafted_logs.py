"""Logs that somebody made to do harm, or that are damaged in odd ways: one message, bounded memory, never a traceback."""

import json
import struct
import tracemalloc
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zstandard
from mcap.writer import MCAP0_MAGIC, Writer
from typer.testing import CliRunner

from groundstation.__main__ import cli
from groundstation.logs.reader import key_topic, open_log, read_log, valid_records
from groundstation.logs.recorder import END_METADATA, Recorder
from groundstation.logs.repair import recover
from groundstation.report.report import write_report
from localizer.evaluation.runner import evaluate_log
from shoal.config.experiment import dump_experiment, load_experiment
from shoal.errors import ConfigError
from shoal.messages import topics
from shoal.messages.codec import Header, encode
from shoal.runtime import mcap_records as log_records
from shoal.runtime.mcap_records import CHANNEL, CHUNK, LARGEST_BYTES, MESSAGE, Damaged
from tests.groundstation.small_log import pose, record_poses, sequences

MIB = 1024 * 1024
MOST = 64 * MIB  # that reading a small file may take in all


def record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def chunk(data: bytes, size: int, packing: str = "zstd") -> bytes:
    """A chunk's record; `size` is what it says to unpack to."""
    return record(
        CHUNK, struct.pack("<QQQII", 0, 1, size, 0, len(packing)) + packing.encode() + struct.pack("<Q", len(data)) + data
    )


def zeros(size: int) -> bytes:
    """So many zeros, packed; as few bytes as a bomb has."""
    packer = zstandard.ZstdCompressor(level=1).compressobj()
    piece = bytes(MIB)
    return b"".join(packer.compress(piece) for _ in range(size // MIB)) + packer.flush()


def packed(data: bytes) -> bytes:
    return zstandard.ZstdCompressor().compress(data)


def bombs() -> Iterator[tuple[str, bytes]]:
    """Chunks that take far more than they are."""
    quarter = zeros(256 * MIB)
    yield "large and says so", chunk(quarter, 256 * MIB)
    yield "large and says it is small", chunk(quarter, 1000)
    small = zeros(16 * MIB)
    yield "many", chunk(small, 16 * MIB) * 200
    messages = packed(record(MESSAGE, struct.pack("<HIQQ", 1, 1, 1, 1)) * 10_000)
    yield "many small messages", chunk(messages, 31 * 10_000) * 500
    yield "records of no length", chunk(packed(bytes(9 * 1_000_000)), 9_000_000)
    yield "a record that is longer than the file", record(CHANNEL, b"")[:1] + struct.pack("<Q", 1 << 62)
    yield "not packed, and longer than its record", chunk(b"abc", 1 << 40, "")
    yield "packed in an unknown way", chunk(b"abc", 3, "rar")


BOMBS = dict(bombs())


@pytest.mark.long
@pytest.mark.parametrize("name", BOMBS)
@pytest.mark.parametrize("closed", [False, True], ids=["cut", "closed"])
def test_a_small_file_never_takes_much_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, closed: bool
) -> None:
    """By every reader: of reports, of replays, of the localizer's evaluation, and in mending."""
    monkeypatch.setattr(log_records, "UNPACKED_AT_LEAST", MIB // 2)  # what is allowed takes a second to read
    monkeypatch.setattr(log_records, "UNPACKED_TIMES", 4)
    path = tmp_path / "run.mcap"
    footer = record(15, bytes(4)) + record(2, bytes(20)) + MCAP0_MAGIC
    path.write_bytes(MCAP0_MAGIC + BOMBS[name] + (footer if closed else b""))
    tracemalloc.start()
    try:
        content = read_log(path)
        assert content.damage and not content.complete and not content.entries
        with pytest.raises(ConfigError, match=r"run\.mcap: (cannot be read|holds no messages)"), open_log(tmp_path) as log:
            list(log.messages(lambda topic, robot: True))
        with pytest.raises(ConfigError):
            evaluate_log(path)
        if next(valid_records(path), None) is not None:
            assert recover(path)
        else:
            before = path.read_bytes()
            with pytest.raises(ConfigError, match="nothing to keep: no record can be read"):
                recover(path)
            assert path.read_bytes() == before and not list(tmp_path.glob("*.original*"))
        assert tracemalloc.get_traced_memory()[1] < MOST
    finally:
        tracemalloc.stop()


def test_records_before_an_oversized_chunk_are_read(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    record_poses(path, 20)
    whole = path.read_bytes()
    end = whole.rindex(record(15, b"")[:1] + struct.pack("<Q", 4))  # the end of the data
    path.write_bytes(whole[:end] + BOMBS["large and says so"])
    assert recover(path)
    assert sequences(path) == list(range(1, 21))


def test_a_flipped_bit_in_a_chunk_ends_what_is_read(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    record_poses(path, 20)
    data = bytearray(path.read_bytes())
    at = data.index(b"zstd") + 60
    data[at] ^= 1
    path.write_bytes(data)
    log = read_log(path)
    assert log.messages == 0 and "chunk" in log.damage and not log.complete


def test_a_files_own_checksum_is_looked_at(tmp_path: Path) -> None:
    good = record(12, struct.pack("<I", 3) + b"run" + struct.pack("<I", 0))
    for checksum, opcodes in ((zlib.crc32(MCAP0_MAGIC + good), [12, 15, 2]), (1, [12])):
        path = tmp_path / "run.mcap"
        path.write_bytes(MCAP0_MAGIC + good + record(15, struct.pack("<I", checksum)) + record(2, bytes(20)) + MCAP0_MAGIC)
        opcodes_read = []
        with path.open("rb") as file:
            try:
                opcodes_read += [opcode for opcode, _ in log_records.records(file)]
            except Damaged as error:
                assert "checksum" in str(error)
                with path.open("rb") as again:
                    opcodes_read += [opcode for opcode, _ in zip_until_damaged(again)]
        assert opcodes_read == opcodes


def zip_until_damaged(file: object) -> Iterator[tuple[int, bytes]]:
    try:
        yield from log_records.records(file)  # type: ignore[arg-type]
    except Damaged:
        return


def write_crafted(folder: Path, key: str, session: str = "1", cut: bool = False, stamp_ns: int = 5, end: str = "{}") -> None:
    """A log with one odd thing in it, and a pose before it."""
    with (folder / "run.mcap").open("wb") as file:
        writer: Any = Writer(file)  # Any: mcap is typed in part
        writer.start(library="somebody")
        schema = writer.register_schema("fleet.Pose", "protobuf", b"")
        good = writer.register_channel("shoal/robot/1/pose", "protobuf", schema, {"session": "1"})
        writer.add_message(good, 1, encode(pose(1)), 1, 1)
        odd = writer.register_channel(key, "protobuf", schema, {"session": session})
        writer.add_message(odd, stamp_ns, encode(pose(1)), stamp_ns, 2)
        writer.add_metadata(END_METADATA, json.loads(end))
        writer.finish()
    (folder / "experiment.toml").write_text(dump_experiment(load_experiment("pool")))


CRAFTED = {
    "a robot of 5000 digits": {"key": f"shoal/robot/{'9' * 5000}/pose"},
    "a robot that is no digit of ours": {"key": "shoal/robot/²/pose"},
    "a session that is no number": {"key": "shoal/robot/2/pose", "session": "zz"},
    "a session that is negative": {"key": "shoal/robot/2/pose", "session": "-1"},
    "a session of 5000 digits": {"key": "shoal/robot/2/pose", "session": "f" * 5000},
    "a stamp that no clock shows": {"key": "shoal/robot/2/pose", "stamp_ns": (1 << 64) - 1},
    "an end that counts in words": {"key": "shoal/robot/2/pose", "end": '{"dropped": "many", "pace": "fast"}'},
    "an end nested too deep": {"key": "shoal/robot/2/pose", "end": json.dumps({"dropped": "9" * 5000, "pace": "[" * 100_000})},
}


@pytest.mark.long
@pytest.mark.parametrize("name", CRAFTED)
def test_no_command_ends_in_a_traceback(tmp_path: Path, name: str) -> None:
    write_crafted(tmp_path, **CRAFTED[name])  # type: ignore[arg-type]
    for command in (
        ["log", "report", str(tmp_path)],
        ["log", "export", str(tmp_path), "--out", str(tmp_path / "tables")],
        ["log", "export", str(tmp_path), "--out", str(tmp_path / "viewer"), "--foxglove"],
        ["log", "repair", str(tmp_path / "run.mcap")],
        ["moment", str(tmp_path), "--at", "1", "--robot", "1"],
    ):
        done = CliRunner().invoke(cli, command)
        assert done.exception is None or isinstance(done.exception, SystemExit | ConfigError), (command, done.exception)


def test_a_record_larger_than_any_of_ours_is_not_read_from_a_large_file_either(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with path.open("wb") as file:
        file.write(MCAP0_MAGIC + struct.pack("<BQ", MESSAGE, LARGEST_BYTES + 1))
        file.truncate(2 * LARGEST_BYTES)  # a hole: no disk is filled
    with path.open("rb") as file, pytest.raises(Damaged, match=f"a record of {LARGEST_BYTES + 1} bytes"):
        next(iter(log_records.records(file)))


@pytest.mark.parametrize(("log_ns", "stamp_ns"), [(1 << 63, 5), (5, 1 << 63)])
def test_either_instant_that_no_clock_shows_damages_its_message(log_ns: int, stamp_ns: int) -> None:
    with pytest.raises(Damaged, match="no clock of ours shows that"):
        log_records.message(struct.pack("<HIQQ", 1, 1, log_ns, stamp_ns))
    latest_ns = (1 << 63) - 1
    log_ns, stamp_ns = min(log_ns, latest_ns), min(stamp_ns, latest_ns)
    assert log_records.message(struct.pack("<HIQQ", 1, 1, log_ns, stamp_ns)) == (1, 1, log_ns, stamp_ns, b"")


def test_an_odd_record_does_not_keep_a_log_from_being_mended(tmp_path: Path) -> None:
    """A channel of a schema that is not there, and a message of a channel that is not."""
    path = tmp_path / "run.mcap"
    record_poses(path, 20)
    whole = path.read_bytes()
    end = whole.rindex(record(15, b"")[:1] + struct.pack("<Q", 4))
    topic = b"shoal/robot/2/pose"
    lost_schema = struct.pack("<HH", 77, 999) + struct.pack("<I", len(topic)) + topic + struct.pack("<I", 0) * 2
    unknown = struct.pack("<HIQQ", 500, 1, 5, 5)
    of_lost = struct.pack("<HIQQ", 77, 21, 6, 6) + encode(pose(1))
    odd = record(CHANNEL, lost_schema) + record(MESSAGE, unknown) + record(MESSAGE, of_lost)
    path.write_bytes(whole[:end] + odd)
    for out in (tmp_path / "viewer",):
        (tmp_path / "experiment.toml").write_text(dump_experiment(load_experiment("pool")))
        done = CliRunner().invoke(cli, ["log", "export", str(tmp_path), "--out", str(out), "--foxglove"])
        assert done.exit_code == 1 and "Damaged log" in done.output  # its last record is missing
        assert len(list(out.iterdir())) == 2
    assert recover(path)
    assert sorted(sequences(path)) == list(range(1, 22))


def test_keys_of_robots_are_numbers_of_three_digits() -> None:
    assert key_topic("shoal/robot/999/pose") == (topics.POSE, 999)
    assert key_topic("robot/1/pose") == (topics.POSE, 1)
    for key in ("shoal/robot/0/pose", "shoal/robot/01/pose", "shoal/robot/1000/pose", "shoal/robot/٣/pose"):
        assert key_topic(key) is None


# --- reports of logs that hold nothing, or not all


def first_line(folder: Path) -> tuple[int, str, str]:
    """Exit code, first line on the terminal, first text of the page."""
    done = CliRunner().invoke(cli, ["log", "report", str(folder)])
    page = (folder / "report.html").read_text()
    body = page[page.index("<main>") :].partition("</p>")[0]
    return done.exit_code, done.output.splitlines()[0], body.rpartition(">")[2]


def test_a_report_of_an_empty_or_cut_log_begins_with_that_and_ends_with_code_1(tmp_path: Path) -> None:
    text, path = dump_experiment(load_experiment("pool")), tmp_path / "run.mcap"
    (tmp_path / "experiment.toml").write_text(text)
    code, line, page = first_line(tmp_path)
    assert (code, line) == (1, page) and line.startswith("No log: there is no run.mcap")
    path.write_bytes(b"")
    code, line, page = first_line(tmp_path)
    assert (code, line) == (1, page) and line.startswith("Empty log: run.mcap holds no message")
    path.unlink()
    record_poses(path, 20)
    whole = path.read_bytes()
    path.write_bytes(whole[: whole.index(b"recorder") - 20])
    for _ in range(2):  # the second time the file itself is whole again
        code, line, page = first_line(tmp_path)
        assert (code, line) == (1, page) and line.startswith("Cut log: run.mcap ends before its run does")
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["notes"][0] == result["log_trouble"] == line
    assert not result["passed"]
    missing = next(check for check in result["checks"] if check["name"] == "messages missing from the log")
    assert (missing["where"], missing["value"], missing["passed"]) == ("Cut log", None, False)


@pytest.mark.parametrize("how", [[], ["--foxglove"]])
def test_export_of_a_cut_log_says_so_and_ends_with_code_1(how: list[str], tmp_path: Path) -> None:
    run, path = tmp_path / "run", tmp_path / "run" / "run.mcap"
    run.mkdir()
    (run / "experiment.toml").write_text(dump_experiment(load_experiment("pool")))
    record_poses(path, 20)
    whole = path.read_bytes()
    path.write_bytes(whole[: whole.index(b"recorder") - 20])
    done = CliRunner().invoke(cli, ["log", "export", str(run), "--out", str(tmp_path / "out"), *how])
    assert done.exit_code == 1 and done.stderr.startswith("Cut log: run.mcap ends before its run does")
    assert list((tmp_path / "out").iterdir())


def test_a_log_with_gaps_says_how_many(tmp_path: Path) -> None:
    write_crafted(tmp_path, "shoal/robot/2/pose", end='{"dropped": "7"}')
    assert write_report(tmp_path).log_trouble == "Log with gaps: the recorder could not take 7 messages."


def test_json_on_stdout_stays_json_and_the_code_stays_1(tmp_path: Path) -> None:
    (tmp_path / "experiment.toml").write_text(dump_experiment(load_experiment("pool")))
    done = CliRunner().invoke(cli, ["log", "report", str(tmp_path), "--json"])
    assert done.exit_code == 1
    assert json.loads(done.stdout)["log_trouble"].startswith("No log")


def test_an_export_for_viewers_into_the_runs_own_folder_keeps_the_log(tmp_path: Path) -> None:
    """In a folder called `run`, the copy's name was once the log's."""
    run = tmp_path / "run"
    run.mkdir()
    write_crafted(run, "shoal/robot/2/pose")
    before = (run / "run.mcap").read_bytes()
    done = CliRunner().invoke(cli, ["log", "export", str(run), "--foxglove", "--out", str(run)])
    assert done.exit_code == 0
    assert (run / "run.mcap").read_bytes() == before
    assert sequences(run / "run-viewer.mcap")


def test_layouts_and_figures_are_written_over_nothing_of_a_run(tmp_path: Path) -> None:
    write_crafted(tmp_path, "shoal/robot/2/pose")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    for name in ("run.mcap", "experiment.toml", "result.json", "report.html"):
        done = CliRunner().invoke(cli, ["foxglove", "layout", "pool", "--out", str(tmp_path / name)])
        assert isinstance(done.exception, ConfigError) and "would be lost" in str(done.exception)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_records_of_a_sound_log_are_those_of_the_recorder(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "run.mcap", "name = 'pool'\n", {"mode": "lockstep"})
    recorder.put(topics.POSE, "shoal/robot/1/pose", Header(7, 3, 5), encode(pose(2)), 6)
    recorder.close()
    kinds = [type(record).__name__ for record in valid_records(tmp_path / "run.mcap")]
    assert {"Attachment", "Metadata", "Schema", "Channel", "Message"} <= set(kinds)
    assert max(map(len, BOMBS.values())) < LARGEST_BYTES  # none is refused for the size of its file


def test_a_chunk_without_its_head_and_a_message_that_is_none_are_told(tmp_path: Path) -> None:
    path, footer = tmp_path / "run.mcap", record(15, bytes(4)) + record(2, bytes(20)) + MCAP0_MAGIC
    path.write_bytes(MCAP0_MAGIC + record(CHUNK, bytes(10)) + footer)
    with pytest.raises(ConfigError, match=r"run\.mcap: cannot be read: byte 8: a chunk of 10 bytes"), open_log(tmp_path):
        pass
    with path.open("wb") as file:
        writer: Any = Writer(file)
        writer.start(library="somebody")
        schema = writer.register_schema("fleet.Pose", "protobuf", b"")
        channel = writer.register_channel("shoal/robot/1/pose", "protobuf", schema, {"session": "1"})
        for k, payload in enumerate((encode(pose(1)), b"\xff", encode(pose(2)))):
            writer.add_message(channel, k + 1, payload, k + 1, k + 1)
        writer.finish()
    content = read_log(path)
    assert (content.messages, content.undecodable) == (3, 1)
