"""SHELL: `make soak`: flies for hours while things break at random, and looks for what only time brings out: memory, handles
or threads that grow, control that slows down, numbers that are not finite.

    python -m tests.faults.soak --hours 2
    python -m tests.faults.soak --simulated 10 --way numeric --way poses
    python -m tests.faults.soak --real-time 4

Half of the time passes by the simulator's clock, every scene in every way with random timelines of faults, half by the wall
clock with the injections of `make faults`: at first all of them, then only those that leave the processes alive, for what
grows shows only in a long life. What matters of the first half is how much is flown: `--simulated 10` flies ten hours of it,
however long that takes, and nothing by the wall clock; `--real-time 4` is four hours of the second half alone.
"""

import argparse
import itertools
import math
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import psutil
from rich.console import Console
from rich.table import Table

from groundstation.logs.reader import read_log
from shoal.config.experiment import EXPERIMENTS, load_experiment
from shoal.errors import ConfigError
from shoal.frames import Array
from shoal.messages.messages import Mode
from sim_bridge.sil.commands import RunOptions, check
from tests.faults.onlooker import Stuck
from tests.faults.rig import Rig, moment
from tests.faults.table import ROWS

SAMPLE_S = 5.0
IN_WATER = ("thruster {r}/{t} dead", "thruster {r}/{t} stuck", "thruster {r}/{t} reversed", "thruster {r}/{t} weak {f}",
            "imu {r} heading {f}", "imu {r} gyro {f}", "battery {r} sag {f}")  # fmt: skip
ON_WIRES = ("link {r} noisy {f}", "link {r} slow {d}")
IN_SIGHT = ("camera frozen", "camera glare {f}", "camera occluded {f}", "marker {r} lost")
LOCKSTEP = ("sil", "--lockstep", "--no-web")
WAYS = {
    "camera": (LOCKSTEP, IN_WATER + ON_WIRES + IN_SIGHT),
    "poses": ((*LOCKSTEP, "--poses"), IN_WATER + ON_WIRES),
    "numeric": (("numeric",), IN_WATER),
}
# Growth from the second quarter of the samples to the last that is no leak: allocators and caches move by as much.
MAY_GROW = {"memory MB": 8.0, "handles": 3.0, "threads": 3.0, "latency ms": 5.0}
GROWS_PER_H = {("groundstation", "memory MB"): 16.0}  # by design: the log's index (groundstation/logs/recorder.py)
KILLING = 0.25  # share of the time by the wall clock in which processes are killed too


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
    """The change of a quantity over time."""

    who: str
    what: str
    hours: float  # from the one to the other
    first: float
    last: float
    per_hour: float

    @property
    def steady(self) -> bool:
        """True if the quantity did not grow."""
        by_design = GROWS_PER_H.get((self.who, self.what), 0.0) * self.hours
        return self.last - self.first <= MAY_GROW[self.what] + by_design


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
    (first_s, first), (last_s, last) = np.median(series[quarter : 2 * quarter], axis=0), np.median(series[-quarter:], axis=0)
    return Trend(who, what, float(last_s - first_s) / 3600.0, float(first), float(last), slope)


# --- by the wall clock


def real_time(hours: float, seed: int, watch: Watch, say: Callable[[str], None]) -> list[str]:
    """Injections of the fault matrix, in a random order, into one lab. Returns what went wrong."""
    random, begin_s, trouble = np.random.default_rng(seed), time.monotonic(), []
    mild_s, end_s = begin_s + KILLING * hours * 3600.0, begin_s + hours * 3600.0
    rows = [row for row in ROWS if row.rig == "lab" and row.key != "flood"]
    mild = [row for row in rows if "SIGKILL" not in row.how]
    with Rig(seed=seed) as rig:
        seen_s = 0.0
        while time.monotonic() < end_s:
            if time.monotonic() > mild_s:
                rows = mild
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
    recent = [report.state for states in rig.states.values() for report in list(states)[-200:]]
    return float(np.median([s.timing.exposure_to_pwm_ms for s in recent if s.mode is Mode.TRACKING]))


# --- by the simulator's clock


def simulated(
    hours: float,
    seed: int,
    watch: Watch,
    say: Callable[[str], None],
    enough_h: float = math.inf,
    ways: Sequence[str] = tuple(WAYS),
) -> list[str]:
    """Every scene there is in every way that it can be flown, in turn, and within each a fault every half a minute: until the
    time is over, or so much has been flown."""
    random, end_s, trouble = np.random.default_rng(seed), time.monotonic() + hours * 3600.0, []
    flown_s = dict.fromkeys(ways, 0.0)
    for name, way in itertools.cycle(_flights(random, ways)):
        left_s = min((end_s - time.monotonic()) * 2.0, enough_h * 3600.0 - sum(flown_s.values()))
        if left_s <= 0.0:
            break
        experiment = load_experiment(name)
        duration_s = round(min(experiment.duration_s, max(20.0, left_s)))
        arguments, kinds = WAYS[way]
        lines = random_faults(random, experiment.robot_ids, duration_s, 1 + duration_s // 30, kinds)
        command = [*arguments, name, "--seed", str(int(random.integers(1 << 30))), "--duration", str(duration_s)]
        for line in lines:
            command += ["--fault", line]
        troubles = _flight(command, watch, SAMPLE_S if hours > 0.1 else 0.5)
        flown_s[way] += duration_s
        say(f"{way:8s} {name}: {duration_s} s, {len(lines)} faults: {'; '.join(troubles) or 'well'}")
        trouble += [f"sim-bridge {shlex.join(command)}: {text}" for text in troubles]
    say("flown: " + ", ".join(f"{seconds / 3600.0:.2f} h {way}" for way, seconds in flown_s.items()))
    return trouble


def _flights(random: np.random.Generator, ways: Sequence[str]) -> list[tuple[str, str]]:
    """Scenes and ways, in a random order."""
    flights = [(path.stem, way) for path in sorted(EXPERIMENTS.glob("*.toml")) for way in ways]
    return [flights[k] for k in random.permutation(len(flights)) if _can_be_flown(*flights[k])]


def _can_be_flown(name: str, way: str) -> bool:
    if way != "camera":
        return True
    try:
        check(load_experiment(name), RunOptions())
    except ConfigError:
        return False
    return True


def _flight(command: list[str], watch: Watch, every_s: float) -> list[str]:
    """The failures of a flight. A run with broken thrusters may miss its limits."""
    with tempfile.TemporaryDirectory(prefix="shoal-soak-") as out, (Path(out) / "said.txt").open("w") as output:
        whole = [sys.executable, "-m", "sim_bridge", *command, "--out", out]
        run = subprocess.Popen(whole, stdout=output, stderr=subprocess.STDOUT)
        while run.poll() is None:
            watch.look(_children(run.pid))
            time.sleep(every_s)
        logs = list(Path(out).glob("*/run.mcap"))
        texts = [Path(out) / "said.txt", *Path(out).glob("*/logs/*.log")]
        troubles = [f"exit code {run.returncode}"] if run.returncode not in (0, 1) else []
        troubles += [f"{text.name}: a traceback" for text in texts if "Traceback" in text.read_text(encoding="utf-8")]
        return troubles + (_unreadable(logs[0]) if logs else ["no log"])


def _children(pid: int) -> dict[str, int]:
    """The processes of a flight; of the agents one."""
    try:
        commands = {child.pid: child.cmdline() for child in psutil.Process(pid).children()}
    except psutil.Error:
        return {}
    return {f"{words[words.index('-m') + 1]} in lockstep": child for child, words in commands.items() if "-m" in words}


def _unreadable(log: Path) -> list[str]:
    """The defects of a log. Every number that can be read is finite: the codec sees to that."""
    read = read_log(log)
    bad = [f"{log}: {read.undecodable} messages cannot be read"] if read.undecodable else []
    return bad + ([f"{log}: {read.dropped} messages were dropped"] if read.dropped else [])


def main() -> int:
    """See the module's docstring."""
    parser = argparse.ArgumentParser(prog="make soak", description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--hours", type=float, default=2.0)
    parser.add_argument("--simulated", type=float, help="hours to fly by the simulator's clock, instead")
    parser.add_argument("--real-time", type=float, help="hours to fly by the wall clock, instead")
    parser.add_argument("--way", action="append", choices=WAYS, help="to fly by the simulator's clock; repeatable; else all")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    console, watch, ways = Console(), Watch(), options.way or tuple(WAYS)

    def say(text: str) -> None:
        console.print(text, highlight=False, soft_wrap=True)

    trouble = []
    if options.simulated is not None:
        trouble += simulated(math.inf, options.seed, watch, say, options.simulated, ways)
    if options.real_time is not None:
        trouble += real_time(options.real_time, options.seed, watch, say)
    if options.simulated is None and options.real_time is None:
        trouble += simulated(options.hours / 2.0, options.seed, watch, say, ways=ways)
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
