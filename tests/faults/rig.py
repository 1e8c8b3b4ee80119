"""SHELL: a lab on this machine whose processes, wires, camera and water can be broken at any instant and mended again, so that
one start-up serves many injections. The processes are those of a real run; only the pool is simulated, and watched.
"""

import json
import os
import socket
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np

from shoal.bus.bus import Bus
from shoal.bus.endpoint import Endpoint
from shoal.bus.zenoh_transport import ZenohTransport
from shoal.config.experiment import dump_experiment, load_experiment
from shoal.messages import topics
from shoal.messages.messages import Command, CommandKind, Mode, Reply
from sim_bridge.sil.ports import free_base_port, free_port
from sim_bridge.sil.processes import Child, Children
from tests.faults.onlooker import PATIENCE_S, Onlooker, Stuck
from tests.faults.wires import NetWire, SerialWire

MANY, MANY_PATIENCE_S = 5, 180.0  # the same with more robots than these: every process takes a second of a core to start
CRUISES = 10  # attempts at a flight in one piece
COMES_UP_S = 2.0  # from the mission's first word of a flight to all thrusters running
ANSWERED_S = 5.0  # an order to the whole fleet, on a machine that has just started it


class Rig(Onlooker):
    """Station, pool, localizer and agents, and who looks on. Use as a context."""

    def __init__(
        self,
        experiment: str = "pool",
        settings: Sequence[str] = (),
        *,
        seed: int = 1,
        poses: bool = False,
        wires: bool = True,
        station_options: Sequence[str] = ("--no-web",),
        run_dir: Path | None = None,
        own_router: bool = False,
        patched: bool = False,
    ) -> None:
        """With `poses` there is neither camera nor localizer; with `wires` robots' boards are behind pseudo-terminals, and
        robot 1 reaches the station through a NetWire. With `own_router` the network does not live in the station.
        `patched` starts all but the pool by way of patched.py."""
        self.experiment = load_experiment(experiment, [*settings, f"seed={seed}"])
        super().__init__(self.experiment.robot_ids, Path(tempfile.mkdtemp(prefix="shoal-faults-")))
        self.file = self.folder / "experiment.toml"
        self.file.write_text(dump_experiment(self.experiment), encoding="utf-8")
        self.run_dir = run_dir or self.folder / "run"
        self.children = Children(self.folder / "logs")
        self._seed, self._poses, self._with_wires = seed, poses, wires
        self.station_options, self._own_router, self._patched = list(station_options), own_router, patched
        self._checked = dict.fromkeys(self.robots, (0, 0))
        self._wrong = 0
        self._commands: dict[str, list[str]] = {}
        self._taken_off_s = float("-inf")

    # --- up and down

    def __enter__(self) -> Self:
        try:
            self._open()
        except BaseException:
            self.__exit__()
            raise
        return self

    def _open(self) -> None:
        router, ports = free_port(), free_base_port(self.robots)
        self.address = f"tcp/127.0.0.1:{router}"
        self._harness = socket.create_server(("127.0.0.1", 0))
        threading.Thread(target=self._listen, name="witness", daemon=True).start()
        self.net = NetWire(router)
        self.wires = {
            robot: SerialWire(robot, ports + robot, self._seed) for robot in (self.robots if self._with_wires else ())
        }
        self.children.log_dir.mkdir(parents=True)
        if self._own_router:
            self.station_options.append("--external-router")
            self.bus = Bus(ZenohTransport(Endpoint(self.address, router=True)))
        station = [
            "run",
            str(self.file),
            "--run-dir",
            str(self.run_dir),
            "--no-report",
            "--listen",
            self.address,
            *self.station_options,
        ]
        self._launch("groundstation", "groundstation", station)
        harness = str(self._harness.getsockname()[1])
        witness = [str(self.file), self.address, str(ports), harness, *(["--poses"] if self._poses else [])]
        self._launch("sim-bridge", "tests.faults.witness", witness)
        if not self._poses:
            self._launch("localizer", "localizer", ["run", str(self.file), "--station", self.address])
        for robot in self.robots:
            link = self.wires[robot].link if robot in self.wires else f"udp:127.0.0.1:{ports + robot}"
            arguments = ["run", str(self.file), "--station", self.agent_station(robot), "--robot", str(robot), "--link", link]
            self._launch(f"agent-{robot}", "robot_agent", arguments)
        if not self._own_router:
            self.bus = Bus(ZenohTransport(Endpoint(self.address)))
        for topic in (topics.STATE, topics.EVENT, topics.HEARTBEAT, topics.POSE, topics.TRUTH):
            self.bus.subscribe(topic, None, self.heard)

    def agent_station(self, robot: int) -> str:
        """Address of the station for a robot's agent."""
        return f"tcp/127.0.0.1:{self.net.port}" if self.wires and robot == self.robots[0] else self.address

    def __exit__(self, *exception: Any) -> None:
        self.children.stop()
        for closing in ("bus", "net", "_harness"):
            if hasattr(self, closing):
                getattr(self, closing).close()
        for wire in getattr(self, "wires", {}).values():
            wire.close()

    def _launch(self, name: str, module: str, arguments: list[str]) -> None:
        self._commands[name] = [module, *arguments]
        self.restart(name)

    def restart(self, name: str) -> None:
        """Start a process anew that has ended."""
        module, *arguments = self._commands[name]
        self.children.all = [child for child in self.children.all if child.name != name]
        log = self.folder / "logs" / f"{name}.log"
        if log.exists():
            log.rename(log.with_name(f"{name}-{time.monotonic_ns()}.log"))
        if name == "groundstation":
            (self.run_dir / "run.mcap").unlink(missing_ok=True)  # no station writes over another's
        if self._patched and name != "sim-bridge":
            module, arguments = "tests.faults.patched", [str(self.children.clock_file(name)), module, *arguments]
        self.children.start(name, module, arguments)

    def process(self, name: str) -> Child:
        """The running process of that name."""
        return next(child for child in self.children.all if child.name == name)

    def _listen(self) -> None:
        try:
            while True:  # a pool that is started again calls again
                connection, _ = self._harness.accept()
                self._witness = connection
                with connection.makefile("rb") as lines:
                    for line in lines:
                        self.witnessed(json.loads(line))
        except OSError:
            return

    # --- flying

    def order(self, order: CommandKind, via: Sequence[tuple[float, float]] = ()) -> Reply:
        """A person's order for the whole fleet; `via`: where GO leads it, x and y in m."""
        return self.bus.command(
            Command(order, robot=0, via=np.array(via).reshape(-1, 2)), time.monotonic_ns(), ANSWERED_S, to=0
        )

    def fly(self) -> None:
        """From anywhere to all robots tracking, thrusters running."""
        deadline = time.monotonic() + (PATIENCE_S if len(self.robots) <= MANY else MANY_PATIENCE_S)
        steps = {
            "STOPPED": CommandKind.CLEAR_STOP,
            "DONE": CommandKind.LOAD,
            "CANCELLED": CommandKind.LOAD,
            "FAILED": CommandKind.LOAD,
            "RUNNING": CommandKind.DISARM,
        }
        steps |= {"PAUSED": CommandKind.DISARM}
        reply, astray = Reply(0, False), False  # adrift for minutes, between two attempts
        while not self.flying:
            if time.monotonic() > deadline:
                raise Stuck(f"no flight: mission {self.mission}, last answer {reply.reason[:500]!r} ({self.folder})")
            if self.mission == "RUNNING" and self._comes_up():
                break
            astray |= "from its start" in reply.reason
            if astray and self.mission in ("WAITING", "DONE", "CANCELLED", "FAILED"):
                reply = self.order(CommandKind.RETURN)
                astray = not reply.accepted
            elif astray and self.mission == "LOADING":
                reply = self.order(CommandKind.DISARM)
            elif self.mission in steps:
                reply = self.order(steps[self.mission])
            elif self.mission in ("WAITING", "LOADING") and any(
                self.mode(r) in (Mode.FAULT, Mode.HOLDING) for r in self.robots
            ):
                reply = self.order(CommandKind.DISARM)
            elif self.mission in ("WAITING", "LOADING"):
                reply = self.order(CommandKind.START)
            time.sleep(0.1)
            self._taken_off_s = time.monotonic()

    def _comes_up(self) -> bool:
        """True if a mission that has just begun flies before long."""
        return self.comes(lambda: self.flying or self.mission != "RUNNING", COMES_UP_S) and self.flying

    @property
    def flying(self) -> bool:
        """True if every robot tracks and every board thrusts."""
        fresh = time.monotonic_ns() - 300_000_000
        return self.mission == "RUNNING" and all(
            self.states[r] and self.states[r][-1].ns > fresh and self.mode(r) is Mode.TRACKING and self.boards[r].thrusting
            for r in self.robots
        )

    def cruise(self, seconds: float) -> None:
        """Fly, and have flown on for a while without a break. A flight past its half is begun anew: no injection is to meet
        its end. Raises Stuck where robots keep dropping out: a machine too busy for the flight itself measures no fault."""
        for _ in range(CRUISES):
            if time.monotonic() - self._taken_off_s > 0.5 * self.experiment.duration_s:
                self.land()
            self.fly()
            end_s = time.monotonic() + seconds
            while self.flying and time.monotonic() < end_s:
                time.sleep(0.01)
            if self.flying:
                return
        raise Stuck(f"no {seconds:.1f} s of flight in one piece: this machine is too busy ({self.folder})")

    def land(self) -> None:
        """End the flight: whatever the robots have got used to in it is forgotten."""
        self.order(CommandKind.DISARM)
        self.wait(lambda: not self.flying, "landed")

    # --- breaking

    def set_clock(self, name: str, offset_s: float) -> None:
        """Set the offset of a process's wall clock from now on."""
        self.children.clock_file(name).write_text(f"{offset_s}\n", encoding="utf-8")

    def signal(self, name: str, number: int) -> int:
        """Send a signal; returns the instant."""
        process = self.process(name).process
        ns = time.monotonic_ns()
        os.kill(process.pid, number)
        return ns

    def break_(self, *what: str) -> int:
        """Break a part of the simulated world from now on; an empty text mends all. Returns the instant."""
        ns = time.monotonic_ns()
        self._witness.sendall(json.dumps(what).encode() + b"\n")
        return ns

    # --- was it right

    def wrongly_taken(self) -> int:
        """Overrides that boards behind wires took though their computers had not sent them, or not in this order, or not as
        often."""
        for robot, wire in self.wires.items():
            taken, given = self.boards[robot].taken, wire.overrides
            at, sent = self._checked[robot]
            while at < len(taken):
                ns, pulses = taken[at]
                match = next((i for i in range(sent, len(given)) if given[i][1] == pulses and given[i][0] <= ns), None)
                self._wrong += match is None
                at, sent = at + 1, sent if match is None else match + 1
            self._checked[robot] = at, sent
        return self._wrong


def moment(random: np.random.Generator) -> float:
    """For how long to fly before an injection, s: so that it falls anywhere within a control period."""
    return float(random.uniform(0.3, 1.0))
