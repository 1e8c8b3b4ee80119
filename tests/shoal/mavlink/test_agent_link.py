"""Both ends of the link back to back, and then through every kind of damage."""

import math
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as dialect
from scipy.spatial.transform import Rotation

from shoal.mavlink import agent_link
from shoal.mavlink.agent_link import IGNORED, AgentLink
from shoal.mavlink.framing import FRAME_TIMEOUT_NS, Receiver, Sender, Sequence8
from shoal.mavlink.signing import SignatureVerifier
from sim_bridge.thruster_board import board_link
from sim_bridge.thruster_board.board_link import Arm, Event, Heartbeat, Override, Timesync, Unsupported

pytestmark = pytest.mark.long

MS = 1_000_000
PULSES = (1400, 1600, 1478, 1522, 1500, 1000, 2000, 1234)
OTHER = (1501, 1502, 1503, 1504, 1505, 1506, 1507, 1508)


class FarEnd(board_link.BoardLink):
    """The board's end, when it does not matter who asks."""

    def events(self, data: bytes, now_ns: int) -> list[Event]:
        return [event for _, event in self.receive(data, now_ns)]


def burst(board: FarEnd, board_ms: int = 5000) -> bytes:
    return b"".join(
        (
            board.imu(board_ms, (0.5, -0.25, -9.80665), 0.1),
            board.pressure(board_ms, 0.321),
            board.servo_output(board_ms * 1000, PULSES),
            board.status(11.97, 1, 1, 3),
            board.heartbeat(armed=True, healthy=True),
            board.attitude(board_ms, -2.5, 0.0625),
        )
    )


def checked(content: bytes, crc_extra: int) -> bytes:
    """A frame with this content (header without start byte, payload) and the checksum that belongs to it."""
    checksum = dialect.x25crc(content)
    checksum.accumulate(bytes([crc_extra]))
    return b"\xfd" + content + struct.pack("<H", checksum.crc)


def test_commands_reach_the_board() -> None:
    agent, board = AgentLink(7), FarEnd(7)
    data = agent.pulses(PULSES) + agent.arm(True) + agent.arm(False) + agent.heartbeat() + agent.timesync(123456789)
    assert board.events(data, 0) == [Override(PULSES), Arm(True), Arm(False), Heartbeat(), Timesync(123456789)]
    assert (board.bad_frames, board.refused_frames, board.stale_frames) == (0, 0, 0)


def test_an_ignored_channel_arrives_as_ignored() -> None:
    pulses = (*PULSES[:4], IGNORED, IGNORED, IGNORED, IGNORED)
    assert FarEnd(1).events(AgentLink(1).pulses(pulses), 0) == [Override(pulses)]


def test_override_uses_the_channels_and_the_marks_of_the_common_dialect() -> None:
    """Read by pymavlink alone: 1-8 set, 9-18 zero, which for these means "ignore"."""
    message = dialect.MAVLink(None).decode(bytearray(AgentLink(3).pulses(PULSES)))
    assert message.get_type() == "RC_CHANNELS_OVERRIDE"
    assert (message.get_srcSystem(), message.get_srcComponent()) == (3, 191)
    assert [getattr(message, f"chan{i}_raw") for i in range(1, 19)] == [*PULSES, *[0] * 10]


def test_roll_and_pitch_arrive_with_their_rates() -> None:
    """Rates about the body's axes become d/dt of roll and pitch: here by differences of the rotation that they make."""
    roll, pitch, p, q, r, step_s = 0.1, -0.2, 0.3, -0.1, 0.5, 1e-6
    agent, board = AgentLink(7), FarEnd(7)
    agent.receive(board.pressure(1, 0.3) + board.attitude(1, 0.4, r, (roll, pitch, p, q)), 0)
    attitude = Rotation.from_euler("ZYX", [0.4, pitch, roll])
    later = attitude * Rotation.from_rotvec(np.array([p, q, r]) * step_s)
    _, pitch_rate, roll_rate = (later.as_euler("ZYX") - attitude.as_euler("ZYX")) / step_s
    assert agent.telemetry.tilt == pytest.approx((roll, pitch, roll_rate, pitch_rate), abs=1e-5)


@pytest.mark.parametrize(
    "tilt", [(0.0, 0.0, 0.0, 0.0), (math.nan, 0.1, 0.0, 0.0), (0.1, 1.55, 0.0, 0.0), (0.1, 0.1, math.inf, 0.0)]
)
def test_zero_or_impossible_tilt_is_unknown_and_keeps_the_heading(tilt: tuple[float, ...]) -> None:
    agent, board = AgentLink(7), FarEnd(7)
    agent.receive(board.pressure(1, 0.3) + board.attitude(1, 0.5, 0.1, (0.1, 0.1, 0.0, 0.0)), 0)
    agent.receive(board.pressure(2, 0.3) + board.attitude(2, 0.25, 0.1, tilt), 20 * MS)
    assert agent.telemetry.heading_rad == 0.25 and agent.telemetry.tilt.size == 0


def test_telemetry_of_a_burst() -> None:
    agent = AgentLink(7)
    assert agent.telemetry.board_ms == -1
    agent.receive(burst(FarEnd(7)), 42)
    telemetry = agent.telemetry
    assert (telemetry.board_ms, telemetry.arrival_ns, telemetry.armed, telemetry.echo_us) == (5000, 42, True, PULSES)
    assert (telemetry.heading_rad, telemetry.yaw_rate_radps) == (-2.5, 0.0625)
    assert telemetry.acceleration_mps2 == pytest.approx((0.5, -0.25, -9.80665), abs=0.0051)  # whole mG
    assert telemetry.depth_m == pytest.approx(0.321, abs=1e-5)
    assert telemetry.battery_v == 11.97
    assert (telemetry.loss, telemetry.bad_frames, telemetry.refused_frames, telemetry.foreign_frames) == (0.0, 0, 0, 0)


def test_pressure_and_depth() -> None:
    """Hydrostatics by hand: 998 kg/m3 * 9.81 m/s2 * 1 m = 9790.38 Pa."""
    assert agent_link.depth_to_hpa(1.0) - agent_link.depth_to_hpa(0.0) == pytest.approx(97.9038)
    assert agent_link.depth_to_hpa(0.0) == 1013.25
    assert agent_link.hpa_to_depth(agent_link.depth_to_hpa(0.37)) == pytest.approx(0.37)


def test_answers() -> None:
    agent, board = AgentLink(1), FarEnd(1)
    agent.receive(board.acknowledge((1, 191), 400, agent_link.REJECTED) + board.text(4, "battery low"), 0)
    agent.receive(board.text(6, "x" * 80), 0)
    telemetry = agent.telemetry
    assert (telemetry.acknowledged, telemetry.acknowledgements) == ((400, 1), 1)
    assert (telemetry.texts, telemetry.texts_received) == (((4, "battery low"), (6, "x" * 50)), 2)


def test_an_answer_to_arm_that_comes_late_is_not_taken_for_one_to_disarm() -> None:
    """An answer names a command, and both are one command. Heartbeats tell what became of the first."""
    agent, board = AgentLink(1), FarEnd(1)
    accepted = board.acknowledge((1, 191), 400, agent_link.ACCEPTED)
    agent.receive(board.heartbeat(False, True), 0)
    assert not agent.telemetry.arm_open
    board.events(agent.arm(True) + agent.arm(False), 0)
    agent.receive(board.heartbeat(False, True), 0)  # of before the board had the request to arm
    assert agent.telemetry.arm_open
    agent.receive(accepted, 0)
    assert agent.telemetry.arm_open and not agent.telemetry.armed
    agent.receive(board.heartbeat(True, True) + accepted + board.heartbeat(False, True), 0)
    assert not agent.telemetry.arm_open and not agent.telemetry.armed

    agent.arm(False)
    assert not agent.telemetry.arm_open, "a request to disarm opens nothing"
    agent.arm(True)
    assert agent.telemetry.arm_open
    agent.receive(board.heartbeat(True, True), 0)  # it is armed: a later answer changes nothing about that
    assert not agent.telemetry.arm_open and agent.telemetry.armed

    agent.receive(board.heartbeat(False, True), 0)
    agent.arm(True)
    agent.receive(board.acknowledge((1, 191), 400, agent_link.REJECTED) + board.heartbeat(False, True), 0)
    assert not agent.telemetry.arm_open  # it stays disarmed


def test_only_the_last_texts_are_kept() -> None:
    agent, board = AgentLink(1), FarEnd(1)
    agent.receive(b"".join(board.text(6, str(i)) for i in range(100)), 0)
    assert len(agent.telemetry.texts) == agent_link.TEXTS_KEPT
    assert agent.telemetry.texts[-1] == (6, "99")
    assert agent.telemetry.texts_received == 100


def test_clock_offset_over_a_symmetric_link() -> None:
    """Board's clock 1 h ahead, 3 ms each way."""
    agent, board = AgentLink(1), FarEnd(1)
    ahead = 3600 * 1000 * MS
    (event,) = board.events(agent.timesync(10 * MS), 0)
    assert isinstance(event, Timesync)
    agent.receive(board.timesync(13 * MS + ahead, event.sent_ns), 16 * MS)
    assert (agent.telemetry.clock_offset_ns, agent.telemetry.round_trip_ns) == (ahead, 6 * MS)


def _answered(agent: AgentLink, board: FarEnd, at_ms: int, ahead_ms: int, trip_ms: int) -> int:
    """One question after the board's time, and its answer half-way. Returns how far its clock is ahead then, in ms."""
    (event,) = board.events(agent.timesync(at_ms * MS), 0)
    assert isinstance(event, Timesync)
    board_ns = (2 * at_ms + trip_ms) * MS // 2 + ahead_ms * MS
    agent.receive(board.timesync(board_ns, event.sent_ns), (at_ms + trip_ms) * MS)
    return agent.telemetry.clock_offset_ns // MS


def test_a_boards_clock_is_set_when_two_answers_in_a_row_say_so_and_not_by_one() -> None:
    agent, board = AgentLink(1), FarEnd(1)
    assert [_answered(agent, board, 100 * k, 1000, 6) for k in range(1, 4)] == [1000] * 3
    assert _answered(agent, board, 400, 1010, 8) == 1000, "a trip of 8 ms and one of 6 explain 7, and 5 are allowed"
    assert _answered(agent, board, 500, 2000, 6) == 1000, "one alone"
    assert _answered(agent, board, 600, 1000, 4) == 1000
    assert _answered(agent, board, 700, 2000, 6) == 1000, "the doubt before is over"
    assert _answered(agent, board, 800, 3000, 6) == 1000, "two that contradict each other"
    assert _answered(agent, board, 900, 3001, 6) == 3001, "two that agree"
    assert _answered(agent, board, 1000, 3000, 2) == 3000, "the quickest counts"
    assert agent.telemetry.round_trip_ns == 2 * MS


def test_an_answer_to_another_question_or_without_a_time_is_none() -> None:
    agent, board = AgentLink(1), FarEnd(1)
    agent.timesync(100 * MS)
    for board_ns, sent_ns in ((5, 99 * MS), (0, 100 * MS)):
        agent.receive(board.timesync(board_ns, sent_ns), 110 * MS)
    assert agent.telemetry.round_trips == 0
    answer = board.timesync(5, 100 * MS), board.timesync(6, 100 * MS)
    for frame in answer:
        agent.receive(frame, 110 * MS)
    assert agent.telemetry.round_trips == 1, "each question has one answer"


def test_pulses_and_a_persons_calibration_are_told_apart_from_all_else() -> None:
    agent = AgentLink(3)
    frames = [agent.pulses(PULSES), agent.arm(True), agent.heartbeat(), agent.timesync(1), agent.calibrate(True), b"", b"\xfd"]
    assert [agent_link.is_override(frame) for frame in frames] == [True] + [False] * 6
    assert not agent_link.is_override(b"\xfe" + frames[0][1:])
    for pressure, gyro in ((True, False), (False, True), (False, False)):
        message = dialect.MAVLink(None).decode(bytearray(agent.calibrate(pressure, gyro)))
        assert (message.command, message.param1, message.param3) == (241, float(gyro), float(pressure))
        assert (message.param2, message.param4, message.target_system) == (0.0, 0.0, 3)


def test_pulses_out_of_range_are_not_sent() -> None:
    for bad in ((0, *PULSES[1:]), (2501, *PULSES[1:]), PULSES[:7]):
        with pytest.raises(ValueError, match="pulses_us"):
            AgentLink(1).pulses(bad)


@pytest.mark.parametrize("value", [0, 499, 2501, 65534])
def test_pulses_out_of_range_are_not_taken(value: int) -> None:
    board, sender = FarEnd(1), Sender((1, agent_link.AGENT_COMPONENT))
    frame = sender.pack(dialect.MAVLink_rc_channels_override_message(1, 1, *PULSES[:7], value))
    assert board.events(frame, 0) == []
    assert board.refused_frames == 1


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e30, -1e3])
@pytest.mark.parametrize("field", ["yaw", "yawspeed"])
def test_attitude_that_cannot_be_true_is_not_taken(field: str, value: float) -> None:
    agent, sender = AgentLink(1), Sender((1, agent_link.BOARD_COMPONENT))
    message = dialect.MAVLink_attitude_message(1, 0, 0, 0, 0, 0, 0)
    setattr(message, field, value)
    depth = dialect.MAVLink_scaled_pressure2_message(1, 1030.0, 0, 0)
    agent.receive(sender.pack(depth) + sender.pack(message), 0)
    assert agent.telemetry.board_ms == -1
    assert agent.telemetry.refused_frames == (0 if math.isnan(value) else 1), "NaN is not measured"


@pytest.mark.parametrize("value", [math.nan, math.inf, 0.0, 1e9])
def test_pressure_that_cannot_be_true_is_not_taken(value: float) -> None:
    agent, sender = AgentLink(1), Sender((1, agent_link.BOARD_COMPONENT))
    agent.receive(sender.pack(dialect.MAVLink_scaled_pressure2_message(1, value, 0, 0)), 0)
    assert agent.telemetry.depth_m == 0.0
    assert agent.telemetry.refused_frames == (0 if math.isnan(value) else 1), "NaN is not measured"


def _attitude(roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0, p: float = 0.0, q: float = 0.0, r: float = 0.0) -> Any:
    return dialect.MAVLink_attitude_message(1, roll, pitch, yaw, p, q, r)


def _servos(pulse_us: int) -> Any:
    return dialect.MAVLink_servo_output_raw_message(1, 0, *PULSES[:7], pulse_us)


def _voltage(millivolts: int) -> Any:
    return dialect.MAVLink_sys_status_message(0, 0, 0, 0, millivolts, -1, -1, 0, 0, 0, 0, 0, 0)


def _charge(state: int) -> Any:
    return dialect.MAVLink_battery_status_message(0, 0, 0, 0, [0] * 10, 0, 0, 0, 0, 0, state)


def _pressure(hpa: float) -> Any:
    return dialect.MAVLink_scaled_pressure2_message(1, hpa, 0, 0)


@pytest.mark.parametrize(
    ("message_of", "low", "high", "beyond"),
    [
        (_servos, 500, 2500, 1),
        (_voltage, 0, 65534, 1),
        (_charge, 0, 7, 1),
        (_pressure, 500.0, 20_000.0, 0.01),
        (lambda yaw: _attitude(yaw=yaw), -6.283, 6.283, 0.001),
        (lambda rate: _attitude(r=rate), -50.0, 50.0, 0.001),
    ],
)
def test_a_measurement_at_the_edge_of_what_can_be_true_is_taken_and_none_beyond(
    message_of: Callable[[Any], Any], low: float, high: float, beyond: float
) -> None:
    for value, refused in ((low, 0), (high, 0), (low - beyond, 1), (high + beyond, 1)):
        agent, sender = AgentLink(1), Sender((1, agent_link.BOARD_COMPONENT))
        agent.receive(sender.pack(_pressure(1030.0)), 0)
        if 0 <= value <= 65535 or isinstance(value, float):  # others the wire cannot carry
            agent.receive(sender.pack(message_of(value)), 0)
            assert agent.telemetry.refused_frames == refused, value


@pytest.mark.parametrize(
    ("axis", "edge", "beyond"), [("roll", 3.141, 3.142), ("pitch", 1.5, 1.501), ("p", 50.0, 50.01), ("q", 50.0, 50.01)]
)
def test_a_tilt_at_the_edge_of_what_can_be_true_is_known_and_none_beyond(axis: str, edge: float, beyond: float) -> None:
    for sign in (1.0, -1.0):
        for value, size in ((edge, 4), (beyond, 0)):
            agent, sender = AgentLink(1), Sender((1, agent_link.BOARD_COMPONENT))
            agent.receive(sender.pack(_pressure(1030.0)) + sender.pack(_attitude(**{axis: sign * value})), 0)
            assert agent.telemetry.tilt.size == size, value


def test_pulses_at_the_edge_of_what_a_servo_takes_are_sent_and_none_beyond() -> None:
    for edge in (500, 2500):
        assert FarEnd(1).events(AgentLink(1).pulses((*PULSES[:7], edge)), 0) == [Override((*PULSES[:7], edge))]
    for beyond in (499, 2501, IGNORED - 1):
        with pytest.raises(ValueError, match="pulses_us"):
            AgentLink(1).pulses((*PULSES[:7], beyond))


def test_each_count_of_the_telemetry_begins_at_zero_and_grows_by_one() -> None:
    agent, board = AgentLink(1), FarEnd(1)
    counts = ("heartbeats", "battery_reports", "acknowledgements", "texts_received", "round_trips", "refused_frames")
    assert [getattr(agent.telemetry, name) for name in counts] == [0] * len(counts)
    for turn in (1, 2, 3):
        (event,) = board.events(agent.timesync(turn * MS), 0)
        assert isinstance(event, Timesync)
        frames = (
            board.heartbeat(False, True), board.status(12.0, 1, 1, 0), board.acknowledge((1, 191), 400, 0),
            board.text(6, "x"), board.timesync(5, event.sent_ns), board.servo_output(1, (1, *PULSES[1:])),
        )  # fmt: skip
        agent.receive(b"".join(frames), turn * MS + 1)
        assert [getattr(agent.telemetry, name) for name in counts] == [turn] * len(counts)


@pytest.mark.parametrize("pressure_hpa", [None, math.nan, 0.0])
def test_a_burst_without_a_depth_that_can_be_true_is_none(pressure_hpa: float | None) -> None:
    """A dead sensor's last depth would look live for ever."""
    agent, sender = AgentLink(1), Sender((1, agent_link.BOARD_COMPONENT))
    pressures_hpa = [1030.0, pressure_hpa, pressure_hpa, 1040.0]
    for k, hpa in enumerate(pressures_hpa):
        if hpa is not None:
            agent.receive(sender.pack(dialect.MAVLink_scaled_pressure2_message(20 * k, hpa, 0, 0)), 20 * k * MS)
        agent.receive(sender.pack(dialect.MAVLink_attitude_message(20 * k, 0, 0, 0.1 * k, 0, 0, 0)), 20 * k * MS)
        last = max(j for j in range(k + 1) if pressures_hpa[j] in (1030.0, 1040.0))
        telemetry = agent.telemetry
        assert (telemetry.board_ms, telemetry.arrival_ns) == (20 * last, 20 * last * MS)
        assert telemetry.heading_rad == pytest.approx(0.1 * last)
        assert telemetry.depth_m == pytest.approx(agent_link.hpa_to_depth(pressures_hpa[last] or 0.0))


@pytest.mark.parametrize("peer", [(2, 191), (1, 190), (0, 0), (255, 190)])
def test_requests_carry_the_address_of_their_sender(peer: tuple[int, int]) -> None:
    board, stranger = FarEnd(1), Sender(peer)
    override = stranger.pack(dialect.MAVLink_rc_channels_override_message(1, 1, *PULSES))
    assert board.receive(override, 0) == [(peer, Override(PULSES))]


def test_a_board_does_not_listen_to_itself() -> None:
    board, echo = FarEnd(1), Sender((1, 1))
    assert board.events(echo.pack(dialect.MAVLink_command_long_message(1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0)), 0) == []


@pytest.mark.parametrize(("system", "component"), [(2, 1), (1, 0), (0, 0), (1, 191)])
def test_commands_for_another_board_are_ignored(system: int, component: int) -> None:
    board, sender = FarEnd(1), Sender((1, agent_link.AGENT_COMPONENT))
    assert board.events(sender.pack(dialect.MAVLink_rc_channels_override_message(system, component, *PULSES)), 0) == []
    assert board.refused_frames == 1


@pytest.mark.parametrize("parameters", [(0.5, 0), (math.nan, 0), (2, 0), (1, 21196)])
def test_arming_takes_no_other_parameters(parameters: tuple[float, float]) -> None:
    """21196 is MAVLink's "force": this board does not have it."""
    board, sender = FarEnd(1), Sender((1, agent_link.AGENT_COMPONENT))
    message = dialect.MAVLink_command_long_message(1, 1, 400, 0, *parameters, 0, 0, 0, 0, 0)
    assert board.events(sender.pack(message), 0) == [Unsupported(400)]


def test_old_and_repeated_frames_are_not_taken() -> None:
    agent, board = AgentLink(1), FarEnd(1)
    first, second, third = agent.pulses(PULSES), agent.pulses(OTHER), agent.pulses(PULSES)
    assert board.events(first, 0) == [Override(PULSES)]
    assert board.events(third + second + third + first, MS) == [Override(PULSES)]
    assert board.stale_frames == 3


def test_a_restarted_agent_is_heard_after_the_silence() -> None:
    board, old = FarEnd(1), AgentLink(1)
    for i in range(200):
        board.events(old.pulses(PULSES), i * 50 * MS)
    assert board.events(AgentLink(1).pulses(OTHER), 200 * 50 * MS + 500 * MS) == [Override(OTHER)]


@example(start=0, behind=128)
@given(start=st.integers(0, 255), behind=st.integers(0, 128))
def test_up_to_half_the_sequence_numbers_are_old(start: int, behind: int) -> None:
    sequence = Sequence8()
    for i in range(300):
        assert sequence.accept((start + i) % 256, i * MS)
    assert not sequence.accept((start + 299 - behind) % 256, 300 * MS)
    assert sequence.accept((start + 300) % 256, 301 * MS)
    assert sequence.loss == 0.0


def test_loss_is_measured_over_five_seconds() -> None:
    sequence = Sequence8()
    for i in range(1000):  # 50 Hz, each fourth lost
        if i % 4:
            sequence.accept(i % 256, i * 20 * MS)
    assert sequence.loss == pytest.approx(0.25, abs=0.01)
    for i in range(1000, 1300):
        sequence.accept(i % 256, i * 20 * MS)
    assert sequence.loss == pytest.approx(0.0, abs=0.005)


# --- damage


def test_a_stream_may_be_cut_anywhere() -> None:
    agent, board = AgentLink(1), FarEnd(1)
    data = agent.pulses(PULSES) + agent.heartbeat() + agent.pulses(OTHER)
    for cut in range(len(data)):
        fresh = FarEnd(1)
        assert [*fresh.events(data[:cut], 0), *fresh.events(data[cut:], 1)] == [
            Override(PULSES),
            Heartbeat(),
            Override(OTHER),
        ]
    assert [e for byte in data for e in board.events(bytes([byte]), 0)] == [Override(PULSES), Heartbeat(), Override(OTHER)]


def test_every_single_bit_flip_is_noticed_and_the_next_frame_is_not_lost() -> None:
    agent = AgentLink(1)
    frame, following = agent.pulses(PULSES), agent.pulses(OTHER)
    for bit in range(len(frame) * 8):
        damaged = bytearray(frame)
        damaged[bit // 8] ^= 1 << bit % 8
        board = FarEnd(1)
        events = [*board.events(bytes(damaged) + following, 0), *board.events(b"", FRAME_TIMEOUT_NS + 1)]
        assert events == [Override(OTHER)], f"bit {bit}"


def test_a_length_that_its_message_cannot_have_costs_no_time() -> None:
    agent, board = AgentLink(1), FarEnd(1)
    damaged = bytearray(agent.pulses(PULSES))
    damaged[1] |= 0x80
    assert board.events(bytes(damaged) + agent.pulses(OTHER), 0) == [Override(OTHER)]


def test_a_newer_dialect_may_have_longer_messages() -> None:
    message = dialect.MAVLink_rc_channels_override_message(1, 1, *PULSES, *[1500] * 10)
    frame = Sender((1, agent_link.AGENT_COMPONENT)).pack(message)
    longer = checked(frame[1:6].replace(bytes([frame[1]]), bytes([frame[1] + 2]), 1) + frame[6:-2] + b"\7\7", 124)
    assert FarEnd(1).events(longer, 0) == [Override(PULSES)]


@pytest.mark.parametrize("flags", [2, 3, 128])
def test_frames_with_flags_that_must_be_understood_are_dropped(flags: int) -> None:
    frame = bytearray(AgentLink(1).pulses(PULSES))
    frame[2] = flags
    board = FarEnd(1)
    assert board.events(checked(bytes(frame[1:-2]), 124) + bytes(13), 0) == []
    assert board.bad_frames > 0


def test_every_truncation_is_noticed_and_the_next_frame_is_not_lost() -> None:
    agent = AgentLink(1)
    frame, following = agent.pulses(PULSES), agent.pulses(OTHER)
    for length in range(len(frame)):
        board = FarEnd(1)
        events = [*board.events(frame[:length] + following, 0), *board.events(b"", FRAME_TIMEOUT_NS + 1)]
        assert events == [Override(OTHER)], f"{length} bytes"


def test_false_headers_do_not_hide_frames_for_long() -> None:
    """The longest frame there is, announced and never sent: pymavlink's own parser would swallow nine overrides."""
    false = bytes([0xFD, 255, 0, 0, 0, 1, 191]) + (131).to_bytes(3, "little")  # ENCAPSULATED_DATA
    agent, board = AgentLink(1), FarEnd(1)
    board.events(false, 0)
    events_by_burst = [(i, board.events(agent.pulses(PULSES), i * 50 * MS)) for i in range(1, 6)]
    first = next(i for i, events in events_by_burst if events)
    assert first * 50 * MS <= FRAME_TIMEOUT_NS + 50 * MS
    assert sum(len(events) for _, events in events_by_burst) == 5


def test_false_headers_that_came_together_are_given_up_together() -> None:
    """Each announces the longest frame there is; what follows them is heard as soon as the first is overdue."""
    false = bytes([0xFD, 255, 0, 0, 0, 1, 191]) + (131).to_bytes(3, "little")
    agent, board = AgentLink(1), FarEnd(1)
    assert board.events(false * 5 + agent.pulses(PULSES), 0) == []
    assert board.events(b"", FRAME_TIMEOUT_NS) == []
    assert board.events(b"", FRAME_TIMEOUT_NS + 1) == [Override(PULSES)]
    assert board.bad_frames == 5


def test_a_frame_that_begins_behind_a_false_header_has_its_own_time() -> None:
    false = bytes([0xFD, 255, 0, 0, 0, 1, 191]) + (131).to_bytes(3, "little")
    agent, board = AgentLink(1), FarEnd(1)
    frame = agent.pulses(PULSES)
    assert board.events(false, 0) == []
    assert board.events(frame[:15], FRAME_TIMEOUT_NS) == []
    assert board.events(b"", FRAME_TIMEOUT_NS + MS) == []
    assert board.events(frame[15:], 2 * FRAME_TIMEOUT_NS) == [Override(PULSES)]


def test_frames_that_pymavlink_passes_unchecked_are_dropped() -> None:
    unknown = bytes([0xFD, 4, 0, 0, 0, 1, 191]) + (16_000_000).to_bytes(3, "little") + b"\1\2\3\4\0\0"
    assert dialect.MAVLink(None).decode(bytearray(unknown)).get_type().startswith("UNKNOWN")
    receiver = Receiver(lambda peer: peer == (1, 191), SignatureVerifier(None))
    assert receiver.receive(unknown, 0) == []
    assert receiver.foreign_frames == 1


def test_frames_inside_another_systems_frame_are_ignored() -> None:
    """A log or a tunnel that carries MAVLink must not command thrusters."""
    inner = AgentLink(1).pulses(PULSES)
    payload = list(inner) + [0] * (128 - len(inner))
    outer = Sender((9, 1)).pack(dialect.MAVLink_tunnel_message(0, 0, 0, len(inner), payload))
    assert inner in outer
    assert FarEnd(1).events(outer, 0) == []


@settings(max_examples=300, deadline=None)
@given(data=st.binary(max_size=600))
def test_any_bytes_between_frames(data: bytes) -> None:
    """Nothing crashes, nothing false is applied, the frames around are heard (after the time limit for unfinished ones)."""
    agent, board = AgentLink(1), FarEnd(1)
    events = board.events(agent.pulses(PULSES) + data + agent.pulses(OTHER), 0)
    for i in range(1, 60):
        events += board.events(b"", i * (FRAME_TIMEOUT_NS + 1))
    assert events == [Override(PULSES), Override(OTHER)]


START_BYTES = st.lists(st.sampled_from([0xFD, 0xFE, 0, 1, 12, 18, 70, 191, 255]), max_size=300).map(bytes)


@settings(max_examples=300, deadline=None)
@given(data=START_BYTES)
def test_bytes_that_look_like_headers(data: bytes) -> None:
    agent, board = AgentLink(1), FarEnd(1)
    events = board.events(data + agent.pulses(PULSES), 0)
    for i in range(1, 60):
        events += board.events(b"", i * (FRAME_TIMEOUT_NS + 1))
    assert events == [Override(PULSES)]


@settings(max_examples=200, deadline=None)
@given(flips=st.lists(st.tuples(st.integers(0, 10_000), st.integers(0, 7)), min_size=1, max_size=20), size=st.integers(1, 90))
def test_damaged_telemetry(flips: list[tuple[int, int]], size: int) -> None:
    """20 bursts with flipped bits, in pieces of any size: whatever gets through is what was sent."""
    board, agent = FarEnd(1), AgentLink(1)
    data = bytearray(b"".join(burst(board, 5000 + i) for i in range(20)))
    for position, bit in flips:
        data[position % len(data)] ^= 1 << bit
    for i, start in enumerate(range(0, len(data), size)):
        agent.receive(bytes(data[start : start + size]), i)
        telemetry = agent.telemetry
        assert telemetry.board_ms == -1 or 5000 <= telemetry.board_ms < 5020
        assert telemetry.heading_rad in (0.0, -2.5)
        assert telemetry.echo_us in ((), PULSES)
        assert telemetry.battery_v in (0.0, 11.97)


@settings(max_examples=300, deadline=None)
@given(
    kind=st.sampled_from(sorted(dialect.mavlink_map)),
    payload=st.binary(min_size=1, max_size=255),
    sequence=st.integers(0, 255),
)
def test_any_payload_with_a_good_checksum(kind: int, payload: bytes, sequence: int) -> None:
    """A peer that talks correct MAVLink and nonsense: no crash, and only values that can be true."""
    for component, link in ((agent_link.AGENT_COMPONENT, FarEnd(1)), (agent_link.BOARD_COMPONENT, AgentLink(1))):
        header = struct.pack("<BBBBBB", len(payload), 0, 0, sequence, 1, component) + kind.to_bytes(3, "little")
        link.receive(checked(header + payload, dialect.mavlink_map[kind].crc_extra), 0)
        if isinstance(link, AgentLink):
            assert math.isfinite(link.telemetry.heading_rad)
            assert math.isfinite(link.telemetry.yaw_rate_radps)
            assert math.isfinite(link.telemetry.depth_m)
            assert math.isfinite(link.telemetry.battery_v)


def test_a_frame_that_ends_late_is_still_taken() -> None:
    """A reader that was busy for longer than the time limit finds the whole frame waiting."""
    board, frame = FarEnd(1), AgentLink(1).pulses(PULSES)
    assert board.events(frame[:11], 0) == []
    assert board.events(frame[11:], 10 * FRAME_TIMEOUT_NS) == [Override(PULSES)]


def synced(ahead_ns: int, now_ns: int, trip_ns: int = 2 * MS, link: AgentLink | None = None) -> AgentLink:
    """A computer that has just heard what the board's clock says, which is ahead of its own."""
    agent, board = link or AgentLink(7), FarEnd(7)
    (event,) = board.events(agent.timesync(now_ns - trip_ns), 0)
    assert isinstance(event, Timesync)
    agent._receiver._sequences.clear()  # each call's board counts its frames anew
    agent.receive(board.timesync(now_ns - trip_ns // 2 + ahead_ns, event.sent_ns), now_ns)
    return agent


def measured_ns(agent: AgentLink, board_ms: int, read_ns: int) -> int:
    """The instant of a burst, as far as the computer knows."""
    # each call's board counts its frames anew
    agent._receiver._sequences.clear()
    agent.receive(burst(FarEnd(7), board_ms), read_ns)
    assert agent.telemetry.board_ms == board_ms
    return agent.telemetry.arrival_ns


AHEAD_NS = 3_000_000_000_000  # a board that was switched on 50 minutes before the computer's clock began


@pytest.mark.parametrize("waited_ms", [0, 7, 43, 390])
def test_a_burst_is_as_old_as_it_is_however_long_it_waited_to_be_read(waited_ms: int) -> None:
    agent = synced(AHEAD_NS, 1000 * MS)
    assert measured_ns(agent, 3_001_200, (1200 + waited_ms) * MS) == 1200 * MS


def test_a_burst_is_never_from_the_future() -> None:
    agent = synced(AHEAD_NS, 1000 * MS)
    assert measured_ns(agent, 3_001_300, 1200 * MS) == 1200 * MS


def test_a_burst_that_a_board_says_again_is_not_younger() -> None:
    """Its measuring has stopped, and it has told no clock by which that could be seen."""
    agent, board = AgentLink(7), FarEnd(7)
    for k in range(10):
        agent.receive(burst(board, 5000), k * 50 * MS)
    assert (agent.telemetry.board_ms, agent.telemetry.arrival_ns) == (5000, 0)
    agent.receive(burst(board, 5050), 500 * MS)
    assert (agent.telemetry.board_ms, agent.telemetry.arrival_ns) == (5050, 500 * MS)


def test_while_the_boards_clock_is_not_known_well_a_burst_is_as_old_as_its_coming() -> None:
    assert measured_ns(AgentLink(7), 5000, 1234 * MS) == 1234 * MS
    assert measured_ns(synced(AHEAD_NS, 1000 * MS, trip_ns=40 * MS), 3_001_000, 1234 * MS) == 1234 * MS


def test_a_board_that_was_started_again_has_another_clock() -> None:
    agent = synced(AHEAD_NS, 1000 * MS)
    assert measured_ns(agent, 3_001_100, 1105 * MS) == 1100 * MS
    assert measured_ns(agent, 20, 2000 * MS) == 2000 * MS
    synced(-1980 * MS, 2100 * MS, link=agent)
    assert measured_ns(agent, 200, 2190 * MS) == 2180 * MS


def test_a_board_whose_clock_is_set_is_believed_at_its_next_answer() -> None:
    """As a simulation's is that was too slow for a moment. The quickest answer of all was given before."""
    agent = synced(AHEAD_NS, 1000 * MS, trip_ns=MS)
    synced(AHEAD_NS - 150 * MS, 2000 * MS, trip_ns=4 * MS, link=agent)
    assert measured_ns(agent, 3_002_000, 2160 * MS) == 2150 * MS


def test_slow_answers_do_not_move_a_clock_that_is_known() -> None:
    agent = synced(AHEAD_NS, 1000 * MS, trip_ns=MS)
    synced(AHEAD_NS + 20 * MS, 2000 * MS, trip_ns=60 * MS, link=agent)  # held up one way
    assert measured_ns(agent, 3_002_000, 2005 * MS) == 2000 * MS


def test_a_boards_time_goes_on_through_its_32_bits() -> None:
    """After 49.7 days of milliseconds."""
    wraps_ns = 2**32 * MS
    agent = synced(wraps_ns - 1000 * MS, 990 * MS)
    assert measured_ns(agent, 2**32 - 5, 1000 * MS) == 995 * MS
    assert measured_ns(agent, 15, 1030 * MS) == 1030 * MS  # it may have been started again
    synced(wraps_ns - 1000 * MS, 1040 * MS, link=agent)
    assert measured_ns(agent, 50, 1060 * MS) == 1050 * MS


def test_battery_reports_are_counted_and_an_impossible_state_is_refused() -> None:
    agent, board = AgentLink(7), FarEnd(7)
    assert (agent.telemetry.battery_reports, agent.telemetry.charge) == (0, 0)
    agent.receive(board.status(0.0, 1, 1, 0) + board.status(11.5, 1, 1, 0) + board.battery(11.5, 3), 0)
    assert (agent.telemetry.battery_v, agent.telemetry.battery_reports, agent.telemetry.charge) == (11.5, 2, 3)
    agent.receive(board.battery(11.5, 8), 0)
    assert (agent.telemetry.charge, agent.telemetry.refused_frames) == (3, 1)
