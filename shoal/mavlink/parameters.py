"""The parameters of a thruster board, asked for and set by a program beside the robot's own, as a ground station would.

Sans-IO, like shoal/mavlink/agent_link.py: the caller carries the bytes and has the clock.
"""

from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import common as dialect

from shoal.mavlink.agent_link import BOARD_COMPONENT, PROTOCOL_VERSION, autopilot_name
from shoal.mavlink.frame_codec import Peer
from shoal.mavlink.framing import Receiver, Sender
from shoal.mavlink.parameter_list import ParameterList
from shoal.mavlink.signing import Key, SignatureVerdict, SignatureVerifier

STATION: Peer = (255, 190)  # what ground stations go by
DOES_NOT_EXIST: int = dialect.MAV_PARAM_ERROR_DOES_NOT_EXIST
LINK_ID = 1  # beside the robot's computer, which has 0


class ParameterClient:
    """The parameters received from a board, and the requests that are still open."""

    def __init__(self, robot_id: int | None = None, key: Key | None = None, now: Callable[[], int] = lambda: 0) -> None:
        """Make it for `robot_id`, or for the first board that is heard."""
        verifier = SignatureVerifier(key, floor=now())
        self.robot_id = robot_id
        self._sender = Sender(STATION, key, lambda: max(now(), verifier.newest + 1))
        self._receiver = Receiver(self._is_board, verifier)
        self.has_answered = False
        self.autopilot: str | None = (
            None  # name of the autopilot at the other end; empty: a thruster board; None: not known yet
        )
        self._others: set[int] = set()  # robots whose boards speak on the link as well
        self._key = key
        self._list = ParameterList()
        self.last_words = ""  # the board's last words
        self._name = ""  # name of the parameter that was asked for or set last
        self.error: tuple[str, int] | None = None  # PARAM_ERROR about that one: its name, MAV_PARAM_ERROR

    def _is_board(self, peer: Peer) -> bool:
        """True for the peer whose parameters are wanted. Boards of other robots are remembered, to name them in messages."""
        wanted = self.robot_id in (None, peer[0])
        if peer[1] == BOARD_COMPONENT and not wanted:
            self._others.add(peer[0])
        return peer[1] == BOARD_COMPONENT and wanted

    def heartbeat(self) -> bytes:
        """Frame that says that this end is there: a board behind UDP learns whom to answer."""
        message = dialect.MAVLink_heartbeat_message(
            dialect.MAV_TYPE_GCS, dialect.MAV_AUTOPILOT_INVALID, 0, 0, dialect.MAV_STATE_ACTIVE, PROTOCOL_VERSION
        )
        return self._sender.pack(message)

    def ask_all(self) -> bytes:
        """Ask for all, or for those that are still missing of a list that has begun to come."""
        return b"".join(map(self._sender.pack, self._list.requests(self.robot_id or 0, BOARD_COMPONENT)))

    def ask(self, name: str) -> bytes:
        self._name, self.error = name, None
        message = dialect.MAVLink_param_request_read_message(self.robot_id or 0, BOARD_COMPONENT, name.encode("ascii"), -1)
        return self._sender.pack(message)

    def set(self, name: str, value: float) -> bytes:
        """Ask for another value; the board answers with the one it then has."""
        self._name, self.error = name, None
        real = dialect.MAV_PARAM_TYPE_REAL32
        message = dialect.MAVLink_param_set_message(self.robot_id or 0, BOARD_COMPONENT, name.encode("ascii"), value, real)
        return self._sender.pack(message)

    def give(self, key: Key, newest: int) -> bytes:
        """Have the board sign from now on, and take nothing that is signed with a time up to `newest`. Whoever can read the
        wire then has the key."""
        message = dialect.MAVLink_setup_signing_message(self.robot_id or 0, BOARD_COMPONENT, list(key.secret), newest)
        return self._sender.pack(message)

    @property
    def values(self) -> dict[str, float]:
        """The values that have come, by name."""
        return self._list.values

    @property
    def value_count(self) -> int:
        """Number of values that came, the same again too."""
        return self._list.value_count

    @property
    def complete(self) -> bool:
        """True if every parameter has come."""
        return self._list.is_complete

    def objection(self, trouble: str = "") -> str:
        """The reason to send nothing more: an autopilot is there, or nobody is heard (see `silence`); empty for a thruster
        board."""
        if self.autopilot:
            return f"{self.autopilot} is there, no thruster board: it takes pulses for a pilot's sticks"
        return self.silence(trouble)

    def silence(self, trouble: str = "") -> str:
        """The reason why no board is heard, from the messages so far or else the link's `trouble`; empty if one is heard."""
        if self.has_answered:
            return ""
        if self._others:
            return f"heard: the board of robot {min(self._others)}, not that of robot {self.robot_id}"
        if self._receiver.refused[SignatureVerdict.FORGED]:
            return "a board is heard that signs " + ("with another key" if self._key else "(--link-key FILE)")
        if self._receiver.refused[SignatureVerdict.UNSIGNED]:
            return "a board is heard that has no key (over a cable, `robot-agent params give-key FILE` gives it one)"
        return trouble or "no board is heard (is it powered?)"

    @property
    def signed(self) -> bool:
        """True if the board signs with a key other than this end's."""
        return self._receiver.refused[SignatureVerdict.FORGED] > 0

    def receive(self, data: bytes, now_ns: int) -> None:
        """Take in bytes that arrived at `now_ns`. Never raises, whatever they are."""
        for message in self._receiver.receive(data, now_ns):
            self._read(message)

    def _read(self, message: Any) -> None:
        """Take in a message of the board: who it is, a parameter, an error, its last words."""
        kind = message.get_type()
        self.has_answered = True
        if kind == "HEARTBEAT":
            self.robot_id = message.get_srcSystem()  # the one that is wanted, if one is
            self.autopilot = autopilot_name(message.autopilot)
        if kind == "PARAM_VALUE":
            self._list.note_value(message)
        is_ours = kind == "PARAM_ERROR" and (message.target_system, message.target_component) == STATION
        if is_ours and message.param_id == self._name:  # another name: it is late, and about what was asked for before
            self.error = (message.param_id, message.error)
        if kind == "STATUSTEXT":
            self.last_words = message.text
