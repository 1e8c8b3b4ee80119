"""Each value that a thruster board reports, once as it cannot be, and twice in a row: what a flight does then.

The frames are real ones, from a board's end of the link into an agent's; the flight is the rehearsal's, which thrusters do not
move.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as dialect

from robot_agent.preflight.rehearsal import ARM_AFTER, DEPTH_M, rehearse
from robot_agent.safety.thruster_fault_detection import ThrusterFaultDetector
from shoal.config.experiment import load_experiment
from shoal.mavlink.agent_link import AgentLink
from shoal.messages.messages import Mode
from sim_bridge.thruster_board.board_link import BoardLink, Timesync

pytestmark = pytest.mark.long

POOL = load_experiment("pool")
ME, MS = 1, 1_000_000
SWITCHED_ON_MS = 500_000  # before the flight
BAD = ARM_AFTER + 60  # step of the first bad sample
FLOWN = BAD + 60  # 3 s more
NAN = float("nan")
AUTOPILOT = dialect.MAV_AUTOPILOT_ARDUPILOTMEGA


@dataclass
class Reports:
    """Values of one burst."""

    board_ms: int
    armed: bool
    echo_us: tuple[int, ...]
    yaw_rate_radps: float
    heading_rad: float = 0.2
    tilt: tuple[float, ...] = (0.01, -0.02, 0.0, 0.0)
    acceleration_mps2: tuple[float, float, float] = (0.1, -0.2, -9.8)
    depth_m: float = DEPTH_M
    battery_v: float = 12.4
    charge: int = 1
    autopilot: int = dialect.MAV_AUTOPILOT_GENERIC
    hil: bool = False
    clock_off_ns: int = 0


class RehearsedBoard:
    """A board on the link of a rehearsed flight. A change makes some of its reports bad, as often as asked."""

    def __init__(self, change: Callable[[Reports], Reports], times: int) -> None:
        self.link, self._board = AgentLink(ME), BoardLink(ME)
        self._change, self._left = change, times
        self._was_armed = False

    def burst(self, k: int, reports: Reports, now_ns: int) -> None:
        """Send the k-th burst: voltages at 2 Hz, heartbeats at 1 Hz and when the board arms, and the board's time at 1 Hz."""
        slow, slowest = k % 10 == 0, k % 20 == 0
        good = reports
        if k >= BAD and self._left:
            changed = {name: value for name, value in vars(self._change(good)).items() if value != getattr(good, name)}
            is_due = slow if {"battery_v", "charge"} & changed.keys() else True
            is_due = slowest if {"armed", "autopilot", "hil", "clock_off_ns"} & changed.keys() else is_due
            reports = replace(good, **changed) if is_due else good
            self._left -= is_due
        board, frames = self._board, []
        frames.append(board.imu(reports.board_ms, reports.acceleration_mps2, good.yaw_rate_radps))
        frames.append(board.pressure(reports.board_ms, reports.depth_m + 0.001 * math.sin(k)))
        frames.append(board.servo_output(reports.board_ms * 1000, reports.echo_us))
        if slow:
            frames += [board.status(reports.battery_v, 0, 0, 0), board.battery(reports.battery_v, reports.charge)]
        if slowest or good.armed is not self._was_armed:
            frames.append(self._heartbeat(reports))
        self._was_armed = good.armed
        frames.append(board.attitude(reports.board_ms, reports.heading_rad, reports.yaw_rate_radps, reports.tilt))
        if slowest:
            ((_, request),) = board.receive(self.link.timesync(now_ns - 2 * MS), now_ns)
            assert isinstance(request, Timesync)
            board_ns = now_ns - MS + SWITCHED_ON_MS * MS + reports.clock_off_ns
            frames.append(board.timesync(board_ns, request.sent_ns))
        self.link.receive(b"".join(frames), now_ns)

    def _heartbeat(self, reports: Reports) -> bytes:
        mode = dialect.MAV_MODE_FLAG_SAFETY_ARMED * reports.armed | dialect.MAV_MODE_FLAG_HIL_ENABLED * reports.hil
        message = dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_SUBMARINE, reports.autopilot, mode, 0, 0, 3)
        return self._board._sender.pack(message)  # private: a board's own heartbeat never names an autopilot


def fault_after(change: Callable[[Reports], Reports], times: int) -> str:
    """The fault of a flight in which the board's reports are bad `times` times in a row; empty if it goes on."""
    board = RehearsedBoard(change, times)
    pulses_us: tuple[int, ...] = (1500,) * 8
    for k, (agent, inputs, now_ns) in enumerate(itertools.islice(rehearse(POOL, ME), FLOWN)):
        rate_radps = inputs.board.yaw_rate_radps
        reports = Reports(SWITCHED_ON_MS + now_ns // MS, inputs.board.armed, pulses_us, rate_radps)
        board.burst(k, reports, now_ns)
        outputs = agent.step(replace(inputs, board=board.link.telemetry), now_ns)
        pulses_us = outputs.pulse_us
        assert k != BAD - 1 or agent.mode is Mode.TRACKING, outputs.state.fault
    assert (agent.mode is Mode.TRACKING) == (outputs.state.fault == "")
    return outputs.state.fault


def changed(**fields: object) -> Callable[[Reports], Reports]:
    return lambda reports: replace(reports, **fields)  # type: ignore[arg-type]


# What one bad sample does is nothing, in each row. Last: the fault after two in a row, empty if these do nothing either.
TABLE = {
    "yaw rate": (changed(yaw_rate_radps=40.0), ""),
    "yaw rate, no number": (changed(yaw_rate_radps=NAN), ""),
    "yaw rate, impossible": (changed(yaw_rate_radps=1e6), ""),
    "heading, no number": (changed(heading_rad=NAN), ""),
    "heading, another": (changed(heading_rad=-3.0), ""),
    "tilt": (changed(tilt=(3.0, 1.4, 40.0, 40.0)), ""),
    "tilt, no number": (changed(tilt=(NAN,) * 4), ""),
    "acceleration": (changed(acceleration_mps2=(300.0, -300.0, 300.0)), ""),
    "depth": (changed(depth_m=10.0), ""),
    "depth, no number": (changed(depth_m=NAN), ""),
    "depth, impossible": (changed(depth_m=-9.0), ""),
    "echo": (changed(echo_us=(1900,) * 8), ""),
    "echo, impossible": (changed(echo_us=(0,) * 8), ""),
    "time, an hour ahead": (lambda r: replace(r, board_ms=r.board_ms + 3_600_000), ""),
    "time, back": (lambda r: replace(r, board_ms=r.board_ms - 400_000), "thruster board silent"),
    "HIL": (changed(hil=True), ""),
    "voltage 0": (changed(battery_v=0.0), "battery empty"),
    "voltage, too high": (changed(battery_v=65.0), ""),
    "charge state": (changed(charge=4), "battery empty"),
    "disarmed": (changed(armed=False), "thruster board disarmed"),
    "autopilot": (changed(autopilot=AUTOPILOT), "no thruster board: autopilot 3 (ARDUPILOTMEGA) is on the link"),
    "clock, 10 s ahead": (changed(clock_off_ns=10_000 * MS), "thruster board silent"),
    "clock, 10 s behind": (changed(clock_off_ns=-10_000 * MS), ""),
}


@pytest.mark.parametrize("times", [1, 2])
@pytest.mark.parametrize(("change", "fault"), TABLE.values(), ids=list(TABLE))
def test_one_bad_sample_ends_no_flight(change: Callable[[Reports], Reports], fault: str, times: int) -> None:
    assert fault_after(change, times) == (fault if times == 2 else "")


def test_one_bad_yaw_rate_is_no_broken_thruster_and_a_lasting_one_is_taken_in() -> None:
    """The rehearsal's thrusters are not watched."""
    detector, period_ns = ThrusterFaultDetector(POOL.vehicle), 50 * MS
    for k in range(400):
        now_ns = k * period_ns
        detector.note_moments(np.full(4, 0.01 * (-1) ** (k // 20)), np.zeros(4), now_ns)
        detector.step(40.0 if k == 300 else 0.0, now_ns, now_ns)
    assert not detector.broken
    for k in range(400, 420):
        detector.step(40.0, k * period_ns, k * period_ns)
    assert detector.broken
