"""SHELL: a person's word about the thruster board's depth zero, from `robot-agent confirm-zero` to the board.

The robot's program has the board's port. So the command puts a request into the folder where the service keeps its state; the
program sends it to the board and takes the file away once the board has acknowledged it. If nobody takes it, the command opens
the link itself. What a killed command has left counts no more: a request says in which boot of the computer it was made, and
when, by a clock that nobody sets. A robot's computer often has no other clock after a start.
"""

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from robot_agent.host.board_zero import boot_id, boot_time_s
from robot_agent.host.config import AgentConfig, open_board_link
from shoal.errors import ConfigError
from shoal.mavlink.agent_link import ACCEPTED, CALIBRATE, UNSUPPORTED, AgentLink, Telemetry
from shoal.mavlink.signing_key import agent_end
from shoal.runtime.output_files import replace_text
from shoal.system.regular_files import read_regular

FILE = "zero-request"
KEPT, AIR = "kept", "air"  # what is kept is right; the robot is in air, take the zero anew
MOST_BYTES = 100
LOOK_S = 0.5  # of the robot's program at the folder; and how often the board is told again
WITHIN_S = 4.0  # for the robot's program, and for the board, beyond what it needs before it speaks


class ZeroRequests:
    """The requests that come to a robot's program."""

    def __init__(self, folder: Path | None, now_s: Callable[[], float] = time.monotonic) -> None:
        """Without a `folder` none come."""
        self._folder, self._now_s, self._looked_s = folder, now_s, -LOOK_S
        self._before = 0  # acknowledgements of the board when it was first told; meaningful while a request is open
        self._open = ""

    def step(self, link: AgentLink) -> bytes:
        """Frame for the board, empty if there is none to send now. Ends a request that the board has acknowledged."""
        now_s, board = self._now_s(), link.telemetry
        if self._folder is None or now_s - self._looked_s < LOOK_S:
            return b""
        self._looked_s = now_s
        request = self._read()
        if not request or request != self._open:
            self._open, self._before = request, board.acknowledgements
        elif board.acknowledgements > self._before and board.acknowledged in ((CALIBRATE, ACCEPTED), (CALIBRATE, UNSUPPORTED)):
            link.set_zero(0.0)  # of a board that does not report its restarts
            self._end()
            return b""
        return link.calibrate(pressure=request == AIR) if request else b""

    def _read(self) -> str:
        """The request in the folder; empty if there is none, or its command has ended."""
        assert self._folder is not None
        try:
            request, boot, at_s = read_regular(self._folder / FILE, MOST_BYTES).decode("ascii", "replace").split()
            age_s = boot_time_s() - float(at_s)
        except (OSError, ValueError):
            return ""
        return request if request in (KEPT, AIR) and boot == _this_boot() and 0.0 <= age_s <= 2.0 * WITHIN_S else ""

    def _end(self) -> None:
        assert self._folder is not None
        self._open = ""
        with suppress(OSError):
            (self._folder / FILE).unlink()


def _this_boot() -> str:
    return boot_id() or "unnamed"


def write_request(path: Path, in_air: bool) -> None:
    """Make a request now. Raises OSError."""
    replace_text(path, f"{AIR if in_air else KEPT} {_this_boot()} {boot_time_s():.3f}", durable=False)


def ask_program(folder: Path, in_air: bool) -> bool:
    """Have the robot's program send the request. False if none takes it up. Raises OSError."""
    if not folder.is_dir():
        return False
    path = folder / FILE
    write_request(path, in_air)
    try:
        end_s = time.monotonic() + WITHIN_S
        while path.exists() and time.monotonic() < end_s:
            time.sleep(0.05)
        return not path.exists()
    finally:
        with suppress(OSError):
            path.unlink()


def tell_board(config: AgentConfig, in_air: bool) -> Telemetry:
    """Send the request over the link. Returns what the board reports since it has answered; it has answered UNSUPPORTED if it
    knows no such command, and `board_ms` is -1 if no depth came. Raises ConfigError if the board refuses."""
    wires, signing = open_board_link(config)
    mavlink = agent_end(config.robot, signing)
    answered_ms: int | None = None  # time of the burst before the answer, on the board's clock
    try:
        end_s, told_s = time.monotonic() + WITHIN_S + wires.first_word_s, 0.0
        while time.monotonic() < end_s:
            if time.monotonic() - told_s > LOOK_S:
                told_s = time.monotonic()
                wires.send(mavlink.heartbeat())
                if mavlink.telemetry.is_thruster_board and answered_ms is None:
                    wires.send(mavlink.calibrate(pressure=in_air))
            wires.wait(0.05)
            mavlink.receive(wires.read(), time.monotonic_ns())
            telemetry = mavlink.telemetry
            answer = telemetry.acknowledged
            if answered_ms is not None and telemetry.board_ms != answered_ms:
                return telemetry
            if answer in ((CALIBRATE, ACCEPTED), (CALIBRATE, UNSUPPORTED)):
                answered_ms = telemetry.board_ms
            elif answer is not None and answer[0] == CALIBRATE:
                answer_text = telemetry.texts[-1][1] if telemetry.texts else f"MAV_RESULT {answer[1]}"
                raise ConfigError(f"{config.link}: the board refuses: {answer_text}")
        if answered_ms is not None:
            return replace(mavlink.telemetry, board_ms=-1)
        raise ConfigError(f"{config.link}: {wires.trouble or 'the board does not answer'}")
    finally:
        wires.close()
