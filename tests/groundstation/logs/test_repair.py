"""Logs that were cut, anywhere: what is good is kept, the rest does no harm, and a cut file is not lost in the mending."""

import random
import resource
import struct
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.records import Message
from mcap.writer import MCAP0_MAGIC

from groundstation.logs.reader import is_complete, open_log, read_log, valid_messages, valid_records
from groundstation.logs.recorder import Recorder
from groundstation.logs.repair import recover
from groundstation.report.report import write_report
from shoal.config.experiment import dump_experiment, load_experiment
from shoal.errors import ConfigError
from shoal.messages import topics
from shoal.messages.codec import Header, encode
from shoal.messages.messages import Preview
from tests.groundstation.small_log import record_poses, sequences
from tests.waiting import eventually


def test_recover_leaves_a_whole_file_alone(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    record_poses(path, 5)
    before = path.read_bytes()
    assert is_complete(path)
    assert recover(path) is False
    assert path.read_bytes() == before


def several_flushes(path: Path) -> None:
    """A file of several chunks, as a run of some seconds has."""
    recorder = Recorder(path, "name = 'pool'\n", {"mode": "lockstep"})
    put_previews(recorder, 1, 8)
    recorder.close()


def put_previews(recorder: Recorder, first: int, last: int) -> None:
    """Record previews with these numbers."""
    for k in range(first, last + 1):
        payload = encode(Preview(random.Random(k).randbytes(150_000)), 0)  # incompressible: two fill a chunk
        recorder.put(topics.PREVIEW, "shoal/camera/preview", Header(1, k, k), payload, k)


def test_any_cut_leaves_a_readable_beginning(tmp_path: Path) -> None:
    """kill -9 and power loss cut anywhere: between records, within one, within the index that close writes."""
    whole = tmp_path / "whole.mcap"
    several_flushes(whole)
    data = whole.read_bytes()
    rng = random.Random(5)
    cuts = [0, 1, 8, 9, len(data) - 1, len(data) - 8, len(data) - 9, *(rng.randrange(len(data)) for _ in range(40))]
    cuts += [len(data) - rng.randrange(3000) for _ in range(40)]  # the index
    kept_before = 0
    for cut in sorted(cuts):
        path = tmp_path / "cut.mcap"
        path.write_bytes(data[:cut])
        if is_complete(path):
            continue
        records = list(valid_records(path))
        expected = [record.sequence for record in records if isinstance(record, Message)]
        if not records:  # what was not mended is not called so
            with pytest.raises(ConfigError, match="nothing to keep"):
                recover(path)
            assert path.read_bytes() == data[:cut] and not path.with_name("cut.mcap.original").exists()
            continue
        assert recover(path) is True
        numbers = sequences(path)
        assert numbers == expected == list(range(1, len(numbers) + 1))
        assert len(numbers) >= kept_before  # a later cut never keeps less
        kept_before = len(numbers)
    assert kept_before == 8
    assert not list(tmp_path.glob(".*"))


def test_an_open_cut_log_has_the_messages_that_mending_keeps(tmp_path: Path) -> None:
    whole, path = tmp_path / "whole.mcap", tmp_path / "run.mcap"
    several_flushes(whole)
    data, rng = whole.read_bytes(), random.Random(7)
    counts: set[int] = set()
    for cut in sorted(rng.randrange(len(data) // 4, len(data)) for _ in range(20)):
        path.write_bytes(data[:cut])
        before = path.read_bytes()
        with open_log(tmp_path) as log:
            opened = [line.header.sequence for line in log.messages(lambda topic, robot: topic is topics.PREVIEW)]
        assert path.read_bytes() == before
        recover(path)
        assert opened == sequences(path)
        counts.add(len(opened))
    assert len(counts) > 2


def test_one_damaged_chunk_of_a_cut_log_costs_that_chunk_alone(tmp_path: Path) -> None:
    """A power cut and one bad sector: all that lies behind the damage is kept, and what was lost is told ever after."""
    path = tmp_path / "run.mcap"
    several_flushes(path)
    whole = path.read_bytes()
    damaged = bytearray(whole[:-50])
    damaged[len(whole) // 2] ^= 0x10
    path.write_bytes(damaged)
    log = read_log(path, ())
    assert recover(path)
    left = sequences(path)
    assert 4 <= len(left) < 8 and left[-1] == 8
    assert (tmp_path / "run.mcap.original").read_bytes() == damaged
    mended = read_log(path, ())
    assert "checksum" in log.damage and "checksum" in mended.damage and mended.trouble.startswith("Damaged log")
    assert mended.messages == log.messages == len(left)


def test_a_closed_log_with_a_damaged_chunk_is_mended_and_says_so(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    several_flushes(path)
    damaged = bytearray(path.read_bytes())
    damaged[len(damaged) // 2] ^= 0x10
    path.write_bytes(damaged)
    assert read_log(path, ()).trouble.startswith("Damaged log")
    assert recover(path)
    assert sequences(path)[-1] == 8
    assert read_log(path, ()).trouble.startswith("Damaged log")
    assert recover(path) is False
    assert [file.name for file in tmp_path.glob("*.original*")] == ["run.mcap.original"]


@pytest.mark.parametrize("is_cut", [False, True])
def test_the_chunk_that_declares_the_channels_costs_no_other_when_it_is_damaged(is_cut: bool, tmp_path: Path) -> None:
    whole, path = tmp_path / "whole.mcap", tmp_path / "run.mcap"
    recorder = Recorder(whole, "name = 'pool'\n", {})
    put_previews(recorder, 1, 3)
    assert eventually(lambda: whole.stat().st_size > 400_000)  # the rest comes with another flush
    put_previews(recorder, 4, 8)
    recorder.close()
    data = bytearray(whole.read_bytes())
    data[100_000] ^= 0xFF  # in the first chunk
    path.write_bytes(data[:-50] if is_cut else data)
    kept = [line.header.sequence for line in valid_messages(path)]
    assert len(kept) >= 5 and kept == list(range(9 - len(kept), 9))
    if is_cut:
        with open_log(tmp_path) as log:
            assert [line.header.sequence for line in log.messages(lambda topic, robot: True)] == kept
    assert recover(path)
    assert sequences(path) == kept


def test_a_damaged_experiment_of_a_log_is_left_out_and_named(tmp_path: Path) -> None:
    """One other digit in it would be another limit, and the report would judge the run by that."""
    path = tmp_path / "run.mcap"
    record_poses(path, 20)
    damaged = bytearray(path.read_bytes())
    damaged[damaged.index(b"experiment.toml") + 60] ^= 0x01
    path.write_bytes(damaged)
    read = read_log(path)
    assert not read.experiment_toml and "an attachment's checksum is wrong" in read.damage
    assert recover(path) is True
    mended = read_log(path)
    assert "an attachment's checksum is wrong" in mended.damage and len(sequences(path)) == 20
    assert (tmp_path / "run.mcap.original").read_bytes() == damaged


def test_an_impossible_length_ends_reading(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    lying = struct.pack("<QQII", 0, 0, 0, 0) + struct.pack("<Q", 1 << 53)  # an attachment: times, name, type, length of data
    path.write_bytes(MCAP0_MAGIC + b"\x09" + struct.pack("<Q", len(lying) + 4) + lying + bytes(4))
    assert list(valid_records(path)) == []


def test_recovered_file_keeps_experiment_metadata_and_sessions(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    record_poses(path, 20, session=0xBEEF)
    path.write_bytes(path.read_bytes()[:-100])
    assert recover(path)
    with path.open("rb") as file:
        reader = make_reader(file)
        assert next(iter(reader.iter_attachments())).data == b"name = 'pool'\n"
        assert {item.name: item.metadata for item in reader.iter_metadata()}["run"]["mode"] == "lockstep"
        assert {channel.metadata["session"] for _, channel, _ in reader.iter_messages()} == {"beef"}


def test_a_log_that_is_still_written_is_left_alone(tmp_path: Path) -> None:
    """A report of a run that goes on would put a mended copy in its place: the rest would go into a file without a name."""
    path = tmp_path / "run.mcap"
    recorder = Recorder(path, dump_experiment(load_experiment("pool")), {})
    (tmp_path / "experiment.toml").write_text(dump_experiment(load_experiment("pool")))

    def put(first: int, last: int) -> None:
        for k in range(first, last + 1):
            recorder.put(topics.PREVIEW, "shoal/camera/preview", Header(1, k, k), encode(Preview(b"x"), 0), k)

    put(1, 5)
    with pytest.raises(OSError, match="still goes on"):
        recover(path)
    write_report(tmp_path)
    with pytest.raises(OSError, match="is there already, and would be lost"):
        Recorder(path, "", {})
    put(6, 10)
    recorder.close()
    assert recorder.error == ""
    assert sequences(path) == list(range(1, 11))


def test_recover_without_room_keeps_the_cut_file(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    several_flushes(path)
    cut = path.read_bytes()[:-50]
    path.write_bytes(cut)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, before[1]))
    try:
        with pytest.raises(OSError, match="too large"):
            recover(path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert path.read_bytes() == cut
    assert not list(tmp_path.glob(".*"))


def test_links_in_a_runs_folder_are_not_followed(tmp_path: Path) -> None:
    """A run that somebody hands over as an archive: what a report writes stays in its folder."""
    run, elsewhere = tmp_path / "run", tmp_path / "elsewhere"
    run.mkdir()
    elsewhere.mkdir()
    text = dump_experiment(load_experiment("pool"))
    (run / "experiment.toml").write_text(text)
    record_poses(elsewhere / "cut.mcap", 20)
    cut = (elsewhere / "cut.mcap").read_bytes()[:-100]
    (elsewhere / "cut.mcap").write_bytes(cut)
    (run / "run.mcap").symlink_to(elsewhere / "cut.mcap")
    for name in ("run.mcap.mending", "result.json", "result.json.new", "report.html", "report.html.new"):
        (elsewhere / name).write_text("precious")
        (run / name).symlink_to(elsewhere / name)
    write_report(run)
    assert (elsewhere / "cut.mcap").read_bytes() == cut
    assert {path.read_text() for path in elsewhere.iterdir() if path.suffix != ".mcap"} == {"precious"}
    assert not any((run / name).is_symlink() for name in ("result.json", "report.html"))


def test_a_log_is_never_written_over(tmp_path: Path) -> None:
    path, link = tmp_path / "run.mcap", tmp_path / "link.mcap"
    record_poses(path, 5)
    before = path.read_bytes()
    link.symlink_to(tmp_path / "none.mcap")
    for place in (path, link):
        with pytest.raises(OSError, match="would be lost"):
            Recorder(place, "", {})
    assert path.read_bytes() == before and not (tmp_path / "none.mcap").exists()
