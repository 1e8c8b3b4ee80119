"""SHELL: the simulated pool with a witness at every thruster board, and levers to break things while it runs.

    python -m tests.faults.witness EXPERIMENT STATION PORTS HARNESS [--poses]

The pool, its boards and its camera are those of `sim-bridge pool`. Over one TCP connection the harness is told, with instants
of the machine's monotonic clock, what each board takes, refuses and puts out; and it sends what is to be broken from now on,
a JSON list of texts as `--fault` has them ("camera frozen"), and "board 2 crossed": outputs 1 and 2 of that board confused;
"depth 2 reads 10", "depth 2 jumps 0.5", "depth 2 stuck": what that robot's pressure sensor says, in m, from now on, or that
much too deep, or the same for ever; "thread camera": the thread of the simulator's camera ends with an exception.
"""

import json
import socket
import sys
import time
from dataclasses import replace
from typing import Any

import numpy as np

import sim_bridge.node.pool
from shoal.bus.bus import Bus
from shoal.bus.endpoint import Endpoint
from shoal.bus.zenoh_transport import ZenohTransport
from shoal.config.experiment import Experiment, load_experiment
from shoal.config.fault_injection import Fault
from shoal.frames import Array
from shoal.mavlink.frame_codec import Peer
from shoal.runtime.runtime import Stop, run_app, start_log
from sim_bridge.fault_schedule import FaultSchedule
from sim_bridge.node.board_ports import UdpPorts
from sim_bridge.node.pool import PoolNode
from sim_bridge.plant.sensors import Reading
from sim_bridge.thruster_board.board import ThrusterBoard
from sim_bridge.thruster_board.nonvolatile import BoardFactory
from sim_bridge.world import World
from tests.faults.patched import end_thread

OWN = ("board", "depth", "thread")  # what is broken here, and not by sim.faults


class Line:
    """The connection to the harness."""

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port))
        self._socket.setblocking(False)
        self._rest = b""

    def tell(self, **what: Any) -> None:
        """One event, now. A harness that has gone, or does not read, is nobody's trouble here."""
        try:
            self._socket.sendall(json.dumps({"ns": time.monotonic_ns(), **what}).encode() + b"\n")
        except OSError:
            return

    def asked(self) -> list[str] | None:
        """The newest list of what is to be broken; None if nothing new came."""
        try:
            self._rest += self._socket.recv(65536)
        except OSError:
            return None
        *lines, self._rest = self._rest.split(b"\n")
        faults: list[str] | None = json.loads(lines[-1]) if lines else None
        return faults


def watched_board(line: Line) -> type[ThrusterBoard]:
    """A board that tells of every override which it takes or refuses."""

    class WatchedBoard(ThrusterBoard):
        def __init__(self, experiment: Experiment, robot_id: int, seed: int) -> None:
            super().__init__(experiment, robot_id, seed)
            self.crossed = False
            self.depth_wrong: tuple[str, ...] = ()  # how, and by how many metres
            self._true_read = self.sensors.read
            self._stuck_m: float | None = None
            vars(self.sensors)["read"] = self._read
            rules, override = self.rules, self.rules.override

            def watched(sender: Peer, pulses_us: tuple[int, ...], now_ns: int) -> None:
                refused, (first, second, *rest) = rules.overrides_refused, pulses_us
                override(sender, (second, first, *rest) if self.crossed else pulses_us, now_ns)
                line.tell(robot=robot_id, taken=rules.overrides_refused == refused, pulses=list(pulses_us))

            vars(rules)["override"] = watched

        def _read(self, *motion: Any) -> Reading:
            reading = self._true_read(*motion)
            match self.depth_wrong:
                case ("reads", metres):
                    return replace(reading, depth_m=float(metres))
                case ("jumps", metres):
                    return replace(reading, depth_m=reading.depth_m + float(metres))
                case ("stuck",):
                    self._stuck_m = reading.depth_m if self._stuck_m is None else self._stuck_m
                    return replace(reading, depth_m=self._stuck_m)
            self._stuck_m = None
            return reading

    return WatchedBoard


def watched_world(line: Line) -> type[World]:
    """A world that tells of every change at the boards' outputs, and is broken by the harness."""

    class WatchedWorld(World):
        def __init__(self, experiment: Experiment, seed: int, starts: Array, make: BoardFactory, held: bool) -> None:
            super().__init__(experiment, seed, starts, make, held)
            self._experiment = experiment
            self._states: list[tuple[bool, bool] | None] = [None] * len(starts)

        def apply_faults(self) -> list[str]:
            requests = line.asked()
            if requests is None:
                return []
            for robot, board in zip(self._experiment.robot_ids, self.boards, strict=True):
                vars(board)["crossed"] = f"board {robot} crossed" in requests
                depths = [what.split()[2:] for what in requests if what.startswith(f"depth {robot} ")]
                vars(board)["depth_wrong"] = tuple(depths[-1]) if depths else ()
            if "thread camera" in requests:
                end_thread("camera")
            faults = tuple(Fault(at_s=0.0, what=what) for what in requests if what.split()[0] not in OWN)
            sim = self._experiment.sim.model_copy(update={"faults": faults})
            self.faults = FaultSchedule(self._experiment.model_copy(update={"sim": sim}))
            flags = self.faults.advance(0.0)
            for board, imu in zip(self.boards, self.faults.imu, strict=True):
                board.sensors.faults = imu
            line.tell(broken=requests)
            return flags

        def step(self, until_ns: int = 0) -> list[tuple[int, bytes]]:
            sent = super().step(until_ns)
            for i, board in enumerate(self.boards):
                now = self.neutral(i), board.armed
                if now != self._states[i]:
                    self._states[i] = now
                    line.tell(robot=self._experiment.robot_ids[i], neutral=now[0], armed=now[1])
            if not np.isfinite(self._state.eta).all():
                line.tell(not_finite=True)
            return sent

    return WatchedWorld


def main() -> None:
    """See the module's docstring."""
    name, station, ports, harness, *options = sys.argv[1:]
    start_log("sim-bridge")
    line, stop, experiment = Line(int(harness)), Stop(), load_experiment(name)
    sockets = UdpPorts(int(ports), experiment.robot_ids, experiment.seed)
    vars(sim_bridge.node.pool)["World"] = watched_world(line)
    with Bus(ZenohTransport(Endpoint(station))) as bus:
        poses, make = "--poses" in options, watched_board(line)
        PoolNode(experiment, bus, sockets, stop, lockstep=False, poses=poses, make=make).run()
    stop.raise_failure()


if __name__ == "__main__":
    run_app(main)
