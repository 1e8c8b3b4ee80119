"""SHELL: compile all kernels of a package once for a machine, in processes of their own, under a lock, with progress.

A program that starts others calls `ensure_compiled` first. Any other program needs no call: the first kernel that it imports
and does not find has its package compiled (`build_package_of`). Whoever comes second waits, and says so.
"""

import fcntl
import json
import os
import platform
import re
import selectors
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import IO, Any, NamedTuple

from shoal.kernels import cache as kernel_cache
from shoal.system import programs

PACKAGES = ("robot_agent", "localizer", "sim_bridge")  # those with kernels
WORKER = "SHOAL_KERNEL_WORKER"  # set in a process that compiles

WORKER_MB = 500.0  # memory of a process that compiles the kernels of one package (measured: 440)
SHARE = 0.6  # of the free memory: a process that has grown beyond it ends, and the next module goes to another
SAY_EVERY_S = 10.0  # where stderr is no terminal
LOOK_EVERY_S = 0.2
WIDTH = 30  # characters of the bar

_built: set[str] = set()  # packages that this process has had compiled: a kernel that is missing then cannot be kept


class Compilation(NamedTuple):
    """Result of `ensure_compiled`."""

    compiled: int  # kernels that were missing
    is_complete: bool  # all are there now, and stay there


def ensure_compiled(packages: tuple[str, ...] = PACKAGES) -> Compilation:
    """Compile the kernels of packages that are missing, before anything that needs them starts."""
    if os.environ.get("NUMBA_DISABLE_JIT") == "1":
        return Compilation(0, True)
    return _build(packages, _is_complete)


def is_worker() -> bool:
    """True in a process that compiles for others."""
    return WORKER in os.environ


def build_package_of(file: str, source: str) -> bool:
    """Compile the package of a kernel whose `file` is missing. Returns False if its caller has to compile it: a worker, a
    kernel of no package of ours, or one that could not be kept the last time."""
    package = file.partition(".")[0]
    ours = package in PACKAGES and Path(source).is_relative_to(kernel_cache.ROOT / package)
    if not ours or package in _built or is_worker():
        return False
    _build((package,), lambda _: any((folder / file).exists() for folder in kernel_cache.readable_folders()))
    return True


def _build(packages: tuple[str, ...], is_done: Callable[[str], bool]) -> Compilation:
    """Compile the kernels of packages, unless it is done: one program at a time does it for all."""
    if all(map(is_done, packages)):
        return Compilation(0, True)
    _built.update(packages)
    try:
        with _locked() as lock:
            missing = [package for package in packages if not is_done(package)]
            return Build(missing, lock).run() if missing else Compilation(0, True)
    except OSError as error:  # no lock, or no process, can be had
        print(f"kernels cannot be compiled once for all programs: {error}", file=sys.stderr)
        return Compilation(0, False)


@contextmanager
def _locked() -> Iterator[IO[str]]:
    """The lock under which kernels are compiled, on this machine and folder. It ends with its holder and the holder's
    workers, however they end. Its file says how far they are."""
    path = kernel_cache.folder() / "lock"
    with path.open("a+", encoding="utf-8") as lock:
        progress = CompileProgress(0)
        while True:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                text = path.read_text(encoding="utf-8")
                progress.say("waiting for another program that compiles the kernels" + (f": {text}" if text else ""))
                time.sleep(LOOK_EVERY_S)
        progress.end()
        lock.truncate(0)
        yield lock


class CompileProgress:
    """One line that is renewed on a terminal, or a line now and then where stderr is none."""

    def __init__(self, kernels: int) -> None:
        self._kernels = kernels
        self._ready = 0
        self.compiled = 0
        self._began_s = time.monotonic()
        self._due_s = 0.0
        self._drawn = False

    def advance(self, kernels: int, compiled: bool) -> str:
        """Count kernels that are ready, and show how far that is."""
        self._ready = min(self._ready + kernels, self._kernels)
        self.compiled += kernels if compiled else 0
        if not self.compiled:  # they lie in the cache: nothing to wait for
            return ""
        left_s = (time.monotonic() - self._began_s) * (self._kernels - self._ready) / self.compiled
        text = f"{self._ready} of {self._kernels} kernels compiled, about {left_s:.0f} s left, only this time"
        hashes = "#" * (WIDTH * self._ready // self._kernels)
        self.say(f"[{hashes:-<{WIDTH}}] {text}" if sys.stderr.isatty() else text)
        return text

    def say(self, text: str) -> None:
        """Show a line, on a terminal over the last one."""
        if sys.stderr.isatty():
            print(f"\r{text}\x1b[K", end="", file=sys.stderr, flush=True)
            self._drawn = True
        elif time.monotonic() >= self._due_s:
            print(text, file=sys.stderr, flush=True)
            self._due_s = time.monotonic() + SAY_EVERY_S

    def end(self) -> None:
        """Remove the line from a terminal, and say what was done."""
        if self._drawn:
            print("\r\x1b[K", end="", file=sys.stderr)
        if self.compiled:
            took_s = time.monotonic() - self._began_s
            print(f"{self.compiled} kernels compiled in {took_s:.0f} s, into {kernel_cache.folder()}", file=sys.stderr)


class Build:
    """One compilation of all kernels of packages."""

    def __init__(self, packages: list[str], lock: IO[str]) -> None:
        self._lock = lock
        self._sources = {package: _kernel_modules(package) for package in packages}
        self._state = {package: _sources_state(modules.values()) for package, modules in self._sources.items()}
        self._files: set[str] = set()
        texts = (path.read_text(encoding="utf-8") for modules in self._sources.values() for path in modules.values())
        self._progress = CompileProgress(sum(len(re.findall(r"^@kernel\b", text, re.MULTILINE)) for text in texts))

    def run(self) -> Compilation:
        """Compile, in two processes where there are processors and memory for them, and write down that it is done."""
        free_mb = free_memory_mb()
        together = (os.cpu_count() or 1) > 1 and free_mb > 2.0 * WORKER_MB
        first = [module for package in self._sources if package == PACKAGES[0] for module in self._sources[package]]
        rest = [module for package in self._sources if package != PACKAGES[0] for module in self._sources[package]]
        succeeded = together and self._compile([first, rest], WORKER_MB)
        succeeded = succeeded or self._compile([first + rest], SHARE * free_mb)  # what is left: one was too large for two
        self._progress.end()
        for package in self._sources if succeeded else ():
            self._write_down(package)
        if not succeeded:
            print("not all kernels could be compiled: each program compiles those that it misses", file=sys.stderr)
        return Compilation(self._progress.compiled, succeeded and kernel_cache.folder_lasts())

    def _compile(self, queues: list[list[str]], limit_mb: float) -> bool:
        """Have each queue of modules compiled by processes one after the other. Returns False if one of them failed."""
        workers: dict[subprocess.Popen[bytes], list[str]] = {}
        with selectors.DefaultSelector() as ready:
            try:
                for queue in filter(None, queues):
                    self._start(queue, limit_mb, workers, ready)
                while workers:
                    for key, _ in ready.select():
                        self._take_report(key.data, limit_mb, workers, ready)
            except ChildProcessError:
                return False
            finally:
                for worker in workers:
                    worker.kill()
                    worker.wait()
        return True

    def _start(self, queue: list[str], limit_mb: float, workers: dict[Any, list[str]], ready: selectors.BaseSelector) -> None:
        """Start a worker that compiles the modules of a queue, with this process's import path."""
        around = {WORKER: "1", "PYTHONPATH": os.pathsep.join([*filter(None, sys.path), str(kernel_cache.ROOT)])}
        words = [str(limit_mb), *queue]
        worker = programs.start(
            "shoal.kernels.worker", words, stdout=subprocess.PIPE, more=around, inherits=[self._lock.fileno()]
        )
        assert worker.stdout is not None
        workers[worker] = queue
        ready.register(worker.stdout, selectors.EVENT_READ, worker)

    def _take_report(self, worker: Any, limit_mb: float, workers: dict[Any, list[str]], ready: selectors.BaseSelector) -> None:
        """Take up one report of a worker, or its end; what an early end has left, another worker goes on with."""
        line = _line(worker.stdout.fileno())
        if line:
            report = json.loads(line)
            if "module" in report:
                workers[worker].remove(report["module"])
            is_new = report.get("file") not in self._files  # a module imports kernels that an earlier process has compiled
            if "file" in report:
                self._files.add(report["file"])
            text = self._progress.advance(report["kernels"] if is_new else 0, report.get("compiled", False))
            with suppress(OSError):  # a full disk
                self._lock.truncate(0)
                self._lock.write(text)
                self._lock.flush()
            return
        ready.unregister(worker.stdout)
        queue = workers.pop(worker)
        if worker.wait() != 0:
            raise ChildProcessError
        if queue:
            self._start(queue, limit_mb, workers, ready)

    def _write_down(self, package: str) -> None:
        """Record that all kernels of a package are there: of which machine and sources, and in which files."""
        files = [name for name in sorted(self._files) if name.startswith(f"{package}.")]
        record = {"machine": _machine(), "sources": self._state[package], "files": files}
        try:
            _record(kernel_cache.folder(), package).write_text(json.dumps(record), encoding="utf-8")
        except OSError as error:
            print(f"{error.filename}: {error.strerror}", file=sys.stderr)


def _line(descriptor: int) -> bytes:
    """The next line of a pipe, and no byte more, which would wait unseen in a buffer; empty at its end."""
    line = b""
    while not line.endswith(b"\n") and (byte := os.read(descriptor, 1)):
        line += byte
    return line


def _is_complete(package: str) -> bool:
    """True if all kernels of a package lie on this machine, by the record of their last compilation: the sources and the
    compiler have not changed since, and each file is there. Takes milliseconds."""
    for folder in kernel_cache.readable_folders():
        try:
            record = json.loads(_record(folder, package).read_text(encoding="utf-8"))
            state = _sources_state([Path(path) for path in record["sources"]])
            if (
                record["machine"] == _machine()
                and record["sources"] == state
                and all(kernel_cache.read(name) for name in record["files"])
            ):
                return True
        except (OSError, ValueError, KeyError, TypeError):
            continue
    return False


def _record(folder: Path, package: str) -> Path:
    return folder / f"{package}.{sys.implementation.cache_tag}.json"


def _sources_state(paths: Any) -> dict[str, list[int]]:
    """Size and time of the sources of kernels, and of the compiler."""
    compiler = [Path(str(spec.origin)).with_name("_version.py") for name in ("numba", "llvmlite") if (spec := find_spec(name))]
    stats = {str(path): path.stat() for path in [*paths, *compiler]}
    return {path: [stat.st_size, stat.st_mtime_ns] for path, stat in stats.items()}


def _machine() -> str:
    """Interpreter and processor, on which machine code depends besides its source."""
    chosen = [f"{key}={value}" for key, value in sorted(os.environ.items()) if key.startswith("NUMBA_CPU")]
    facts = [sys.version, platform.machine(), *chosen]
    processor = _lines("/proc/cpuinfo") or [f"CPU {platform.processor()}"]
    kinds = ("model", "vendor", "flags", "Features", "CPU")
    return "\n".join(dict.fromkeys([*facts, *(line for line in processor if line.startswith(kinds))]))


def _kernel_modules(package: str) -> dict[str, Path]:
    """Modules of a package with kernels, by their names; what others import comes before them."""
    root = kernel_cache.ROOT
    modules = {".".join(path.relative_to(root).with_suffix("").parts): path for path in sorted((root / package).rglob("*.py"))}
    ordered: dict[str, Path] = {}
    visited: set[str] = set()

    def visit(module: str) -> None:
        """Add a module that has kernels, after those that it imports."""
        if module in visited or module not in modules:
            return
        visited.add(module)
        text = modules[module].read_text(encoding="utf-8")
        for source, names in re.findall(r"^ *(?:from|import) ([\w.]+)(?: import (.+))?$", text, re.MULTILINE):
            for name in [source, *(f"{source}.{name.strip()}" for name in names.split(","))]:
                visit(name)
        if re.search(r"^@kernel\b", text, re.MULTILINE):
            ordered[module] = modules[module]

    for module in modules:
        visit(module)
    return ordered


def free_memory_mb() -> float:
    """Memory that this process and its children may still take."""
    limits = [float(line.split()[1]) / 1024.0 for line in _lines("/proc/meminfo") if line.startswith("MemAvailable:")]
    for line in _lines("/proc/self/cgroup"):
        _, kind, group = line.rstrip().split(":", 2)
        if kind == "memory":
            folder, limit, usage = f"/sys/fs/cgroup/memory{group}", "memory.limit_in_bytes", "memory.usage_in_bytes"
        elif kind == "":
            folder, limit, usage = f"/sys/fs/cgroup{group}", "memory.max", "memory.current"
        else:
            continue
        values = [value for name in (limit, usage) for value in _lines(f"{folder}/{name}")]
        if len(values) == 2 and values[0].strip().isdecimal():
            limits.append((int(values[0]) - int(values[1])) / 2**20)
    return min(limits, default=4.0 * WORKER_MB)


def _lines(path: str) -> list[str]:
    """Lines of a text file; none if it cannot be read."""
    try:
        return Path(path).read_text(encoding="utf-8").splitlines()
    except OSError:
        return []


if __name__ == "__main__":
    sys.exit(not ensure_compiled().is_complete)
