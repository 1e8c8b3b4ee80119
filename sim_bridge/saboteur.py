"""SHELL: kills and stops processes as the fault timeline says, and lets the stopped ones go on."""

import signal
import time

from sim_bridge.processes import Children
from wire import topics
from wire.bus import Bus
from wire.experiment import Experiment
from wire.faults import Fault
from wire.messages import Event
from wire.runtime import WallClock

INFO = 2  # an event's level


class Saboteur:
    """The timeline's process faults, against the children of one run. Others lose whom they need: that is the point."""

    def __init__(self, experiment: Experiment, children: Children, bus: Bus) -> None:
        self._waiting = [fault for fault in experiment.sim.faults if fault.broken.kind == "process"]
        self._stopped: list[Fault] = []
        self._children, self._bus, self._clock = children, bus, WallClock()
        self._start_s: float | None = None
        self.killed: set[str] = set()  # whose end is no trouble

    def act(self, flown_s: float) -> None:
        """Do what is due. `flown_s` along the trajectories starts the clock; then it runs, whoever has stopped."""
        now_s = time.monotonic()
        if self._start_s is None and flown_s > 0.0:
            self._start_s = now_s - flown_s
        if self._start_s is None:
            return
        time_s = now_s - self._start_s
        for fault in [f for f in self._waiting if f.at_s <= time_s]:
            self._waiting.remove(fault)
            kill = fault.broken.effect == "killed"
            if kill:
                self.killed.add(fault.broken.process)
            elif fault.for_s is not None:
                self._stopped.append(fault)
            self._signal(fault, signal.SIGKILL if kill else signal.SIGSTOP, f"fault: {fault.what}")
        for fault in [f for f in self._stopped if not f.holds(time_s)]:
            self._stopped.remove(fault)
            self._signal(fault, signal.SIGCONT, f"fault over: {fault.what}")

    def _signal(self, fault: Fault, number: signal.Signals, text: str) -> None:
        for child in self._children.all:
            if child.name == fault.broken.process and child.exit_code is None:
                child.process.send_signal(number)
        self._bus.publish(topics.EVENT, Event(INFO, "sim-bridge", text), self._clock.now_ns())
