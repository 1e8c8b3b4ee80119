"""Errors that end a program with one message: a configuration that cannot be used, a station that cannot be reached."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class ConfigError(Exception):
    """A configuration that cannot be used. The message is for the person who wrote the file."""


class Unreached(Exception):
    """The station's router cannot be reached, or the process is to stop before it could be."""


@contextmanager
def os_errors_as_config_errors(path: Path) -> Iterator[None]:
    """Turns errors of the file system inside the block into a ConfigError that names the file and the reason."""
    try:
        yield
    except OSError as error:
        raise ConfigError(f"{error.filename or path}: {error.strerror or error}") from None
