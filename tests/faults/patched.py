"""SHELL: runs one of the programs with a flaw built in that no wire can bring about.

    python -m tests.faults.patched FILE MODULE ARGUMENTS...

The wall clock is off by as many seconds as FILE says. From a signal on, the solver of the quadratic program never returns
(SIGUSR1), takes 30 ms longer (SIGUSR2), or finds no solution (SIGALRM); robot 2 gets none of the orders that this process
sends it, START for 1.2 s from the first one on (START_LATE) or SWITCH for ever (SWITCH_LOST), until SIGHUP; or a thread ends
with an exception (END_THREAD). All else is the program as it is.
"""

import ctypes
import runpy
import signal
import sys
import threading
import time
from pathlib import Path
from types import FrameType
from typing import Any

from robot_agent.control.nonlinear.planner import Planner
from shoal.bus.bus import Bus
from shoal.messages.messages import Command, CommandKind
from sim_bridge.sil import clock_shim

SLOW_S, FOR_EVER_S = 0.03, 1e6
START_LATE, SWITCH_LOST = signal.SIGRTMIN, signal.SIGRTMIN + 1
LOST = {START_LATE: (CommandKind.START, 1.2), SWITCH_LOST: (CommandKind.SWITCH, FOR_EVER_S)}  # s, from the first try on
DEAF_ROBOT = 2
THREADS = ("previews", "recorder", "gatherer")
END_THREAD = {name: signal.SIGRTMIN + 2 + i for i, name in enumerate(THREADS)}


class Ended(BaseException):
    """Ends a thread. No `except Exception` of the thread's work stops it."""


def end_thread(name: str) -> None:
    """Raise an exception in a thread of this process, wherever it is."""
    for thread in threading.enumerate():
        if thread.name == name and thread.ident is not None:
            ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread.ident), ctypes.py_object(Ended))


class Flaws:
    """The faults of this process at present."""

    def __init__(self) -> None:
        self.delay_s = 0.0
        self.unsolved = False
        self.lost: tuple[CommandKind, float] | None = None  # which order does not get through, and for how long, s
        self.first_try_s: float | None = None

    def on_signal(self, number: int, frame: FrameType | None) -> None:
        """Another flaw."""
        self.unsolved |= number == signal.SIGALRM
        self.delay_s = {int(signal.SIGUSR1): FOR_EVER_S, int(signal.SIGUSR2): SLOW_S}.get(number, self.delay_s)
        if number in LOST or number == signal.SIGHUP:
            self.lost, self.first_try_s = LOST.get(number), None
        for name, end in END_THREAD.items():
            if number == end:
                end_thread(name)

    def loses(self, command: Command) -> bool:
        """True if a command is lost now."""
        if self.lost is None or (command.robot, command.order) != (DEAF_ROBOT, self.lost[0]):
            return False
        self.first_try_s = self.first_try_s or time.monotonic()
        return time.monotonic() - self.first_try_s < self.lost[1]

    def install(self) -> None:
        """Build the flaws in."""
        real_planner = Planner.step

        def improve(planner: Any, *problem: Any) -> Any:
            time.sleep(self.delay_s)  # a solver that waits is as late as one that computes
            iteration = real_planner(planner, *problem)
            return iteration._replace(rounds=0) if self.unsolved else iteration

        # an order that is lost on its way: every order of a bus goes through this one method
        real_ask = Bus._ask

        def ask(bus: Bus, key: str, command: Command, stamp_ns: int, timeout_s: float, only_after: int | None = None) -> Any:
            if self.loses(command):
                return 0, lambda: time.sleep(timeout_s)  # nobody answers
            return real_ask(bus, key, command, stamp_ns, timeout_s, only_after)

        Planner.step = improve  # type: ignore[assignment, method-assign]
        # an order that is lost on its way: every order of a bus goes through this one method
        Bus._ask = ask  # type: ignore[assignment, method-assign]
        for number in (signal.SIGUSR1, signal.SIGUSR2, signal.SIGALRM, signal.SIGHUP, *LOST, *END_THREAD.values()):
            signal.signal(number, self.on_signal)


if __name__ == "__main__":
    file, module, *arguments = sys.argv[1:]
    clock_shim.install(Path(file))
    Flaws().install()
    sys.argv = [module, *arguments]
    runpy.run_module(module, run_name="__main__", alter_sys=True)
