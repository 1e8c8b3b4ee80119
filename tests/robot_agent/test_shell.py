"""A robot's program: when it steps."""

import threading
import time
from socket import SOCK_DGRAM

import pytest

from robot_agent import pace, shell
from sim_bridge.ports import free_port
from wire import topics
from wire.bus import Bus
from wire.experiment import load_experiment
from wire.link import open_link
from wire.messages import Command, Mode, Order, RobotState, StationHeartbeat
from wire.runtime import Stop, wait
from wire.transport import MemoryHub, MemoryTransport

PATIENCE_S = 20.0
NEVER = 1e4  # periods


@pytest.mark.parametrize("order", [Order.STOP, Order.DISARM])
def test_an_order_that_takes_the_power_away_does_not_wait_for_the_next_step(
    order: Order, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pace, "LATE", NEVER)
    hub, stop, link = MemoryHub(), Stop(install=False), open_link(f"udp:127.0.0.1:{free_port(SOCK_DGRAM)}")
    bus, station = Bus(MemoryTransport(hub)), Bus(MemoryTransport(hub))
    heard = station.inbox(topics.STATE, RobotState, 1)
    robot = shell.Shell(load_experiment("pool"), 1, bus, link, False, stop)
    robot.agent.mode = Mode.HOLDING
    thread = threading.Thread(target=robot.run)
    thread.start()
    try:
        while not station.order(Command(order, robot=1), time.time_ns(), 1.0).accepted:  # until it serves, and hears us
            station.publish(topics.HEARTBEAT, StationHeartbeat(), time.time_ns())
        assert wait(station, stop, lambda: heard.newest_header() is not None, PATIENCE_S)
    finally:
        stop.request()
        thread.join()
        link.close()
    told = heard.newest()
    assert told is not None
    assert told.message.mode is {Order.STOP: Mode.STOPPED, Order.DISARM: Mode.DISARMED}[order]
    assert set(told.message.pulse_us) == {1500}


def test_a_board_that_is_not_there_is_named_and_once_is_enough(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(shell, "LINK_HEARTBEAT_S", 0.0)
    hub, stop, link = MemoryHub(), Stop(install=False), open_link("serial:/dev/none")
    bus, station = Bus(MemoryTransport(hub)), Bus(MemoryTransport(hub))
    heard = station.inbox(topics.STATE, RobotState, 1)
    thread = threading.Thread(target=shell.Shell(load_experiment("pool"), 1, bus, link, False, stop).run)
    thread.start()
    try:
        assert wait(station, stop, lambda: (header := heard.newest_header()) is not None and header.sequence > 3, PATIENCE_S)
    finally:
        stop.request()
        thread.join()
    assert [record.getMessage() for record in caplog.records if record.levelname == "WARNING"] == [
        "thruster board: /dev/none: not there; is the board plugged in, and powered?",
        "told to stop; neutral and disarm sent to the thruster board, which has not said within 0.25 s that it is disarmed",
    ]
