"""SHELL: `make soak`: flies for hours while things break at random, and looks for what only time brings out: memory, handles
or threads that grow, control that slows down, numbers that are not finite.

    python -m tests.faults.soak --hours 2

Half of the time passes in lockstep with random timelines of faults, half by the wall clock with the injections of `make
faults`.
"""

import argparse
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import psutil
from rich.console import Console
from rich.table import Table

from groundstation.runlog import read_log
from tests.faults.rig import Rig, Stuck, moment
from tests.faults.table import ROWS
from wire.experiment import load_experiment
from wire.frames import Array
from wire.messages import Mode

SAMPLE_S = 5.0
IN_WATER = ("thruster {r}/{t} dead", "thruster {r}/{t} stuck", "thruster {r}/{t} reversed", "thruster {r}/{t} weak {f}",
            "imu {r} heading {f}", "imu {r} gyro {f}", "battery {r} sag {f}")  # fmt: skip
ON_WIRES = (
    "link {r} noisy {f}",
    "link {r} slow {d}",
    "camera frozen",
    "camera glare {f}",
    "camera occluded {f}",
    "marker {r} lost",
)
# Growth from the second quarter of the samples to the last that is no leak: allocators and caches move by as much.
MAY_GROW = {"memory MB": 8.0, "handles": 3.0, "threads": 3.0, "latency ms": 5.0}


def random_faults(
    random: np.random.Generator, robots: tuple[int, ...], duration_s: float, count: int = 6, kinds: tuple[str, ...] = IN_WATER
) -> list[str]:
    """Lines for `--fault`."""
    lines = []
    for _ in range(count):
        what = kinds[int(random.integers(len(kinds)))].format(
            r=int(random.choice(robots)),
            t=int(random.integers(1, 5)),
            f=round(float(random.uniform(0.05, 0.9)), 2),
            d=round(float(random.uniform(0.01, 0.1)), 3),
        )
        lines.append(f"t={random.uniform(0, duration_s):.1f} for={random.uniform(0.5, 8):.1f} {what}")
    return lines


@dataclass(frozen=True)
class Trend:
    """How a quantity went."""

    who: str
    what: str
    first: float
    last: float
    per_hour: float

    @property
    def steady(self) -> bool:
        """Whether it stayed what it was."""
        return self.last - self.first <= MAY_GROW[self.what]


@dataclass
class Watch:
    """Samples of every process, by name and pid: one that is started anew begins anew."""

    samples: dict[tuple[str, int, str], list[tuple[float, float]]] = field(default_factory=dict)

    def look(self, processes: Mapping[str, int]) -> None:
        """Sample those that run."""
        for name, pid in processes.items():
            try:
                process = psutil.Process(pid)
                values = {
                    "memory MB": process.memory_info().rss / 1e6,
                    "handles": float(process.num_fds()),
                    "threads": float(process.num_threads()),
                }
            except psutil.Error:  # it has ended meanwhile
                continue
            for what, value in values.items():
                self.note(name, pid, what, value)

    def note(self, name: str, pid: int, what: str, value: float) -> None:
        """One sample."""
        self.samples.setdefault((name, pid, what), []).append((time.monotonic(), value))

    def trends(self) -> list[Trend]:
        """Of each process the life with the most samples; eight at least, or there is no trend."""
        longest: dict[tuple[str, str], list[tuple[float, float]]] = {}
        for (name, _, what), series in self.samples.items():
            if len(series) >= max(8, len(longest.get((name, what), ()))):
                longest[name, what] = series
        return [_trend(name, what, np.array(series)) for (name, what), series in sorted(longest.items())]


def _trend(who: str, what: str, series: Array) -> Trend:
    """Of samples (n, 2) of time and value, without the first quarter: a start is no leak."""
    quarter = len(series) // 4
    settled = series[quarter:]
    slope = float(np.polyfit(settled[:, 0] - settled[0, 0], settled[:, 1], 1)[0]) * 3600.0
    return Trend(who, what, float(np.median(series[quarter : 2 * quarter, 1])), float(np.median(series[-quarter:, 1])), slope)


# --- by the wall clock


def real_time(hours: float, seed: int, watch: Watch, say: Callable[[str], None]) -> list[str]:
    """Injections of the fault matrix, in a random order, into one lab. Returns what went wrong."""
    random, end_s, trouble = np.random.default_rng(seed), time.monotonic() + hours * 3600.0, []
    rows = [row for row in ROWS if row.rig == "lab" and row.key != "flood"]
    with Rig(seed=seed) as rig:
        seen_s = 0.0
        while time.monotonic() < end_s:
            try:
                rig.cruise(moment(random))
                if time.monotonic() - seen_s > SAMPLE_S:
                    seen_s = time.monotonic()
                    watch.look({child.name: child.process.pid for child in rig.children.all})
                    watch.note("robots", 0, "latency ms", _latency_ms(rig))
                if random.random() < 0.3:
                    rows[int(random.integers(len(rows)))].inject(rig, random)
                else:
                    time.sleep(SAMPLE_S)
            except Stuck as error:
                trouble.append(str(error))
                say(f"stuck: {error}")
                if len(trouble) > 3:
                    break
        watch.look({child.name: child.process.pid for child in rig.children.all})
        trouble += [f"{rig.wrongly_taken()} commands wrongly taken"] if rig.wrongly_taken() else []
        trouble += [f"{rig.not_finite} times numbers in the water were not finite"] if rig.not_finite else []
        log = rig.run_dir / "run.mcap"
    return trouble + _unreadable(log)


def _latency_ms(rig: Rig) -> float:
    """Median from exposure to pulses, of the last 200 states of every robot that tracked."""
    recent = [heard.state for states in rig.states.values() for heard in list(states)[-200:]]
    return float(np.median([s.exposure_to_pwm_ms for s in recent if s.mode is Mode.TRACKING]))


# --- in lockstep


def lockstep(hours: float, seed: int, watch: Watch, say: Callable[[str], None]) -> list[str]:
    """Flights of ten simulated minutes, one after the other, and within each a fault every half a minute."""
    random, end_s, trouble = np.random.default_rng(seed), time.monotonic() + hours * 3600.0, []
    while time.monotonic() < end_s:
        name = ("pool", "figure-eight")[int(random.integers(2))]
        duration_s = min(600.0, max(20.0, (end_s - time.monotonic()) * 2.0))
        robots = load_experiment(name).robot_ids
        lines = random_faults(random, robots, duration_s, 1 + int(duration_s / 30.0), IN_WATER + ON_WIRES)
        with tempfile.TemporaryDirectory(prefix="shoal-soak-") as out:
            flown = str(int(random.integers(1 << 30)))
            command = ["sil", name, "--no-web", "--lockstep", "--seed", flown, "--duration", f"{duration_s:.0f}", "--out", out]
            for line in lines:
                command += ["--fault", line]
            run = subprocess.Popen([sys.executable, "-m", "sim_bridge", *command], stdout=subprocess.PIPE, text=True)
            while run.poll() is None:
                watch.look(_children(run.pid))
                time.sleep(SAMPLE_S if hours > 0.1 else 0.5)
            said = run.stdout.read() if run.stdout is not None else ""
            logs = list(Path(out).glob("*/run.mcap"))
            found = [f"{name}: {code}" for code in ([run.returncode] if run.returncode not in (0, 1) else [])]
            found += [f"{name}: no log: {said[-300:]}"] if not logs else _unreadable(logs[0])
            say(f"{name}, seed {flown}, {duration_s:.0f} s in lockstep, {len(lines)} faults: {found or 'well'}")
            trouble += found
    return trouble


def _children(pid: int) -> dict[str, int]:
    """The processes of a flight."""
    try:
        children = psutil.Process(pid).children()
        commands = {child.pid: child.cmdline() for child in children}
    except psutil.Error:
        return {}
    names = {}
    for child, words in commands.items():
        if "-m" in words:
            robot = words[words.index("--robot") + 1] if "--robot" in words else ""
            names[f"{words[words.index('-m') + 1]}{robot} in lockstep"] = child
    return names


def _unreadable(log: Path) -> list[str]:
    """What is wrong with a log: every number in what can be read is finite, the codec sees to that."""
    read = read_log(log)
    bad = [f"{log}: {read.undecodable} messages cannot be read"] if read.undecodable else []
    return bad + ([f"{log}: {read.dropped} messages were dropped"] if read.dropped else [])


def main() -> int:
    """See the module's docstring."""
    parser = argparse.ArgumentParser(prog="make soak", description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--hours", type=float, default=2.0)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    console, watch = Console(), Watch()

    def say(text: str) -> None:
        console.print(text, highlight=False, soft_wrap=True)

    trouble = lockstep(options.hours / 2.0, options.seed, watch, say)
    trouble += real_time(options.hours / 2.0, options.seed, watch, say)
    table = Table("who", "what", "second quarter", "last quarter", "per hour", "")
    trends = watch.trends()
    for t in trends:
        table.add_row(
            t.who, t.what, f"{t.first:.1f}", f"{t.last:.1f}", f"{t.per_hour:+.2f}", "steady" if t.steady else "GROWS"
        )
    console.print(table)
    for text in trouble:
        console.print(f"[red]{text}[/]", soft_wrap=True)
    steady = not trouble and all(trend.steady for trend in trends) and all(math.isfinite(t.per_hour) for t in trends)
    console.print("[green]steady[/]" if steady else "[red]not steady[/]")
    return 0 if steady else 1


if __name__ == "__main__":
    sys.exit(main())
