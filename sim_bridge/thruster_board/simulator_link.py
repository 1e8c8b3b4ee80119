"""The simulator's end of the link to a board in HIL mode, sans-IO: simulated measurements out; outputs and mode in.

The terms are in docs/board.md; the board's end is sim_bridge/thruster_board/board_link.py.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

from pymavlink.dialects.v20 import common as dialect

from shoal.mavlink.agent_link import BOARD_COMPONENT, SERVOS, SIMULATOR_COMPONENT, Refused, depth_to_hpa, pulses_of
from shoal.mavlink.framing import Receiver, Sender
from shoal.mavlink.signing import Key, SignatureVerifier
from sim_bridge.thruster_board.board_link import HIL_FIELDS, MOST_MILLIVOLTS

LINK_ID = 3  # beside the robot's computer (0) and the programs of people
FIELD_GAUSS = 0.5  # length of the simulated magnetic field; only its direction counts
RESTART_US = 500_000  # us by which the board's clock and ours may part between two echoes; more is another life of the board


class SimulatorLink:
    """The latest outputs and mode that a board has told, and the packing of its simulated measurements."""

    def __init__(self, robot_id: int, key: Key | None = None, now: Callable[[], int] = lambda: 0) -> None:
        """Make the link. With a `key` it is signed; `now()` is the time in ticks."""
        verifier = SignatureVerifier(key, floor=now())
        self._sender = Sender((robot_id, SIMULATOR_COMPONENT), key, lambda: max(now(), verifier.newest + 1))
        self._receiver = Receiver(lambda peer: peer == (robot_id, BOARD_COMPONENT), verifier)
        self._board_us = 0
        self.echo_us: tuple[int, ...] = ()  # outputs: 4 thrusters, 4 ankles
        self.echo_ns: int | None = None  # when they were heard
        self.armed = False
        self.hil: bool | None = None  # in HIL mode or not; None: not told since the board's clock last jumped

    @property
    def stamp(self) -> int:
        """The latest timestamp of a signature that this end has sent; 0 without a key."""
        return self._sender.signer.last if self._sender.signer is not None else 0

    def motion(
        self, time_us: int, heading_rad: float, yaw_rate_radps: float, acceleration_mps2: Sequence[float], depth_m: float
    ) -> bytes:
        """Measurements of the motion; `acceleration_mps2` is the specific force in the body frame."""
        ahead, side = FIELD_GAUSS * math.cos(heading_rad), -FIELD_GAUSS * math.sin(heading_rad)
        turn, field = (0.0, 0.0, yaw_rate_radps), (ahead, side, 0.0)
        hpa = depth_to_hpa(depth_m)
        return self._sender.pack(
            dialect.MAVLink_hil_sensor_message(time_us, *acceleration_mps2, *turn, *field, hpa, 0.0, 0.0, 20.0, HIL_FIELDS)
        )

    def battery(self, voltage_v: float) -> bytes:
        """Measurement of the whole battery."""
        cells = [min(max(round(voltage_v * 1000.0), 0), MOST_MILLIVOLTS), *[65535] * 9]
        unknown_temperature, whole = 32767, (0, dialect.MAV_BATTERY_FUNCTION_ALL, dialect.MAV_BATTERY_TYPE_LIPO)
        return self._sender.pack(dialect.MAVLink_battery_status_message(*whole, unknown_temperature, cells, -1, -1, -1, -1))

    def receive(self, data: bytes, now_ns: int) -> None:
        """Take in bytes that arrived at `now_ns`. Never raises, whatever they are."""
        for message in self._receiver.receive(data, now_ns):
            kind = message.get_type()
            if kind == "HEARTBEAT":
                self.armed = bool(message.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED)
                self.hil = bool(message.base_mode & dialect.MAV_MODE_FLAG_HIL_ENABLED)
            elif kind == "SERVO_OUTPUT_RAW":
                self._note_echo(message, now_ns)

    def _note_echo(self, message: Any, now_ns: int) -> None:
        """Take in the outputs. A board whose clock has jumped was restarted: its mode is not known until it tells it again."""
        try:
            echo_us = pulses_of(message, SERVOS, ignorable=False)
        except Refused:
            return
        if self.echo_ns is not None:
            board_us = (message.time_usec - self._board_us) % 2**32
            if abs(board_us - (now_ns - self.echo_ns) // 1000) > RESTART_US:
                self.hil = None
        self.echo_us, self.echo_ns, self._board_us = echo_us, now_ns, message.time_usec
