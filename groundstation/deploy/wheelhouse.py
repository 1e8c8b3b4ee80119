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
from shoal.errors import ConfigError
from shoal.runtime.version import PACKAGES
from shoal.system import programs

ROOT = Path(__file__).parents[2]  # of this program: its checkout (`pip install -e`), or the folder that it is installed in
PINS, PROJECT = "constraints.txt", "pyproject.toml"
KEPT = 6  # folders of wheels in the cache, some 100 MB each: boards of two kinds, before and after a few changes
_TURN = threading.Lock()  # several boards are brought up to date at once: what one has made serves the others


def wheels(probe: Probe) -> Path:
    """A folder with the wheels for such a board. Raises ConfigError where they cannot be had."""
    key = f"{probe.machine}-{probe.python}-{_source_digest(checkout())}"
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "shoal" / "wheels" / key
    with _TURN:
        if not folder.is_dir():
            folder.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=folder.parent) as building:
                fresh = Path(building) / "wheels"
                _build(probe, fresh)
                try:
                    fresh.rename(folder)
                except OSError:
                    if not folder.is_dir():  # else another program has made the same meanwhile
                        raise
            _clean(folder)
    return folder


def checkout() -> Path:
    """The checkout that this program runs from, else the one that holds the working folder. Raises ConfigError if there is
    none, and for a checkout of other sources than this program's: a board must not get another version."""
    here = Path.cwd()
    root = next((folder for folder in (ROOT, here, *here.parents) if _is_checkout(folder)), None)
    if root is None:
        raise ConfigError(f"{here}: in no checkout (no {PINS} there or above); run this from one, or give --wheelhouse FOLDER")
    if root != ROOT and not _has_this_code(root):
        raise ConfigError(
            f"{root}: holds other sources than this program runs ({ROOT}); install that checkout "
            f"(pip install -c {PINS} '.[station]'), or give --wheelhouse FOLDER"
        )
    return root


def _is_checkout(folder: Path) -> bool:
    """True for a folder with the project's packages, its pins and its project file."""
    return (folder / PINS).is_file() and (folder / PROJECT).is_file() and all((folder / name).is_dir() for name in PACKAGES)


def _has_this_code(folder: Path) -> bool:
    """True if a checkout holds each module of this program as it is here."""
    modules = (path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
    pairs = ((path, folder / path.relative_to(ROOT)) for path in modules)
    return all(there.is_file() and there.read_bytes() == path.read_bytes() for path, there in pairs)


def _clean(newest: Path) -> None:
    """Delete the oldest folders of wheels beside a new one."""
    others = [place for place in newest.parent.iterdir() if place.is_dir() and place != newest and "-" in place.name]
    for place in sorted(others, key=lambda place: place.stat().st_mtime)[: -(KEPT - 1)]:
        shutil.rmtree(place, ignore_errors=True)


def _source_digest(root: Path) -> str:
    """The digest of all files that the project's wheel is made of, and of the pins."""
    files = [root / PROJECT, root / PINS]
    for package in PACKAGES:
        files += [path for path in (root / package).rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    return digest((str(path.relative_to(root)), path.read_bytes()) for path in files if "node_modules" not in path.parts)


def _build(probe: Probe, folder: Path) -> None:
    """Fill a folder with this checkout's wheel and those that it needs, as pinned, for the board's platform and Python."""
    root = checkout()
    with tempfile.TemporaryDirectory() as scratch:
        _pip("wheel", "--no-deps", "--wheel-dir", scratch, str(root))
        project_wheel = next(Path(scratch).glob("shoal-*.whl"))
        target = ["--python-version", probe.python, "--implementation", "cp", "--only-binary=:all:"]
        for platform in probe.platforms:
            target += ["--platform", platform]
        _pip("download", "--dest", str(folder), *target, "--constraint", str(root / PINS), str(project_wheel))
        shutil.copy(project_wheel, folder)


def _pip(*arguments: str) -> None:
    """Run pip. Raises ConfigError with its message if it fails."""
    result = programs.ask("pip", ["--quiet", "--disable-pip-version-check", *arguments])
    if result.returncode != 0:
        raise ConfigError(f"pip {arguments[0]}: {result.stderr.strip() or result.stdout.strip()}")
