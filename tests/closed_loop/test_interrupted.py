"""Robots hold, go on and stop as a person tells them, seen by their camera.

At several rates, and with another robot: HOLD holds for a minute, RESUME goes on near the path, also from a HOLD that has not
come to rest, and after STOP nobody thrusts."""

import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from groundstation.report.report import evaluated
from shoal.bus.bus import Bus
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.config.experiment import load_experiment
from shoal.messages import topics
from shoal.messages.messages import WHOLE_FLEET, Command, CommandKind, Mode, RobotState, Truth
from sim_bridge.in_process.executor import Executor

pytestmark = pytest.mark.slow

ORDERS = (  # seconds from the first step that a robot is on its path
    (15.0, CommandKind.HOLD),
    (85.0, CommandKind.RESUME),
    (100.0, CommandKind.HOLD),
    (101.0, CommandKind.RESUME),
    (115.0, CommandKind.STOP),
)
END_S = 118.0
AT_REST_S = 10.0
FLIGHTS = {
    "20 Hz": [],
    "10 Hz": ["controller.period_s=0.1", "camera.rate_hz=10.0"],
    "50 Hz": ["controller.period_s=0.02", "camera.rate_hz=50.0"],
    "side thrust": ["vehicle=vectored"],
}


@dataclass
class Distances:
    """Of all robots from what they were told, by the plant's truth, in m."""

    held: list[float] = field(default_factory=list)  # from the place, once at rest
    back: list[float] = field(default_factory=list)  # from the path's place of now, after a RESUME
    stopped: list[float] = field(default_factory=list)  # N: thrust a second after the STOP


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("name", FLIGHTS)
def test_robots_hold_go_on_and_stop_as_they_are_told(name: str, seed: int, tmp_path: Path) -> None:
    experiment = load_experiment("pool", ["duration_s=200", f"seed={seed}", *FLIGHTS[name]])
    executor, bus, far = Executor(experiment, tmp_path, hub := MemoryHub()), Bus(MemoryTransport(hub)), Distances()
    inboxes = bus.inboxes(topics.STATE, RobotState, experiment.robot_ids)
    truths, orders, steps = bus.inbox(topics.TRUTH, Truth), list(ORDERS), 0

    def each_tick() -> None:
        nonlocal steps
        states, truth = [inbox.newest() for inbox in inboxes.values()], truths.newest()
        if truth is None or (not steps and any(s is None or s.message.mode is not Mode.TRACKING for s in states)):
            return
        steps += 1
        time_s = steps * experiment.controller.period_s
        if orders and time_s >= orders[0][0]:
            order = Command(orders.pop(0)[1], WHOLE_FLEET)
            answer = bus.command(order, time.monotonic_ns(), 10.0, to=WHOLE_FLEET)
            assert answer.accepted, (order, answer.reason)
        since_s, last = max(((at_s, kind) for at_s, kind in ORDERS if at_s <= time_s), default=(0.0, None))
        for i, state in enumerate(states):
            assert state is not None
            control = state.message.control
            if last is CommandKind.STOP and time_s > since_s + 1.0:
                far.stopped.append(float(np.abs(truth.message.wrench[i]).max()))
            elif control is not None:
                off_m = float(np.linalg.norm(truth.message.eta[i, :2] - control.eta_reference[:2]))
                if last is CommandKind.HOLD and time_s > since_s + AT_REST_S:
                    assert state.message.mode is Mode.HOLDING
                    far.held.append(off_m)
                elif last is CommandKind.RESUME and state.message.mode is Mode.TRACKING:
                    far.back.append(off_m)
        if time_s > END_S:
            executor.stop.request()

    executor.fly(each_tick)
    print(f"{name}, seed {seed}: HOLD at most {1e3 * max(far.held):.1f} mm, way back at most {1e3 * max(far.back):.1f} mm")
    assert not orders and max(far.held) < 0.02
    assert max(far.back) < 0.05
    assert max(far.stopped) < 0.01
    _, _, result = evaluated(tmp_path)
    assert {fault.text for fault in result.faults} == {"stopped: emergency stop"} and not result.passed
