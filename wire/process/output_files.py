"""SHELL: files that commands write: whole or not at all, never through a link, never over what is read or belongs to a run.

    check_output(out, reads=[image])                # raises ConfigError: would be written over what is read, or a run's own
    with replacing(out) as file: ...                # binary; beside it until it is whole, then in its place
    replace_text(run / "result.json", text)

A file is made beside its place under a name that cannot be guessed, and put there by renaming. So a link that lies there, for
example in a run from another person, is replaced and not followed, and a command that reads what it writes over could
not cut it.
"""

import errno
import os
import secrets
import shutil
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from wire.toml_loader import ConfigError, os_errors_as_config_errors

# What tells a folder of results, and the files in it that only the command which made it may write.
RUN = ("run.mcap", "experiment.toml", "result.json", "report.html", "label.json")
PAGE_OPEN = ".page-open"  # in a run's folder: its page was open when its station ended; who shows the ended run takes it away
CAMPAIGN = ("journal.jsonl", "results.parquet", "report.html")
COMPARISON = ("comparison.json", "comparison.html")
_OWN = {"run.mcap": RUN, "experiment.toml": RUN, "journal.jsonl": CAMPAIGN, "comparison.json": COMPARISON}
_KINDS = {RUN: "a run", CAMPAIGN: "a campaign", COMPARISON: "a comparison"}


def page_was_open(folder: Path) -> bool:
    """True if the page of a run's station was open when the station ended. Takes the mark away that says so."""
    mark = folder / PAGE_OPEN
    found = mark.exists()
    mark.unlink(missing_ok=True)
    return found


def check_output(path: Path, reads: Iterable[Path] = (), mine: tuple[str, ...] = ()) -> None:
    """Refuse to write over one of the files that the command reads, or over a file of a folder of results. `mine` are the
    files that the command itself keeps there. Raises ConfigError."""
    for read in reads:
        if _same(path, read):
            raise ConfigError(f"{path}: is read by this command and would be lost (write to another file)")
    for mark, own in _OWN.items():
        if own is mine or not (path.parent / mark).exists():
            continue
        if path.name in own or any(_same(path, path.parent / name) for name in own):
            raise ConfigError(f"{path}: is a file of {_KINDS[own]}, and would be lost (write to another file)")


@contextmanager
def replacing(path: Path, durable: bool = False, mode: int | None = None) -> Iterator[IO[bytes]]:
    """A new binary file that takes the place of `path` when the block ends without an error.

    With `durable` its bytes are on the disk before that. `mode` sets its permissions, from the beginning on; without it the
    file gets those of the one that it replaces. Raises OSError that names `path`."""
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if _is_device(path):
        with path.open("wb") as file:
            yield file
        return
    new = path.with_name(f".{secrets.token_hex(8)}.new")
    created_mode = 0o666 if mode is None else mode
    try:
        if mode is None and path.is_file() and not path.is_symlink():
            mode = path.stat(follow_symlinks=False).st_mode & 0o777
        descriptor = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, created_mode)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from None
    try:
        with os.fdopen(descriptor, "wb") as file:
            if mode is not None:
                os.fchmod(file.fileno(), mode)
            yield file
            file.flush()
            if durable:
                os.fsync(file.fileno())
        new.replace(path)
    except OSError as error:
        if error.filename not in (None, str(new)):
            raise
        raise OSError(error.errno, error.strerror, str(path)) from None
    finally:
        new.unlink(missing_ok=True)


def replace_text(path: Path, text: str) -> None:
    """Write a text as UTF-8, see `replacing`."""
    with replacing(path) as file:
        file.write(text.encode())


def keep_old(path: Path) -> Path:
    """Copy a file to one beside it with the time in its name, which was not there. Returns that. Raises OSError."""
    stem, old = f"{path.name}.{time.strftime('%Y%m%d-%H%M%S')}", path.read_bytes()
    for suffix in ["", *(f"-{i}" for i in range(2, 1000))]:
        copy = path.with_name(stem + suffix)
        try:
            file = copy.open("xb")
        except FileExistsError:
            continue
        try:
            with file:
                file.write(old)
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            copy.unlink(missing_ok=True)
            raise OSError(error.errno, error.strerror, str(copy)) from None
        return copy
    raise RuntimeError(f"cannot keep {path} as {stem}")


def _same(path: Path, other: Path) -> bool:
    """True if both are one file, by whatever names and links."""
    try:
        return path.samefile(other)
    except OSError:  # one of them is not there
        return path.absolute() == other.absolute()


def _is_device(path: Path) -> bool:
    """A terminal, a pipe, /dev/null: what cannot be replaced is written to."""
    return path.absolute().parts[1:2] in (("dev",), ("proc",)) or (path.exists() and not path.is_file())


def new_run_folder(out: Path, name: str) -> Path:
    """Make the folder `out`/<experiment>-<time>, with a number when two start in the same second. Raises ConfigError."""
    stem = f"{name}-{time.strftime('%Y%m%d-%H%M%S')}"
    for suffix in ["", *(f"-{i}" for i in range(2, 1000))]:
        folder = out / f"{stem}{suffix}"
        with os_errors_as_config_errors(out):
            try:
                folder.mkdir(parents=True)
                return folder
            except FileExistsError:
                if folder.exists():
                    continue
                raise
    raise RuntimeError(f"cannot make a folder {out / stem}")


@contextmanager
def run_folder(out: Path, name: str) -> Iterator[Path]:
    """A `new_run_folder`, which is taken away again, and `out` with it if it is new, where nothing was put into it."""
    is_new = not out.exists()
    folder = new_run_folder(out, name)
    try:
        yield folder
    finally:
        with suppress(OSError):  # what holds something stays
            folder.rmdir()
            if is_new:
                out.rmdir()


def disk_free(folder: Path) -> int:
    """Bytes that can still be written there."""
    return shutil.disk_usage(folder).free
