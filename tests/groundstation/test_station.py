"""The station's loop: when it acts."""

import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from groundstation import station_process
from groundstation.asking import Answer
from groundstation.inboxes import listen
from groundstation.itinerary import Wanted
from groundstation.laps import Laps
from groundstation.legs import Leg, first_leg
from groundstation.mission import Mission
from groundstation.phases import Phase
from groundstation.recorder import Recorder
from groundstation.station import Station
from groundstation.tuner import Tuner
from wire import topics
from wire.bus import Bus, Inbox
from wire.experiment import dump_experiment, load_experiment
from wire.messages import Command, Order, Reply, StationHeartbeat
from wire.runtime import Stop, WallClock, wait
from wire.topics import WHOLE_FLEET
from wire.transport import MemoryHub, MemoryTransport

PERIOD_S = 0.125
PATIENCE_S = 20.0
TRIES = 5


def next_beat_ns(bus: Bus, stop: Stop, beats: Inbox[StationHeartbeat]) -> int:
    """Stamp of the next heartbeat."""
    seen = beats.newest_header()
    assert wait(bus, stop, lambda: beats.newest_header() is not seen, PATIENCE_S)
    header = beats.newest_header()
    assert header is not None
    return header.stamp_ns


@contextmanager
def a_station(folder: Path) -> Iterator[Station]:
    """Alone on its bus."""
    experiment = load_experiment("pool")
    leg, bus = first_leg(experiment), Bus(MemoryTransport(MemoryHub()))
    recorder, tuner = Recorder(folder / "run.mcap", "", {}), Tuner(experiment)
    with ThreadPoolExecutor(1) as pool:
        yield Station(
            experiment, bus, WallClock(), recorder, Mission(experiment, leg, {}, False), tuner, Laps(tuner.lap_s),
            listen(bus, experiment.robot_ids), pool, {},
        )  # fmt: skip
    recorder.close()


def test_a_plan_that_comes_when_another_is_wanted_counts_for_nothing(tmp_path: Path) -> None:
    """A detour was being planned when a person sent everybody home."""
    late = threading.Event()
    with a_station(tmp_path) as station:
        mission, detour = station.mission, station.mission.leg
        home = replace(detour, home=True)

        def slow() -> Leg:
            late.wait(PATIENCE_S)
            return detour

        mission.phase, mission.itinerary.wanted = Phase.HALTING, Wanted("another path", slow)
        station._plan(False, 0)
        mission.itinerary.wanted = Wanted("a way for everybody from rest", lambda: home)
        late.set()
        deadline = time.monotonic() + PATIENCE_S
        while mission.phase is Phase.HALTING and time.monotonic() < deadline:
            station._plan(False, 0)
            time.sleep(0.001)
        assert mission.phase is Phase.RELOADING
        assert mission.leg is home


def test_a_planner_that_breaks_leaves_the_fleet_holding_and_the_station_alive(tmp_path: Path) -> None:
    with a_station(tmp_path) as station:
        mission = station.mission
        station.seen = station.fleet()
        mission.phase, mission.itinerary.wanted = Phase.HALTING, Wanted("another path", lambda: dict[str, Leg]()["robot 3"])
        station._plan(True, 0)
        assert mission.phase is Phase.PAUSED
        assert "KeyError: 'robot 3'" in mission.reason


def test_answers_for_people_do_not_keep_the_paths_that_were_sent(tmp_path: Path) -> None:
    """Where no page takes them, the last 256 stay for as long as the station runs."""
    with a_station(tmp_path) as station:
        load, reply = Command(Order.LOAD, 1, trajectory=station.mission.leg.trajectories[1]), Reply(1, True)
        station.pending.append((load, station.pool.submit(lambda: reply)))
        station.pool.shutdown()
        (heard,), (kept,) = station._answers(), station.answers
    assert heard == Answer(load, reply)
    assert (kept.command.order, kept.command.trajectory, kept.reply) == (Order.LOAD, None, reply)


def test_a_stop_does_not_wait_for_the_next_cycle(tmp_path: Path) -> None:
    experiment = load_experiment("pool", [f"controller.period_s={PERIOD_S}", "camera.rate_hz=8"])
    hub, stop = MemoryHub(), Stop(install=False)
    bus, person = Bus(MemoryTransport(hub)), Bus(MemoryTransport(hub))
    beats = person.inbox(topics.HEARTBEAT, StationHeartbeat)
    options = {"automatic": False, "lockstep": False, "stop": stop}
    thread = threading.Thread(
        target=station_process.run, args=(experiment, dump_experiment(experiment), bus, tmp_path), kwargs=options
    )
    thread.start()
    gaps_s = []
    try:
        for _ in range(TRIES):  # a busy machine may take longer than a period now and then, but not every time
            before_ns = next_beat_ns(person, stop, beats)
            assert person.order(Command(Order.STOP, WHOLE_FLEET), time.time_ns(), PATIENCE_S).accepted
            gaps_s.append((next_beat_ns(person, stop, beats) - before_ns) * 1e-9)
            beat = beats.newest()
            assert beat is not None and beat.message.emergency_stop
    finally:
        stop.request()
        thread.join()
    assert min(gaps_s) < 0.5 * PERIOD_S, gaps_s
