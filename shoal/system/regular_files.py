"""SHELL: files that another person, or another program, may have put there: read only if they are files, and not too large.

Opening a named pipe waits for its other end, and a device has no end: one such name in a folder would hang the program that
looks into it, or take its memory.
"""

import errno
import os
import stat
from pathlib import Path
from typing import BinaryIO


def open_regular(path: Path) -> BinaryIO:
    """Open for reading. Raises OSError, also for what is no regular file, and then without having waited for it."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    if stat.S_ISREG(os.fstat(descriptor).st_mode):
        return os.fdopen(descriptor, "rb")
    os.close(descriptor)
    raise OSError(errno.EINVAL, "is no regular file", str(path))


def read_regular(path: Path, most_bytes: int) -> bytes:
    """All bytes of a file. Raises OSError, also for a larger one, of which no more is read than that."""
    with open_regular(path) as file:
        data = file.read(most_bytes + 1)
    if len(data) > most_bytes:
        raise OSError(errno.EFBIG, f"is larger than {most_bytes} bytes, the most that is read", str(path))
    return data
