"""The parts that all benchmarks share: a row, a fair stopwatch, and environments for peers outside our dependencies.

Standard library only: peers import this file from environments that have nothing else of ours.
"""

import gc
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
PEERS = ROOT / "benchmarks" / "peers"
ENVIRONMENTS = ROOT / ".bench-venv"


@dataclass(frozen=True)
class Row:
    """One measured figure. `subject` is `ours`, a variant of ours, or a peer's name."""

    benchmark: str
    case: str
    subject: str
    unit: str
    p50: float
    p99: float
    max: float
    n: int
    target: str = ""  # for `ours`, in the unit

    @classmethod
    def of(cls, benchmark: str, case: str, subject: str, unit: str, samples: Iterable[float], target: str = "") -> "Row":
        """The row of some samples. Percentiles are samples that occurred (nearest rank), never interpolated."""
        ranked = sorted(samples)
        n = len(ranked)
        if not n:
            raise ValueError(f"{benchmark}, {case}, {subject}: no samples")

        def percentile(p: int) -> float:
            return ranked[max(-(-p * n // 100), 1) - 1]  # ceil(p n / 100), counted from 1

        return cls(benchmark, case, subject, unit, percentile(50), percentile(99), ranked[-1], n, target)

    def as_dict(self) -> dict[str, Any]:
        """The row as a dictionary for JSON."""
        return asdict(self)


def time_us(call: Callable[[], object], n: int, warm_up: int | None = None) -> list[float]:
    """Microseconds that each of `n` calls took, after a tenth as many unmeasured ones.

    The garbage collector is off meanwhile: its pauses belong to whoever made the garbage, not to whoever is measured next.
    """
    for _ in range(max(n // 10, 1) if warm_up is None else warm_up):
        call()
    samples = []
    gc.collect()
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        for _ in range(n):
            start = time.perf_counter_ns()
            call()
            samples.append((time.perf_counter_ns() - start) * 1e-3)
    finally:
        if was_enabled:
            gc.enable()
    return samples


def peer_python(name: str, requirements: Sequence[str]) -> Path:
    """Interpreter of the peer's own environment, made on first use and again when its requirements change."""
    home = ENVIRONMENTS / name
    python, stamp = home / "bin" / "python", home / "requirements.txt"
    text = "".join(f"{line}\n" for line in requirements)
    if not (stamp.is_file() and stamp.read_text() == text):
        print(f"installing {', '.join(requirements)} into {home.relative_to(ROOT)} ...", file=sys.stderr)
        subprocess.run([sys.executable, "-m", "venv", "--clear", str(home)], check=True)
        install = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *requirements]
        subprocess.run(install, check=True, stdin=subprocess.DEVNULL)
        stamp.write_text(text)
    return python


def run_peer(name: str, requirements: Sequence[str], task: object, timeout_s: float = 600.0) -> list[Row]:
    """Run benchmarks/peers/NAME.py in its own environment and return the rows it prints.

    The script reads `task` as JSON from its standard input; the last line it prints is a JSON list of rows (solvers like to
    introduce themselves). A peer that cannot be installed
    or fails is reported on stderr and left out: no network must not mean no benchmark.
    """
    try:
        result = subprocess.run(
            [str(peer_python(name, requirements)), str(PEERS / f"{name}.py")],
            input=json.dumps(task),
            capture_output=True,
            text=True,
            timeout=timeout_s,
            check=False,
            cwd=ROOT,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )
    except (subprocess.SubprocessError, OSError) as error:
        print(f"peer {name} not measured: {error}", file=sys.stderr)
        return []
    if result.returncode != 0:
        print(f"peer {name} not measured: it ended with {result.returncode}: {result.stderr.strip()}", file=sys.stderr)
        return []
    return [Row(**row) for row in json.loads(result.stdout.splitlines()[-1])]
