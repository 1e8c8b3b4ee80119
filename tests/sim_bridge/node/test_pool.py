"""The pool on the wires, by the wall clock: what comes of every exposure."""

import logging
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from groundstation.logs.recorder import Recorder
from shoal.bus.bus import Bus, Received
from shoal.bus.endpoint import Endpoint
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.bus.zenoh_transport import ZenohTransport
from shoal.config.experiment import load_experiment
from shoal.config.fault_injection import BY_HAND
from shoal.messages import topics
from shoal.messages.codec import Header, decode, encode
from shoal.messages.messages import Event, FaultRequest, StationHeartbeat
from shoal.messages.topics import Topic
from shoal.runtime.runtime import Failed, Stop, WallClock
from sim_bridge.camera.renderer import Renderer
from sim_bridge.in_process.resume import Moment, faults_by_hand
from sim_bridge.node.board_ports import UdpPorts
from sim_bridge.node.pool import PoolNode
from sim_bridge.sil.ports import free_base_port
from sim_bridge.world import World
from tests.waiting import wait_for_line

ROBOT = "robots=[{id=1, node_m=[0.0, 0.0, 0.0], start=[0.4, 0.0, 0.3, 0.0]}]"
EXPOSURES = 8


def test_every_exposure_has_a_pose_however_old_poses_are() -> None:
    """Four periods of the camera old, and told when they are as old as that."""
    experiment = load_experiment("pool", ["sim.latency_s=0.2", ROBOT])
    hub, stop = MemoryHub(), Stop(install=False)
    exposed: list[int] = []
    headers: list[Header] = []

    def count(topic: Topic, key: str, header: Header, payload: bytes) -> None:
        exposed.append(header.stamp_ns)
        if len(exposed) == EXPOSURES:
            stop.request()

    witness = Bus(MemoryTransport(hub))
    witness.subscribe(topics.TRUTH, None, count)
    witness.subscribe(topics.POSE, 1, lambda topic, key, header, payload: headers.append(header))
    sockets = UdpPorts(free_base_port((1,)), (1,), experiment.seed)
    PoolNode(experiment, Bus(MemoryTransport(hub)), sockets, stop, lockstep=False, poses=True).run()
    assert [header.stamp_ns for header in headers] == exposed
    assert min(header.age_ns for header in headers) >= 200_000_000


@pytest.mark.timeout(60)
def test_a_fault_by_hand_is_logged_in_words_that_repeat_it(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """By the log's lines, as `sim-bridge sil --from` takes them. A fault that there cannot be is left out, and told: the
    station may have another experiment."""
    caplog.set_level(logging.INFO, "shoal")
    experiment, lines = load_experiment("pool", ["sim.latency_s=0", ROBOT]), list[str]()
    hub, stop = MemoryHub(), Stop(install=False)
    person, clock = Bus(MemoryTransport(hub)), WallClock()

    def ask() -> None:
        for what in ("rudder 1 lost", "thruster 7/1 dead", "thruster 1/5 dead", "camera east dark", "process agent-1 killed"):
            person.publish(topics.FAULT, FaultRequest(what), clock.now_ns())
        for for_s in (-5.0, 5.0):
            person.publish(topics.FAULT, FaultRequest("thruster 1/3 dead", for_s), clock.now_ns())
        person.publish(topics.FAULT, FaultRequest("battery 1 sag"), clock.now_ns())

    def hear(topic: Topic, key: str, header: Header, payload: bytes) -> None:
        event = decode(Event, payload, key, topic.name)
        lines.append(event.message)
        if event.message == "robots are in the water":
            threading.Thread(target=ask).start()
        elif "battery 1 sag" in event.message:
            stop.request()

    person.subscribe(topics.EVENT, None, hear)
    sockets = UdpPorts(free_base_port((1,)), (1,), experiment.seed)
    PoolNode(experiment, Bus(MemoryTransport(hub)), sockets, stop, lockstep=False, poses=True).run()
    recorder = Recorder(tmp_path / "run.mcap", "name = 'pool'\n", {})
    for k, line in enumerate(lines, start=1):
        recorder.put(topics.EVENT, "shoal/event", Header(7, k, k), encode(Event(2, "sim-bridge", line)), k)
    recorder.close()
    repeated = [fault for _, fault in faults_by_hand(tmp_path, Moment(0.0, 10**10, 10**10, 10**11))]
    # What ended before the start is told, and no fault of a flight from there on.
    assert f"{BY_HAND}before the start for=5 thruster 1/3 dead" in lines
    refused = [line for line in lines if line.startswith("a fault that cannot be made: ")]
    reasons = (
        "'rudder' cannot be broken",
        "no robot 7",
        "no such thruster (allowed: 1, 2, 3, 4)",
        "no camera 'east'",
        "only by the timeline",
        "must be seconds",
    )
    assert len(refused) == len(reasons) and all(reason in line for reason, line in zip(reasons, refused, strict=True))
    assert repeated == ["t=0.000 battery 1 sag"]
    assert load_experiment("pool", faults=repeated).sim.faults[0].what == "battery 1 sag"


@pytest.mark.long
def test_a_camera_thread_that_fails_ends_the_run_with_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    """At its third picture. The run ends by itself, although nobody takes pictures any more, and says why."""
    experiment, count = load_experiment("pool", [ROBOT]), [0]

    def render(*args: Any) -> Any:
        count[0] += 1
        if count[0] == 3:
            raise ValueError("robot 1: eta = nan must be finite")
        return np.zeros((960, 1280), np.uint8)

    monkeypatch.setattr(Renderer, "render", render)
    sockets, stop = UdpPorts(free_base_port((1,)), (1,), experiment.seed), Stop(install=False)
    PoolNode(experiment, Bus(MemoryTransport(MemoryHub())), sockets, stop, lockstep=False).run()
    assert count[0] == 3
    with pytest.raises(Failed, match="thread camera ended: ValueError: robot 1: eta = nan must be finite"):
        stop.raise_failure()


def test_water_does_not_run_ahead_when_a_port_is_flooded() -> None:
    """A datagram between two steps wakes the simulator; the next step waits for its time all the same. The clock stands
    still but for a millisecond at each look at it."""
    experiment = load_experiment("pool", [ROBOT, "sim.latency_s=0"])
    hub, stop = MemoryHub(), Stop(install=False)
    sockets = EndlessPorts(free_base_port((1,)), (1,), experiment.seed)
    pool = PoolNode(experiment, Bus(MemoryTransport(hub)), sockets, stop, lockstep=False, poses=True)
    clock = TickingClock()
    # the node makes its clock itself; the test's clock stands still
    pool._clock = clock
    steps = []
    # what is counted is the step between two sleeps, which no message shows
    move = pool._step_plant

    def counted(world: World, until_ns: int = 0) -> None:
        move(world, until_ns)
        steps.append((world.now_ns, clock.now_ns() - clock.begin_ns))
        if len(steps) == 50:
            stop.request()

    # what is counted is the step between two sleeps, which no message shows
    pool._step_plant = counted  # type: ignore[method-assign]
    pool.run()
    assert sockets.woken > 100, "the flood has woken it between steps"
    assert all(water_ns - passed_ns <= 2 * 5_000_000 for water_ns, passed_ns in steps)


@pytest.mark.timeout(60)
def test_a_fault_by_hand_counts_from_the_newest_flight_of_the_session(caplog: pytest.LogCaptureFixture) -> None:
    """Before any, in the first, after it, and in the second, as the station's heartbeats report them. The timeline's fault
    comes in each."""
    caplog.set_level(logging.INFO, "shoal")
    experiment = load_experiment("pool", ["sim.latency_s=0", ROBOT, 'sim.faults=[{at_s=1.0,what="imu 1 gyro 0.1"}]'])
    hub, stop, lines = MemoryHub(), Stop(install=False), list[str]()
    station, clock = Bus(MemoryTransport(hub)), WallClock()
    ahead_ns = 5_000_000_000_000  # of the station's clock: nothing depends on it
    flown_s = iter((None, 10.0, None, 0.5))  # of the newest flight, or none

    def ask() -> None:
        for begun_s in flown_s:
            now_ns = clock.now_ns() + ahead_ns
            began_ns = 0 if begun_s is None else now_ns - round(begun_s * 1e9)
            station.publish(topics.HEARTBEAT, StationHeartbeat(began_ns=began_ns), now_ns)
            time.sleep(0.3)  # exposures
            station.publish(topics.FAULT, FaultRequest("battery 1 sag", 0.1), clock.now_ns())
            time.sleep(0.3)
        stop.request()

    def hear(topic: Topic, key: str, header: Header, payload: bytes) -> None:
        lines.append(decode(Event, payload, key, topic.name).message)
        if lines[-1] == "robots are in the water":
            threading.Thread(target=ask).start()

    station.subscribe(topics.EVENT, None, hear)
    sockets = UdpPorts(free_base_port((1,)), (1,), experiment.seed)
    PoolNode(experiment, Bus(MemoryTransport(hub)), sockets, stop, lockstep=False, poses=True).run()
    times = [re.search("(before the start|t=[0-9.]+) for=0.1 battery 1 sag", line) for line in lines]
    first, *flights = [match[1] for match in times if match is not None]
    assert first == "before the start"
    assert [float(time_s[2:]) for time_s in flights] == pytest.approx([10.3, 10.9, 0.8], abs=0.2)
    imu = [line for line in lines if "imu 1 gyro" in line]
    assert imu == ["fault: imu 1 gyro 0.1", "fault over: imu 1 gyro 0.1", "fault: imu 1 gyro 0.1"]


@pytest.mark.timeout(60)
def test_a_fault_by_hand_counts_by_the_flights_time_after_a_standstill(caplog: pytest.LogCaptureFixture) -> None:
    """The simulator was held up for a second, which the water has lost, and the robots' trajectories have not."""
    caplog.set_level(logging.INFO, "shoal")
    experiment = load_experiment("pool", ["sim.latency_s=0", ROBOT])
    hub, stop, lines = MemoryHub(), Stop(install=False), list[str]()
    station, clock = Bus(MemoryTransport(hub)), WallClock()
    exposed, begun_ns = 0, clock.now_ns()

    def stand_still(topic: Topic, key: str, header: Header, payload: bytes) -> None:
        nonlocal exposed
        exposed += 1
        if exposed == 1:
            station.publish(topics.HEARTBEAT, StationHeartbeat(began_ns=begun_ns), clock.now_ns())
        elif exposed == 4:
            time.sleep(1.0)
        elif exposed == 8:
            station.publish(topics.FAULT, FaultRequest("battery 1 sag"), clock.now_ns())

    def hear(topic: Topic, key: str, header: Header, payload: bytes) -> None:
        lines.append(decode(Event, payload, key, topic.name).message)
        if "by hand" in lines[-1]:
            lines.append(f"{(clock.now_ns() - begun_ns) * 1e-9}")
            stop.request()

    station.subscribe(topics.TRUTH, None, stand_still)
    station.subscribe(topics.EVENT, None, hear)
    sockets = UdpPorts(free_base_port((1,)), (1,), experiment.seed)
    PoolNode(experiment, Bus(MemoryTransport(hub)), sockets, stop, lockstep=False, poses=True).run()
    made = next(k for k, line in enumerate(lines) if "by hand" in line)
    assert any("time skipped" in line for line in lines)
    told_s = float(lines[made].removeprefix(f"{BY_HAND}t=").split()[0])
    assert told_s == pytest.approx(float(lines[made + 1]), abs=0.2)


class TickingClock:
    """A millisecond later at each look."""

    waits, begin_ns = False, 1_700_000_000_000_000_000

    def __init__(self) -> None:
        self._now_ns = self.begin_ns

    def now_ns(self) -> int:
        self._now_ns += 1_000_000
        return self._now_ns

    def arrival_ns(self, stamp_ns: int) -> int:
        return self.now_ns()

    def instant_ns(self, received: Received[Any]) -> int:
        return received.header.stamp_ns


class EndlessPorts(UdpPorts):
    """There is always something to be read."""

    woken = 0

    def wait(self, timeout_s: float) -> None:
        self.woken += 1


@pytest.mark.long
def test_a_second_simulator_in_a_fleet_waits_and_simulates_nothing(address: str, tmp_path: Path) -> None:
    """Else two worlds would say by turns where the robots are."""
    log, run = (
        tmp_path / "sim-bridge.log",
        ["sim_bridge", "pool", "pool", "--station", address, "--ports", str(free_base_port((1, 2)))],
    )
    with log.open("wb") as output, Bus(ZenohTransport(Endpoint(address), patience_s=5.0)) as first:
        first.claim("sim-bridge", bool)
        second = subprocess.Popen([sys.executable, "-m", *run], stderr=output)
        try:
            wait_for_line(log, "sim-bridge: another process of this name is in the fleet; waiting")
            second.send_signal(signal.SIGINT)
            assert second.wait(30.0) == 1
        finally:
            second.kill()
            second.wait()
    assert "sim-bridge: stopped while another process of this name is in fleet shoal" in log.read_text()
