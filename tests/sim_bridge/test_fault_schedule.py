"""Faults against what they do to water, sensors, pictures and links."""

import itertools
import shlex
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from groundstation.logs.recorder import Recorder
from shoal.config.experiment import dump_experiment, load_experiment
from shoal.config.fault_injection import read_request, read_what
from shoal.errors import ConfigError
from shoal.frames import Array
from shoal.messages import topics
from shoal.messages.codec import Header, encode
from shoal.messages.messages import Event
from sim_bridge.camera import faults as camera_faults
from sim_bridge.camera.faults import CameraFaults
from sim_bridge.camera.renderer import Renderer
from sim_bridge.fault_schedule import FaultSchedule, ImuFaults, LinkFaults, faults_after_the_end, require_kinds
from sim_bridge.in_process.resume import Moment, faults_by_hand, load_changed
from sim_bridge.node.board_ports import LossyLink
from sim_bridge.plant.fleet import Plant
from sim_bridge.plant.sensors import BoardSensors
from sim_bridge.world import World

NS = 1_000_000_000
CALM = ("pool.walls=false", "sim.plant.buoyancy_n=0", "sim.plant.thruster_spread=0", "sim.plant.battery.capacity_wh=0")
APART = np.array([[-9.0, 0.0, 5.0, 0.0], [9.0, 0.0, 5.0, 0.0]])


def thrust(line: str, pulses: list[float]) -> Array:
    """Force (2, 4) that the thrusters reach when this holds and these pulses have been on for a second, 1600 us before."""
    experiment = load_experiment("pool", CALM, [f"t=0.5 {line}"])
    fleet, faults = Plant(experiment, 1), FaultSchedule(experiment)
    state = fleet.start(APART)
    for k in range(300):
        faults.advance(k * 0.005)
        wanted = [1600.0] * 4 if k <= 100 else pulses
        state = fleet.step(state, faults.pulses(np.tile([*wanted, *[1500.0] * 4], (2, 1))), faults.actuators)
    return state.motors.force_n


@pytest.mark.parametrize(("effect", "factor"), [("dead", 0.0), ("reversed", -1.0), ("weak 0.3", 0.3), ("stuck", 0.478 / 1.22)])
def test_broken_thruster_gives_its_faulty_thrust(effect: str, factor: float) -> None:
    force = thrust(f"thruster 2/3 {effect}", [1700.0] * 4)
    expected = np.full((2, 4), 1.22)
    expected[1, 2] *= factor
    assert force == pytest.approx(expected, abs=1e-3)


def test_schedule_names_what_breaks_and_what_is_repaired() -> None:
    faults = FaultSchedule(load_experiment("pool", faults=["t=1 for=2 camera dark", "t=2 battery 1 sag 2"]))
    assert faults.advance(0.99) == []
    assert faults.advance(1.0) == ["fault: camera dark"]
    assert faults.advance(2.5) == ["fault: battery 1 sag 2"]
    assert faults.advance(3.0) == ["fault over: camera dark"]
    assert faults.actuators.sag_v.tolist() == [2.0, 0.0] and faults.camera == ()
    assert [faults.quiet_steps(time_s, 0.005, 150) for time_s in (-1.0, 0.5, 0.51, 0.998, 1.0, 2.9, 3.0)] == [
        150, 100, 98, 1, 150, 20, 150
    ]  # fmt: skip


def test_a_sagging_battery_is_measured_and_felt() -> None:
    world = World(
        load_experiment("pool", faults=["t=1 battery 2 sag 2"]), 1, np.array([[-0.5, 0, 0.3, 0], [0.5, 0, 0.3, 0.0]])
    )
    world.start_ns = 0
    texts = []
    for _ in range(260):
        texts += world.apply_faults()
        world.step()
    assert texts == ["fault: battery 2 sag 2"]
    # the boards tell the voltage with noise; the exact one is the plant's
    volts = world._plant.rest_v(world._state, world.faults.actuators)
    assert volts[0] - volts[1] == pytest.approx(2.0, abs=1e-9)


def test_before_the_start_nothing_breaks() -> None:
    world = World(load_experiment("pool", faults=["t=0 camera dark"]), 1, np.array([[-0.5, 0, 0.3, 0], [0.5, 0, 0.3, 0.0]]))
    assert world.apply_faults() == []
    world.start_ns = 0
    assert world.apply_faults() == ["fault: camera dark"]


def test_broken_imu_gives_its_faulty_samples() -> None:
    experiment = load_experiment("pool")
    still = np.zeros(4)
    whole, broken = (BoardSensors(experiment, 1, 1) for _ in range(2))
    broken.faults = ImuFaults(0.5, -0.1)
    a, b = whole.read(still, still, still), broken.read(still, still, still)
    assert (b.heading_rad - a.heading_rad, b.yaw_rate_radps - a.yaw_rate_radps) == pytest.approx((0.5, -0.1))


@pytest.mark.parametrize(
    ("whats", "rate_radps", "force_mps2"),
    [
        (("imu 1 scaled",), 0.0, (0.0, 0.0, -9.81)),
        (("imu 1 scaled -1", "imu 1 gyro 0.1"), -0.3, (0.0, 0.0, -9.81)),
        (("imu 1 turned 3.1415926",), -0.4, (0.0, 0.0, 9.81)),
        (("imu 1 turned 1.5707963",), 0.0, (0.0, -9.81, 0.0)),
        (("imu 1 stuck",), 0.0, (0.0, 0.0, 0.0)),  # nothing was measured before
    ],
)
def test_imu_faults_change_what_is_measured_of_a_turn(
    whats: tuple[str, ...], rate_radps: float, force_mps2: tuple[float, float, float]
) -> None:
    experiment = load_experiment("pool", [], [f"t=0 {what}" for what in whats])
    schedule, sensors, still = FaultSchedule(experiment), BoardSensors(experiment, 1, 1), np.zeros(4)
    schedule.advance(0.0)
    sensors.faults = schedule.imu[0]
    reading = sensors.read(still, np.array([0.0, 0.0, 0.0, 0.4]), still)
    assert reading.yaw_rate_radps == pytest.approx(rate_radps, abs=0.02)
    assert reading.acceleration_mps2 == pytest.approx(force_mps2, abs=0.1)


# --- camera


def test_a_frozen_camera_sends_its_last_picture() -> None:
    camera, random = CameraFaults(), np.random.default_rng(1)
    first, second = (random.integers(0, 255, (48, 64), dtype=np.uint8) for _ in range(2))
    assert (camera.apply(first, ()) == first).all()
    frozen = (read_what("camera frozen"),)
    assert (camera.apply(second, frozen) == first).all() and (camera.apply(second, frozen) == first).all()
    assert (camera.apply(second, ()) == second).all()


def test_camera_faults_darken_hide_and_dazzle_the_picture() -> None:
    picture = np.full((400, 600), 96, dtype=np.uint8)
    dark, hidden, dazzled = (
        CameraFaults().apply(picture, (read_what(f"camera {effect}"),)) for effect in ("dark", "occluded 0.25", "glare 0.2")
    )
    assert (dark == 6).all()
    assert (hidden[:, :150] == 12).all() and (hidden[:, 150:] == 96).all()
    assert 0.19 < np.mean(dazzled == 255) < 0.22 and dazzled[0, 0] == 96
    assert (picture == 96).all()


def test_a_glare_is_made_once_for_all_pictures_of_a_size() -> None:
    camera, glare = CameraFaults(), (read_what("camera glare 0.3"),)
    # how often the glare is drawn is seen in its cache alone
    before = camera_faults._glare.cache_info().misses
    pictures = [camera.apply(np.full((96, 128), level, np.uint8), glare) for level in (10, 20, 30)]
    # how often the glare is drawn is seen in its cache alone
    assert camera_faults._glare.cache_info().misses == before + 1
    assert [int(picture[0, 0]) for picture in pictures] == [10, 20, 30]
    assert all(picture[48, 64] == 255 and picture.flags.writeable for picture in pictures)


def test_a_lost_marker_is_not_in_the_picture() -> None:
    experiment = load_experiment(
        "pool", ["camera.size_px=[320,240]", "camera.focal_px=[250,250]", "camera.centre_px=[159.5,119.5]"]
    )
    eta = np.array([[-0.5, 0.0, 0.3, 0.0], [0.5, 0.0, 0.3, 0.0]])
    renderer = Renderer(experiment, 1)
    before = renderer.render(eta, np.zeros((2, 4)), 0.0, 0).astype(int)
    renderer.hide_markers({1})
    unmarked = renderer.render(eta, np.zeros((2, 4)), 0.0, 0).astype(int)
    renderer.hide_markers(())
    assert (renderer.render(eta, np.zeros((2, 4)), 0.0, 0) == before).all()
    changed = np.abs(unmarked - before) > 20
    assert changed[:, 160:].sum() > 20 and changed[:, :160].sum() == 0


# --- links


def through(trouble: LinkFaults, count: int = 2000) -> list[tuple[int, int]]:
    """(time in ms, number) of what comes out when number k goes in at k * 20 ms."""
    link, out = LossyLink(1, 1, 0, 0), []
    for now_ms in range(0, count * 20 + 6000, 5):
        if now_ms % 20 == 0 and now_ms < count * 20:
            link.push(now_ms.to_bytes(4, "big"), now_ms * 1_000_000, trouble, 0)
        out += [(now_ms, int.from_bytes(data, "big") // 20) for data, _ in link.pop(now_ms * 1_000_000)]
    return out


def test_a_whole_link_changes_nothing() -> None:
    assert through(LinkFaults()) == [(20 * k, k) for k in range(2000)]


def test_a_cut_link_lets_nothing_through() -> None:
    assert through(LinkFaults(cut=True)) == []


def test_a_slow_link_is_late_and_in_order() -> None:
    assert through(LinkFaults(delay_s=0.3)) == [(20 * k + 300, k) for k in range(2000)]


def test_a_noisy_link_loses_doubles_and_reorders() -> None:
    numbers = [number for _, number in through(LinkFaults(loss=0.2))]
    counts = Counter(numbers)
    assert 0.17 < 1 - len(counts) / 2000 < 0.23
    assert 0.17 < sum(count == 2 for count in counts.values()) / len(counts) < 0.23
    assert 0.05 < sum(b < a for a, b in itertools.pairwise(numbers)) / len(numbers) < 0.25
    assert numbers == [number for _, number in through(LinkFaults(loss=0.2))]  # the same seed, the same luck


def test_fault_that_this_flight_cannot_have_is_refused() -> None:
    experiment = load_experiment("pool", faults=["t=1 thruster 1/1 dead", "t=2 camera dark"])
    with pytest.raises(
        ConfigError, match=r"sim.faults.1.what = 'camera dark': in a numeric flight .* \(allowed here: thruster"
    ):
        require_kinds(experiment, ("thruster",), "in a numeric flight there is none")


def test_the_tag_of_what_was_overtaken_is_gone() -> None:
    link = LossyLink(1, 1, 0, 0)
    link.push(b"slow", 0, LinkFaults(delay_s=0.1), tag=7)
    link.push(b"fast", 10, LinkFaults(), tag=8)
    assert link.pop(20) == [(b"fast", 8)]
    assert link.pop(10**9) == [(b"slow", 0)]


def test_a_fault_after_the_end_is_told_to_never_happen() -> None:
    experiment = load_experiment("pool", ["duration_s=30"], ["t=29.9 thruster 1/1 dead", "t=500 camera dark"])
    assert faults_after_the_end(experiment) == ["never happens: camera dark at 500 s, for the run ends after 30 s"]


def test_a_fault_made_by_hand_holds_from_then_on_and_is_reported_as_a_command_line() -> None:
    """The plant is two seconds older than the robots' flight."""
    experiment = load_experiment("pool", faults=["t=1 thruster 1/1 weak 0.5"])
    schedule = FaultSchedule(experiment)
    schedule.advance(5.0, 7.0)
    assert schedule.add("thruster 2/3 dead", 0.0, 5.0, 7.0) == "t=5.000 thruster 2/3 dead"
    assert schedule.add("water gust 0.04", 2.0, 5.0, 7.0) == "t=5.000 for=2 water gust 0.04"
    assert schedule.add("ball 0.5,-1 drops", 0.0, 5.0, 7.0) == "t=5.000 ball 0.5,-1 drops"
    assert schedule.advance(5.0, 7.0) == ["fault: thruster 2/3 dead", "fault: water gust 0.04", "fault: ball 0.5,-1 drops"]
    assert (schedule.actuators.thrust[1, 2], schedule.gust_mps) == (0.0, 0.04)
    assert schedule.balls[0].start_m == (0.5, -1.0, experiment.path.depth_m)
    assert schedule.quiet_steps(6.0, 0.1, 1000, 8.0) == 10
    assert schedule.advance(7.0, 9.0) == ["fault over: water gust 0.04"]
    assert schedule.add("", 0.0, 9.0, 11.0) == "mended at 9.000 s: thruster 2/3 dead; mended at 9.000 s: ball 0.5,-1 drops"
    assert schedule.advance(9.0, 11.0) == ["fault over: thruster 2/3 dead", "fault over: ball 0.5,-1 drops"]
    assert schedule.actuators.thrust[0, 0] == 0.5  # what the file breaks stays broken


def test_a_fault_by_hand_is_over_in_time_also_before_the_robots_start() -> None:
    world = World(load_experiment("pool", CALM), 1, APART, held=True)
    assert world.break_by_hand("battery 1 sag 2", 5.0) == "before the start for=5 battery 1 sag 2"
    texts = []
    while world.now_ns < 6_000_000_000:
        texts += [(text, round(world.now_ns * 1e-9, 2)) for text in world.apply_faults()]
        world.step()
    assert texts == [("fault: battery 1 sag 2", 0.0), ("fault over: battery 1 sag 2", 5.0)]


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("thruster 2/9 dead", "no such thruster"),
        ("thruster 7/1 dead", "no robot 7"),
        ("process agent-1 killed", "only by the timeline"),
        ("water low", "only by the timeline"),
        ("marker 1 lost for ever", "must be seconds"),
        ("ball here drops", "must read: ball X,Y"),
        ("camera north dark", "no camera 'north' .allowed: east, west"),
    ],
)
def test_a_fault_by_hand_that_cannot_be_is_refused_with_what_can(text: str, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        read_request(text, (1, 2), (1, 2, 3, 4), ("east", "west"))


@pytest.mark.parametrize("text", ["camera dark", "marker 1 lost for 5"])
def test_without_a_camera_nothing_that_only_one_sees_is_broken(text: str) -> None:
    with pytest.raises(ValueError, match="no camera sees it in this run"):
        read_request(text, (1, 2), (1, 2, 3, 4), uses_camera=False)


def record_lines(run: Path, lines: list[tuple[float, str]]) -> None:
    """A log of the simulator's lines, each at a time in s, in a run's folder."""
    recorder = Recorder(run / "run.mcap", "name = 'pool'\n", {})
    for k, (time_s, line) in enumerate(lines, start=1):
        stamp_ns = round(time_s * NS)
        recorder.put(topics.EVENT, "shoal/event", Header(7, k, stamp_ns), encode(Event(2, "sim-bridge", line)), stamp_ns)
    recorder.close()


def moment(zero_s: float, until_s: float = 1e6) -> Moment:
    """A moment 2 s into a flight, whose time 0 is at `zero_s` in the log."""
    return Moment(2.0, round((zero_s + 2.0) * NS), round((zero_s + 2.0) * NS), round(until_s * NS))


def test_faults_made_by_hand_are_read_back_from_the_log_as_a_timeline(tmp_path: Path) -> None:
    lines = [
        (3.0, "by hand: before the start for=5 battery 1 sag 2"),  # over before the flight
        (9.0, "by hand: before the start for=5 battery 2 sag 2"),
        (13.1, "by hand: t=3.100 thruster 1/2 weak 0.4"),
        (14.0, "by hand: t=4.000 for=2 imu 2 gyro 0.1"),
        (15.0, "by hand: t=5.000 camera frozen"),
        (16.0, "by hand: t=6.000 for=20 thruster 1/4 dead"),
        (
            19.5,
            "by hand: mended at 9.500 s: thruster 1/2 weak 0.4; mended at 9.500 s: camera frozen; "
            "mended at 9.500 s: thruster 1/4 dead",
        ),
    ]
    record_lines(tmp_path, lines)
    assert [fault for _, fault in faults_by_hand(tmp_path, moment(10.0))] == [
        "t=0.000 for=4 battery 2 sag 2",
        "t=3.100 for=6.4 thruster 1/2 weak 0.4",
        "t=4.000 for=2 imu 2 gyro 0.1",
        "t=5.000 for=4.5 camera frozen",
        "t=6.000 for=3.5 thruster 1/4 dead",
    ]


def test_faults_made_by_hand_come_at_the_same_time_of_the_flight_that_is_resumed(tmp_path: Path) -> None:
    """Two flights in one session, from 10 s and from 100 s on. What was broken in the first, and is not mended, is broken in
    the second from its start on; what came in the second is none of the first's."""
    lines = [
        (20.0, "by hand: t=10.000 thruster 1/2 dead"),
        (80.0, "by hand: t=70.000 for=60 battery 1 sag 2"),
        (81.0, "by hand: t=71.000 for=5 battery 2 sag 2"),
        (105.0, "by hand: t=5.000 for=3 imu 2 gyro 0.1"),
        (107.0, "by hand: mended at 7.000 s: thruster 1/2 dead; mended at 7.000 s: imu 2 gyro 0.1"),
    ]
    record_lines(tmp_path, lines)
    assert [fault for _, fault in faults_by_hand(tmp_path, moment(10.0, until_s=100.0))] == [
        "t=10.000 thruster 1/2 dead",
        "t=70.000 for=60 battery 1 sag 2",
        "t=71.000 for=5 battery 2 sag 2",
    ]
    assert [fault for _, fault in faults_by_hand(tmp_path, moment(100.0))] == [
        "t=0.000 for=7 thruster 1/2 dead",
        "t=0.000 for=40 battery 1 sag 2",
        "t=5.000 for=2 imu 2 gyro 0.1",
    ]


def test_a_fault_that_a_flight_from_a_logged_moment_cannot_have_is_said(tmp_path: Path) -> None:
    made = ("t=3.100 thruster 1/2 weak 0.4", "t=4.000 radio 1 dead", "t=4.500 water gust 0.1", "t=5.000 for=9 camera frozen")
    record_lines(tmp_path, [(float(fault[2:7]), f"by hand: {fault}") for fault in made])
    (tmp_path / "experiment.toml").write_text(dump_experiment(load_experiment("pool")))
    experiment, (left_out, again) = load_changed(tmp_path, moment(0.0), ["seed=4"], ["t=7 imu 2 gyro 0.1"])
    assert [fault.what for fault in experiment.sim.faults] == [
        "thruster 1/2 weak 0.4", "radio 1 dead", "water gust 0.1", "imu 2 gyro 0.1"
    ]  # fmt: skip
    assert left_out.endswith("t=5.000 for=9 camera frozen")
    command = ["sim-bridge", "sil", str(tmp_path / "experiment.toml"), "--set", "seed=4"]
    for fault in (*made, "t=7 imu 2 gyro 0.1"):
        command += ["--fault", fault]
    assert shlex.split(again.partition(", fly ")[2]) == command
