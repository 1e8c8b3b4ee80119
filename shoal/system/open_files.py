"""SHELL: the limit of files and connections that this process may have open, and the errors of one too many."""

import contextlib
import errno
import resource

FILES_APART = 64  # file descriptors for everything but connections
NO_FILES = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)  # nothing to accept a connection with
REST_S = 0.1  # before the next attempt to accept one


def allow_files(count: int) -> int:
    """Raise the process's soft limit of open files to `count`, as far as that is allowed. Returns the limit."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != resource.RLIM_INFINITY and soft < count:
        with contextlib.suppress(ValueError, OSError):  # some systems know a hard limit that they do not grant
            limit = count if hard == resource.RLIM_INFINITY else min(count, hard)
            resource.setrlimit(resource.RLIMIT_NOFILE, (limit, hard))
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return count if soft == resource.RLIM_INFINITY else soft
