"""SHELL: a person's word about the thruster board's depth zero, from `robot-agent confirm-zero` to the board.

The robot's program has the board's port. So the command puts a request into the folder where the service keeps its state; the
program sends it to the board and takes the file away once the board has acknowledged it, or writes into it why it was refused.
If nobody takes it, the command opens the link itself. One command asks at a time: of two, each would take the end of the
other's request for the answer to its own. What a killed command has left counts no more: a request says in which boot of the
computer it was made, and when, by a clock that nobody sets. A robot's computer often has no other clock after a start.
"""

import fcntl
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

from robot_agent.host.board_zero import boot_id, boot_time_s, put_for_owner
from robot_agent.host.config import AgentConfig, open_board_link
from shoal.errors import ConfigError
from shoal.mavlink.agent_link import ACCEPTED, CALIBRATE, UNSUPPORTED, AgentLink, Telemetry
from shoal.mavlink.signing_key import agent_end
from shoal.runtime.output_files import replace_text
from shoal.system.regular_files import read_regular

FILE = "zero-request"
KEPT, AIR = "kept", "air"  # what is kept is right; the robot is in air, take the zero anew
REFUSED = "refused "  # begins the answer to a request that was refused; the reason follows
MOST_BYTES = 200
LOOK_S = 0.5  # of the robot's program at the folder; and how often the board is told again
WITHIN_S = 4.0  # for the robot's program, and for the board, beyond what it needs before it speaks


class ZeroRequests:
    """The requests that come to a robot's program."""

    def __init__(
        self,
        folder: Path | None,
        now_s: Callable[[], float] = time.monotonic,
        on_confirmed: Callable[[], None] = lambda: None,
    ) -> None:
        """Without a `folder` none come. `on_confirmed` is called when the board has carried one out."""
        self._folder, self._now_s, self._looked_s, self._on_confirmed = folder, now_s, -LOOK_S, on_confirmed
        self._open = ""  # text of the request that the board is asked to carry out; "" if there is none
        self._acknowledged_before = 0  # the board's acknowledgements when that request was new

    def step(self, link: AgentLink, has_power: bool = False) -> bytes:
        """Frame for the board, empty if there is none to send now. Ends a request that the board has acknowledged, and refuses
        one that it has refused or that comes at a wrong time: `has_power`, the robot may move."""
        now_s, board = self._now_s(), link.telemetry
        if self._folder is None or now_s - self._looked_s < LOOK_S:
            return b""
        self._looked_s = now_s
        request = self._read_file()
        if not request or request != self._open:
            self._open, self._acknowledged_before = request, board.acknowledgements
        elif self._is_answered(board) and board.acknowledged in answers(_is_in_air(request)):
            link.set_zero(0.0)  # of a board that does not report its restarts
            self._on_confirmed()
            self._end()
            return b""
        if not request:
            return b""
        refusal = "the robot has power: disarm it first" if has_power else self._refusal(board)
        if refusal:
            self._refuse(refusal)
            return b""
        return link.calibrate(pressure=_is_in_air(request)) if board.is_thruster_board else b""

    def _is_answered(self, board: Telemetry) -> bool:
        """True if the board has acknowledged something since the open request was new."""
        return board.acknowledgements > self._acknowledged_before

    def _refusal(self, board: Telemetry) -> str:
        """The reason why the board does not carry out the open request; empty if there is none."""
        if board.autopilot_name:
            return f"{board.autopilot_name} is on the link, no thruster board"
        return refusal_of(board, _is_in_air(self._open)) if self._is_answered(board) else ""

    def _read_file(self) -> str:
        """The request in the folder, all of its text; empty if there is none, or its command has ended."""
        assert self._folder is not None
        try:
            text = read_regular(self._folder / FILE, MOST_BYTES).decode("ascii", "replace")
            request, boot, at_s = text.split()
            age_s = boot_time_s() - float(at_s)
        except (OSError, ValueError):
            return ""
        return text if request in (KEPT, AIR) and boot == _this_boot() and 0.0 <= age_s <= 2.0 * WITHIN_S else ""

    def _end(self) -> None:
        """Take the file of a request away: that is the answer that it was carried out."""
        assert self._folder is not None
        self._open = ""
        with suppress(OSError):
            (self._folder / FILE).unlink()

    def _refuse(self, reason: str) -> None:
        """Write the reason into the file in place of the request."""
        assert self._folder is not None
        self._open = ""
        with suppress(OSError):  # the command then waits in vain
            replace_text(self._folder / FILE, f"{REFUSED}{reason}", durable=False)


def _is_in_air(request: str) -> bool:
    """True for a request to take the zero anew in air, False for one to keep it (`write_request`)."""
    return request.startswith(AIR)


def answers(in_air: bool) -> tuple[tuple[int, int], ...]:
    """The answers of a board that has carried a request out, as far as there is something to do: one that knows no such
    command keeps its zero, and takes none anew."""
    return ((CALIBRATE, ACCEPTED),) if in_air else ((CALIBRATE, ACCEPTED), (CALIBRATE, UNSUPPORTED))


def refusal_of(board: Telemetry, in_air: bool) -> str:
    """The reason for which a board has refused a request, for a person; empty if it has not refused."""
    answer = board.acknowledged
    if answer is None or answer[0] != CALIBRATE or answer in answers(in_air):
        return ""
    if answer[1] == UNSUPPORTED:
        return "the board cannot take its zero anew when it is told to: restart it in air"
    return f"the board refuses: {board.texts[-1][1] if board.texts else f'MAV_RESULT {answer[1]}'}"


def _this_boot() -> str:
    return boot_id() or "unnamed"


def write_request(path: Path, in_air: bool) -> None:
    """Make a request now. Raises OSError."""
    put_for_owner(path, f"{AIR if in_air else KEPT} {_this_boot()} {boot_time_s():.3f}", durable=False)


@contextmanager
def only_request(folder: Path) -> Iterator[None]:
    """Let no other command ask meanwhile. Raises ConfigError if one does, and OSError."""
    if not folder.is_dir():
        yield
        return
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ConfigError(f"{folder}: another confirm-zero is under way: wait for its answer") from None
        yield
    finally:
        os.close(descriptor)


def ask_program(folder: Path, in_air: bool) -> bool:
    """Have the robot's program send the request, as the only one (`only_request`). False if none takes it up. Raises OSError,
    and ConfigError with the reason if it is refused."""
    if not folder.is_dir():
        return False
    path = folder / FILE
    write_request(path, in_air)
    try:
        end_s = time.monotonic() + WITHIN_S
        while path.exists() and time.monotonic() < end_s:
            with suppress(FileNotFoundError):
                answer = read_regular(path, MOST_BYTES).decode("ascii", "replace")
                if answer.startswith(REFUSED):
                    raise ConfigError(answer.removeprefix(REFUSED))
            time.sleep(0.05)
        return not path.exists()
    finally:
        with suppress(OSError):
            path.unlink()


def tell_board(config: AgentConfig, in_air: bool) -> Telemetry:
    """Send the request over the link, again and again until the board answers.

    Returns the board's telemetry of the first burst after its answer, or the last one with `board_ms` -1 if no burst follows.
    A board that does not know the command answers UNSUPPORTED, which is a success for a zero to be kept. Raises ConfigError if
    the board refuses or does not answer.
    """
    wires, signing = open_board_link(config)
    mavlink = agent_end(config.robot, signing)
    answer_burst_ms: int | None = None  # time of the last burst before the answer, on the board's clock
    try:
        end_s, sent_s = time.monotonic() + WITHIN_S + wires.first_word_s, 0.0
        while time.monotonic() < end_s:
            if time.monotonic() - sent_s > LOOK_S:
                sent_s = time.monotonic()
                wires.send(mavlink.heartbeat())
                if mavlink.telemetry.is_thruster_board and answer_burst_ms is None:
                    wires.send(mavlink.calibrate(pressure=in_air))
            wires.wait(0.05)
            mavlink.receive(wires.read(), time.monotonic_ns())
            telemetry = mavlink.telemetry
            if answer_burst_ms is not None and telemetry.board_ms != answer_burst_ms:
                return telemetry
            if telemetry.acknowledged in answers(in_air):
                answer_burst_ms = telemetry.board_ms
            elif refusal := refusal_of(telemetry, in_air):
                raise ConfigError(f"{config.link}: {refusal}")
        if answer_burst_ms is not None:
            return replace(mavlink.telemetry, board_ms=-1)
        raise ConfigError(f"{config.link}: {wires.trouble or 'the board does not answer'}")
    finally:
        wires.close()
