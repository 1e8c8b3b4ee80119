"""Water that sinks and a camera that is bumped, in a lockstep flight: check marks tell which, and poses claim their error."""

import re
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest

from shoal.bus.bus import Bus
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.config.experiment import load_experiment
from shoal.messages import topics
from shoal.messages.codec import decode
from shoal.messages.messages import Event, LocalizerStatus, Pose, Truth
from shoal.messages.topics import Topic
from sim_bridge.in_process.executor import Executor

pytestmark = pytest.mark.long

M = TypeVar("M")

SUNK, BUMPED = "water low 0.02", "camera bump 8"  # m, px each way
FAULTS = (f"t=1 for=3 {SUNK}", f"t=6 for=3 {BUMPED}")
NOTICED_NS = 1_300_000_000  # five marks in turns at 20 Hz have their five readings


@pytest.mark.slow  # tests/localizer/tracking has both without a flight
def test_sunken_water_and_a_bumped_camera_are_told_apart_in_flight(tmp_path: Path) -> None:
    experiment, hub = load_experiment("figure-eight", ["duration_s=11"], FAULTS), MemoryHub()
    bus = Bus(MemoryTransport(hub))
    collected = {topic.name: bus.collect(topic) for topic in (topics.EVENT, topics.LOCALIZER, topics.POSE, topics.TRUTH)}
    Executor(experiment, tmp_path, hub).fly()

    def heard(topic: Topic, kind: type[M]) -> list[tuple[int, str, M]]:
        return [(h.stamp_ns, key, decode(kind, data, "test", key)) for _, key, h, data in collected[topic.name]()]

    when_ns = {event.message: stamp_ns for stamp_ns, _, event in heard(topics.EVENT, Event)}
    spells = {what: (when_ns[f"fault: {what}"], when_ns[f"fault over: {what}"]) for what in (SUNK, BUMPED)}
    messages = [(stamp_ns, status.message) for stamp_ns, _, status in heard(topics.LOCALIZER, LocalizerStatus)]
    sunk, bumped = ({text for at, text in messages if a + NOTICED_NS < at < b} for a, b in spells.values())
    drops_mm = [float(mm) for text in sunk for mm in re.findall(r"the water stands (\d+) mm lower", text)]
    shifts_px = [float(px) for text in bumped for px in re.findall(r"the camera was moved: check marks are ([\d.]+) px", text)]
    assert len(drops_mm) == len(sunk) and drops_mm == pytest.approx([20.0] * len(sunk), abs=6.0)
    assert len(shifts_px) == len(bumped) and shifts_px == pytest.approx([8 * np.sqrt(2.0)] * len(bumped), abs=1.0)
    begin_ns, end_ns = spells[SUNK][0], spells[BUMPED][1]
    well = {
        text
        for at, text in messages
        if at < begin_ns or spells[SUNK][1] + NOTICED_NS < at < spells[BUMPED][0] or at > end_ns + NOTICED_NS
    }
    assert not [text for text in well if "water" in text or "check mark" in text]

    true = {stamp_ns: dict(zip(t.robots, t.eta, strict=True)) for stamp_ns, _, t in heard(topics.TRUTH, Truth)}
    for at, key, pose in heard(topics.POSE, Pose):
        if any(a + NOTICED_NS < at < b for a, b in spells.values()):
            off_m = np.array([pose.x_m, pose.y_m]) - true[at][int(key.split("/")[-2])][:2]
            assert np.hypot(*off_m) < 3.0 * np.sqrt(np.trace(pose.covariance[:2, :2])), f"{key} at {at * 1e-9:.2f} s"
