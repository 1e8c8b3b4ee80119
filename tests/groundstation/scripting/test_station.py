"""A script at a real station, over the network, that no robot has joined."""

import subprocess
import sys
from pathlib import Path

import pytest

import shoal
from sim_bridge.sil.ports import free_port

pytestmark = pytest.mark.real_time


def test_a_station_without_robots_says_so_refuses_to_start_and_ends_when_asked(tmp_path: Path) -> None:
    address = f"tcp/127.0.0.1:{free_port()}"
    command = [sys.executable, "-m", "groundstation", "run", "pool", "--no-web", "--listen", address, "--out", str(tmp_path)]
    station = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        with shoal.connect(address, patience_s=120.0) as fleet:
            assert fleet.wait_mission("WAITING", timeout_s=120.0) == "WAITING"
            with pytest.raises(shoal.NotHeard, match="not ready within 1 s"):
                fleet.wait_ready(1.0)
            with pytest.raises(shoal.RequestFailed, match=r"start: refused: .*not heard"):
                fleet.start()
            assert fleet.robots == ()
            fleet.end()
        station.wait(120.0)
    finally:
        station.kill()
        station.wait()
    assert list(tmp_path.glob("pool-*/run.mcap"))
