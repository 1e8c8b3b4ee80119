"""A fleet with keys, over real Zenoh sessions: every right that the topic table gives works, and no other does."""

import dataclasses
import json
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
import pytest
import zenoh

from groundstation.deploy import key_ring
from groundstation.gate.gate import Gate
from shoal.bus.bus import Bus
from shoal.bus.connection_diagnostics import trouble_reaching
from shoal.bus.endpoint import FLOOD, Endpoint
from shoal.bus.key_ring import Keys, common_name
from shoal.bus.network import endpoint
from shoal.bus.zenoh_transport import ZenohTransport
from shoal.errors import Unreached
from shoal.messages import messages, topics
from shoal.messages.messages import Command, CommandKind, Reply
from shoal.messages.topics import Role, Topic
from sim_bridge.sil.ports import free_port
from tests.waiting import eventually

pytestmark = pytest.mark.real_time

ROLES = {
    "groundstation": Role.STATION,
    "operator": Role.OPERATOR,
    "agent-1": Role.ROBOT,
    "agent-2": Role.ROBOT,
    "localizer": Role.LOCALIZER,
    "sim-bridge": Role.SIMULATOR,
    "viewer": Role.VIEWER,
}
SERVED = {0: "groundstation", 1: "agent-1", 2: "agent-2"}
PERIOD_S = 0.05
PICTURES: dict[type, Any] = {messages.Frame: np.zeros((4, 4), np.uint8), messages.Preview: b"jpeg",
    messages.Video: b"h264", messages.Picture: b"jpeg"}  # fmt: skip
PLAIN: dict[Any, Any] = {int: 2, float: PERIOD_S, str: "text"}


def example(topic: Topic) -> Any:
    """A message of a topic that gets through the codec."""
    if topic.type in PICTURES:
        return topic.type(PICTURES[topic.type])
    hints = get_type_hints(topic.type)
    required = [f.name for f in dataclasses.fields(topic.type) if f.default is f.default_factory]
    return topic.type(**{name: PLAIN[hints[name]] for name in required})


def each_key() -> Iterator[tuple[Topic, int | None]]:
    for topic in topics.TOPICS:
        for robot in (1, 2) if "{robot}" in topic.name else (None,):
            yield topic, robot


@dataclass
class GuardedRouter:
    """A router with keys, and what everybody hears and obeys."""

    ring: Path
    address: str
    buses: dict[str, Bus] = field(default_factory=dict)
    links: set[tuple[str, str, int]] = field(default_factory=set)  # who heard what key of which session
    obeyed: list[tuple[int, CommandKind]] = field(default_factory=list)

    def join(self, process: str) -> Bus:
        station = process == "groundstation"
        address = self.address.replace("127.0.0.1", "0.0.0.0") if station else self.address  # it listens for other machines
        where = endpoint(address, process, self.ring, router=station)
        return Bus(ZenohTransport(where, patience_s=5.0, gate=Gate))

    def open(self) -> None:
        for process in ROLES:
            bus = self.buses[process] = self.join(process)
            for topic in topics.TOPICS:
                bus.subscribe(topic, None, lambda _, key, header, __, me=process: self.links.add((me, key, header.session)))  # type: ignore[misc]
        for number, process in SERVED.items():

            def obey(_: object, command: Command, number: int = number) -> Reply:
                self.obeyed.append((number, command.order))
                return Reply(number, True)

            self.buses[process].serve(number, obey)
        for process, bus in self.buses.items():
            bus.watch_presence()
            bus.announce(process)
        assert eventually(lambda: all(bus.present == set(ROLES) for bus in self.buses.values()))

    def close(self) -> None:
        for bus in reversed(self.buses.values()):
            bus.close()


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[GuardedRouter]:
    ring, now = tmp_path_factory.mktemp("ring") / "keys", datetime.now(UTC)
    key_ring.init(ring, ["station.pool"], "shoal", now)
    for robot in (1, 2):
        key_ring.add(ring, "robot", robot, now)
    fleet = GuardedRouter(ring, f"tls/127.0.0.1:{free_port()}")
    try:
        fleet.open()
        yield fleet
    finally:
        fleet.close()


def may_write(process: str, topic: Topic, robot: int | None) -> bool:
    own = ROLES[process] is not Role.ROBOT or robot is None or process == f"agent-{robot}"
    return ROLES[process] in topic.writers and own


def test_each_role_receives_exactly_the_topics_of_the_table(guarded: GuardedRouter) -> None:
    """Everybody but the router publishes everything, also for robots that are not theirs."""
    writers = {process: bus for process, bus in guarded.buses.items() if process != "groundstation"}
    wanted = {
        (reader, f"shoal/{topic.key(robot)}", bus.session)
        for topic, robot in each_key()
        for reader, role in ROLES.items()
        for writer, bus in writers.items()
        if writer != reader  # what a session says to itself does not leave it
        if role in topic.readers and may_write(writer, topic, robot)
    }
    assert len(wanted) > 100
    slot_s = 1.5 / (FLOOD * topics.PLAN.rate_hz)  # whoever speaks for two robots at once speaks too often
    deadline = time.monotonic() + 20.0
    while not wanted <= guarded.links and time.monotonic() < deadline:
        for topic, robot in each_key():
            for bus in writers.values():
                bus.publish(topic, example(topic), 5, robot)
            time.sleep(slot_s)
    over_the_network = {
        (reader, key, session)
        for reader, key, session in guarded.links
        if session in {bus.session for writer, bus in writers.items() if writer != reader}
    }
    assert over_the_network == wanted


def test_a_localizer_speaks_and_is_seen_for_one_of_several_cameras_and_a_robot_does_not(guarded: GuardedRouter) -> None:
    topic, sessions = topics.LOCALIZER.of_camera("west"), list[int]()
    viewer, localizer, robot = (guarded.buses[process] for process in ("viewer", "localizer", "agent-1"))
    viewer.subscribe(topic, None, lambda _, key, header, payload: sessions.append(header.session))

    def told() -> bool:
        for bus in (robot, localizer):
            bus.publish(topic, example(topic), 5)
        return localizer.session in sessions

    assert eventually(told)
    robot.announce("localizer-east")
    localizer.announce("localizer-west")
    assert eventually(lambda: "localizer-west" in viewer.present)
    assert "localizer-east" not in viewer.present and set(sessions) == {localizer.session}


def test_only_the_station_commands_robots_and_only_it_and_the_operator_command_the_station(guarded: GuardedRouter) -> None:
    allowed = {("groundstation", 0), ("groundstation", 1), ("groundstation", 2), ("operator", 0)}
    guarded.obeyed.clear()
    answers = {
        (process, number): bus.command(Command(CommandKind.ARM, number), 1, 2.0 if (process, number) in allowed else 0.2)
        for process, bus in guarded.buses.items()
        for number, own in SERVED.items()
        if process != own or process == "groundstation"  # within one session nothing goes over the network
    }
    assert {who for who, reply in answers.items() if reply.accepted} == allowed
    assert sorted(guarded.obeyed) == [(0, CommandKind.ARM), (0, CommandKind.ARM), (1, CommandKind.ARM), (2, CommandKind.ARM)]


def test_a_robot_cannot_speak_for_another_not_even_by_a_wildcard(guarded: GuardedRouter) -> None:
    # a bus sends only under its own keys; a forger uses the session below it
    session = guarded.buses["agent-1"].transport._control  # type: ignore[attr-defined]
    puts: list[str] = []
    listener = guarded.buses["viewer"].transport
    listener.subscribe("shoal/robot/*/state", topics.STATE.qos, lambda key, payload, _: puts.append(payload.decode()))
    listener.subscribe("shoal/station/heartbeat", topics.HEARTBEAT.qos, lambda key, payload, _: puts.append(payload.decode()))
    for key in ("shoal/robot/2/state", "shoal/robot/*/state", "shoal/robot/**", "shoal/**", "shoal/station/heartbeat"):
        session.put(key, "forged")
    session.delete("shoal/robot/2/state")
    assert eventually(lambda: session.put("shoal/robot/1/state", "own") is None and "own" in puts)
    assert set(puts) == {"own"}


def test_a_robot_cannot_answer_for_another(guarded: GuardedRouter) -> None:
    guarded.obeyed.clear()
    usurped: list[bytes] = []
    guarded.buses["agent-1"].transport.serve("shoal/robot/2/command", lambda payload, _: usurped.append(payload) or b"", bool)  # type: ignore[func-returns-value]
    time.sleep(0.2)
    assert guarded.buses["groundstation"].command(Command(CommandKind.STOP, 2), 1, 2.0).accepted
    assert (usurped, guarded.obeyed) == ([], [(2, CommandKind.STOP)])


def no_way_in(where: Endpoint) -> str:
    """The reason why no session can be opened there."""
    with pytest.raises(Unreached) as refused:
        ZenohTransport(where, patience_s=0.1)
    return str(refused.value)


def test_strangers_are_refused_and_told_why_and_the_router_logs_it(
    guarded: GuardedRouter, tmp_path: Path, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    now = datetime.now(UTC)
    other = tmp_path / "other"
    key_ring.init(other, [], "shoal", now)
    mixed = tmp_path / "mixed"  # believes our authority, was made by another
    shutil.copytree(other / "viewer", mixed)
    shutil.copy(guarded.ring / "ca.pem", mixed / "ca.pem")
    old = tmp_path / "ring"
    shutil.copytree(guarded.ring, old)
    key_ring.add(old, "viewer", 0, now - timedelta(days=3), days=1.0)
    capfd.readouterr()
    assert "not believed" in no_way_in(endpoint(guarded.address, "viewer", other))
    assert "another authority made it" in no_way_in(Endpoint(guarded.address, keys=Keys(mixed)))
    assert "it has expired" in no_way_in(endpoint(guarded.address, "viewer", old))
    no_way_in(Endpoint(guarded.address.replace("tls/", "tcp/")))
    assert eventually(lambda: "refused a connection from 127.0.0.1 without a valid certificate" in caplog.text)
    assert capfd.readouterr().out == ""  # nothing in another form


def test_without_a_certificate_there_is_no_way_in(guarded: GuardedRouter) -> None:
    config = zenoh.Config()
    for key, value in {
        "mode": "client",
        "scouting/multicast/enabled": False,
        "connect/endpoints": [guarded.address],
        "connect/timeout_ms": 300,
        "connect/exit_on_failure": True,
        "transport/link/tls/root_ca_certificate": str(guarded.ring / "ca.pem"),
    }.items():
        config.insert_json5(key, json.dumps(value))
    with pytest.raises(zenoh.ZError):
        zenoh.open(config)


def test_a_station_under_another_name_is_not_believed(guarded: GuardedRouter, tmp_path: Path) -> None:
    """A robot's certificate is good for a client only: it cannot pass for the station, though our authority made it."""
    where = endpoint(f"tls/127.0.0.1:{free_port()}", "groundstation", guarded.ring, router=True)
    impostor = ZenohTransport(
        Endpoint(where.address, router=True, keys=Keys(guarded.ring / "agent-1"), access=where.access), gate=Gate
    )
    try:
        assert no_way_in(endpoint(where.address, "agent-2", guarded.ring))
        assert trouble_reaching(where.address, Keys(guarded.ring / "agent-2"))
    finally:
        impostor.close()


def test_a_revoked_member_is_deaf_and_dumb_once_the_router_starts_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    ring, now, address = tmp_path / "keys", datetime.now(UTC), f"tls/127.0.0.1:{free_port()}"
    key_ring.init(ring, [], "shoal", now)
    key_ring.add(ring, "robot", 1, now)
    stolen = tmp_path / "stolen"
    shutil.copytree(ring / "agent-1", stolen)
    key_ring.revoke(ring, "agent-1", now)
    key_ring.add(ring, "robot", 1, now)  # the robot's number lives on under another certificate
    router = Bus(ZenohTransport(endpoint(address, "groundstation", ring, router=True), gate=Gate))
    sessions: list[int] = []
    router.subscribe(topics.STATE, None, lambda topic, key, header, payload: sessions.append(header.session))
    thief = Bus(ZenohTransport(Endpoint(address, keys=Keys(stolen)), patience_s=5.0))
    robot = Bus(ZenohTransport(endpoint(address, "agent-1", ring), patience_s=5.0))
    try:
        beats = thief.inbox(topics.HEARTBEAT, messages.StationHeartbeat)
        own = robot.inbox(topics.HEARTBEAT, messages.StationHeartbeat)

        def told() -> bool:
            for bus in (thief, robot):
                bus.publish(topics.STATE, messages.RobotState(), 1, robot=1)
            router.publish(topics.HEARTBEAT, messages.StationHeartbeat(), 1)
            return robot.session in sessions and own.newest_header() is not None

        assert eventually(told)
        assert set(sessions) == {robot.session}
        assert beats.newest_header() is None
        unlisted = [record.getMessage() for record in caplog.records if "is not on the list" in record.getMessage()]
        assert len(unlisted) == 1 and unlisted[0].startswith(f"{common_name(Keys(stolen))} is not on the list of members")
    finally:
        for bus in (robot, thief, router):
            bus.close()
