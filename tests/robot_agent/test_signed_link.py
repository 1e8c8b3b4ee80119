"""A robot's program and a board of its own process, over UDP, with keys that match and keys that do not."""

import threading
import time
from pathlib import Path
from socket import SOCK_DGRAM

import pytest

from robot_agent.node import AgentNode
from shoal.bus.bus import Bus
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.config.experiment import load_experiment
from shoal.mavlink.board_port import open_link
from shoal.mavlink.signing_key import Signing, new_key
from shoal.messages import topics
from shoal.messages.messages import RobotState
from shoal.runtime.runtime import Stop
from sim_bridge.sil.ports import free_port
from tests.sim_bridge.boards import board

pytestmark = pytest.mark.real_time


@pytest.mark.parametrize("same", [True, False], ids=["one key", "two keys"])
def test_state_tells_of_the_board_and_of_its_clock_only_where_the_keys_match(same: bool, tmp_path: Path) -> None:
    folder, port, hub = tmp_path / "boards", free_port(SOCK_DGRAM), MemoryHub()
    folder.mkdir()
    new_key(folder / "robot-1.key")
    new_key(tmp_path / "other.key")
    signing = Signing.of(folder / "robot-1.key" if same else tmp_path / "other.key", "agent")
    stop, link = Stop(install=False), open_link(f"udp:127.0.0.1:{port}")
    bus, ear = Bus(MemoryTransport(hub)), Bus(MemoryTransport(hub))
    inbox = ear.inbox(topics.STATE, RobotState, 1)
    node = AgentNode(load_experiment("pool"), 1, bus, link, stop, signing=signing)
    with board(f"udp:127.0.0.1:{port}", folder):
        thread = threading.Thread(target=node.run)
        thread.start()
        try:
            deadline, newest = time.monotonic() + (20.0 if same else 3.0), None
            while time.monotonic() < deadline and not (newest and newest.message.timing.board_round_trip_ms > 0.0):
                time.sleep(0.05)
                newest = inbox.newest()
        finally:
            stop.request()
            thread.join()
            link.close()
    assert newest is not None
    state = newest.message
    echo_us = state.board.echo_us if state.board is not None else ()
    facts = (state.timing.board_round_trip_ms > 0.0, state.timing.board_age_ms is not None, len(echo_us))
    assert facts == ((True, True, 8) if same else (False, False, 0))
    assert abs(state.timing.board_clock_offset_s) > 1e6 or not same  # the board counts from when it was switched on
