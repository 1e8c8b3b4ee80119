"""SHELL: the key of a signed thruster link in a file, and the times that its signatures have used up."""

import os
import secrets
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from shoal.errors import ConfigError
from shoal.mavlink.agent_link import AgentLink
from shoal.mavlink.signing import KEY_BYTES, LATEST, Key, ticks
from shoal.runtime.output_files import replace_text, replacing
from shoal.system.regular_files import read_regular
from shoal.system.secret_files import refuse_shared

# A program writes down how far it may count before it counts there. Half of this is left when it writes again, from its
# control loop and without waiting for the disk: longer than a file system holds writes back (ext4: 5 s).
AHEAD_TICKS = 6_000_000  # 60 s
MOST_BYTES = 1000  # of a key, or a time
HOW = "make one with `robot-agent link-key FILE` and give the board the same"


def new_key(path: Path) -> None:
    """Write a new key, readable by its owner only. Raises ConfigError rather than to write over one."""
    try:
        with replacing(path, mode=0o600, over=False) as file:
            file.write(f"{secrets.token_hex(KEY_BYTES)}\n".encode("ascii"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be made: {error.strerror}") from None


def write_key(path: Path, key: Key) -> None:
    """Put a key in the place of one that may be there, readable by its owner only. Raises OSError."""
    with replacing(path, mode=0o600) as file:
        file.write(f"{key.secret.hex()}\n".encode("ascii"))


def load_key(path: Path, link_id: int = 0) -> Key:
    """The key of a file that no other user can read. Raises ConfigError, which never shows what is in the file."""
    try:
        text = read_regular(path, MOST_BYTES).decode("ascii").strip()
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such link key ({HOW})") from None
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "not a text"  # never what is in it
        raise ConfigError(f"{path}: cannot be read as a link key: {why}") from None
    refuse_shared(path, "the link key")
    try:
        return Key(bytes.fromhex(text), link_id)
    except ValueError:
        raise ConfigError(f"{path}: not a link key (allowed: {2 * KEY_BYTES} hexadecimal digits; {HOW})") from None


class TimestampStore:
    """The time for signatures, in ticks: Unix time, but never before what an earlier life of this program has used."""

    def __init__(self, path: Path, unix_ns: Callable[[], int] = time.time_ns) -> None:
        """The file at `path` holds the time up to which timestamps may have been used. Raises ConfigError if it cannot be
        kept."""
        self._path, self._unix_ns = path, unix_ns
        try:
            used_before = _read_time(path) if path.exists() else 0
            self._least = self._limit = used_before
            now = self()
            self._reserve(now, durable=True)
        except OSError as error:
            raise ConfigError(f"{path}: the times that signatures have used cannot be kept: {error}") from None

    def __call__(self) -> int:
        """Now. What is signed with it, and with the few thousand ticks after it, is covered by the file."""
        return max(ticks(self._unix_ns()), self._least)

    def renew(self, used: int) -> None:
        """Write the file again if `used` has come near to what it covers. Call it now and then."""
        if used > self._limit - AHEAD_TICKS // 2:
            self._reserve(used)

    def _reserve(self, used: int, durable: bool = False) -> None:
        self._limit = used + AHEAD_TICKS
        replace_text(self._path, str(self._limit), durable)


def _read_time(path: Path) -> int:
    """The time that a file of these holds. Raises OSError, and ConfigError for one that a loss of power has cut."""
    try:
        time = int(read_regular(path, MOST_BYTES))
    except ValueError:
        time = -1
    if not 0 <= time <= LATEST:
        raise ConfigError(
            f"{path}: the times that signatures have used cannot be kept: it holds none, as after a loss of power "
            "(remedy: see that this computer's clock is right, then remove the file)"
        )
    return time


@dataclass(frozen=True)
class Signing:
    """The key of a program, and the timestamps it has used."""

    key: Key
    stamps: TimestampStore

    @classmethod
    def of(cls, path: Path, program: str, link_id: int = 0) -> "Signing":
        """The key of a file, and the file of the times that this program has used: beside it, or where systemd has a service
        keep its state, which is all that it may write. Raises ConfigError."""
        folder = Path(os.environ.get("STATE_DIRECTORY") or path.parent)
        return cls(load_key(path, link_id), TimestampStore(folder / f"{path.name}.{program}-stamps"))


def agent_end(robot: int, signing: Signing | None) -> AgentLink:
    """The end of a link at a robot's computer, signed if there is something to sign with."""
    return AgentLink(robot) if signing is None else AgentLink(robot, signing.key, signing.stamps)
