"""The world that looks ahead: what it expects comes, and having looked changes nothing."""

import numpy as np
import pytest

from shoal.config.experiment import load_experiment
from shoal.frames import Array
from shoal.mavlink.agent_link import AgentLink
from sim_bridge.world import World

FIRST_TICK, STEPS, TICKS = 6, 10, 40  # of 5 ms: an exposure is due four steps after each control step
QUICK_ANKLES = "vehicle.legs.ankle_dead_time_s=0.015"  # pulses act before the exposure: nothing can be known of it

Motion = tuple[Array, Array, Array]  # poses, velocities, tilts


def fly(looks: bool, *settings: str) -> tuple[list[bytes], list[Motion | None], list[Motion]]:
    """Robots under pulses drawn at random, a thruster dying on the way between a control step and an exposure. The state after
    every step, what was expected of each exposure, and what came."""
    experiment = load_experiment("pool", settings, ["t=0.54 for=0.3 thruster 1/2 dead"])
    world = World(experiment, 1, np.array([[0.4, 0.0, 0.3, 0.0], [-0.4, 0.0, 0.3, 1.0]]))
    world.start_ns = 0
    links, random = [AgentLink(robot) for robot in experiment.robot_ids], np.random.default_rng(2)
    states: list[bytes] = []
    expected: list[Motion | None] = []
    came: list[Motion] = []

    def move(steps: int) -> None:
        for _ in range(steps):
            world.apply_faults()
            world.step()
            truth = world.truth()
            parts = (world.eta, world.nu, world.tilt, truth.wrench, truth.disturbance)
            states.append(b"".join(part.tobytes() for part in parts))

    for i, link in enumerate(links):
        world.receive(i, link.pulses((1500,) * 8))
        world.receive(i, link.arm(True))
    move(FIRST_TICK)
    for _ in range(TICKS):
        expected.append(world.next_exposure() if looks else None)
        for i, link in enumerate(links):
            world.receive(i, link.pulses((*random.integers(1250, 1750, 4).tolist(), *random.integers(1200, 1800, 4).tolist())))
        move(4)
        assert world.exposed
        came.append((world.eta, world.nu, world.tilt))
        move(STEPS - 4)
    return states, expected, came


def told(by_events: bool, *settings: str) -> list[tuple[int, int, bytes]]:
    """Bytes of the boards under pulses that change at every control step, faults, and the truth at each step's end.

    Faults begin and end within control steps, and from 1.2 s on no pulses come."""
    experiment = load_experiment("pool", settings, ["t=0.533 for=0.3 thruster 1/2 dead", "t=0.7 imu 2 heading 0.1"])
    world = World(experiment, 1, np.array([[0.4, 0.0, 0.3, 0.0], [-0.4, 0.0, 0.3, 1.0]]))
    world.start_ns = 0
    links, random = [AgentLink(robot) for robot in experiment.robot_ids], np.random.default_rng(2)
    output: list[tuple[int, int, bytes]] = []
    for tick in range(40):
        if tick < 24:
            for i, link in enumerate(links):
                world.receive(i, link.pulses((*random.integers(1250, 1750, 4).tolist(), 1500, 1600, 1500, 1400)))
        if tick == 3:
            for i, link in enumerate(links):
                world.receive(i, link.pulses((1500,) * 8) + link.arm(True) + b"\xfd begun")
        while world.now_ns < (tick + 1) * 50_000_000:
            output += [(world.now_ns, -1, fault.encode()) for fault in world.apply_faults()]
            output += [(world.now_ns, i, data) for i, data in world.step((tick + 1) * 50_000_000 * by_events) if data]
        truth = world.truth()
        output.append((world.now_ns, -2, b"".join(part.tobytes() for part in (world.eta, world.tilt, truth.disturbance))))
    return output


@pytest.mark.parametrize("settings", [(), ("sim.sensors.rate_hz=70",), ("sim.board.slew_us_per_s=1000",)])
def test_events_alone_send_and_move_what_single_steps_do(settings: tuple[str, ...]) -> None:
    by_events = told(True, *settings)
    assert by_events == told(False, *settings)
    assert sum(b"no override" in data for _, _, data in by_events) >= 1  # a board that was armed has timed out
    assert sum(i == -1 for _, i, _ in by_events) == 3  # two faults begin, one ends


def test_expected_exposure_comes_unless_something_breaks() -> None:
    _, expected, came = fly(True)
    right = [
        then is not None and all(np.array_equal(a, b) for a, b in zip(then, now, strict=True))
        for then, now in zip(expected, came, strict=True)
    ]
    assert right.count(False) == 2  # when it dies, and when it is whole again
    assert came[-1][1].any()


@pytest.mark.parametrize("settings", [(), (QUICK_ANKLES,), ("sim.plant.tilt.enabled=false",)])
def test_having_looked_ahead_changes_nothing(settings: tuple[str, ...]) -> None:
    assert fly(True, *settings)[0] == fly(False, *settings)[0]


@pytest.mark.parametrize(("rate_hz", "step_s"), [(20.0, 0.005), (30.0, 0.005), (200.0, 0.005), (240.0, 0.005), (60.0, 0.05)])
def test_exposures_are_the_first_steps_at_or_after_they_are_due(rate_hz: float, step_s: float) -> None:
    """Counted in whole numbers of microseconds. A camera faster than the steps has one in each, and none lies in the past."""
    experiment = load_experiment("pool", [f"camera.rate_hz={rate_hz}", f"sim.plant.step_s={step_s}"])
    world = World(experiment, 1, np.array([[0.4, 0.0, 0.3, 0.0], [-0.4, 0.0, 0.3, 1.0]]))
    step_us, rate = round(step_s * 1e6), round(rate_hz)
    wanted = {-(-frame * 1_000_000 // (rate * step_us)) * step_us for frame in range(1, rate)}
    exposed = []
    while world.now_ns < 900_000_000:
        announced_ns = world.exposure_ns
        world.step()
        assert announced_ns >= world.now_ns
        if world.exposed:
            assert announced_ns == world.now_ns
            exposed.append(world.now_ns // 1000)
    assert exposed == sorted(us for us in wanted if us <= 900_000)


def test_robots_that_are_held_stay_where_they_are_until_one_is_armed() -> None:
    """Then all are let go, and stay so when it is disarmed."""
    experiment, starts = load_experiment("pool"), np.array([[0.4, 0.0, 0.3, 0.0], [-0.4, 0.0, 0.3, 1.0]])
    world, link = World(experiment, 1, starts, held=True), AgentLink(1)
    for _ in range(200):
        world.step()
        assert world.next_exposure() is None
    assert np.array_equal(world.eta, starts) and world.now_ns == 200 * 5_000_000
    world.receive(0, link.pulses((1500,) * 8))
    world.receive(0, link.arm(True))
    world.step()
    world.receive(0, link.arm(False))
    for _ in range(200):
        world.step()
    assert np.abs(world.eta[:, 2] - 0.3).min() > 1e-3
