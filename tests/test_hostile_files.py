"""No reader waits for a hostile file, takes all memory for it, or loses what lies beside it.

Such files are a pipe without an end, a device, too many bytes, where ours should be.
"""

import ast
import json
import os
import resource
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner

from groundstation.__main__ import cli
from groundstation.logs import reader, repair, run_folders
from groundstation.report import compare_report
from groundstation.scripting.runs import FlownRun
from groundstation.web.run_desk import run_end
from localizer.calibration.images import read_picture
from localizer.evaluation.offline import PoseTable
from localizer.evaluation.runner import read_frame_table
from localizer.sources.files import decode_file
from localizer.sources.recording import FRAMES, recorded_frames
from localizer.sources.video import VideoReader
from robot_agent.preflight.identify import thrust
from shoal.config.experiment import load_experiment
from shoal.config.loader import read_toml
from shoal.errors import ConfigError
from shoal.mavlink.signing_key import TimestampStore, load_key
from shoal.system.regular_files import open_regular, read_regular
from sim_bridge.studies.campaign_runner import Journal
from tests.source_tree import nodes, sources, tree_of

pytestmark = pytest.mark.timeout(60)

# each reader, with the name of its file in a folder
READERS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "read_toml": ("experiment.toml", read_toml),
    "is_complete": ("run.mcap", reader.is_complete),
    "valid_records": ("run.mcap", lambda path: list(reader.valid_records(path))),
    "open_log": ("run.mcap", lambda path: reader.open_log(path.parent).__enter__()),
    "read_log": ("run.mcap", reader.read_log),
    "recover": ("run.mcap", repair.recover),
    "result": ("result.json", lambda path: FlownRun(path.parent).result),
    "comparison": ("comparison.json", lambda path: compare_report.write(path.parent)),
    "load_key": ("robot-1.key", load_key),
    "timestamps": ("robot-1.time", TimestampStore),
    "read_picture": ("a.png", read_picture),
    "decode_file": ("a.png", decode_file),
    "recorded_frames": (FRAMES, lambda path: list(recorded_frames(path.parent))),
    "frame table": ("a.csv", lambda path: list(read_frame_table(path, load_experiment("pool"), (), ()))),
    "part of a table": (
        "poses.csv.key.part",
        lambda path: list(PoseTable(path.with_name("poses.csv"), "key").write(iter(()), load_experiment("pool"))),
    ),
    "video": ("a.avi", VideoReader),
    "readings of a scale": ("scale.csv", thrust),
    "journal": ("journal.jsonl", Journal),
}
MAKERS: dict[str, Callable[[Path], object]] = {
    "pipe": os.mkfifo,
    "device": lambda path: path.symlink_to("/dev/zero"),
    "folder": Path.mkdir,
}


@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS.keys())
@pytest.mark.parametrize(("name", "read"), READERS.values(), ids=READERS.keys())
def test_a_reader_refuses_what_is_no_file(
    tmp_path: Path, name: str, read: Callable[[Path], object], make: Callable[[Path], object]
) -> None:
    make(tmp_path / name)
    with pytest.raises((ConfigError, OSError), match="no regular file"):
        read(tmp_path / name)


def test_a_file_is_read_up_to_its_limit(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_bytes(b"12345")
    (tmp_path / "link").symlink_to(file)
    assert read_regular(tmp_path / "link", 5) == b"12345"
    with pytest.raises(OSError, match="is larger than 4 bytes") as refused:
        read_regular(file, 4)
    assert refused.value.filename == str(file)  # run_app prints it
    with open_regular(file) as opened:
        assert opened.read() == b"12345"
    with pytest.raises(FileNotFoundError):
        read_regular(tmp_path / "missing", 5)


# Modules that read files in another way: what they read is the installation's, the system's, this user's own cache or keys, a
# file that the same program has written just now, or may be a pipe (a token).
READ_THEIR_OWN = {
    "groundstation/cli/keys.py", "groundstation/cli/run.py", "groundstation/deploy/key_ring.py", "groundstation/deploy/ssh.py",
    "groundstation/deploy/wheelhouse.py", "groundstation/report/report.py", "robot_agent/commands.py",
    "robot_agent/host/board_zero.py",
    "robot_agent/host/realtime.py", "robot_agent/preflight/network.py", "localizer/sources/video.py",
    "sim_bridge/cli/new.py", "sim_bridge/sil/after_run.py", "sim_bridge/sil/clock_shim.py", "sim_bridge/sil/launcher.py",
    "sim_bridge/sil/processes.py", "sim_bridge/studies/campaign_runner.py", "shoal/kernels/build.py", "shoal/kernels/cache.py",
    "shoal/config/key_reference.py", "shoal/runtime/output_files.py", "shoal/runtime/version.py", "shoal/bus/key_ring.py",
}  # fmt: skip


def test_files_of_others_are_read_in_one_place() -> None:
    """A module that reads files asks first what they are, or stands in the list above."""
    reading = set()
    for source in sources("groundstation", "robot_agent", "localizer", "sim_bridge", "shoal"):
        for call in nodes(tree_of(source)):
            if isinstance(call, ast.Call) and isinstance(call.func, ast.Attribute):
                mode = [argument.value for argument in call.args if isinstance(argument, ast.Constant)]
                if call.func.attr in ("read_text", "read_bytes") or (call.func.attr == "open" and mode == ["rb"]):
                    reading.add(source)
    assert reading - {"shoal/system/regular_files.py"} == READ_THEIR_OWN


def a_run(folder: Path) -> Path:
    folder.mkdir()
    (folder / "run.mcap").write_bytes(bytes(1000))
    return folder


CONTENTS: dict[str, Callable[[Path], object]] = {
    **MAKERS,
    "deep": lambda path: path.write_text("[" * 200_000),
    "many digits": lambda path: path.write_text('{"passed": true, "duration_s": ' + "9" * 400 + "}"),
    "more digits than Python reads": lambda path: path.write_text('{"passed": ' + "9" * 5000 + "}"),
    "infinite": lambda path: path.write_text('{"duration_s": 1e999, "name": NaN, "tags": [[[1]], {"a": 1}]}'),
    "other types": lambda path: path.write_text('{"passed": [1], "duration_s": true, "scene": {"a": 1}, "tags": 5}'),
    "not UTF-8": lambda path: path.write_bytes(b'{"name": "\xff"}'),
    "large": lambda path: path.write_text(json.dumps({"scene": "x" * run_folders.MOST_JSON_BYTES})),
    "long texts": lambda path: path.write_text(json.dumps({"scene": "x" * 9999, "name": "y" * 9999, "tags": ["z"] * 999})),
}  # fmt: skip


@pytest.mark.parametrize("file", ["result.json", "label.json", "experiment.toml"])
@pytest.mark.parametrize("spoil", CONTENTS.values(), ids=CONTENTS.keys())
def test_a_bad_file_costs_one_row_of_the_list_of_runs(tmp_path: Path, spoil: Callable[[Path], object], file: str) -> None:
    (a_run(tmp_path / "good") / "result.json").write_text('{"scene": "pool", "duration_s": 4.5, "passed": true}')
    spoil(a_run(tmp_path / "odd") / file)
    rows = {Path(run.run).name: run for run in run_folders.list_runs(tmp_path)}
    assert set(rows) == {"good", "odd"}
    assert (rows["good"].verdict, rows["good"].duration_s) == ("passed", 4.5)
    assert 0.0 <= rows["odd"].duration_s < run_folders.LONGEST_S
    assert len(json.dumps(rows["odd"].__dict__)) < 20_000  # what a page is sent
    assert run_end(tmp_path / "odd") is None  # nor has the page of that run an end to show


def test_texts_of_a_run_do_not_act_on_the_terminal_that_lists_it(tmp_path: Path) -> None:
    run = a_run(tmp_path / "run")
    (run / "label.json").write_text(json.dumps({"name": "\x1b]0;owned\x07\x9b2J\u202egnp", "tags": ["a\nb"]}))
    listed = CliRunner().invoke(cli, ["log", "list", "--in", str(tmp_path)]).stdout
    assert listed.count("\n") == 1
    assert '"\\x1b]0;owned\\x07\\x9b2J\\u202egnp" #a\\nb' in listed


def a_png(width: int, height: int) -> bytes:
    """A black picture of one bit a pixel."""
    row = b"\0" + bytes(width // 8)
    packer = zlib.compressobj(9)
    data = b"".join(packer.compress(row) for _ in range(height)) + packer.flush()
    head = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)
    parts = ((b"IHDR", head), (b"IDAT", data), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body)) for kind, body in parts
    )


@pytest.mark.long
def test_a_small_file_of_a_gigapixel_is_refused(tmp_path: Path) -> None:
    picture = tmp_path / "a.png"
    picture.write_bytes(a_png(32_000, 32_000))
    assert picture.stat().st_size < 200_000
    program = (
        "import sys; from pathlib import Path; from localizer.calibration.images import read_picture;"
        "read_picture(Path(sys.argv[1]))"
    )

    def confine() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (3 << 30, 3 << 30))  # the picture would take 3 GB beside what libraries reserve

    done = subprocess.run(
        [sys.executable, "-c", program, str(picture)], preexec_fn=confine, capture_output=True, text=True, check=False
    )
    assert "not a picture that OpenCV reads" in done.stderr and "at most 134 million pixels" in done.stderr, done.stderr
