"""Every command that writes a file a person would miss: how it is called, what lies in its folder before, what it writes."""

import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tomli_w
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat, load_pem_private_key

from shoal.config.experiment import EXPERIMENTS
from tests.groundstation.small_log import record_poses
from tests.groundstation.synthetic import Script, write_run
from tests.localizer.small_basin import FLOOR, POOL_M, RIM, TRUTH

OLD = b"old\n"
PLACES = {**{f"rim {i}": (*xy, -0.1) for i, xy in RIM.items()}, **{f"floor {i}": (*xy, 0.8) for i, xy in FLOOR.items()}}


def nothing(folder: Path) -> None:
    """Have nothing in the folder before."""


def whole(data: bytes) -> object:
    """The whole file: it is the same each time."""
    return data


@dataclass(frozen=True)
class FileCommand:
    """A command that writes files into the folder where it runs."""

    arguments: tuple[str, ...]
    written: tuple[str, ...]  # names of the files that it writes
    before: Callable[[Path], None] = nothing  # makes what is there before
    content: Callable[[bytes], object] = whole  # what of a file is the same whenever it is written
    keeps_old: bool = False  # under another name
    is_new: bool = False  # never written over an earlier file
    survives_power_cut: bool = True
    check: Callable[[Path], None] = nothing  # raises AssertionError for files that do not fit one another


def olds(*names: str) -> Callable[[Path], None]:
    """Makes earlier files of these names."""

    def make(folder: Path) -> None:
        for name in names:
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_bytes(OLD)

    return make


def cut_log(folder: Path) -> None:
    """A log without its last third."""
    record_poses(folder / "run.mcap", 4000)
    data = (folder / "run.mcap").read_bytes()
    (folder / "run.mcap").write_bytes(data[: len(data) * 2 // 3])


TABLES = (
    "tables/event.csv", "tables/localizer-status.csv", "tables/sim-truth.csv",
    *(f"tables/robot-{robot}-{topic}.csv" for robot in (1, 2) for topic in ("pose", "state", "trajectory")),
)  # fmt: skip


def a_run(folder: Path) -> None:
    """A run of four seconds, with an earlier report and earlier tables."""
    (folder / "run").mkdir()
    write_run(folder / "run", Script(duration_s=4.0))
    olds("run/result.json", "run/report.html", "run/label.json")(folder)
    olds(*TABLES[2:])(folder)


def surveyed(folder: Path) -> None:
    """A camera whose lens is known, and where points of the pool are seen in its picture; and an earlier calibration."""
    from sim_bridge.camera.optics import project

    lens = TRUTH.model_dump(mode="json")
    (folder / "lens.toml").write_text(tomli_w.dumps({"camera": lens}), encoding="utf-8")
    (folder / "camera.toml").write_text(tomli_w.dumps({"camera": lens | {"rate_hz": 11.0}}), encoding="utf-8")
    (folder / "camera.png").write_bytes(OLD)
    points = [
        {"name": name, "pool_m": list(place), "pixel_px": project(TRUTH, np.array([place]))[0].tolist()}
        for name, place in PLACES.items()
    ]
    (folder / "points.toml").write_text(tomli_w.dumps({"pool": {"size_m": POOL_M}, "points": points}), encoding="utf-8")


def camera_of(data: bytes) -> object:
    """The camera of a file; its head tells the time. A picture is compared as it is."""
    return tomllib.loads(data.decode())["camera"] if data.startswith(b"#") else data


def lab(folder: Path) -> None:
    """An experiment of one's own, with its camera."""
    table = tomllib.loads((EXPERIMENTS / "pool.toml").read_text(encoding="utf-8"))
    (folder / "lab.toml").write_text("# ours\n" + tomli_w.dumps(table), encoding="utf-8")


def key_length(data: bytes) -> object:
    """The length of a link's key, which is another one each time."""
    return data.endswith(b"\n") and len(bytes.fromhex(data.decode().strip()))


def a_ring(folder: Path) -> None:
    """A key ring with the keys of a robot."""
    from datetime import UTC, datetime

    from groundstation.deploy import key_ring

    key_ring.init(folder / "keys", ["pool.local"], "shoal", datetime.now(UTC))
    key_ring.add(folder / "keys", "robot", 2, datetime.now(UTC))


def keys_fit(folder: Path) -> None:
    """Raise AssertionError if a certificate in a key ring is not that of the private key beside it."""
    for place in (folder / "keys").glob("[!.]*/"):
        public_key = x509.load_pem_x509_certificate((place / "cert.pem").read_bytes()).public_key()
        private = load_pem_private_key((place / "key.pem").read_bytes(), None).public_key()
        form = (Encoding.DER, PublicFormat.SubjectPublicKeyInfo)
        assert public_key.public_bytes(*form) == private.public_bytes(*form), f"{place}: of two different pairs"


def kind_of_pem(data: bytes) -> object:
    """The kind of a certificate or a key, which is another one each time; of the list of members, the processes in it."""
    if b"-----BEGIN" not in data:
        return sorted({member["process"] for member in tomllib.loads(data.decode())["member"]})
    return data.splitlines()[0], data.splitlines()[-1]


PROCESSES = ("groundstation", "localizer", "operator", "sim-bridge", "viewer")
PAIR = ("ca.pem", "cert.pem", "key.pem")
COMMANDS = {
    "repair": FileCommand(("groundstation", "log", "repair", "run.mcap"), ("run.mcap",), cut_log, keeps_old=True),
    "report": FileCommand(("groundstation", "log", "report", "run"), ("run/result.json", "run/report.html"), a_run),
    "label": FileCommand(("groundstation", "log", "label", "run", "--name", "dive"), ("run/label.json",), a_run),
    "export": FileCommand(
        ("groundstation", "log", "export", "run", "--out", "tables"),
        TABLES,
        a_run,
    ),
    "viewer": FileCommand(
        ("groundstation", "log", "export", "run", "--out", "viewer", "--foxglove"),
        ("viewer/run-viewer.mcap", "viewer/foxglove-layout.json"), a_run,
    ),
    "calibrate": FileCommand(
        ("localizer", "calibrate", "--lens", "lens.toml", "--pool-points", "points.toml"),
        ("camera.toml", "camera.png"), surveyed, camera_of, keeps_old=True,
    ),
    "setup": FileCommand(("tests.disks.jobs:setup",), ("lab.toml",), lab, keeps_old=True),
    "edit": FileCommand(("tests.disks.jobs:edit",), ("experiments/mine.toml",), is_new=True),
    "board": FileCommand(
        ("tests.disks.jobs:board",), ("robot-1.json", "robot-1.key"), olds("robot-1.json"),
        survives_power_cut=False,  # it is simulated, and its loop waits for no disk
    ),
    "new": FileCommand(("sim-bridge", "new", "lab"), ("lab.toml",), is_new=True),
    "link-key": FileCommand(("robot-agent", "link-key", "board.key"), ("board.key",), content=key_length, is_new=True),
    "init": FileCommand(
        ("robot-agent", "init", "--robot", "2", "--station", "tcp/127.0.0.1:7447", "--force"), ("agent.toml",),
        olds("agent.toml"),
    ),
    "keys-init": FileCommand(
        ("groundstation", "keys", "init", "--host", "pool.local"),
        ("keys/ca.pem", "keys/authority.key", "keys/members.toml", *(f"keys/{p}/{f}" for p in PROCESSES for f in PAIR)),
        content=kind_of_pem, check=keys_fit, is_new=True,
    ),
    "keys-add": FileCommand(
        ("groundstation", "keys", "add", "robot", "2"),
        ("keys/members.toml", *(f"keys/agent-2/{file}" for file in PAIR[1:])), a_ring, kind_of_pem, check=keys_fit,
    ),
    "markers": FileCommand(("localizer", "print-markers", "--ids", "1-3"), ("markers.pdf",), olds("markers.pdf")),
    "layout": FileCommand(("groundstation", "foxglove", "layout", "pool", "--out", "l.json"), ("l.json",), olds("l.json")),
}  # fmt: skip
