"""Process faults against real processes."""

import time
from pathlib import Path

import psutil

from sim_bridge.processes import Children
from sim_bridge.saboteur import Saboteur
from wire.bus import Bus
from wire.experiment import load_experiment
from wire.transport import MemoryHub, MemoryTransport


def test_it_stops_lets_go_on_and_kills(tmp_path: Path) -> None:
    lines = ["t=0.1 for=0.3 process agent-1 stopped", "t=0.2 process agent-2 killed"]
    children = Children(tmp_path)
    try:
        one, two = (children.start(f"agent-{i}", "http.server", ["0"]) for i in (1, 2))
        with Bus(MemoryTransport(MemoryHub())) as bus:
            saboteur = Saboteur(load_experiment("pool", faults=lines), children, bus)
            saboteur.act(0.0)
            assert saboteur._start_s is None  # the robots have not started: nothing breaks
            begin_s, was_stopped = time.monotonic(), False
            while time.monotonic() - begin_s < 20.0 and (not was_stopped or saboteur._stopped or two.exit_code is None):
                saboteur.act(0.01)
                was_stopped |= psutil.Process(one.process.pid).status() == psutil.STATUS_STOPPED
                time.sleep(0.01)
            assert was_stopped and two.exit_code == -9
            assert psutil.Process(one.process.pid).status() != psutil.STATUS_STOPPED
            assert saboteur.killed == {"agent-2"}
    finally:
        children.stop()
