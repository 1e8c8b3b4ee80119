"""Cost of neighbours: processor time of one control step, all threads, while a robot's program receives their plans.

One agent of fleet-20 runs for real; poses, the station's heartbeat and the plans come from here at 20 Hz, each plan over a
session of its own and at its own time, as from that many robots. No board answers and the robot is disarmed: what is measured
is all but the control law (for that: `control_step`).
"""

import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import psutil

from benchmarks.harness import Row
from shoal.bus.bus import Bus
from shoal.bus.endpoint import Endpoint
from shoal.bus.zenoh_transport import ZenohTransport
from shoal.config.experiment import load_experiment
from shoal.messages import topics
from shoal.messages.messages import Plan, Pose, StationHeartbeat, Track
from sim_bridge.sil.ports import free_port
from sim_bridge.sil.processes import Children

SAMPLES, SAMPLE_S = 4, 3.0
START_S = 3.0
SPREAD = 0.8  # of a period: over so much of it the plans come


def _plans(count: int, horizon: int, period_s: float) -> list[Plan]:
    """Of robots that stand in a row and tremble."""
    random, stand = np.random.default_rng(1), np.zeros((horizon + 1, 4))
    rows = [stand + np.array([0.7 * i - 3.0, 1.0, 0.5, 0.0]) for i in range(count)]
    return [Plan(period_s, row + 0.01 * random.normal(size=row.shape), row, 0.01, False) for row in rows]


def _feed(station: Bus, others: Sequence[Bus], plans: Sequence[Plan], period_s: float) -> None:
    """All that an agent hears in one period."""
    began_s, now_ns = time.monotonic(), time.time_ns()
    station.publish(topics.POSE, Pose(-1.0, -1.0, 0.0, track=Track.KCF), now_ns, 1, age_ns=5_000_000)
    station.publish(topics.HEARTBEAT, StationHeartbeat(), now_ns)
    for i, (bus, plan) in enumerate(zip(others, plans, strict=True)):
        time.sleep(max(began_s + SPREAD * period_s * (i + 1) / len(others) - time.monotonic(), 0.0))
        bus.publish(topics.PLAN, plan, time.time_ns(), i + 2)
    time.sleep(max(began_s + period_s - time.monotonic(), 0.0))


def _samples(neighbours: int) -> Iterator[float]:
    """Milliseconds of processor time a step."""
    experiment = load_experiment("fleet-20")
    period_s, address = experiment.controller.period_s, f"tcp/127.0.0.1:{free_port()}"
    plans = _plans(neighbours, experiment.controller.mpc.horizon, period_s)
    with ExitStack() as stack:
        children = Children(Path(stack.enter_context(tempfile.TemporaryDirectory())))
        station = stack.enter_context(Bus(ZenohTransport(Endpoint(address, router=True))))
        others = [stack.enter_context(Bus(ZenohTransport(Endpoint(address)))) for _ in plans]
        stack.callback(children.stop)
        agent = children.start("agent-1", "robot_agent", ["run", "fleet-20", "--robot", "1", "--station", address])
        time.sleep(START_S)
        watched, steps = psutil.Process(agent.process.pid), round(SAMPLE_S / period_s)
        for sample in range(SAMPLES + 1):
            before = watched.cpu_times()
            for _ in range(steps):
                _feed(station, others, plans, period_s)
            spent = watched.cpu_times()
            if sample:  # not the first: it warms up
                yield 1e3 * (spent.user + spent.system - before.user - before.system) / steps


def run() -> Iterator[Row]:
    """None, one, and nineteen."""
    for neighbours in (0, 1, 19):
        yield Row.of("neighbours", f"an agent that hears {neighbours} plans", "ours", "ms a step", _samples(neighbours))
