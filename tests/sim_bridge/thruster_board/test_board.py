"""The thruster board, driven by a real AgentLink: when it may thrust, when it must stop, what it measures."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as dialect
from scipy.spatial.transform import Rotation

from shoal.config.experiment import Experiment, load_experiment
from shoal.frames import Array
from shoal.mavlink import agent_link
from shoal.mavlink.agent_link import IGNORED, AgentLink, Telemetry
from shoal.mavlink.framing import Sender
from sim_bridge.plant.sensors import BoardSensors
from sim_bridge.thruster_board.board import ThrusterBoard
from sim_bridge.thruster_board.parameters import Parameters
from sim_bridge.thruster_board.state_machine import BoardStateMachine, Charge

pytestmark = pytest.mark.long

MS = 1_000_000
S = 1000 * MS
STEP = 5 * MS
LEVEL = (1500,) * 4
NEUTRAL = (*LEVEL, *LEVEL)
AHEAD = (1700, 1650, 1400, 1600, 1500, 1200, 1800, 1500)
STILL = np.zeros(4)
QUIET = tuple(
    f"sim.sensors.{name}=0"
    for name in (
        "gyro_noise_radps",
        "gyro_bias_radps",
        "heading_noise_rad",
        "heading_bias_rad",
        "tilt_noise_rad",
        "tilt_bias_rad",
        "pressure_noise_m",
        "pressure_bias_m",
        "battery_noise_v",
    )
)


class BoardBench:
    """A board and the computer beside it, on one clock. Commands arrive just before a step."""

    def __init__(self, *settings: str, robot_id: int = 1, seed: int = 1, start_ns: int = 0) -> None:
        self.board = ThrusterBoard(load_experiment("pool", settings), robot_id, seed)
        self.agent = AgentLink(robot_id)
        self.now_ns = start_ns
        self.supply_v: float | None = None

    @property
    def seen(self) -> Telemetry:
        return self.agent.telemetry

    def step(self, *frames: bytes, eta: Array = STILL, nu: Array = STILL, acceleration: Array = STILL) -> tuple[int, ...]:
        for frame in frames:
            self.board.receive(frame, self.now_ns)
        self.agent.receive(self.board.step(self.now_ns, eta, nu, acceleration, self.supply_v), self.now_ns)
        self.now_ns += STEP
        return self.board.pulses

    def drive(self, pulses: tuple[int, ...], seconds: float) -> None:
        """Send pulses at 20 Hz."""
        for i in range(round(seconds * S / STEP)):
            self.step(*([self.agent.pulses(pulses)] if i % 10 == 0 else []))

    def arm(self) -> None:
        self.drive(NEUTRAL, 0.1)
        self.step(self.agent.arm(True))
        assert self.board.armed


class BatteryWatch:
    """The rules, seen through the battery alone."""

    def __init__(self) -> None:
        self.rules = BoardStateMachine(Parameters.of(load_experiment("pool")), (1, agent_link.AGENT_COMPONENT))

    def update(self, voltage: float, elapsed_s: float) -> Charge:
        self.rules.battery(voltage, elapsed_s)
        return self.rules.charge


def thrusters(bench: BoardBench) -> tuple[int, ...]:
    return bench.board.pulses[:4]


# --- arming


def test_disarmed_is_neutral() -> None:
    bench = BoardBench()
    bench.drive(AHEAD, 1.0)
    assert bench.board.pulses == NEUTRAL
    assert not bench.seen.armed


def test_arms_at_neutral_and_follows() -> None:
    bench = BoardBench()
    bench.arm()
    bench.drive(AHEAD, 0.3)
    assert bench.board.pulses == AHEAD
    assert bench.seen.armed
    assert bench.seen.acknowledged == (400, agent_link.ACCEPTED)
    assert bench.seen.echo_us == AHEAD
    assert bench.board.rules.overrides_received == 8


def test_does_not_arm_without_overrides() -> None:
    bench = BoardBench()
    bench.step(bench.agent.arm(True))
    bench.step()
    assert not bench.board.armed
    assert bench.seen.acknowledged == (400, agent_link.REJECTED)
    assert bench.seen.texts[-1][1] == "not armed: no override is arriving"


def test_does_not_arm_on_an_old_override() -> None:
    bench = BoardBench()
    bench.drive(NEUTRAL, 0.1)
    bench.now_ns += 300 * MS
    bench.step(bench.agent.arm(True))
    bench.step()
    assert not bench.board.armed
    assert bench.seen.acknowledged == (400, agent_link.REJECTED)


@pytest.mark.parametrize("thruster", range(4))
def test_does_not_arm_with_a_thruster_commanded(thruster: int) -> None:
    bench = BoardBench()
    pulses = list(NEUTRAL)
    pulses[thruster] = 1550
    bench.drive(tuple(pulses), 0.1)
    bench.step(bench.agent.arm(True))
    assert not bench.board.armed
    assert bench.board.pulses == NEUTRAL


def test_ankles_may_stand_anywhere_when_arming() -> None:
    bench = BoardBench()
    bench.drive((*LEVEL, 1000, 2000, 1300, 1500), 0.1)
    bench.step(bench.agent.arm(True))
    assert bench.board.armed


def test_arming_twice_changes_nothing() -> None:
    bench = BoardBench()
    bench.arm()
    bench.drive(AHEAD, 0.2)
    bench.step(bench.agent.arm(True))
    bench.step()
    assert bench.board.pulses == AHEAD
    assert bench.seen.acknowledged == (400, agent_link.ACCEPTED)


def test_disarming_is_neutral_at_the_next_step() -> None:
    bench = BoardBench()
    bench.arm()
    bench.drive(AHEAD, 0.3)
    assert bench.step(bench.agent.arm(False))[:4] == LEVEL
    bench.drive(AHEAD, 0.2)
    assert thrusters(bench) == LEVEL
    assert not bench.seen.armed


# --- the link falls silent


@pytest.mark.parametrize("phase_ns", range(0, 50 * MS, 5 * MS))
def test_silence_is_neutral_in_time_whatever_the_phase(phase_ns: int) -> None:
    """The last override lands at any instant between the board's steps; worst case over all."""
    worst = 0
    for offset_ns in (0, 1, STEP // 2, STEP - 1):
        bench = BoardBench(start_ns=phase_ns)
        bench.arm()
        bench.drive(AHEAD, 0.2)
        last_ns = bench.now_ns - STEP + offset_ns
        bench.board.receive(bench.agent.pulses(AHEAD), last_ns)
        while thrusters(bench) != LEVEL:
            bench.step()
        worst = max(worst, bench.now_ns - STEP - last_ns)
        assert not bench.board.armed
    assert 250 * MS < worst <= 250 * MS + STEP


def test_after_a_silence_thrust_needs_arming_again() -> None:
    bench = BoardBench()
    bench.arm()
    bench.drive(AHEAD, 0.2)
    for _ in range(60):
        bench.step()
    bench.drive(AHEAD, 1.0)
    assert thrusters(bench) == LEVEL
    assert not bench.seen.armed
    assert any(text == "disarmed: no override for 250 ms" for _, text in bench.seen.texts)


def test_a_short_gap_is_ridden_out() -> None:
    bench = BoardBench()
    bench.arm()
    bench.drive(AHEAD, 0.2)
    for _ in range(35):
        bench.step()
    assert bench.board.pulses == AHEAD
    bench.drive(AHEAD, 0.2)
    assert bench.board.armed


def test_heartbeats_and_damaged_frames_keep_nothing_alive() -> None:
    bench = BoardBench()
    bench.arm()
    bench.drive(AHEAD, 0.2)
    for _ in range(55):
        damaged = bytearray(bench.agent.pulses(AHEAD))
        damaged[12] ^= 1
        bench.step(bench.agent.heartbeat(), bytes(damaged), bench.agent.timesync(bench.now_ns))
    assert thrusters(bench) == LEVEL


def test_a_repeated_frame_keeps_nothing_alive() -> None:
    bench = BoardBench()
    bench.arm()
    frame = bench.agent.pulses(AHEAD)
    for _ in range(400):
        bench.step(frame)
    assert thrusters(bench) == LEVEL
    assert not bench.board.armed


def test_ankles_hold_their_angle_at_neutral() -> None:
    bench = BoardBench()
    bench.arm()
    bench.drive(AHEAD, 0.2)
    for _ in range(60):
        bench.step()
    assert bench.board.pulses == (*LEVEL, *AHEAD[4:])


# --- limits


@pytest.mark.parametrize(
    ("channel", "value"), [(0, 1099), (1, 1901), (3, IGNORED), (2, 2200), (4, 999), (5, 2001), (7, 500), (0, 2500)]
)
def test_one_pulse_out_of_range_and_the_whole_message_is_refused(channel: int, value: int) -> None:
    bench = BoardBench()
    bench.arm()
    bench.drive(AHEAD, 0.2)
    pulses = list(AHEAD)
    pulses[(channel + 1) % 4] = 1600
    pulses[channel] = value
    assert bench.step(bench.agent.pulses(pulses)) == AHEAD
    assert bench.board.rules.overrides_refused == 1
    bench.drive(tuple(pulses), 0.3)
    assert thrusters(bench) == LEVEL  # and it does not keep the thrusters running


def test_refused_overrides_are_reported_and_still_counted() -> None:
    bench = BoardBench()
    bench.drive((1099, *NEUTRAL[1:]), 0.7)
    assert bench.board.rules.overrides_received == bench.board.rules.overrides_refused == 14
    data = b"".join(bench.board.step(bench.now_ns + i * STEP, STILL, STILL, STILL) for i in range(100))
    (status,) = (m for m in dialect.MAVLink(None).parse_buffer(data) or [] if m.get_type() == "SYS_STATUS")
    assert status.errors_count1 == 14
    assert status.onboard_control_sensors_health == status.onboard_control_sensors_present


def test_an_ignored_ankle_stays_where_it_is() -> None:
    bench = BoardBench()
    bench.arm()
    bench.drive(AHEAD, 0.2)
    bench.drive((*AHEAD[:4], IGNORED, 1700, IGNORED, IGNORED), 0.2)
    assert bench.board.pulses[4:] == (AHEAD[4], 1700, AHEAD[6], AHEAD[7])


def test_thrusters_turn_around_no_faster_than_allowed() -> None:
    """8000 us/s in steps of 5 ms: 40 us a step; full reverse to full ahead in 0.1 s."""
    bench = BoardBench()
    bench.arm()
    bench.drive((1100,) * 4 + LEVEL, 0.2)
    reverse, ahead = thrusters(bench), (1900,) * 4 + LEVEL
    assert reverse == (1100,) * 4
    pulses = [bench.step(bench.agent.pulses(ahead))[0] for _ in range(21)]
    assert np.diff([1100, *pulses]) == pytest.approx([40] * 20 + [0])


def test_the_slew_rate_does_not_depend_on_the_step() -> None:
    bench = BoardBench()
    bench.arm()
    agent, now = bench.agent, bench.now_ns - STEP
    for elapsed_ms in (1, 7, 2, 13):
        bench.board.receive(agent.pulses((1900,) * 4 + LEVEL), now)
        before = thrusters(bench)[0]
        now += elapsed_ms * MS
        bench.board.step(now, STILL, STILL, STILL)
        assert thrusters(bench)[0] - before == 8 * elapsed_ms


# --- battery


def test_battery_levels_in_order_and_without_chatter() -> None:
    """A falling ramp with noise of +-0.15 V, then a rising one: each level is entered once and left once."""
    for seed in range(8):
        watch, random = BatteryWatch(), np.random.default_rng(seed)
        ramp = np.concatenate([np.linspace(12.0, 9.0, 6000), np.linspace(9.0, 12.0, 6000)])
        levels = [watch.update(v + random.uniform(-0.15, 0.15), 0.02) for v in ramp]
        changes = [level for level, before in zip(levels[1:], levels[:-1], strict=True) if level is not before]
        down = [Charge.WARN, Charge.NO_ARM, Charge.NEUTRAL]
        assert changes == [*down, *reversed(down[:-1]), Charge.GOOD]


def test_battery_levels_at_their_voltages() -> None:
    """Entered below 10.8, 10.5, 9.9 V; left 0.3 V above. Held long enough for the filter."""
    watch = BatteryWatch()
    sequence = [(10.81, 0), (10.79, 1), (11.09, 1), (11.11, 0), (10.49, 2), (10.79, 2), (10.81, 1), (9.89, 3), (10.19, 3)]
    sequence += [(10.21, 2), (9.0, 3), (12.0, 0)]
    for volts, level in sequence:
        assert watch.update(volts, 60.0) == level, volts


def test_a_moment_of_full_thrust_is_no_empty_battery() -> None:
    watch = BatteryWatch()
    watch.update(11.0, 0.02)
    assert [watch.update(10.5, 0.02) for _ in range(20)] == [Charge.GOOD] * 20


def test_low_battery_forbids_arming_but_not_flying() -> None:
    bench = BoardBench()
    bench.supply_v = 12.0
    bench.arm()
    bench.supply_v = 10.3
    bench.drive(NEUTRAL, 5.0)
    assert bench.board.armed
    bench.step(bench.agent.arm(False))
    bench.step(bench.agent.arm(True))
    bench.step()
    assert not bench.board.armed
    assert bench.seen.texts[-1][1] == "not armed: battery low"
    assert any(text.startswith("battery WARN") for _, text in bench.seen.texts)


def test_empty_battery_is_neutral_and_stays_so() -> None:
    """Without thrust the voltage recovers. That must not start the thrusters again."""
    bench = BoardBench()
    bench.supply_v = 12.0
    bench.arm()
    bench.supply_v = 9.5
    while bench.board.armed:
        bench.drive(AHEAD, 0.05)
        assert bench.now_ns < 20 * S
    assert thrusters(bench) == LEVEL
    bench.supply_v = 12.0
    bench.drive(AHEAD, 5.0)
    assert thrusters(bench) == LEVEL
    assert any(text == "disarmed: battery empty" for _, text in bench.seen.texts)


def test_voltage_sags_with_thrust() -> None:
    """0.5 V with all four at 3 N."""
    bench = BoardBench(*QUIET)
    bench.arm()
    bench.drive(NEUTRAL, 1.0)
    assert bench.seen.battery_v == pytest.approx(12.4)
    bench.drive((1900,) * 4 + LEVEL, 1.5)
    assert bench.seen.battery_v == pytest.approx(11.9)


# --- measurements


def test_bursts_come_at_their_rate_and_end_with_attitude() -> None:
    board, parser = ThrusterBoard(load_experiment("pool"), 1, 1), dialect.MAVLink(None)
    bursts = [data for t in range(0, 3 * S, STEP) if (data := board.step(t, STILL, STILL, STILL))]
    kinds = [[message.get_type() for message in parser.parse_buffer(data) or []] for data in bursts]
    assert len(bursts) == 150
    assert all(kind[:3] == ["SCALED_IMU", "SCALED_PRESSURE2", "SERVO_OUTPUT_RAW"] for kind in kinds)
    assert all(kind[-1] == "ATTITUDE" and kind.count("ATTITUDE") == 1 for kind in kinds)
    assert sum(kind.count("SYS_STATUS") for kind in kinds) == 6
    assert sum(kind.count("HEARTBEAT") for kind in kinds) == 3


@pytest.mark.parametrize("rate_hz", [30.0, 33.0, 7.0, 400.0])
def test_status_and_heartbeat_come_at_any_sensor_rate(rate_hz: float) -> None:
    board, parser = ThrusterBoard(load_experiment("pool", [f"sim.sensors.rate_hz={rate_hz}"]), 1, 1), dialect.MAVLink(None)
    data = b"".join(board.step(t, STILL, STILL, STILL) for t in range(0, 4 * S, MS))
    kinds = [message.get_type() for message in parser.parse_buffer(data) or []]
    assert kinds.count("ATTITUDE") == pytest.approx(4 * rate_hz, abs=1)
    assert kinds.count("SYS_STATUS") == 8
    assert kinds.count("HEARTBEAT") == 4


def test_burst_carries_its_time_and_the_motion() -> None:
    bench = BoardBench(*QUIET, start_ns=7 * S)
    eta, nu = np.array([1.0, -0.5, 0.42, 2.5]), np.array([0.3, -0.1, 0.05, 0.6])
    bench.step(eta=eta, nu=nu, acceleration=np.array([0.2, -0.3, 0.1, 0.7]))
    telemetry = bench.seen
    assert (telemetry.board_ms, bench.board.burst_ms) == (7000, 7000)
    assert telemetry.heading_rad == pytest.approx(2.5, abs=1e-6)
    assert telemetry.yaw_rate_radps == pytest.approx(0.6, abs=1e-6)
    assert telemetry.depth_m == pytest.approx(0.42, abs=1e-5)
    specific = (0.2 + 0.1 * 0.6, -0.3 + 0.6 * 0.3, 0.1 - 9.81)  # v' + omega x v - g, by hand
    assert telemetry.acceleration_mps2 == pytest.approx(specific, abs=0.1)


def test_burst_carries_the_tilt_and_its_rates() -> None:
    bench, tilt = BoardBench(*QUIET, start_ns=7 * S), (0.1, -0.15, 0.2, 0.3)
    bench.agent.receive(bench.board.step(7 * S, STILL, np.array([0.0, 0.0, 0.0, 0.5]), STILL, tilt=tilt), 7 * S)
    assert bench.seen.tilt == pytest.approx(tilt, abs=1e-6)
    assert bench.seen.yaw_rate_radps == pytest.approx(0.5, abs=1e-6)  # of the heading, however the body leans


def test_the_rates_of_a_swinging_body_integrate_to_its_attitude() -> None:
    """A second integration: rotations composed from what the gyroscopes measure, against the angles themselves. It knows no
    Euler angles' rates."""
    sensors, step_s = BoardSensors(load_experiment("pool", QUIET), 1, 1), 1e-3
    turned = Rotation.identity()
    for k in range(4000):
        t = (k + 0.5) * step_s
        roll, pitch, yaw_rate = 0.4 * math.sin(3.0 * t), 0.3 * math.sin(2.0 * t), 0.8 * math.cos(t)
        tilt = (roll, pitch, 1.2 * math.cos(3.0 * t), 0.6 * math.cos(2.0 * t))
        reading = sensors.read(STILL, np.array([0.0, 0.0, 0.0, yaw_rate]), STILL, tilt)
        assert reading.heading_rate_radps == pytest.approx(yaw_rate, abs=1e-9)
        turned *= Rotation.from_rotvec(np.array([*reading.tilt_sensed[2:], reading.yaw_rate_radps]) * step_s)
    end_s = 4000 * step_s
    true = (0.8 * math.sin(end_s), 0.3 * math.sin(2.0 * end_s), 0.4 * math.sin(3.0 * end_s))
    assert turned.as_euler("ZYX") == pytest.approx(true, abs=1e-5)


def test_heading_is_wrapped() -> None:
    bench = BoardBench(*QUIET)
    bench.step(eta=np.array([0, 0, 0, 7 * math.pi / 2]))
    assert bench.seen.heading_rad == pytest.approx(-math.pi / 2, abs=1e-6)


def test_noise_and_bias_are_what_the_file_says() -> None:
    experiment = load_experiment("pool")
    sensors, board = experiment.sim.sensors, BoardSensors(experiment, 1, 1)
    readings = [board.read(STILL, STILL, STILL) for _ in range(4000)]
    for values, bias, noise in (
        ([r.heading_rad for r in readings], board.heading_bias_rad, sensors.heading_noise_rad),
        ([r.yaw_rate_radps for r in readings], board.gyro_bias_radps, sensors.gyro_noise_radps),
        ([r.depth_m for r in readings], board.depth_bias_m, sensors.pressure_noise_m),
    ):
        assert np.mean(values) == pytest.approx(bias, abs=4 * noise / math.sqrt(4000))
        assert np.std(values) == pytest.approx(noise, rel=0.05)
    tilts = np.array([board.read(STILL, STILL, STILL, (0.1, -0.1, 0.3, 0.2)).tilt for _ in range(4000)])
    sigmas = np.repeat([sensors.tilt_noise_rad, sensors.gyro_noise_radps], 2)
    tilt_bias = np.append(board.tilt_bias_rad, [0.0, 0.0])
    assert np.abs(tilts.mean(axis=0) - [0.1, -0.1, 0.3, 0.2] - tilt_bias).max() < 4 * sigmas.max() / math.sqrt(4000)
    assert tilts.std(axis=0) == pytest.approx(sigmas, rel=0.05)
    biases = [BoardSensors(experiment, robot, seed).heading_bias_rad for robot in (1, 2) for seed in range(100)]
    assert len(set(biases)) == 200
    assert np.max(np.abs(biases)) <= sensors.heading_bias_rad
    assert np.std(biases) == pytest.approx(sensors.heading_bias_rad / math.sqrt(3), rel=0.15)


def test_depth_is_off_by_the_robots_own_offset() -> None:
    settings = (*QUIET, "robots.1.depth_offset_m=0.25")
    for robot_id, depth_m in ((1, 1.0), (2, 1.25)):
        bench = BoardBench(*settings, robot_id=robot_id)
        bench.step(eta=np.array([0.0, 0.0, 1.0, 0.0]))
        assert bench.seen.depth_m == pytest.approx(depth_m, abs=2e-3)


def test_the_same_seed_sends_the_same_bytes() -> None:
    def sent(seed: int, robot_id: int) -> bytes:
        bench = BoardBench(seed=seed, robot_id=robot_id)
        bench.arm()
        return b"".join(bench.board.step(bench.now_ns + i * STEP, STILL, STILL, STILL) for i in range(100))

    assert sent(1, 1) == sent(1, 1)
    assert sent(1, 1) != sent(2, 1)


def test_board_answers_timesync_and_unknown_commands() -> None:
    bench = BoardBench(start_ns=3600 * S)
    bench.step(bench.agent.timesync(bench.now_ns))
    assert bench.seen.clock_offset_ns == 0
    order = dialect.MAVLink_command_long_message(1, 1, 246, 0, 1, 0, 0, 0, 0, 0, 0)
    fresh = BoardBench()
    fresh.step(Sender((1, agent_link.AGENT_COMPONENT)).pack(order))
    fresh.step()
    assert fresh.seen.acknowledged == (246, agent_link.UNSUPPORTED)


# --- anything at all

ACTIONS = st.lists(
    st.one_of(
        st.tuples(st.just("pulses"), st.lists(st.integers(500, 2500) | st.just(IGNORED), min_size=8, max_size=8)),
        st.tuples(st.just("near"), st.lists(st.integers(1095, 1905), min_size=8, max_size=8)),
        st.tuples(st.just("neutral"), st.none()),
        st.tuples(st.just("arm"), st.booleans()),
        st.tuples(st.just("bytes"), st.binary(max_size=60)),
        st.tuples(st.just("flip"), st.integers(0, 239)),
        st.tuples(st.just("wait"), st.integers(1, 400)),
        st.tuples(st.just("battery"), st.floats(8.0, 13.0)),
    ),
    max_size=40,
)


def frame_for(bench: BoardBench, action: str, value: object) -> bytes:
    if action == "arm":
        return bench.agent.arm(bool(value))
    if action == "bytes":
        assert isinstance(value, bytes)
        return value
    if action == "flip":
        assert isinstance(value, int)
        frame = bytearray(bench.agent.pulses(AHEAD))
        frame[value // 8] ^= 1 << value % 8
        return bytes(frame)
    return bench.agent.pulses(value if isinstance(value, list) else NEUTRAL)


def allowed(experiment: Experiment, pulses: tuple[int, ...]) -> bool:
    return all(1100 <= p <= 1900 for p in pulses[:4]) and all(1000 <= p <= 2000 for p in pulses[4:])


@settings(max_examples=150)
@given(actions=ACTIONS)
def test_rules_hold_whatever_arrives(actions: list[tuple[str, object]]) -> None:
    """Against a second, blunt account of the rules: thrust only when armed, within 255 ms of an override that was allowed,
    never out of range, never faster than the slew rate."""
    experiment = load_experiment("pool")
    bench, last_valid_ns, sent = BoardBench(), -S, {1500}
    before = thrusters(bench)
    for action, value in actions:
        if action == "battery":
            assert isinstance(value, float)
            bench.supply_v = value
            continue
        count = value if action == "wait" else 1
        assert isinstance(count, int)
        for _ in range(count):
            if action != "wait":
                good = bench.board.rules.overrides_received - bench.board.rules.overrides_refused
                bench.board.receive(frame_for(bench, action, value), bench.now_ns)
                if bench.board.rules.overrides_received - bench.board.rules.overrides_refused > good:
                    last_valid_ns = bench.now_ns
                    sent |= set(value if isinstance(value, list) else NEUTRAL)
            now = bench.step()
            assert allowed(experiment, now)
            if now[:4] != LEVEL:
                assert bench.board.armed
                assert bench.now_ns - STEP - last_valid_ns <= 255 * MS
                assert min(sent) <= min(now[:4])
                assert max(now[:4]) <= max(sent)
                assert max(abs(a - b) for a, b in zip(now[:4], before, strict=True)) <= 41
            before = now[:4]
