"""SHELL: applies the fault timeline to processes, and undoes it: kills, stops, fills a disk, sets clocks."""

import resource
import signal
import time

from shoal.bus.bus import Bus
from shoal.config.experiment import Experiment
from shoal.config.fault_injection import OF_PROCESSES, Fault
from shoal.messages import topics
from shoal.messages.messages import Event
from shoal.runtime.runtime import WallClock
from sim_bridge.sil.processes import Child, Children

INFO = 2  # an event's level
LOG = "run.mcap"  # the file whose growth a full disk stops


class ProcessFaultInjector:
    """The timeline's faults of processes, applied to the children of one run."""

    def __init__(self, experiment: Experiment, children: Children, bus: Bus) -> None:
        self._faults = [fault for fault in experiment.sim.faults if fault.broken.kind in OF_PROCESSES]
        self._waiting: list[Fault] = []  # faults of this flight that are to come
        self._broken: list[Fault] = []  # faults that hold now
        self._children, self._bus, self._clock = children, bus, WallClock()
        self._began_ns, self._start_s = 0, 0.0  # of the newest flight: on the station's clock, and the monotonic one
        self.killed: set[str] = set()  # processes whose end is intended

    def act(self, began_ns: int, time_s: float | None) -> None:
        """Apply and undo the faults that are due. A flight that began, or will begin, at `began_ns` on the station's clock,
        `time_s` ago, starts the timeline anew; it then runs by the monotonic clock, as the station may be what breaks."""
        now_s = time.monotonic()
        if time_s is not None and began_ns not in (0, self._began_ns):
            self._began_ns, self._start_s = began_ns, now_s - time_s
            self._waiting = [fault for fault in self._faults if fault.broken.process not in self.killed]
        if not self._began_ns:
            return
        time_s = now_s - self._start_s
        for fault in [f for f in self._broken if not f.holds(time_s) and f.broken.effect != "killed"]:
            self._broken.remove(fault)
            self._act(fault, undo=True)
        self._waiting = [fault for fault in self._waiting if fault not in self._broken]
        for fault in [f for f in self._waiting if f.at_s <= time_s]:
            self._waiting.remove(fault)
            self._broken.append(fault)
            self._act(fault, undo=False)

    def _act(self, fault: Fault, undo: bool) -> None:
        """Begin a fault, or undo it, and say so. While another of its kind lasts, undoing goes back to that one."""
        if fault.broken.effect == "killed":
            self.killed.add(fault.broken.process)
        what = fault.broken.kind, fault.broken.process
        alike = [other for other in self._broken if undo and (other.broken.kind, other.broken.process) == what]
        self._apply(alike[-1] if alike else fault, undo and not alike)
        text = f"fault over: {fault.what}" if undo else f"fault: {fault.what}"
        self._bus.publish(topics.EVENT, Event(INFO, "sim-bridge", text), self._clock.now_ns())

    def _apply(self, fault: Fault, undo: bool) -> None:
        """Break a child process, its disk or its clock, or undo that."""
        broken = fault.broken
        for child in self._children.all:
            if child.exit_code is None and child.name == (broken.process or "groundstation"):
                match broken.kind:
                    case "process":
                        self._signal(child, broken.effect, undo)
                    case "disk":
                        self._fill(child, undo)
                    case "clock":
                        offset_s = 0.0 if undo else broken.value
                        self._children.clock_file(child.name).write_text(f"{offset_s}\n", encoding="utf-8")

    def _signal(self, child: Child, effect: str, undo: bool) -> None:
        child.process.send_signal(signal.SIGCONT if undo else signal.SIGKILL if effect == "killed" else signal.SIGSTOP)

    def _fill(self, child: Child, undo: bool) -> None:
        """Keep the log from growing: to its writer that is a full disk, except for the error's number."""
        _, most = resource.prlimit(child.process.pid, resource.RLIMIT_FSIZE)
        log = self._children.log_dir.parent / LOG
        allowed = most if undo or not log.exists() else log.stat().st_size
        resource.prlimit(child.process.pid, resource.RLIMIT_FSIZE, (allowed, most))
