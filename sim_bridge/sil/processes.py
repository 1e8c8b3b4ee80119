"""SHELL: child processes that are watched while they run and never left behind."""

import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from shoal.system import programs

GRACE_S = 5.0  # s between SIGTERM and SIGKILL

# Numerical libraries on one thread: on two cores their thread pools compete, and results depend on their number.
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@dataclass
class Child:
    """A started process; its output is in `log`."""

    name: str
    process: subprocess.Popen[bytes]
    log: Path

    @property
    def exit_code(self) -> int | None:
        """The exit code: None while it runs, negative if a signal ended it."""
        return self.process.poll()

    def explain(self) -> str:
        """Explain a process in one line: exit code or signal, or that it is not ready, with the last line of its output."""
        code = self.exit_code
        if code is None:
            how = "has not got ready"
        else:
            how = f"killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        lines = self.log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        return f"{self.name} {how}{f': {lines[-1]}' if lines and code != 0 else ''}"


@dataclass
class Children:
    log_dir: Path
    clocks: frozenset[str] = frozenset()  # names of processes whose wall clock will be set, by clock_file
    all: list[Child] = field(default_factory=list)

    def start(
        self,
        name: str,
        module: str,
        arguments: Sequence[str],
        environment: Mapping[str, str] | None = None,
        inherits: Sequence[int] = (),
    ) -> Child:
        """Start a program with its output in a log. `inherits`: descriptors of open files that it keeps."""
        self.log_dir.mkdir(parents=True, exist_ok=True)
        if name in self.clocks:
            module, arguments = "sim_bridge.sil.clock_shim", [str(self.clock_file(name)), module, *arguments]
        log = self.log_dir / f"{name}.log"
        with log.open("wb") as output:
            process = programs.start(
                module,
                arguments,
                stdout=output,
                stderr=subprocess.STDOUT,
                more={**ONE_THREAD, **(environment or {})},
                inherits=inherits,
            )
        child = Child(name, process, log)
        self.all.append(child)
        return child

    def clock_file(self, name: str) -> Path:
        """The file with the offset of a process's clock, in seconds."""
        return self.log_dir / f"{name}.clock"

    def ended(self) -> list[Child]:
        return [child for child in self.all if child.exit_code is not None]

    def stop(self) -> None:
        """Ask all to end, last started first; kill those that do not within GRACE_S."""
        running = [child for child in reversed(self.all) if child.exit_code is None]
        for child in running:
            child.process.send_signal(signal.SIGCONT)  # a stopped process would never see the rest
            child.process.terminate()
        deadline = time.monotonic() + GRACE_S
        for child in running:
            try:
                child.process.wait(max(deadline - time.monotonic(), 0.01))
            except subprocess.TimeoutExpired:
                child.process.kill()
                child.process.wait()
