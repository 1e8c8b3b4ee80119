"""SHELL: the wheels that a board installs from, made here: it needs no compiler and no way to the Internet.

This project's own wheel, and what its base installation needs, pinned by constraints.txt, for the board's CPU and Python.
Kept in the user's cache until the source or a pin changes.
"""

import os
import shutil
import tempfile
import threading
from pathlib import Path

from groundstation.deploy.manifest import Probe, digest
from wire import programs
from wire.process.version import PACKAGES
from wire.toml_loader import ConfigError

ROOT = Path(__file__).parents[2]
KEPT = 6  # folders of wheels in the cache, some 100 MB each: boards of two kinds, before and after a few changes
_TURN = threading.Lock()  # several boards are brought up to date at once: what one has made serves the others


def wheels(probe: Probe) -> Path:
    """A folder with the wheels for such a board. Raises ConfigError where they cannot be had."""
    if not (ROOT / "constraints.txt").is_file():
        raise ConfigError(f"{ROOT}: no constraints.txt there; run this from a checkout, or give --wheelhouse FOLDER")
    key = f"{probe.machine}-{probe.python}-{_source_digest()}"
    folder = _cache() / key
    with _TURN:
        if not folder.is_dir():
            folder.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=folder.parent) as building:
                fresh = Path(building) / "wheels"
                _build(probe, fresh)
                fresh.rename(folder)
            _clean(folder)
    return folder


def _clean(newest: Path) -> None:
    """Delete the oldest folders of wheels beside a new one."""
    others = [place for place in newest.parent.iterdir() if place.is_dir() and place != newest and "-" in place.name]
    for place in sorted(others, key=lambda place: place.stat().st_mtime)[: -(KEPT - 1)]:
        shutil.rmtree(place, ignore_errors=True)


def _source_digest() -> str:
    files = [ROOT / "pyproject.toml", ROOT / "constraints.txt"]
    for package in PACKAGES:
        files += [path for path in (ROOT / package).rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    return digest((str(path.relative_to(ROOT)), path.read_bytes()) for path in files if "node_modules" not in path.parts)


def _cache() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "shoal" / "wheels"


def _build(probe: Probe, folder: Path) -> None:
    with tempfile.TemporaryDirectory() as own:
        _pip("wheel", "--no-deps", "--wheel-dir", own, str(ROOT))
        built = next(Path(own).glob("shoal-*.whl"))
        where = [option for platform in probe.platforms for option in ("--platform", platform)]
        constraints = ["--constraint", str(ROOT / "constraints.txt")]
        python = ["--python-version", probe.python, "--implementation", "cp", "--only-binary=:all:"]
        _pip("download", "--dest", str(folder), *where, *python, *constraints, str(built))
        shutil.copy(built, folder)


def _pip(*arguments: str) -> None:
    done = programs.ask("pip", ["--quiet", "--disable-pip-version-check", *arguments])
    if done.returncode != 0:
        raise ConfigError(f"pip {arguments[0]}: {done.stderr.strip() or done.stdout.strip()}")
