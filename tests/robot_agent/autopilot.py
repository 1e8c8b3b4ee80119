"""An autopilot on a link in memory, where the thruster board belongs, and what it is sent."""

from pymavlink.dialects.v20 import common as dialect

from shoal.mavlink.board_port import Link
from shoal.mavlink.framing import Receiver, Sender
from shoal.mavlink.signing import SignatureVerifier


class Autopilot(Link):
    """An autopilot that is armed, and reports no depth that can be true."""

    def __init__(self, system: int = 1, kind: int = dialect.MAV_AUTOPILOT_ARDUPILOTMEGA) -> None:
        self._kind, self._sender, self._sent = kind, Sender((system, 1)), bytearray()

    @property
    def received(self) -> set[str]:
        """Kinds of the messages that it was sent."""
        return {
            message.get_type()
            for message in Receiver(lambda peer: True, SignatureVerifier(None)).receive(bytes(self._sent), 0)
        }

    def send(self, data: bytes) -> None:
        self._sent += data

    def read(self) -> bytes:
        """Its heartbeat, once it has heard anybody."""
        armed = dialect.MAV_MODE_FLAG_SAFETY_ARMED
        beat = dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_SUBMARINE, self._kind, armed, 0, dialect.MAV_STATE_ACTIVE, 3)
        return self._sender.pack(beat) if self._sent else b""

    def wait(self, timeout_s: float) -> None: ...
    def close(self) -> None: ...
