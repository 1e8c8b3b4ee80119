"""SHELL: a real thruster board in HIL mode, in the place of a simulated one: `sim-bridge hil`.

    agent -> its port (board_ports.py) -> gate -> board -> SERVO_OUTPUT_RAW -> plant -> HIL_SENSOR -> board
                                                  board -> telemetry -> agent

The gate lets an agent's frames through only to a board that has just said that it is in HIL mode. So a board on whose
pins thrusters may turn is never armed from here.
"""

import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path

from shoal.config.experiment import Experiment
from shoal.errors import ConfigError
from shoal.frames import Array
from shoal.mavlink.agent_link import IGNORED
from shoal.mavlink.board_port import Link, open_link
from shoal.mavlink.parameters import DOES_NOT_EXIST, ParameterClient
from shoal.mavlink.signing import SignatureVerifier
from shoal.mavlink.signing_key import Signing
from shoal.runtime.runtime import Failed, log
from sim_bridge.plant.sensors import BoardSensors
from sim_bridge.thruster_board.board import STATUS_NS, DemandedLoad, crosses
from sim_bridge.thruster_board.board_link import BoardLink, Override, SetParameter
from sim_bridge.thruster_board.parameters import VOLATILE
from sim_bridge.thruster_board.simulator_link import LINK_ID, SimulatorLink

HEARD_WITHIN_S = 5.0
ASK_AGAIN_S = 0.3
YOUNG_NS = 100_000_000  # ns, age of the echo up to which bytes pass: less than a board takes to start again
SILENT_NS = 1_000_000_000  # ns without an echo, after which the run ends
MODE_NS = 2_500_000_000  # ns without a word about the mode, after which the run ends: two heartbeats
ORDERS_KEPT = 8  # orders whose effect may still be on its way back; at 50 Hz those of 0.16 s


class HilBoard:
    """One robot's real board: its outputs move the robot in the plant, whose motion it is told as measurements."""

    next_event_ns = 0  # something may have come from the board at any time
    burst_ms = -1  # by which a lockstep run waits for a board; this one runs by its own clock

    def __init__(
        self, experiment: Experiment, robot_id: int, seed: int, where: str, link: Link, signing: Signing | None
    ) -> None:
        """`where`: the board's address, for texts. `link` is open, and the caller closes it. `signing` None: frames are not
        signed."""
        key, now = (None, lambda: 0) if signing is None else (signing.key, signing.stamps)
        self.sensors = BoardSensors(experiment, robot_id, seed)
        thruster, self._where, self._robot_id = experiment.vehicle.thruster, where, robot_id
        self._load = DemandedLoad(thruster, experiment.vehicle.thruster_count)
        self._link, self._signing = link, signing
        self._judge = BoardLink(robot_id, SignatureVerifier(key))  # checks an agent's frames as the board does
        self._board = SimulatorLink(robot_id, key, now)
        self._burst_ns = round(1e9 / experiment.sim.sensors.rate_hz)  # between two measurements
        self._neutral_us, self._thruster_count = experiment.vehicle.neutral_us, experiment.vehicle.thruster_count
        self._begin_ns = 0  # instant of the first step
        self._mode_ns = 0  # last instant at which the board's mode was known
        self._last_step_ns: int | None = None
        # Instant of the order that this step's outputs obey; None if they have not changed, or obey none
        self.obeys_ns: int | None = None
        # (instant of passing it on, pulses in us) of each order whose pulses differ from those of the order before it
        self._orders: deque[tuple[int, tuple[int, ...]]] = deque(maxlen=ORDERS_KEPT)
        self._last_echo_us = self._neutral_us
        self._echo_was_ordered = True  # the last echo shows the pulses of an order

    @property
    def pulses(self) -> tuple[int, ...]:
        """Pulses of the board's outputs, us: 4 thrusters, 4 ankles."""
        return self._board.echo_us or self._neutral_us

    @property
    def armed(self) -> bool:
        """True if the board has said so."""
        return self._board.armed

    @property
    def neutral(self) -> bool:
        """True if all thrusters stand still."""
        return self.pulses[: self._thruster_count] == self._neutral_us[: self._thruster_count]

    def receive(self, data: bytes, now_ns: int) -> bool:
        """Pass an agent's frames on to the board, if it is in HIL mode. Returns True if one of them is one that the board
        takes. HIL_MODE and HIL_OUTPUTS cannot be changed through here. Only whole frames that were read go on: in other bytes
        the board might find a frame that was not."""
        before = self._judge.taken_frames
        self._judge.receive(data, now_ns)
        passed = [(f, e) for f, e in self._judge.read if not (isinstance(e, SetParameter) and e.name in VOLATILE)]
        if len(passed) < len(self._judge.read):
            log.warning("robot %d: a change of %s is not passed on", self._robot_id, " or ".join(VOLATILE))
        if passed and self._is_open(now_ns):
            self._link.send(b"".join(frame for frame, _ in passed))
            for pulses_us in (event.pulses_us for _, event in passed if isinstance(event, Override)):
                if not self._orders or pulses_us != self._orders[-1][1]:
                    self._orders.append((now_ns, pulses_us))
        return self._judge.taken_frames > before

    def _is_open(self, now_ns: int) -> bool:
        heard_ns = self._board.echo_ns
        return self._board.hil is True and heard_ns is not None and now_ns - heard_ns <= YOUNG_NS

    def measures(self, now_ns: int) -> bool:
        """True if the step to this instant reads the sensors."""
        return crosses(self._burst_ns, self._last_step_ns, now_ns)

    def step(
        self, now_ns: int, eta: Array, nu: Array, acceleration: Array, supply_v: float, tilt: Array | Sequence[float]
    ) -> bytes:
        """Send the measurements that are due. Returns what the board has sent, for its agent. The arguments are those of
        ThrusterBoard.step. Raises Failed if the board is not in HIL mode, or silent."""
        if self._last_step_ns is None:
            self._begin_ns = self._mode_ns = now_ns
            while self._link.read():  # what was sent before the run says nothing about the board's mode now
                pass
        data = self._link.read()
        self._board.receive(data, now_ns)
        self._require_hil(now_ns)
        self._note_outputs()
        if self.measures(now_ns):
            reading = self.sensors.read(eta, nu, acceleration, tilt, now_ns * 1e-9)
            values = (reading.heading_rad, reading.yaw_rate_radps, reading.acceleration_mps2, reading.depth_m)
            self._link.send(self._board.motion(now_ns // 1000, *values))
            if crosses(STATUS_NS, self._last_step_ns, now_ns):
                load = self._load.of(self.pulses)
                self._link.send(self._board.battery(self.sensors.battery_v(supply_v, load)))
                if self._signing is not None:
                    self._renew(self._signing)
        self._last_step_ns = now_ns
        return data

    def _note_outputs(self) -> None:
        """Note which order new outputs obey: the echo comes up to two periods of the board after it. Outputs that have still
        to slew obey none yet, nor do those at which they end: when that began is not known."""
        self.obeys_ns, last_was_ordered = None, self._echo_was_ordered
        if self.pulses == self._last_echo_us:
            return
        self._last_echo_us = self.pulses
        ordered_ns = [
            ns for ns, order in self._orders if all(o in (p, IGNORED) for o, p in zip(order, self.pulses, strict=True))
        ]
        self._echo_was_ordered = bool(ordered_ns)
        self.obeys_ns = ordered_ns[-1] if ordered_ns and last_was_ordered else None

    def _renew(self, signing: Signing) -> None:
        """Keep the times of signatures. A full disk is no reason to stop, as on a robot: only a restart would come too early
        for the board."""
        try:
            signing.stamps.renew(self._board.stamp)
        except OSError as error:
            log.warning("robot %d: the times of signatures cannot be kept: %s", self._robot_id, error)

    def _require_hil(self, now_ns: int) -> None:
        """Raise Failed for a board that is silent, or not in HIL mode."""
        board = self._board
        if board.hil is False:
            raise Failed(f"robot {self._robot_id}: {not_in_hil(self._where)}")
        heard_ns = self._begin_ns if board.echo_ns is None else board.echo_ns
        if now_ns - heard_ns > SILENT_NS:
            why = f"; {self._link.trouble}" if self._link.trouble else ""
            silent_s = (now_ns - heard_ns) * 1e-9
            raise Failed(f"robot {self._robot_id}: the board at {self._where} is silent for {silent_s:.1f} s{why}")
        if board.hil:
            self._mode_ns = now_ns
        elif now_ns - self._mode_ns > MODE_NS:
            raise Failed(f"robot {self._robot_id}: the board at {self._where} does not say whether it is in HIL mode")


def not_in_hil(where: str) -> str:
    """The text about a board that is not in HIL mode, with what to do."""
    return f"the board at {where} is not in HIL mode, any more: it was restarted, or told so (start this again, which sets it)"


def connect(robot_id: int, where: str, key: Path | None, insecure: bool) -> tuple[Link, Signing | None]:
    """Open the link to a real board and have it enter HIL mode: opening may reset a board, and a start leaves that mode.
    Raises ConfigError with the reason why it cannot be used."""
    signing = Signing.of(key, "hil", LINK_ID) if key is not None else None
    link = open_link(where, secured=signing is not None or insecure, option=f"--board {robot_id}")
    client = ParameterClient(robot_id) if signing is None else ParameterClient(robot_id, signing.key, signing.stamps)
    try:
        _set_mode(link, client)
        if client.values.get("HIL_MODE") == 1.0:
            return link, signing
        raise ConfigError(f"--board {robot_id}={where}: {client.objection(link.trouble) or _refusal(client)}")
    except ConfigError:
        link.close()
        raise


def _set_mode(link: Link, client: ParameterClient) -> None:
    """Tell a thruster board to enter HIL mode until it answers, or HEARD_WITHIN_S are over. An autopilot is told nothing."""
    end_s, asked_s = time.monotonic() + HEARD_WITHIN_S + link.first_word_s, 0.0
    while not (client.autopilot or client.error or client.values.get("HIL_MODE") == 1.0) and time.monotonic() < end_s:
        if time.monotonic() - asked_s > ASK_AGAIN_S:
            asked_s = time.monotonic()
            is_board = client.autopilot == ""
            link.send(client.heartbeat() + (client.set("HIL_MODE", 1.0) if is_board else b""))
        link.wait(0.05)
        client.receive(link.read(), time.monotonic_ns())


def _refusal(client: ParameterClient) -> str:
    if client.error is not None and client.error[1] == DOES_NOT_EXIST:
        return "the board has no HIL mode"
    return f"the board does not enter HIL mode{client.last_words and ': '}{client.last_words}"
