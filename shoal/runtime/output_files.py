"""SHELL: files that commands write: whole or not at all, never through a link, never over what is read or belongs to a run.

    check_output(out, reads=[image])                # raises ConfigError: would be written over what is read, or a run's own
    with replacing(out) as file: ...                # binary; beside it until it is whole, then in its place
    replace_text(run / "result.json", text)
    with replacing(out, keep=dated) as file: ...    # file.kept is then the earlier one
    with replacing_together() as opened: ...        # several that belong together: all are whole before one is in its place

A file is made beside its place under a name that cannot be guessed, and put there by renaming when its bytes are on the disk.
So whenever the disk fails, the program is killed or the power is cut, the old file or the whole new one is there. A link that
lies there, for example in a run from another person, is replaced and not followed, and a command that reads what it writes
over could not cut it.
"""

import ctypes
import errno
import io
import os
import secrets
import shutil
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from shoal.errors import ConfigError, os_errors_as_config_errors

# What tells a folder of results, and the files in it that only the command which made it may write.
RUN = ("run.mcap", "experiment.toml", "result.json", "report.html", "label.json")
PAGE_OPEN = ".page-open"  # in a run's folder: its page was open when its station ended; who shows the ended run takes it away
CAMPAIGN = ("journal.jsonl", "results.parquet", "report.html")
COMPARISON = ("comparison.json", "comparison.html")
_OWN = {"run.mcap": RUN, "experiment.toml": RUN, "journal.jsonl": CAMPAIGN, "comparison.json": COMPARISON}
_NOT_HERE = (errno.EINVAL, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP)  # what a file system says that cannot do something
_NEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
_BUFFER_BYTES = 65536
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2  # of Linux
_KINDS = {RUN: "a run", CAMPAIGN: "a campaign", COMPARISON: "a comparison"}


def page_was_open(folder: Path) -> bool:
    """True if the page of a run's station was open when the station ended. Takes the mark away that says so."""
    mark = folder / PAGE_OPEN
    was_open = mark.exists()
    with suppress(OSError):  # on a disk that has become read-only it is found again, which does no harm
        mark.unlink(missing_ok=True)
    return was_open


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


class NewFile(io.BufferedWriter):
    """A binary file beside the place that it will take. Errors name that place."""

    def __init__(self, path: Path, mode: int | None, keep: "Names | None", over: bool) -> None:
        """Arguments as for `replacing`. Raises OSError."""
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        if not over and os.path.lexists(path):
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))
        self.path = path
        self.kept: Path | None = None  # the earlier file's other name
        self._keep, self._over = keep, over
        self._beside = path.with_name(f".{secrets.token_hex(8)}.new")
        self._in_place = _is_device(path)
        with _named(path):
            if self._in_place:
                descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CLOEXEC)  # stdout may be a file, appended to
            else:
                if mode is None and path.is_file() and not path.is_symlink():
                    mode = path.stat(follow_symlinks=False).st_mode & 0o777
                descriptor = os.open(self._beside, _NEW, 0o666 if mode is None else mode)
        super().__init__(_RawFile(path, descriptor), _BUFFER_BYTES)
        try:
            with _named(path):
                if mode is not None and not self._in_place:
                    os.fchmod(descriptor, mode)
        except OSError:
            self.discard()
            raise

    def finish(self, durable: bool) -> None:
        """Write what is left, with `durable` onto the disk, and close the file."""
        with _named(self.path):
            self.flush()
            if durable and not self._in_place:
                os.fsync(self.fileno())
            self.close()

    def put_in_place(self) -> None:
        """Give the file its name, and the earlier one another."""
        if self._in_place:
            return
        with _named(self.path):
            if self._keep is not None and self.path.exists():
                self.kept = _keep(self.path, self._keep(self.path))
            if not self._over and _link(self._beside, self.path):
                return
            if not self._over and os.path.lexists(self.path):
                raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST))
            self._beside.replace(self.path)
            self._in_place = True

    def discard(self) -> None:
        """Remove what is not in place. A disk that is gone keeps it."""
        with suppress(OSError):
            self.close()
        if not self._in_place:
            with suppress(OSError):
                self._beside.unlink(missing_ok=True)


class _RawFile(io.FileIO):
    """An open file whose errors name the place that it will take: a full disk's name none."""

    def __init__(self, path: Path, descriptor: int) -> None:
        super().__init__(descriptor, "wb")
        self._path = path

    def write(self, data: Any) -> int:
        with _named(self._path):
            return super().write(data)


Names = Callable[[Path], Iterator[Path]]  # under which a file may be kept


def dated(path: Path) -> Iterator[Path]:
    """Names of a file with the time in them."""
    stem = f"{path.name}.{time.strftime('%Y%m%d-%H%M%S')}"
    yield from (path.with_name(f"{stem}{suffix}") for suffix in ["", *(f"-{i}" for i in range(2, 1000))])


@contextmanager
def replacing_together(durable: bool = True) -> Iterator[Callable[..., NewFile]]:
    """A function that opens files as `replacing` does. All are whole before the first takes its place, so that a full disk
    leaves the old ones, and no mixture."""
    files: list[NewFile] = []
    with ExitStack() as stack:

        def opened(path: Path, mode: int | None = None, keep: Names | None = None, over: bool = True) -> NewFile:
            files.append(NewFile(path, mode, keep, over))
            stack.callback(files[-1].discard)
            return files[-1]

        yield opened
        for file in files:
            file.finish(durable)
        for file in files:
            file.put_in_place()
        for path in {file.path.parent: file.path for file in files}.values() if durable else ():
            _sync_name(path)


@contextmanager
def replacing(
    path: Path, durable: bool = True, mode: int | None = None, keep: Names | None = None, over: bool = True
) -> Iterator[NewFile]:
    """A new binary file that takes the place of `path` when the block ends without an error. A device is written to.

    With `durable` its bytes are on the disk before that, and its name after. `mode` sets its permissions, from the beginning
    on; without it the file gets those of the one that it replaces. That one is kept under the first free name of `keep`;
    `kept` of the new file then tells it. Without `over` there must be none. Raises OSError that names `path`."""
    with replacing_together(durable) as opened:
        yield opened(path, mode, keep, over)


@contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """A new folder that takes the place of `path` when the block ends without an error; what else was there goes into it. Only
    its owner may look into it. Raises OSError, and ConfigError from the block, naming `path`."""
    with _named(path):
        if path.exists() and not path.is_dir():
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST))
        new = path.with_name(f".{secrets.token_hex(8)}.new")
        new.mkdir(mode=0o700)
    in_place = False
    try:
        yield new
        with _named(path):
            if path.exists():
                _exchange(new, path)
            else:
                new.rename(path)
            in_place = True
            for other in new.iterdir() if new.exists() else ():
                if not os.path.lexists(path / other.name):
                    other.rename(path / other.name)
        shutil.rmtree(new, ignore_errors=True)
        _sync_name(path)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(error.filename or path).replace(str(new), str(path))) from None
    except ConfigError as error:
        raise ConfigError(str(error).replace(str(new), str(path))) from None
    finally:
        if not in_place:
            shutil.rmtree(new, ignore_errors=True)


def _exchange(new: Path, old: Path) -> None:
    """Give two folders each other's names, at once where the system can do that. Raises OSError."""
    call = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if call is not None and call(_AT_FDCWD, os.fsencode(new), _AT_FDCWD, os.fsencode(old), _RENAME_EXCHANGE) == 0:
        return
    if call is not None and ctypes.get_errno() not in _NOT_HERE:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    for file in sorted(new.iterdir()):
        file.replace(old / file.name)


def replace_text(path: Path, text: str, durable: bool = True, over: bool = True) -> None:
    """Write a text as UTF-8, see `replacing`."""
    with replacing(path, durable, over=over) as file:
        file.write(text.encode())


def sync_folder(folder: Path) -> None:
    """Have the names of a folder's files on the disk, where its file system can do that. Raises OSError."""
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except PermissionError:
        return
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in _NOT_HERE:
            raise OSError(error.errno, error.strerror, str(folder)) from None
    finally:
        os.close(descriptor)


def check_named(descriptor: int, path: Path) -> None:
    """Raise FileNotFoundError that names `path` if an open file was deleted: what is written into it is lost, and the system
    reports no error."""
    if os.fstat(descriptor).st_nlink == 0:
        raise FileNotFoundError(errno.ENOENT, "was deleted while it was written: what was in it is lost", str(path))


def _sync_name(path: Path) -> None:
    """Have the name of a file that is written on the disk. Raises OSError that says so."""
    try:
        sync_folder(path.parent)
    except FileNotFoundError as error:
        raise FileNotFoundError(error.errno, "was deleted with its folder as soon as it was there", str(path)) from None
    except OSError as error:
        raise OSError(error.errno, f"is written, but may be lost with the power: {error.strerror}", str(path)) from None


def _keep(path: Path, names: Iterator[Path]) -> Path:
    """Let a file have another name as well, which was free; where there are no links, a copy. Raises OSError."""
    path = path.resolve()
    for name in names:
        if _same(name, path):  # of a command that was killed behind this
            return name
        if os.path.lexists(name):
            continue
        if not _link(path, name):
            with path.open("rb") as old, replacing(name, over=False) as copy:
                shutil.copyfileobj(old, copy)
        return name
    raise FileExistsError(errno.EEXIST, "too many earlier files are kept already: delete some", str(path))


def _link(path: Path, name: Path) -> bool:
    """Give a file another name that is free. Returns False where the file system has no such links."""
    try:
        name.hardlink_to(path)
    except OSError as error:
        if error.errno not in (*_NOT_HERE, errno.EPERM, errno.EXDEV, errno.EMLINK):
            raise
        return False
    return True


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Lets errors of the file system name this path, instead of none or of one beside it."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from None


def _same(path: Path, other: Path) -> bool:
    """True if both are one file, by whatever names and links."""
    try:
        return path.samefile(other)
    except OSError:  # one of them is not there
        return path.absolute() == other.absolute()


def _is_device(path: Path) -> bool:
    """True for a terminal, a pipe, /dev/null, which cannot be replaced. /dev/shm is a disk, in memory."""
    top = path.absolute().parts[1:3]
    return (top[:1] in (("dev",), ("proc",)) and top != ("dev", "shm")) or (path.exists() and not path.is_file())


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
    with folder_in_use(out), _empty_ones_removed(folder := new_run_folder(out, name)):
        yield folder


@contextmanager
def folder_in_use(folder: Path) -> Iterator[Path]:
    """A folder, made where it is missing; a new one is taken away again where nothing was put into it. Raises ConfigError."""
    is_new = not folder.exists()
    with os_errors_as_config_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    with _empty_ones_removed(*([folder] if is_new else [])):
        yield folder


@contextmanager
def _empty_ones_removed(*folders: Path) -> Iterator[None]:
    """Remove those of these folders that are empty when the block ends."""
    try:
        yield
    finally:
        for folder in folders:
            with suppress(OSError):  # what holds something stays
                folder.rmdir()


def disk_free(folder: Path) -> int:
    """Bytes that can still be written there."""
    return shutil.disk_usage(folder).free
