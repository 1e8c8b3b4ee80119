"""The same contract for real Zenoh sessions through a real router, and for the in-memory twin."""

import contextlib
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack

import numpy as np
import pytest
import zenoh

from shoal.bus import zenoh_transport
from shoal.bus.bus import LOOK_AGAIN_S, Bus
from shoal.bus.endpoint import Endpoint
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.bus.transport import Presence
from shoal.bus.zenoh_transport import ZenohTransport
from shoal.errors import ConfigError, Unreached
from shoal.messages import messages, topics
from shoal.messages.codec import Header, decode, encode
from sim_bridge.sil.ports import free_port
from tests.waiting import eventually

pytestmark = pytest.mark.real_time

MakeBus = Callable[[], Bus]


@pytest.fixture(params=["zenoh", "memory"])
def make_bus(request: pytest.FixtureRequest) -> Iterator[MakeBus]:
    buses: list[Bus] = []
    hub = MemoryHub()
    address = f"tcp/127.0.0.1:{free_port()}"

    def make() -> Bus:
        first = not buses
        zenoh = request.param == "zenoh"
        buses.append(Bus(ZenohTransport(Endpoint(address, router=first)) if zenoh else MemoryTransport(hub)))
        return buses[-1]

    make()  # the router
    yield make
    for bus in reversed(buses):
        bus.close()


def test_a_muted_bus_sends_only_afterwards_what_counts_and_reads_what_it_had(make_bus: MakeBus) -> None:
    robot, station = make_bus(), make_bus()
    beats, events = robot.inbox(topics.HEARTBEAT, messages.StationHeartbeat), station.inbox(topics.EVENT, messages.Event)
    before = messages.StationHeartbeat("a")
    assert eventually(lambda: bool(station.publish(topics.HEARTBEAT, before, 1)) and beats.newest() is not None)
    robot.mute(True)
    station.publish(topics.HEARTBEAT, before, 2)
    robot.publish(topics.EVENT, messages.Event(2, "agent-1", "said without a radio"), 3)
    assert eventually(lambda: (header := beats.newest_header()) is not None and header.stamp_ns == 2)
    received = beats.newest()
    assert received is not None and received.header.stamp_ns == 1 and events.newest() is None
    robot.mute(False)
    assert eventually(lambda: events.newest() is not None and beats.newest() is not received)


def test_no_command_reaches_a_robot_without_a_radio(make_bus: MakeBus) -> None:
    robot, station = make_bus(), make_bus()
    robot.serve(1, lambda header, command: messages.Reply(1, True))
    hold = messages.Command(messages.CommandKind.HOLD, 1)
    assert eventually(lambda: station.command(hold, 0, 1.0).accepted)
    station.unreachable = frozenset({1})
    reply = station.command(hold, 0, 1.0)
    assert reply.silent and not reply.accepted


def test_a_message_arrives_with_its_header(make_bus: MakeBus) -> None:
    sender, receiver = make_bus(), make_bus()
    inbox = receiver.inbox(topics.POSE, messages.Pose, robot=3)
    other = receiver.inbox(topics.POSE, messages.Pose, robot=4)
    pose = messages.Pose(1.0, -2.0, 0.5, np.eye(3), messages.Track.MARKER, True, 0.9, 0.3)
    assert eventually(lambda: bool(sender.publish(topics.POSE, pose, 123, robot=3, age_ns=7)) and inbox.newest() is not None)
    received = inbox.newest()
    assert received is not None
    assert (received.message.x_m, received.message.track) == (1.0, messages.Track.MARKER)
    assert (received.header.stamp_ns, received.header.age_ns, received.header.session) == (123, 7, sender.session)
    assert other.newest() is None


def test_the_newest_wins_and_older_stamps_can_be_asked_for(make_bus: MakeBus) -> None:
    sender, receiver = make_bus(), make_bus()
    inbox = receiver.inbox(topics.HEARTBEAT, messages.StationHeartbeat)
    receiver.announce("receiver")
    sender.watch_presence()
    assert eventually(lambda: "receiver" in sender.present)
    for stamp in (10, 20, 30):
        sender.publish(topics.HEARTBEAT, messages.StationHeartbeat(mission=str(stamp)), stamp)
    assert receiver.wait(lambda: (h := inbox.newest_header()) is not None and h.stamp_ns == 30, 5.0)
    newest, earlier = inbox.newest(), inbox.newest(up_to_ns=29)
    assert newest is not None
    assert newest.message.mission == "30"
    assert earlier is not None
    assert earlier.message.mission == "20"


def test_repeated_and_reordered_messages_are_dropped_and_a_restart_is_not(make_bus: MakeBus) -> None:
    bus = make_bus()
    inbox = bus.inbox(topics.HEARTBEAT, messages.StationHeartbeat)
    heartbeat = messages.StationHeartbeat(mission="x")
    _, first, payload = bus.publish(topics.HEARTBEAT, heartbeat, 1)
    assert eventually(lambda: inbox.newest_header() is not None)
    key = "shoal/station/heartbeat"
    put = bus.transport.publisher(key, topics.HEARTBEAT.qos)
    put(payload, first.encode())  # repeated
    put(payload, Header(first.session, 5, 5).encode())
    put(payload, Header(first.session, 4, 4).encode())  # reordered
    assert eventually(lambda: inbox.dropped == 2)
    assert inbox.newest_header() == Header(first.session, 5, 5)
    put(payload, Header(first.session + 1, 1, 6).encode())  # restarted
    assert eventually(lambda: (h := inbox.newest_header()) is not None and h.stamp_ns == 6)


def test_bad_messages_are_counted_and_the_last_good_one_stays(make_bus: MakeBus) -> None:
    bus = make_bus()
    inbox = bus.inbox(topics.HEARTBEAT, messages.StationHeartbeat)
    bus.publish(topics.HEARTBEAT, messages.StationHeartbeat(mission="good"), 1)
    put = bus.transport.publisher("shoal/station/heartbeat", topics.HEARTBEAT.qos)
    put(b"\xff\xff\xff", Header(bus.session, 9, 2).encode())
    assert eventually(lambda: (h := inbox.newest_header()) is not None and h.sequence == 9)
    received = inbox.newest()
    assert received is not None
    assert received.message.mission == "good"
    assert inbox.bad == 1
    assert "station/heartbeat" in inbox.last_error
    put(b"", b"no header")
    assert eventually(lambda: bus.rejected == 1)


def test_an_order_is_answered_refused_or_reported_unanswered(make_bus: MakeBus) -> None:
    station, robot = make_bus(), make_bus()
    commands: list[tuple[Header, messages.Command]] = []

    def handle(header: Header, command: messages.Command) -> messages.Reply:
        commands.append((header, command))
        return messages.Reply(command.robot, command.order is messages.CommandKind.ARM, "only arming", messages.Mode.ARMED)

    robot.serve(1, handle)
    order = messages.CommandKind
    trajectory = messages.Trajectory("t", 0.05, np.ones((4000, 4)), np.ones((4000, 4)), np.ones((4000, 4)))
    assert eventually(lambda: station.command(messages.Command(order.ARM, 1), 5, 1.0).accepted)
    refused = station.command(messages.Command(order.LOAD, 1, trajectory=trajectory), 6, 1.0)
    assert (refused.accepted, refused.reason) == (False, "only arming")
    assert commands[-1][1].trajectory is not None
    assert commands[-1][1].trajectory.eta.shape == (4000, 4)
    assert commands[-1][0].sequence > commands[-2][0].sequence
    assert station.command(messages.Command(order.ARM, 2), 7, 20.0).reason == "nobody answers there"


def test_presence_comes_and_goes(make_bus: MakeBus) -> None:
    watcher, late = make_bus(), make_bus()
    watcher.watch_presence()
    guest = make_bus()
    guest.announce("agent-1")
    assert watcher.wait(lambda: "agent-1" in watcher.present, 5.0)
    late.watch_presence()
    assert late.wait(lambda: "agent-1" in late.present, 5.0)
    guest.close()
    assert watcher.wait(lambda: "agent-1" not in watcher.present, 5.0)


def test_events_reach_a_late_subscriber_and_states_do_not(make_bus: MakeBus) -> None:
    sender, late = make_bus(), make_bus()
    events: list[str] = []
    states: list[str] = []
    for i in range(3):
        sender.publish(topics.EVENT, messages.Event(2, "test", f"line {i}"), i)
        sender.publish(topics.STATE, messages.RobotState(), i, robot=1)
    late.subscribe(topics.EVENT, None, lambda t, key, h, payload: events.append(key))
    late.subscribe(topics.STATE, None, lambda t, key, h, payload: states.append(key))
    assert eventually(lambda: len(events) == 3)
    assert states == []


def test_of_paths_a_late_subscriber_hears_the_last_few(make_bus: MakeBus) -> None:
    sender, early, late = make_bus(), make_bus(), make_bus()
    passed: list[int] = []
    early.subscribe(topics.TRAJECTORY, None, lambda t, key, header, payload: passed.append(header.stamp_ns))
    paths: list[tuple[str, int]] = []
    last = range(10 - topics.TRAJECTORY.cache_depth, 10)
    for stamp_ns in range(10):
        for robot in (1, 2):
            sender.publish(topics.TRAJECTORY, messages.Trajectory(str(stamp_ns), 0.05), stamp_ns, robot)
    assert eventually(lambda: passed[-2:] == [9, 9])  # none is under way any more
    late.subscribe(topics.TRAJECTORY, None, lambda t, key, header, payload: paths.append((key, header.stamp_ns)))
    wanted = {(f"shoal/robot/{robot}/trajectory", stamp_ns) for robot in (1, 2) for stamp_ns in last}
    assert eventually(lambda: len(paths) >= len(wanted))
    assert set(paths) == wanted and len(paths) == len(wanted)


def test_collected_are_all_messages_of_all_robots_once_and_in_order(make_bus: MakeBus) -> None:
    sender, receiver = make_bus(), make_bus()
    states, events = receiver.collect(topics.STATE), receiver.collect(topics.EVENT)
    receiver.announce("receiver")
    sender.watch_presence()
    assert eventually(lambda: "receiver" in sender.present)
    collected: list[tuple[topics.Topic, str, int]] = []

    def look() -> int:
        collected.extend((topic, key, header.stamp_ns) for c in (states, events) for topic, key, header, _ in c())
        return len(collected)

    sent = []
    for k in range(20):
        sender.publish(topics.STATE, messages.RobotState(), 2 * k, robot=1 + k % 2)
        sender.publish(topics.EVENT, messages.Event(2, "test", f"line {k}"), 2 * k + 1)
        sent.extend([(topics.STATE, f"shoal/robot/{1 + k % 2}/state", 2 * k), (topics.EVENT, "shoal/event", 2 * k + 1)])
        assert eventually(lambda: look() >= len(sent))
    for topic in (topics.STATE, topics.EVENT):
        assert [entry for entry in collected if entry[0] is topic] == [entry for entry in sent if entry[0] is topic]


def test_uncollected_messages_do_not_delay_other_topics(monkeypatch: pytest.MonkeyPatch) -> None:
    """The oldest go; orders, poses and heartbeats of the same session come as ever."""
    monkeypatch.setattr(zenoh_transport, "UNCOLLECTED", 4)
    address = f"tcp/127.0.0.1:{free_port()}"
    with Bus(ZenohTransport(Endpoint(address, router=True))) as receiver, Bus(ZenohTransport(Endpoint(address))) as sender:
        collect = receiver.collect(topics.STATE)
        beats = receiver.inbox(topics.HEARTBEAT, messages.StationHeartbeat)
        came: list[int] = []
        receiver.subscribe(topics.STATE, 1, lambda topic, key, header, payload: came.append(header.stamp_ns))
        receiver.announce("receiver")
        sender.watch_presence()
        assert eventually(lambda: "receiver" in sender.present)
        for k in range(12):
            sender.publish(topics.STATE, messages.RobotState(), k, robot=1)
            assert eventually(lambda stamp=k: came[-1:] == [stamp])  # type: ignore[misc]
        sender.publish(topics.HEARTBEAT, messages.StationHeartbeat(), 1000)
        assert eventually(lambda: beats.newest() is not None)
        assert [header.stamp_ns for _, _, header, _ in collect()] == [8, 9, 10, 11]


def test_threads_that_send_their_first_pictures_at_once_share_a_session(monkeypatch: pytest.MonkeyPatch) -> None:
    """The localizer's previews and its film begin with the same picture. A second session would never be closed."""
    # a second session would be seen neither in messages nor in the transport's public names
    opened, real, together = [], zenoh_transport._open, threading.Barrier(2)

    def open_and_note(endpoint: Endpoint, stopped: Callable[[], bool], patience_s: float) -> zenoh.Session:
        opened.append(real(endpoint, stopped, patience_s))
        return opened[-1]

    address = f"tcp/127.0.0.1:{free_port()}"
    with Bus(ZenohTransport(Endpoint(address, router=True))), Bus(ZenohTransport(Endpoint(address))) as sender:
        monkeypatch.setattr(zenoh_transport, "_open", open_and_note)

        def send(topic: topics.Topic, message: messages.Message) -> None:
            together.wait()
            sender.publish(topic, message, 1)

        with ThreadPoolExecutor(2) as pool:
            sent: list[tuple[topics.Topic, messages.Message]] = [
                (topics.PREVIEW, messages.Preview(b"1")),
                (topics.PICTURE, messages.Picture(b"2")),
            ]
            for future in [pool.submit(send, *one) for one in sent]:
                future.result()
    assert [session.is_closed() for session in opened] == [True]


def test_a_picture_arrives_whole(make_bus: MakeBus) -> None:
    camera, localizer = make_bus(), make_bus()
    inbox = localizer.inbox(topics.FRAME, messages.Frame)
    pixels = np.random.default_rng(1).integers(0, 256, (960, 1280), dtype=np.uint8)
    assert eventually(lambda: bool(camera.publish(topics.FRAME, messages.Frame(pixels), 1)) and inbox.newest() is not None)
    received = inbox.newest()
    assert received is not None
    assert np.array_equal(received.message.pixels, pixels)


# --- several orders at a time


class Obeying:
    """A robot that says yes, and what it was told."""

    def __init__(self, bus: Bus) -> None:
        self.orders: list[messages.CommandKind] = []
        bus.serve(1, self._obey)

    def _obey(self, header: Header, command: messages.Command) -> messages.Reply:
        self.orders.append(command.order)
        return messages.Reply(1, True)


TUNE, HOLD = messages.Command(messages.CommandKind.TUNE, 1), messages.Command(messages.CommandKind.HOLD, 1)


@pytest.mark.parametrize(("slow", "quick"), [(TUNE, HOLD), (HOLD, TUNE)], ids=["tune is slow", "hold is slow"])
def test_a_command_slow_to_encode_neither_outdates_nor_delays_another(
    make_bus: MakeBus, monkeypatch: pytest.MonkeyPatch, slow: messages.Command, quick: messages.Command
) -> None:
    station, robot = make_bus(), Obeying(make_bus())
    assert eventually(lambda: station.command(messages.Command(messages.CommandKind.ARM, 1), 1, 2.0).accepted)
    robot.orders.clear()
    begun, go_on = threading.Event(), threading.Event()

    def encode_slowly(message: messages.Message, stamp_ns: int = 0) -> bytes:
        if isinstance(message, messages.Command) and message.order is slow.order:
            begun.set()
            assert go_on.wait(20.0)
        return encode(message, stamp_ns)

    monkeypatch.setattr("shoal.bus.bus.encode", encode_slowly)
    with ThreadPoolExecutor(1) as pool:
        late = pool.submit(station.command, slow, 1, 5.0)
        assert begun.wait(20.0)
        try:
            answer = station.command(quick, 1, 5.0)
        finally:
            go_on.set()
        assert (answer.accepted, late.result().accepted) == (True, True), (answer.reason, late.result().reason)
    assert robot.orders == [quick.order, slow.order]


def test_orders_from_many_threads_are_all_taken(make_bus: MakeBus) -> None:
    station, _ = make_bus(), Obeying(make_bus())
    assert eventually(lambda: station.command(messages.Command(messages.CommandKind.ARM, 1), 1, 2.0).accepted)
    with ThreadPoolExecutor(8) as pool:
        replies = list(pool.map(lambda k: station.command(HOLD if k % 2 else TUNE, k, 5.0), range(200)))
    assert [reply.reason for reply in replies if not reply.accepted] == []


def test_messages_of_one_topic_from_many_threads_all_arrive(make_bus: MakeBus) -> None:
    """Numbered in one order and sent in another, the earlier number would be taken for an old message."""
    sender, receiver = make_bus(), make_bus()
    numbers: list[int] = []
    receiver.subscribe(topics.STATE, 1, lambda topic, key, header, payload: numbers.append(header.sequence))
    assert eventually(lambda: bool(sender.publish(topics.STATE, messages.RobotState(), 1, robot=1)) and bool(numbers))
    with ThreadPoolExecutor(8) as pool:
        for _ in range(20):
            list(pool.map(lambda k: sender.publish(topics.STATE, messages.RobotState(), k, robot=1), range(8)))
            time.sleep(0.005)
    assert eventually(lambda: len(numbers) > 100)
    assert numbers == sorted(numbers)


def test_commands_arrive_in_the_order_of_sending_when_replies_are_awaited_on_any_thread(make_bus: MakeBus) -> None:
    station, robot = make_bus(), Obeying(make_bus())
    assert eventually(lambda: station.command(messages.Command(messages.CommandKind.ARM, 1), 1, 2.0).accepted)
    robot.orders.clear()
    waiting = [
        station.send_command(HOLD if k % 3 else TUNE, 1, 5.0) for k in range(8)
    ]  # more than 16 at once a queue may drop
    assert [reply.reason for wait in reversed(waiting) if not (reply := wait()).accepted] == []
    assert robot.orders == [(HOLD if k % 3 else TUNE).order for k in range(8)]


def test_a_simulator_that_is_started_again_is_told_of_no_fault_from_before(make_bus: MakeBus) -> None:
    station = make_bus()

    def simulator() -> list[str]:
        faults: list[str] = []
        make_bus().subscribe(
            topics.FAULT,
            None,
            lambda topic, key, header, payload: faults.append(decode(messages.FaultRequest, payload, "", "").what),
        )
        return faults

    def breaks(what: str, faults: list[str]) -> bool:
        station.publish(topics.FAULT, messages.FaultRequest(what), 1)
        return eventually(lambda: what in faults, 0.5)

    first = simulator()
    assert eventually(lambda: breaks("thruster 1/2 dead", first))
    again = simulator()
    assert eventually(lambda: breaks("thruster 1/3 dead", again))
    assert set(again) == {"thruster 1/3 dead"}


def test_a_second_try_does_not_come_after_a_later_order(make_bus: MakeBus) -> None:
    """A robot that is met for the first time is asked who it is: by then another order may have been given."""
    station, robot_bus = make_bus(), make_bus()
    robot = Obeying(robot_bus)
    robot_bus.announce("agent-1")
    station.watch_presence()
    assert eventually(lambda: "agent-1" in station.present)  # before that an order finds nobody
    resume, hold = (
        station.send_command(messages.Command(messages.CommandKind.RESUME, 1), 1, 20.0),
        station.send_command(HOLD, 1, 20.0),
    )
    overtaken = resume()
    assert (overtaken.accepted, overtaken.reason) == (False, "RESUME was overtaken by a later order")
    assert hold().accepted
    assert robot.orders == [messages.CommandKind.HOLD]


@pytest.mark.parametrize("make_bus", ["zenoh"], indirect=True)  # in memory the sender's thread does what is asked
def test_a_stop_is_obeyed_while_another_command_is_under_way(make_bus: MakeBus) -> None:
    station, robot = make_bus(), make_bus()
    begun, go_on, obeyed = threading.Event(), threading.Event(), list[messages.CommandKind]()

    def handle(header: Header, command: messages.Command) -> messages.Reply:
        if command.order is messages.CommandKind.TUNE:
            begun.set()
            assert go_on.wait(20.0)
        obeyed.append(command.order)
        return messages.Reply(1, True)

    robot.serve(1, handle)
    assert eventually(lambda: station.command(messages.Command(messages.CommandKind.ARM, 1), 1, 2.0).accepted)
    obeyed.clear()
    with ThreadPoolExecutor(2) as pool:
        slow = pool.submit(station.command, TUNE, 1, 20.0)
        assert begun.wait(20.0)
        behind = pool.submit(station.command, HOLD, 1, 20.0)
        try:
            assert station.command(messages.Command(messages.CommandKind.STOP, 1), 1, 5.0).accepted
            assert obeyed == [messages.CommandKind.STOP]
        finally:
            go_on.set()
        assert slow.result().accepted
        behind.result()  # obeyed, or refused as older than the STOP
    assert obeyed[:2] == [messages.CommandKind.STOP, messages.CommandKind.TUNE]
    assert station.command(HOLD, 1, 5.0).accepted


@pytest.mark.parametrize("order", [messages.CommandKind.STOP, messages.CommandKind.HOLD], ids=["urgent", "in turn"])
def test_a_command_at_which_the_recipient_fails_is_refused_with_the_reason(
    make_bus: MakeBus, order: messages.CommandKind, caplog: pytest.LogCaptureFixture
) -> None:
    """Without an answer the sender would look for the fault in the network. What is done by half is not done again."""
    station, robot = make_bus(), make_bus()
    orders, fails = list[messages.CommandKind](), threading.Event()

    def handle(header: Header, command: messages.Command) -> messages.Reply:
        orders.append(command.order)
        if fails.is_set():
            raise KeyError("no such path")
        return messages.Reply(1, True)

    robot.serve(1, handle)
    assert eventually(lambda: station.command(messages.Command(messages.CommandKind.ARM, 1), 1, 2.0).accepted)
    fails.set()
    reply = station.command(messages.Command(order, 1), 1, 5.0)
    assert (reply.accepted, reply.silent, reply.reason) == (False, False, f"{order.name} failed: KeyError: 'no such path'")
    assert orders.count(order) == 1
    assert f"{order.name} failed: KeyError" in caplog.text
    fails.clear()
    assert station.command(HOLD, 1, 5.0).accepted, "it goes on to answer"


def test_two_programs_that_send_a_topic_by_turns_are_noticed_and_a_restart_is_not_two(make_bus: MakeBus) -> None:
    first, second, receiver = make_bus(), make_bus(), make_bus()
    inbox = receiver.inbox(topics.HEARTBEAT, messages.StationHeartbeat)

    def send(bus: Bus, mission: str) -> None:
        def came() -> bool:
            newest = inbox.newest()
            return newest is not None and newest.message.mission == mission

        assert eventually(lambda: bus.publish(topics.HEARTBEAT, messages.StationHeartbeat(mission=mission), 1) and came())

    for k in range(3):
        send(first, f"first {k}")
    send(second, "restarted")
    send(second, "goes on")
    assert not inbox.has_two_senders()
    send(first, "both")
    assert inbox.has_two_senders()
    send(second, "alone again")
    assert eventually(lambda: not inbox.has_two_senders(within_s=0.2))


# --- one process of a name

THERE = """
import sys, time
from shoal.bus.bus import Bus
from shoal.bus.endpoint import Endpoint
from shoal.bus.zenoh_transport import ZenohTransport
bus = Bus(ZenohTransport(Endpoint(sys.argv[1]), patience_s=20.0))
bus.claim("agent-1", bool)
bus.announce("agent-1")
print("there", flush=True)
time.sleep(600)
"""


@pytest.fixture
def fleet_with_agent() -> Iterator[tuple[Bus, "subprocess.Popen[bytes]"]]:
    """A client of a router where another process is agent-1, and that process."""
    address = f"tcp/127.0.0.1:{free_port()}"
    with Bus(ZenohTransport(Endpoint(address, router=True))), Bus(ZenohTransport(Endpoint(address))) as bus:
        other = subprocess.Popen([sys.executable, "-c", THERE, address], stdout=subprocess.PIPE)
        try:
            assert other.stdout is not None and other.stdout.readline() == b"there\n"
            bus.watch_presence()  # its token reaches the router some time after it was declared
            assert bus.wait(lambda: "agent-1" in bus.present, 20.0)
            yield bus, other
        finally:
            other.kill()
            other.communicate()


def test_a_second_process_of_a_name_is_refused(fleet_with_agent: tuple[Bus, "subprocess.Popen[bytes]"]) -> None:
    bus, _ = fleet_with_agent
    with pytest.raises(ConfigError, match=r"agent-1: another process of this name is in fleet shoal .*end it"):
        bus.claim("agent-1", bool, patience_s=0.5)
    bus.claim("agent-2", bool)


def test_a_program_that_fails_has_left_the_fleet_and_its_name_is_free() -> None:
    hub = MemoryHub()
    watcher = Bus(MemoryTransport(hub))
    watcher.watch_presence()
    with pytest.raises(ZeroDivisionError), Bus(MemoryTransport(hub)) as bus:
        bus.announce("agent-1")
        assert eventually(lambda: "agent-1" in watcher.present)
        raise ZeroDivisionError
    assert bus.closed and eventually(lambda: "agent-1" not in watcher.present)
    watcher.claim("agent-1", lambda: False)


def test_a_program_that_is_stopped_while_a_name_is_taken_does_not_get_it(caplog: pytest.LogCaptureFixture) -> None:
    """Else a second agent that waits, and is ended by Ctrl-C, would disarm the board of the first one on its way out."""
    hub, stopped = MemoryHub(), threading.Event()
    with Bus(MemoryTransport(hub)) as first, Bus(MemoryTransport(hub)) as second:
        first.claim("agent-1", bool)
        threading.Timer(0.4, stopped.set).start()
        with pytest.raises(Unreached, match=r"agent-1: stopped while another process of this name is in fleet shoal"):
            second.claim("agent-1", stopped.is_set)
        assert not eventually(lambda: "act by turns" in caplog.text, 0.3), "it never had the name"


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP], ids=["crashed", "cut off"])
def test_a_name_is_free_when_its_process_is_gone(
    fleet_with_agent: tuple[Bus, "subprocess.Popen[bytes]"], how: signal.Signals
) -> None:
    bus, other = fleet_with_agent
    other.send_signal(how)
    bus.claim("agent-1", bool)
    bus.announce("agent-1")


class LateNews(MemoryTransport):
    """A network that remembers a process that has just ended."""

    def __init__(self, hub: MemoryHub, token: str, after_s: float) -> None:
        super().__init__(hub)
        self._token, self._after_s = token, after_s

    def watch(self, key: str, presence: Presence, anew: bool = False) -> None:
        super().watch(key, presence, anew)
        if not anew and key.startswith("shoal/claim/"):
            threading.Timer(self._after_s, presence, (self._token, True)).start()


def test_a_process_that_ended_while_it_was_looked_for_does_not_keep_its_name() -> None:
    with Bus(LateNews(MemoryHub(), "shoal/claim/agent-1/holder/1", 0.0)) as bus:
        bus.claim("agent-1", bool, patience_s=2.0 * LOOK_AGAIN_S)


def test_a_process_that_is_gone_does_not_act_by_turns(caplog: pytest.LogCaptureFixture) -> None:
    with Bus(LateNews(MemoryHub(), "shoal/claim/agent-1/holder/1", 0.5)) as bus:
        bus.claim("agent-1", bool)
        time.sleep(1.0)
    assert "act by turns" not in caplog.text


def test_of_several_that_claim_a_name_together_one_gets_it() -> None:
    address = f"tcp/127.0.0.1:{free_port()}"
    with Bus(ZenohTransport(Endpoint(address, router=True))), ExitStack() as closing:
        for number in range(3):
            buses = [closing.enter_context(Bus(ZenohTransport(Endpoint(address)))) for _ in range(3)]
            together, got = threading.Barrier(len(buses)), list[int]()

            def claim(bus: Bus, name: str, together: threading.Barrier = together, got: list[int] = got) -> None:
                together.wait()
                with contextlib.suppress(ConfigError):
                    bus.claim(name, bool, patience_s=1.0)
                    got.append(bus.session)

            threads = [threading.Thread(target=claim, args=(bus, f"agent-{number}")) for bus in buses]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
            assert got == [min(bus.session for bus in buses)]


def test_two_that_have_one_name_all_the_same_are_said(caplog: pytest.LogCaptureFixture) -> None:
    """Each got it in its own part of a network that is whole again."""
    hub, other = MemoryHub(), MemoryHub()
    with Bus(MemoryTransport(hub)) as bus, Bus(MemoryTransport(other)) as apart:
        bus.claim("agent-1", bool)
        apart.claim("agent-1", bool)
        for key in list(other.tokens):
            MemoryTransport(hub).announce(key)
        assert eventually(
            lambda: "agent-1: another process of this name is in the fleet, and the two act by turns" in caplog.text
        )
