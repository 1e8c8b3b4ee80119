"""SHELL: all processes of a lockstep run in this one: `sim-bridge sil NAME --lockstep --one-process`.

The nodes are those of the processes, on a transport in memory; boards and agents pass MAVLink's bytes in lists. No node waits
for another. Where the simulator would wait for the robots' pulses, each of the others makes the step that the tick calls for:

    exposed k ─▶ localizer: poses k     tick k ─▶ station: orders, heartbeat k ─▶ agent 1 ... agent n: pulses k ─▶ plant

So all inputs of a step are there when it begins, and the pulses are bit by bit those of processes. This module is the only one
that may import all other packages.
"""

import gc
import logging
from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import cv2
from rich.console import Console

from groundstation.station import process as station_process
from shoal.bus.bus import Bus, Decode
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.bus.transport import Answer, Urgent
from shoal.config.experiment import Experiment
from shoal.errors import ConfigError
from shoal.messages import topics
from shoal.messages.codec import Header, decode
from shoal.messages.messages import Tick
from shoal.messages.topics import Topic
from shoal.runtime.runtime import Failed, Stop, log, log_handler, speaking
from shoal.runtime.web_access import WebOptions, web_options
from sim_bridge.lockstep.agent import agent_in_lockstep
from sim_bridge.lockstep.localizer import fusion_in_lockstep, localizer_in_lockstep
from sim_bridge.lockstep.station import simulated_time
from sim_bridge.node.board_ports import Address, BoardPorts
from sim_bridge.node.pool import PoolNode
from sim_bridge.sil import launcher
from sim_bridge.sil.commands import GIVE_UP_S, RunOptions
from sim_bridge.sil.monitor import Monitor

PEER: Address = ("memory", 0)  # of every board: its robot's computer
COLLECTED_AT = (20_000, 20, 100)  # objects, some 30 steps' worth, and collections of the younger objects


class SharedDecoder:
    """The codec of all buses of a run: messages are frozen, so one that several nodes read is decoded once."""

    def __init__(self) -> None:
        self._read: dict[int, tuple[bytes, Any]] = {}  # in this tick: payload and message, by the payload's address
        self._before: dict[int, tuple[bytes, Any]] = {}  # in the tick before

    def decode(self, kind: type[Any], payload: bytes, peer: str, topic: str) -> Any:
        """Decode a message, as codec.decode does."""
        entry = self._read.get(id(payload)) or self._before.get(id(payload))
        if entry is None or entry[0] is not payload:
            entry = payload, decode(kind, payload, peer, topic)
        self._read[id(payload)] = entry
        return entry[1]

    def next_tick(self) -> None:
        """Forget the messages that were not read in the last tick."""
        self._before, self._read = self._read, {}


class Part:
    """One node with its own bus and its own log file. `steps` is its loop, which yields after each step."""

    def __init__(self, name: str, hub: MemoryHub, log_dir: Path, closing: ExitStack, decode: Decode = decode) -> None:
        self.name = name
        self.result: Any = None  # of its loop
        self.ended = False
        self._steps: Generator[None, None, Any] | None = None
        stream = closing.enter_context((log_dir / f"{name}.log").open("w", encoding="utf-8"))
        handler = log_handler(name, stream)
        closing.callback(handler.close)
        log.addHandler(handler)
        self.bus = closing.enter_context(Bus(_PartTransport(hub, self), decode=decode))

    @contextmanager
    def acting(self) -> Iterator[None]:
        """Log as this part meanwhile. An exception other than ConfigError becomes Failed, with the part's name."""
        before = speaking.set(self.name)
        try:
            yield
        except (ConfigError, Failed):
            raise
        except Exception as error:
            log.exception("ended by an exception")
            raise Failed(f"{self.name} has ended: {type(error).__name__}: {error}") from error
        finally:
            speaking.reset(before)

    def begin(self, make: Callable[[Bus], Generator[None, None, Any]]) -> None:
        """Make the node and let it come as far as its first step."""
        with self.acting():
            self._steps = make(self.bus)
        self.step()

    def step(self) -> None:
        """Do one step. Its inputs have to be there: nothing arrives meanwhile."""
        assert self._steps is not None, f"{self.name} has not begun"
        with self.acting():
            self.ended, self.result = _next(self._steps)

    def finish(self) -> None:
        """Let the loop come to its end, after a stop was asked for."""
        while self._steps is not None and not self.ended:
            self.step()


def _next(steps: Generator[None, None, Any]) -> tuple[bool, Any]:
    """Resume a generator. Returns whether it has ended, and its result."""
    try:
        next(steps)
    except StopIteration as end:
        return True, end.value
    return False, None


@contextmanager
def _own_log() -> Iterator[None]:
    """Take the logger's handlers away meanwhile, so that only the log files of the parts are written."""
    handlers, level, propagates = log.handlers[:], log.level, log.propagate
    log.handlers.clear()
    log.setLevel(logging.INFO)
    log.propagate = False
    try:
        yield
    finally:
        log.handlers[:] = handlers
        log.setLevel(level)
        log.propagate = propagates


@contextmanager
def _rare_collections() -> Iterator[None]:
    """Look for unreachable cycles rarely, and only among what is made from now on: a step makes hundreds of objects, hardly a
    cycle among them, and the collector would look through all nodes again and again."""
    before = gc.get_threshold()
    gc.collect()
    gc.freeze()
    gc.set_threshold(*COLLECTED_AT)
    try:
        yield
    finally:
        gc.set_threshold(*before)
        gc.unfreeze()


class _PartTransport(MemoryTransport):
    """A part's place on the hub. What it does for an order is its own, in whose step the order may come."""

    def __init__(self, hub: MemoryHub, part: Part) -> None:
        super().__init__(hub)
        self._part = part

    def serve(self, key: str, answer: Answer, urgent: Urgent) -> None:
        def acting(payload: bytes, header: bytes) -> bytes:
            with self._part.acting():
                return answer(payload, header)

        super().serve(key, acting, urgent)


class MemoryWire:
    """The wire between a board's port and its robot's computer; this is the computer's end (shoal/mavlink/board_port.py)."""

    trouble = ""

    def __init__(self) -> None:
        self.to_board: list[bytes] = []
        self.to_computer: list[bytes] = []

    def send(self, data: bytes) -> None:
        self.to_board.append(data)

    def read(self) -> bytes:
        data = b"".join(self.to_computer)
        self.to_computer.clear()
        return data

    def wait(self, timeout_s: float) -> None:
        raise RuntimeError("waits for its board, which says nothing until the step is over")

    def close(self) -> None:
        """Do nothing: nothing is open."""


class MemoryPort:
    """The board's end of a wire."""

    def __init__(self, wire: MemoryWire) -> None:
        self._wire = wire

    def read(self) -> list[tuple[bytes, Address]]:
        datagrams = [(data, PEER) for data in self._wire.to_board]
        self._wire.to_board.clear()
        return datagrams

    def hear(self, peer: Address, now_ns: int) -> None:
        """Do nothing: there is one peer, and it stays."""

    def send(self, data: bytes, now_ns: int) -> None:
        self._wire.to_computer.append(data)


class MemoryPorts(BoardPorts):
    """The boards' ports. Instead of waiting for the agents' datagrams they call `step_others`, in which agents send them."""

    all_heard = True

    def __init__(self, wires: list[MemoryWire], robots: tuple[int, ...], seed: int, step_others: Callable[[], None]) -> None:
        super().__init__([MemoryPort(wire) for wire in wires], robots, seed)
        self._step_others = step_others

    def forget(self) -> None:
        """Do nothing: no datagram is ever left waiting."""

    def wait(self, timeout_s: float) -> None:
        self._step_others()

    def close(self) -> None:
        """Do nothing: nothing is open."""


class Executor:
    """A lockstep run of all nodes of an experiment in this process."""

    def __init__(
        self, experiment: Experiment, run_dir: Path, hub: MemoryHub, *, poses: bool = False, pace: float | None = None
    ) -> None:
        """Prepare a run into the existing folder `run_dir`. Others may listen at the `hub`. With `poses` there is no
        localizer: the simulator publishes poses in its place. `pace`: at most this many times real time."""
        self.stop = Stop(install=False)
        self._experiment, self._run_dir, self._hub = experiment, run_dir, hub
        self._poses, self._pace = poses, pace
        self._each_tick: Callable[[], None] = lambda: None
        self._decoder = SharedDecoder()
        self._ticked = False
        self._exposed: Tick | None = None
        self._station: Part
        self._localizers: dict[str, Part] = {}  # by camera; "" is the only one's, or what fuses the others' poses
        self._frames_ns: tuple[int, ...] = ()  # of several cameras, stamps of the frames that were localized in
        self._agents: list[Part] = []

    def fly(
        self,
        each_tick: Callable[[], None] = lambda: None,
        *,
        automatic: bool = True,
        page: str | None = None,
        came_up: Callable[[], None] = lambda: None,
    ) -> bool:
        """Fly to the end of the mission, or until `stop` is requested; `each_tick` is called after every control step, `page`
        is where the operator's page is served (HOST:PORT), `came_up` is called when it is. Returns whether the mission
        succeeded.

        Raises ConfigError if the station refuses the experiment, Failed with its name if a part of the run has ended.
        """
        self._each_tick, self._came_up = each_tick, came_up
        cv2.setNumThreads(1)
        log_dir = self._run_dir / "logs"
        log_dir.mkdir(exist_ok=True)
        with ExitStack() as closing:
            closing.enter_context(_own_log())

            parts: list[Part] = []

            def make_part(name: str) -> Part:
                parts.append(Part(name, self._hub, log_dir, closing, self._decoder.decode))
                return parts[-1]

            listener = closing.enter_context(Bus(MemoryTransport(self._hub)))
            listener.subscribe(topics.TICK, None, lambda *_: setattr(self, "_ticked", True))
            listener.subscribe(topics.EXPOSED, None, self._note_exposed)
            try:
                self._run_all(make_part, automatic, web_options(page) if page is not None else None)
            finally:  # also of a run that breaks: a localizer that is not finished has a thread, which keeps the program
                self.stop.request()
                for one in parts:
                    one.finish()  # the station closes the log
            self.stop.raise_failure()
        return bool(self._station.result)

    def _run_all(self, make_part: Callable[[str], Part], automatic: bool, web: WebOptions | None) -> None:
        """Begin station, localizers and agents, then run the simulator to its end. Where it waits for the others' tick, it
        calls `_step_others` (MemoryPorts)."""
        experiment = self._experiment
        self._station = make_part("groundstation")
        self._station.begin(lambda bus: self._cycles(bus, automatic, web))
        self._came_up()
        for camera in () if self._poses else (*experiment.camera_names, ""):
            self._localizers[camera] = make_part(topics.localizer_name(camera))
            self._localizers[camera].begin(lambda bus, c=camera: self._localizer(bus, c))  # type: ignore[misc]
        wires = [MemoryWire() for _ in experiment.robot_ids]
        for robot, wire in zip(experiment.robot_ids, wires, strict=True):
            agent = make_part(f"agent-{robot}")
            self._agents.append(agent)
            agent.begin(lambda bus, r=robot, w=wire: agent_in_lockstep(experiment, r, bus, w, self.stop).steps())  # type: ignore[misc]
        ports = MemoryPorts(wires, experiment.robot_ids, experiment.seed, self._step_others)
        pool = make_part("sim-bridge")
        with _rare_collections(), pool.acting():
            PoolNode(experiment, pool.bus, ports, self.stop, True, self._poses, pace=self._pace).run()

    def _cycles(self, bus: Bus, automatic: bool, web: WebOptions | None) -> Generator[None, None, bool]:
        options = station_process.StationOptions(automatic, GIVE_UP_S, web)
        owner = simulated_time(bus, self.stop)
        return station_process.cycles(self._experiment, bus, self._run_dir, options, self.stop, owner)

    def _localizer(self, bus: Bus, camera: str) -> Generator[None]:
        if self._experiment.cameras and not camera:
            return fusion_in_lockstep(self._experiment, bus, self.stop).steps()
        return localizer_in_lockstep(self._experiment, bus, self.stop, camera).steps()

    def _note_exposed(self, topic: Topic, key: str, header: Header, payload: bytes) -> None:
        self._exposed = decode(Tick, payload, "sim-bridge", key)

    def _localize(self, exposed: Tick) -> None:
        """Step the localizer of each camera that has a new frame, and then the fusion of their poses."""
        before = self._frames_ns or (-1,) * len(exposed.frames_ns)
        self._frames_ns = exposed.frames_ns
        has_new_frame = [new_ns > old_ns for new_ns, old_ns in zip(exposed.frames_ns, before, strict=True)]
        for localizer, is_due in zip(self._localizers.values(), [*has_new_frame, True], strict=False):  # the last one fuses
            if is_due:
                localizer.step()

    def _step_others(self) -> None:
        """Do the step of every node but the simulator, for the tick that it has published."""
        if not self._ticked:
            raise RuntimeError("the simulator waits, but not for a step")
        if self._exposed is not None:
            self._localize(self._exposed)
        self._ticked, self._exposed = False, None
        self._decoder.next_tick()
        self._station.step()
        if self._station.ended:
            self.stop.request()
            return
        for agent in self._agents:
            agent.step()
        self._each_tick()


def run(experiment: Experiment, run_dir: Path, options: RunOptions, stop: Stop, console: Console) -> int:
    """Run an experiment in this process, after `commands.check`. Folder, verdict and exit code are those of `launcher.run`."""
    launcher.write_experiment(experiment, run_dir)
    log_file, succeeded = run_dir / "run.mcap", False
    try:
        succeeded = fly(experiment, run_dir, options, stop, console)
    except (ConfigError, Failed) as error:
        launcher.print_error(console, str(error))
        if isinstance(error, ConfigError) and not log_file.exists():
            return launcher.nothing_flown(run_dir, console)
    return launcher.conclude(run_dir, log_file.exists(), succeeded, stop, console)


def fly(experiment: Experiment, run_dir: Path, options: RunOptions, stop: Stop, console: Console) -> bool:
    """Fly an experiment in this process into a folder that holds it. Returns whether the mission succeeded; raises as
    `Executor.fly`."""
    hub = MemoryHub()
    executor = Executor(experiment, run_dir, hub, poses=options.poses, pace=options.pace)
    monitor = Monitor(experiment, Bus(MemoryTransport(hub)), options.pace)
    stop.on_request(lambda: executor.stop.request(stop.interrupted))
    with monitor.shown(console) as say:
        print_address = partial(launcher.tell_page, options.page, console) if options.page is not None else lambda: None
        return executor.fly(say, automatic=not options.manual, page=options.page, came_up=print_address)
