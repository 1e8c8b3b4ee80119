"""SHELL: machine code of kernels on disk: its folder, and one file a kernel, checked when it is read.

Kernels are kept in `NUMBA_CACHE_DIR`, else beside the sources, else in the user's cache, else in a folder of this process and
its children. A file that a power cut has left empty, half written or with other bytes counts as missing.
"""

import atexit
import contextlib
import functools
import hashlib
import logging
import os
import shutil
import tempfile
import zlib
from pathlib import Path

ROOT = Path(__file__).parents[2]  # folder of the installed packages
MAGIC = b"shoal kernel 1\n"
TEMPORARY = "shoal-kernels-"  # begins the name of a folder that goes with its process

_log = logging.getLogger("shoal")


def _named_folders() -> list[Path]:
    """Folders that may hold kernels, the preferred one first."""
    named = os.environ.get("NUMBA_CACHE_DIR", "")
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser())
    installation = hashlib.sha256(str(ROOT).encode()).hexdigest()[:12]  # two of them do not clear each other's kernels away
    return [
        *([Path(named) / "shoal-kernels"] if named else []),
        ROOT / "shoal" / "__pycache__" / "kernels",
        user / "shoal" / f"kernels-{installation}",
    ]


def _is_writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True


@functools.cache
def folder() -> Path:
    """Folder into which this process writes kernels: the first that can be written."""
    for candidate in _named_folders():
        if _is_writable(candidate):
            return candidate
    _log.warning("no folder to keep compiled kernels in: every start compiles them (set NUMBA_CACHE_DIR)")
    with contextlib.suppress(OSError):
        own = tempfile.mkdtemp(prefix=TEMPORARY)
        atexit.register(shutil.rmtree, own, ignore_errors=True)
        os.environ["NUMBA_CACHE_DIR"] = own  # children share it
        (own_kernels := _named_folders()[0]).mkdir()
        return own_kernels
    return _named_folders()[0]


def folder_lasts() -> bool:
    """True if what is written now is there at the next start."""
    return not folder().parent.name.startswith(TEMPORARY)


def readable_folders() -> list[Path]:
    """Folders in which kernels may lie: also one that somebody else has filled and this user cannot write."""
    return list(dict.fromkeys([folder(), *_named_folders()]))


def file_name(kernel: str, built_for: str) -> str:
    """Name of the file of a kernel (its full name) as it is built for content, versions and processor."""
    return f"{kernel}-{hashlib.sha256(built_for.encode()).hexdigest()[:20]}.kernel"


def read(name: str) -> bytes | None:
    """Content of a kernel's file; None if there is none. A damaged file is removed, and the log says so."""
    start = len(MAGIC) + 4
    for place in readable_folders():
        try:
            data = (place / name).read_bytes()
        except OSError:
            continue
        if len(data) > start and data[:start] == MAGIC + zlib.crc32(data[start:]).to_bytes(4, "little"):
            return data[start:]
        discard(name, "is damaged")
    return None


def write(name: str, content: bytes) -> None:
    """Keep a kernel's machine code. Without room on the disk it is not kept, and the log says so."""
    target = folder() / name
    part = target.with_name(f"{name}.{os.getpid()}.part")
    try:
        part.write_bytes(MAGIC + zlib.crc32(content).to_bytes(4, "little") + content)
        part.replace(target)
    except OSError as error:
        part.unlink(missing_ok=True)
        _log.warning("%s: a compiled kernel cannot be kept: %s", target, error.strerror)


def clear() -> list[Path]:
    """Remove the folders of kernels, as far as this user may. Returns those that were there."""
    folders = [place for place in dict.fromkeys(_named_folders()) if place.is_dir()]
    for place in folders:
        shutil.rmtree(place, ignore_errors=True)
    return folders


def discard(name: str, reason: str) -> None:
    """Remove a kernel's file that is of no use, and say so in the log."""
    for place in readable_folders():
        try:
            (place / name).unlink()
        except OSError:
            continue
        _log.warning("%s %s: that kernel is compiled again", place / name, reason)
