"""SHELL: the folders in which the programs of one user on one machine find each other, whatever kind of login started them.

A station puts its doors into each of these folders, and a terminal looks into each: the environment of a desktop, of `su` and
of cron differ, and the user's folder in /run goes when the last login ends. $SHOAL_RUNTIME_DIR confines both to one folder;
one that cannot be used counts for nothing, and a warning says so: an emergency stop that ends there would reach nobody.
"""

import functools
import os
import stat
from pathlib import Path

from shoal.runtime.runtime import log

RUN, TEMPORARY = Path("/run/user"), Path("/tmp")  # the same for every login
ONLY = "SHOAL_RUNTIME_DIR"
LONGEST_SOCKET = 100  # bytes of a Unix socket's path; systems allow 104 (macOS) or 108


def user_folders(make: bool = False) -> tuple[Path, ...]:
    """Folders that are this user's alone, the best first. With `make` those are made that can be."""
    only = os.environ.get(ONLY, "")
    if only and Path(only).is_absolute() and is_private(Path(only)):
        return (Path(only),)
    if only:
        _warn_of(only)
    return tuple(folder for folder in _candidates() if is_private(folder, make))


@functools.cache
def _warn_of(folder: str) -> None:
    log.warning("%s = %s counts for nothing: it is no absolute path of a folder of yours with mode 700", ONLY, folder)


def _candidates() -> tuple[Path, ...]:
    """Folders in which this user's programs may meet, the best one first."""
    user = os.geteuid()
    own, temporary = (os.environ.get(name, "") for name in ("XDG_RUNTIME_DIR", "TMPDIR"))
    folders = [Path(own) / "shoal"] if Path(own).is_absolute() else []
    folders += [RUN / str(user) / "shoal", TEMPORARY / f"shoal-{user}"]
    folders += [Path(temporary) / f"shoal-{user}"] if Path(temporary).is_absolute() else []
    return tuple(dict.fromkeys(folders))


def is_private(folder: Path, make: bool = False) -> bool:
    """True for a folder of this user that nobody else may enter. With `make` it is made where its parent is there."""
    try:
        if make:
            folder.mkdir(mode=0o700, exist_ok=True)
        info = folder.lstat()
    except (OSError, ValueError):
        return False
    return stat.S_ISDIR(info.st_mode) and info.st_uid == os.geteuid() and not stat.S_IMODE(info.st_mode) & 0o077


def fits(socket: Path) -> bool:
    """True if a Unix socket can have this path."""
    return len(os.fsencode(socket)) <= LONGEST_SOCKET
