"""SHELL: the file that says at which depth a thruster board took its zero; it outlives the robot's computer.

A board that does not report how its lives begin (docs/board.md, "After a reset") takes the pressure at which it is switched on
for that at the surface. While the agent runs, it sees a restart of such a board under water (shoal/mavlink/power_on_depth.py).
This file is for what no program sees: board and computer lose their power together, or the agent ends between. It holds the
robot's last depth and which life of the board that was: the computer's boot, and the instant in it at which the board was
switched on. A board of another life took its zero at that depth, as far as anybody knows, until a person confirms it
(`robot-agent confirm-zero`). Of a file that cannot be read, as one that a loss of power has cut, too.
"""

import errno
import json
import math
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from shoal.runtime.output_files import replacing
from shoal.runtime.runtime import log
from shoal.system.regular_files import read_regular

if TYPE_CHECKING:
    from shoal.mavlink.agent_link import Telemetry

SERVICE_FOLDER = Path("/var/lib/shoal-agent")  # StateDirectory of the service
FILE = "depth-zero.json"
MOST_BYTES = 1000
STEP_M = 0.05  # the file follows the depth in such steps
LOOK_S = 1.0  # between two looks at the telemetry
WRITE_S = 10.0  # between two depths that are written without waiting for the disk; a dive is written at once
SLACK_S, DRIFT = 5.0, 0.01  # of the instant at which a board was switched on: what a burst waits, and how wrong its clock goes
MS_WRAPS = 2**32  # `time_boot_ms` begins at 0 again after 49.7 days


@dataclass(frozen=True)
class ZeroRecord:
    """The file's content."""

    boot: str  # the computer's, as Linux names it
    at_s: float  # when this was written, from that boot on
    board_on_s: float  # when the board was switched on, from that boot on; negative: before it
    zero_m: float  # depth at which the board took its zero
    depth_m: float  # of the robot, counted from the surface


def state_folder(environment: Mapping[str, str] = os.environ) -> Path | None:
    """The folder in which systemd has the service keep its state; None for a program that is no service."""
    return Path(environment["STATE_DIRECTORY"]) if environment.get("STATE_DIRECTORY") else None


def read_record(folder: Path) -> ZeroRecord | None:
    """Content of the file in a folder; None if there is none. Raises OSError, also for a file that holds no depth."""
    try:
        fields = json.loads(read_regular(folder / FILE, MOST_BYTES))
        record = ZeroRecord(str(fields.pop("boot")), **{name: _finite(value) for name, value in fields.items()})
    except FileNotFoundError:
        return None
    except (ValueError, TypeError, AttributeError, KeyError) as error:
        raise OSError(errno.EINVAL, f"holds no depth of a robot: {error}", str(folder / FILE)) from None
    return record


def _finite(value: Any) -> float:
    """A number of the file. Raises ValueError and TypeError."""
    if not math.isfinite(number := float(value)):
        raise ValueError(f"{value} is no number")
    return number


def write_record(folder: Path, record: ZeroRecord, durable: bool) -> None:
    """Put the file in its place. Raises OSError."""
    put_for_owner(folder / FILE, json.dumps(asdict(record)), durable)


def put_for_owner(path: Path, text: str, durable: bool) -> None:
    """Write a file for whom its folder belongs to: the service has to read what root writes. Raises OSError."""
    with replacing(path, durable, mode=0o600) as file:
        if os.geteuid() == 0:
            owner = path.parent.stat()
            os.fchown(file.fileno(), owner.st_uid, owner.st_gid)
        file.write(text.encode())


def boot_id() -> str:
    """Name of this computer's boot; empty where it has none."""
    path = Path("/proc/sys/kernel/random/boot_id")
    return path.read_text(encoding="ascii").strip() if path.exists() else ""


def boot_time_s() -> float:
    """Time since this computer's boot, sleep included."""
    return time.clock_gettime(time.CLOCK_BOOTTIME) if hasattr(time, "CLOCK_BOOTTIME") else time.monotonic()


def confirmed(telemetry: "Telemetry") -> ZeroRecord:
    """Record of a board whose zero a person has confirmed: its depths are counted from the surface."""
    now_s = boot_time_s()
    return ZeroRecord(boot_id(), now_s, now_s - 1e-3 * telemetry.board_ms, 0.0, telemetry.depth_m)


class BoardZero:
    """The file of one robot's program, and what it says about the board that is heard."""

    def __init__(self, folder: Path | None, boot: str = "", now_s: Callable[[], float] = boot_time_s) -> None:
        """Without a `folder` nothing is kept."""
        self._folder, self._boot, self._now_s = folder, boot or boot_id(), now_s
        self._written: ZeroRecord | None = None
        self._looked_s = -math.inf
        self._failed = False
        self.is_unknown = False  # the file cannot be read: until a person decides, nobody knows where the zero was taken

    def confirm(self) -> None:
        """Take note that a person has confirmed the zero, or has had it taken anew."""
        self.is_unknown = False

    def note(self, telemetry: "Telemetry") -> float | None:
        """Take in the board's telemetry. Returns the depth of its zero if that is another one than `telemetry` has."""
        now_s = self._now_s()
        if self._folder is None or telemetry.board_ms < 0 or now_s - self._looked_s < LOOK_S or telemetry.reports_start:
            return None
        first, self._looked_s = self._looked_s == -math.inf, now_s
        zero_m = telemetry.power_on_depth_m
        board_on_s = now_s - 1e-3 * telemetry.board_ms
        record = self._read() if first else None
        if record is not None:
            zero_m = record.zero_m if self._same_life(record, now_s, board_on_s) else record.depth_m
            if zero_m > STEP_M:
                log.warning("the thruster board's depth zero is taken to be at %.2f m, the robot's last known depth", zero_m)
        depth_m = telemetry.depth_m + zero_m
        self._keep(ZeroRecord(self._boot, now_s, board_on_s, zero_m, depth_m))
        return zero_m if zero_m != telemetry.power_on_depth_m else None

    def _read(self) -> ZeroRecord | None:
        """The record in the file; None if there is none, or it cannot be read, which is reported."""
        try:
            return read_record(self._folder) if self._folder is not None else None
        except OSError as error:
            log.warning("%s: %s: the thruster board's depth zero is in question", error.filename, error.strerror)
            self.is_unknown = True
            return None

    def _same_life(self, record: ZeroRecord, now_s: float, board_on_s: float) -> bool:
        """True if the board has not been switched on since the file was written."""
        if record.boot != self._boot:  # the computer was: a board that was on before that has its own supply
            return board_on_s < -SLACK_S - DRIFT * now_s
        apart_s = (board_on_s - record.board_on_s) % (1e-3 * MS_WRAPS)
        return min(apart_s, 1e-3 * MS_WRAPS - apart_s) <= SLACK_S + DRIFT * (now_s - record.at_s)

    def _keep(self, record: ZeroRecord) -> None:
        """Write a record that says something new; none over a file that nobody could read, before a person has decided."""
        if self.is_unknown:
            return
        before = self._written
        if before is not None and before.zero_m == record.zero_m and self._same_life(before, record.at_s, record.board_on_s):
            moved_m = abs(record.depth_m - before.depth_m)
            dives = before.depth_m <= STEP_M < record.depth_m  # with the depth at the surface it would be armed below
            if moved_m < STEP_M or (record.at_s - before.at_s < WRITE_S and not dives):
                return
        self._written = record
        try:
            assert self._folder is not None
            write_record(self._folder, record, durable=False)
        except OSError as error:  # a full disk is no reason to stop
            self._tell(error)

    def _tell(self, error: OSError) -> None:
        if not self._failed:
            log.warning("the robot's depth cannot be kept: %s", error)
        self._failed = True
