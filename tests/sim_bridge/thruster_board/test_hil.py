"""HIL mode of the reference board: whose measurements it tells, what its pins do, how it enters and leaves."""

import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as dialect

from shoal.config.experiment import load_experiment
from shoal.mavlink.agent_link import AgentLink
from shoal.mavlink.framing import Sender
from shoal.mavlink.parameters import ParameterClient
from sim_bridge.thruster_board.board import NonvolatileState, ThrusterBoard
from sim_bridge.thruster_board.simulator_link import SimulatorLink
from sim_bridge.thruster_board.state_machine import Charge

MS = 1_000_000
STEP = 5 * MS
LEVEL = (1500,) * 4
AHEAD = (1700, 1650, 1400, 1600, 1500, 1200, 1800, 1500)
STILL = np.zeros(4)
MOTION = (2.0, -0.5, (1.0, -2.0, -9.0), 3.0)  # heading, yaw rate, specific force, depth
EXPERIMENT = load_experiment("pool")


class HilBench:
    """A board on a desk with its agent, a ground station and a simulator, on one clock."""

    def __init__(self, stored: NonvolatileState | None = None) -> None:
        self.stored = stored or NonvolatileState()
        self.board = ThrusterBoard(EXPERIMENT, 1, 1, stored=self.stored, store=self._store)
        self.agent, self.simulator, self.station = AgentLink(1), SimulatorLink(1), ParameterClient(1)
        self.now_ns = 0

    def _store(self, stored: NonvolatileState) -> None:
        self.stored = stored

    def step(self, *frames: bytes) -> None:
        for frame in frames:
            self.board.receive(frame, self.now_ns)
        data = self.board.step(self.now_ns, STILL, STILL, STILL)
        self.agent.receive(data, self.now_ns)
        self.station.receive(data, self.now_ns)
        self.now_ns += STEP

    def run(self, seconds: float, *kinds: str) -> None:
        """Let time pass, while the simulator sends `kinds` (motion, battery) and the agent, with `drive`, AHEAD."""
        for k in range(round(seconds * 200)):
            frames = []
            if k % 4 == 0 and "motion" in kinds:
                frames.append(self.simulator.motion(0, *MOTION))
            if k % 100 == 0 and "battery" in kinds:
                frames.append(self.simulator.battery(11.5))
            if k % 10 == 0 and ("drive" in kinds or "hold" in kinds):
                frames.append(self.agent.pulses(AHEAD if "drive" in kinds else (*LEVEL, *LEVEL)))
            self.step(*frames)

    def set(self, name: str, value: float) -> bool:
        self.step(self.station.set(name, value))
        self.run(0.05)
        return self.station.values[name] == value

    def arm(self) -> bool:
        self.run(0.1, "hold", "motion")
        self.step(self.agent.arm(True))
        return self.board.armed


def told(desk: HilBench) -> tuple[float, ...]:
    telemetry = desk.agent.telemetry
    return (telemetry.heading_rad, telemetry.yaw_rate_radps, *telemetry.acceleration_mps2, telemetry.depth_m)


def test_measurements_are_the_simulators_in_hil_mode_and_its_own_after_it() -> None:
    desk = HilBench()
    desk.run(0.1, "motion", "battery")
    assert desk.agent.telemetry.depth_m == pytest.approx(0.0, abs=0.1) and not desk.agent.telemetry.hil
    assert desk.set("HIL_MODE", 1.0)
    desk.run(0.6, "motion", "battery")
    assert desk.agent.telemetry.hil
    assert told(desk) == pytest.approx((2.0, -0.5, 1.0, -2.0, -9.0, 3.0), abs=0.01)
    assert desk.agent.telemetry.battery_v == 11.5
    assert desk.set("HIL_MODE", 0.0)
    desk.run(0.6, "motion", "battery")
    assert not desk.agent.telemetry.hil
    assert desk.agent.telemetry.depth_m == pytest.approx(0.0, abs=0.1)
    assert desk.agent.telemetry.battery_v != 11.5


def test_outputs_follow_in_hil_mode_and_pins_do_not() -> None:
    desk = HilBench()
    assert desk.set("THR1_TRIM_US", 10.0) and desk.set("HIL_MODE", 1.0)
    desk.run(0.1, "motion", "battery")
    assert desk.arm()
    desk.run(0.3, "drive", "motion")
    assert desk.agent.telemetry.echo_us == AHEAD
    assert desk.board.pulses == (1510, 1500, 1500, 1500, *LEVEL)


def test_pins_follow_in_hil_mode_if_asked_and_not_after_another_power_on() -> None:
    desk = HilBench()
    assert not desk.set("HIL_OUTPUTS", 1.0), "outside HIL mode it would mean nothing, and then surprise"
    assert desk.set("HIL_MODE", 1.0) and desk.set("HIL_OUTPUTS", 1.0)
    assert desk.arm()
    desk.run(0.3, "drive", "motion")
    assert desk.board.pulses == AHEAD
    again = HilBench(desk.stored).board.rules.parameters
    assert (again.hil, again.pins_held, again["HIL_OUTPUTS"]) == (False, False, 0.0)


def test_hil_mode_is_neither_entered_nor_left_while_armed() -> None:
    desk = HilBench()
    assert desk.arm()
    desk.step(desk.station.set("HIL_MODE", 1.0))
    assert not desk.board.rules.parameters.hil
    desk.run(0.5)
    assert desk.set("HIL_MODE", 1.0) and desk.arm()
    desk.step(desk.station.set("HIL_MODE", 0.0))
    assert desk.board.rules.parameters.hil and desk.board.armed


def test_without_simulated_motion_no_depth_looks_live_and_outputs_are_told() -> None:
    desk = HilBench()
    desk.set("HIL_MODE", 1.0)
    desk.run(0.3, "motion")
    last_ms = desk.agent.telemetry.board_ms
    echoes_ns: list[int] = []
    for _ in range(80):
        desk.simulator.receive(desk.board.step(desk.now_ns, STILL, STILL, STILL), desk.now_ns)
        desk.now_ns += STEP
        echoes_ns.append(desk.simulator.echo_ns or 0)
    assert desk.agent.telemetry.board_ms == last_ms
    assert len(set(echoes_ns)) >= 18, "SERVO_OUTPUT_RAW goes on at 50 Hz"
    desk.run(0.1, "motion")
    assert desk.agent.telemetry.board_ms > last_ms


def test_a_simulated_battery_that_falls_silent_counts_as_empty() -> None:
    desk = HilBench()
    desk.set("HIL_MODE", 1.0)
    desk.run(1.8, "motion")
    assert (desk.board.rules.charge, desk.agent.telemetry.battery_reports) == (Charge.GOOD, 0)
    desk.run(1.0, "battery", "motion")
    assert desk.board.rules.charge is Charge.GOOD
    desk.run(1.0)
    assert desk.arm()
    desk.run(4.0, "hold", "motion")
    assert (desk.board.armed, desk.board.rules.charge) == (False, Charge.NEUTRAL)


@pytest.mark.parametrize(
    "field",
    [
        {"xacc": math.nan},
        {"zacc": -301.0},
        {"zgyro": 51.0},
        {"xmag": math.inf},
        {"xmag": 0.0, "ymag": 0.0},
        {"ymag": 10.5},
        {"abs_pressure": 499.0},
        {"abs_pressure": math.nan},
        {"fields_updated": 0x2E7 & ~0x200},
    ],
)
def test_measurements_that_cannot_be_true_are_refused_as_a_whole_and_counted(field: dict[str, float]) -> None:
    desk = HilBench()
    desk.set("HIL_MODE", 1.0)
    message = dialect.MAVLink(None).decode(bytearray(desk.simulator.motion(0, *MOTION)))
    values = {name: getattr(message, name) for name in message.fieldnames} | field
    refused = desk.board.link.refused_frames
    desk.step(Sender((1, 200)).pack(dialect.MAVLink_hil_sensor_message(**values)))
    desk.run(0.1)
    assert desk.board.link.refused_frames == refused + 1
    assert desk.agent.telemetry.depth_m < 1.0


@pytest.mark.parametrize("sender", [(2, 200), (1, 191), (255, 190)])
def test_measurements_of_anybody_else_are_ignored(sender: tuple[int, int]) -> None:
    desk = HilBench()
    desk.set("HIL_MODE", 1.0)
    desk.run(0.1)
    before = desk.agent.telemetry.board_ms
    message = dialect.MAVLink(None).decode(bytearray(desk.simulator.motion(0, *MOTION)))
    fields = {name: getattr(message, name) for name in message.fieldnames}
    desk.step(Sender(sender).pack(dialect.MAVLink_hil_sensor_message(**fields)))
    desk.run(0.1)
    assert (desk.agent.telemetry.board_ms, desk.board.link.refused_frames) == (before, 0)
