"""Lockstep says the same to the last bit however slow the machine, and whoever of its processes is late."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from shoal.config.experiment import Experiment, load_experiment
from shoal.mavlink.agent_link import AgentLink
from shoal.mavlink.board_port import UdpLink
from shoal.mavlink.signing import Key
from shoal.messages.messages import Mode
from sim_bridge.node.board_ports import UdpPorts
from sim_bridge.sil.ports import free_base_port
from sim_bridge.thruster_board.board import SENT_BETWEEN, ThrusterBoard
from sim_bridge.world import World
from tests.closed_loop.slow_network import fly

pytestmark = pytest.mark.long

ADRIFT = "sim.drifters=[{radius_m=0.2, start_m=[-3.0, 0.2, 0.5], from_s=0.0, velocity_mps=[0.1, 0.0, 0.0]}]"
NOISY = "t=0.1 for=0.6 link 1 noisy 0.3"
LATER = SENT_BETWEEN + 1  # than a new board begins to count, in ticks of a signature's timestamp
POOL = load_experiment("pool", ["duration_s=0.9"], [NOISY])
OFTEN = [pytest.mark.slow, pytest.mark.timeout(1200)]
BALL = load_experiment("blocked-path", ["duration_s=0.9", ADRIFT])


@pytest.mark.parametrize(
    ("experiment", "poses", "seeds"),
    [
        pytest.param(POOL, True, (1, 2), id="noisy-link"),
        pytest.param(POOL, True, range(10, 40), id="noisy-link-often", marks=OFTEN),
        pytest.param(POOL, False, range(10, 20), id="camera-often", marks=OFTEN),
        pytest.param(BALL, True, range(10, 30), id="obstacle-often", marks=OFTEN),
    ],
)
def test_a_lockstep_flight_is_the_same_whichever_process_is_late(
    experiment: Experiment, poses: bool, seeds: Sequence[int], tmp_path: Path
) -> None:
    """All that goes over the bus but previews and lines for people: truth, poses, plans, states, inputs, orders."""
    undisturbed = fly(experiment, tmp_path / "undisturbed", None, poses)
    for robot in experiment.robot_ids:
        modes = {state["mode"] for _, state in undisturbed.messages[f"shoal/robot/{robot}/state"]}
        assert Mode.TRACKING in modes, "nothing was flown"
    for seed in seeds:
        assert not fly(experiment, tmp_path / str(seed), seed, poses).differs(undisturbed), f"seed {seed}"


@pytest.mark.parametrize("latency_s", [0.0, 0.05, 0.12])  # less than, as much as and more than from picture to picture
def test_poses_are_as_old_as_the_experiment_says(latency_s: float, tmp_path: Path) -> None:
    messages = fly(load_experiment("pool", ["duration_s=0.3", f"sim.latency_s={latency_s}"]), tmp_path / "run", None).messages
    for robot in POOL.robot_ids:
        ages_ms = {round(state["timing"]["pose_age_ms"], 6) for _, state in messages[f"shoal/robot/{robot}/state"]}
        assert ages_ms == {1000.0 * latency_s}


def test_no_step_uses_what_a_board_measures_after_it(tmp_path: Path) -> None:
    """With steps of the plant that go into the control period, but not into the age of the poses, which begins the ticks."""
    experiment = load_experiment("pool", ["duration_s=0.3", "sim.plant.step_s=0.025", "sim.latency_s=0.03"])
    messages = fly(experiment, tmp_path / "run", None, poses=True).messages
    for robot in POOL.robot_ids:
        inputs = messages[f"shoal/robot/{robot}/inputs"]
        ages_ns = [stamp_ns - step["board"]["board_ms"] * 1_000_000 for stamp_ns, step in inputs]
        assert len(ages_ns) > 5 and min(ages_ns) >= 0


def test_a_robot_without_a_pose_publishes_no_plan_and_others_do_not_wait_for_one(tmp_path: Path) -> None:
    experiment = load_experiment("pool", ["duration_s=1.5", "mission.lost=go-on"], ["t=0.1 marker 1 lost"])
    messages = fly(experiment, tmp_path / "run", None, poses=False).messages
    first_ns, *_, last_ns = sorted(stamp_ns for stamp_ns, _ in messages["shoal/robot/1/plan"])
    states = messages["shoal/robot/1/state"]
    unplanned = [stamp_ns for stamp_ns, state in states if state["estimate"] is None and stamp_ns > first_ns]
    assert len(unplanned) > 5
    assert unplanned[0] > last_ns
    assert messages["shoal/robot/2/state"][-1][1]["trajectory_s"] == pytest.approx(1.5, abs=0.11)


@pytest.mark.parametrize("key", [None, Key(bytes(range(32)))], ids=["plain", "signed"])
@pytest.mark.parametrize("greetings", [600, 728])  # half the numbers' range apart: behind one gap or the other all looks old
def test_a_board_that_was_greeted_for_a_minute_takes_the_first_pulses(greetings: int, key: Key | None) -> None:
    """While the others start, a robot greets its board ten times a second; of what nobody reads a port drops the last."""
    ports = free_base_port(POOL.robot_ids)
    sockets = UdpPorts(ports, POOL.robot_ids, POOL.seed)
    link, computer = UdpLink("127.0.0.1", ports + 1), AgentLink(1, key, lambda: LATER)
    starts = np.array([[0.4, 0.0, 0.3, 0.0], [-0.4, 0.0, 0.3, 0.0]])
    world = World(POOL, POOL.seed, starts, lambda experiment, robot, seed: ThrusterBoard(experiment, robot, seed, key))
    try:
        for _ in range(greetings):
            link.send(computer.heartbeat())
        sockets.forget()
        link.send(computer.heartbeat())  # the next, before time begins
        sockets.wait(1.0)
        sockets.exchange(world)
        link.send(computer.pulses((1500,) * 8))
        link.send(computer.arm(True))
        while computer.telemetry.board_ms < 0 and world.now_ns < 200_000_000:
            sockets.exchange(world)
            for i, data in world.step():
                sockets.send(i, data, world)
            sockets.deliver(world)
            computer.receive(link.read(), world.now_ns)
        assert computer.telemetry.armed
    finally:
        sockets.close()
        link.close()
