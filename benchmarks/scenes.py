"""`python -m benchmarks.scenes`: every shipped experiment, flown whole as its users fly it, on several seeds.

Each flight is the command `sim-bridge sil NAME --lockstep --one-process --no-web --seed N`, one worker process a core. So the
camera is in the loop wherever the experiment has one. The verdict is the exit code, which must agree with result.json; errors
are against the plant's truth. With all scenes and --write, docs/evidence/scenes.md and scenes.json are written anew.
"""

import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from benchmarks import evidence
from localizer.evaluation.metrics import PoseRow
from localizer.evaluation.runner import evaluate_log
from shoal.config.experiment import EXPERIMENTS, load_experiment
from shoal.errors import ConfigError
from shoal.runtime.output import terminal

ROOT = Path(__file__).parents[1]
SCENES = tuple(sorted(path.stem for path in EXPERIMENTS.glob("*.toml")))
EVIDENCE = ROOT / "docs" / "evidence" / "scenes"
TRACKS = ("marker", "kcf", "coast", "lost")  # kinds of track that a pose has, from best to worst
COLUMNS = (
    "Scene",
    "RMS, whole run",
    "RMS after 20 s",
    "Largest",
    "Depth, RMS after 20 s",
    "At the end",
    "Nearest centres, m",
    "Worst seed",
)
FEWEST = 100  # poses of a kind of track from which on its figures are shown
FLIGHT_WITHIN_S = 1800.0  # of wall time: the longest takes two minutes on an idle core


@dataclass(frozen=True)
class FlownScene:
    """One flight. Errors are those of the worst robot on its worst axis, in m; NaN for what the flight did not give."""

    scene: str
    seed: int
    passed: bool
    reason: str  # of a failure, in the report's words
    rms_whole_m: float
    rms_settled_m: float  # after 20 s
    max_m: float  # of the whole run
    depth_settled_m: float
    arrival_m: float  # from the place where the path ends; NaN where the experiment sets no limit for it
    separation_m: float
    faults: tuple[str, ...]
    tracks: dict[str, PoseRow] = field(default_factory=dict)
    took_s: float = 0.0


@dataclass(frozen=True)
class Poses:
    """Errors of all poses of one kind of track over several flights."""

    count: int
    rms_mm: float
    max_mm: float
    nees: float  # 3 where the published covariances are right


def fly(scene: str, seed: int, changes: Sequence[str] = ()) -> FlownScene:
    """Fly a scene as a user does, with `changes` to it, and read what it left. Raises RuntimeError where exit code and result
    disagree."""
    with tempfile.TemporaryDirectory(prefix="shoal-scene-") as folder:
        command = [sys.executable, "-P", "-m", "sim_bridge", "sil", scene, "--lockstep", "--one-process", "--no-web"]
        begin_s = time.monotonic()
        ended = subprocess.run(
            [*command, "--seed", str(seed), "--out", folder, *(word for change in changes for word in ("--set", change))],
            capture_output=True,
            encoding="utf-8",
            errors="replace",
            timeout=FLIGHT_WITHIN_S,
            check=False,
        )
        took_s = time.monotonic() - begin_s
        results = list(Path(folder).glob("*/result.json"))
        if not results:
            return _not_flown(scene, seed, (ended.stderr or ended.stdout).strip().splitlines()[-1:], took_s)
        result = json.loads(results[0].read_text(encoding="utf-8"))
        if result["passed"] != (ended.returncode == 0):
            raise RuntimeError(f"{scene}, seed {seed}: exit code {ended.returncode}, but result.json says {result['passed']}")
        return _flight(result, _tracks(results[0].with_name("run.mcap")), took_s)


def _not_flown(scene: str, seed: int, last_line: Sequence[str], took_s: float) -> FlownScene:
    nan = math.nan
    return FlownScene(scene, seed, False, "".join(last_line) or "no result", nan, nan, nan, nan, nan, nan, (), {}, took_s)


def _flight(result: dict[str, Any], tracks: dict[str, PoseRow], took_s: float) -> FlownScene:
    robots = result["robots"].values()
    unmet = [check["name"] for check in result["checks"] if check["passed"] is False]
    cause = result["cause"]["text"] if result["cause"] else ""
    arrival = next((check["value"] for check in result["checks"] if check["name"] == "from its place at the end"), None)
    faults = tuple(f"{fault['source']}: {fault['text']} ({fault['time_s']:.1f} s)" for fault in result["faults"])
    return FlownScene(
        result["scene"],
        result["seed"],
        result["passed"],
        "" if result["passed"] else cause or ", ".join(unmet),
        _worst(robots, "rms_m", (0, 1)),
        _worst(robots, "rms_after_20s_m", (0, 1)),
        _worst(robots, "max_m", (0, 1)),
        _worst(robots, "rms_after_20s_m", (2,)),
        _number(arrival),
        _number(result["min_separation_m"]),
        faults,
        tracks,
        took_s,
    )


def _worst(robots: Any, name: str, axes: tuple[int, ...]) -> float:
    values = [robot[name][axis] for robot in robots if robot[name] for axis in axes]
    return max(values, default=math.nan)


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def _tracks(log: Path) -> dict[str, PoseRow]:
    """Rows of the poses by kind of track; empty where no localizer took part."""
    try:
        rows, damage = evaluate_log(log)
    except ConfigError:
        return {}
    if damage:
        raise ConfigError(damage)
    return {row.subject: row for row in rows if row.subject in TRACKS}


def pooled(flights: Sequence[FlownScene], track: str) -> Poses | None:
    """The poses of one kind of track of all flights together; None if there is none."""
    rows = [flight.tracks[track] for flight in flights if track in flight.tracks]
    count = sum(row.poses for row in rows)
    if not count:
        return None
    square = sum(row.poses * row.rms_mm**2 for row in rows)
    nees = sum(row.poses * row.nees for row in rows if math.isfinite(row.nees))
    return Poses(count, math.sqrt(square / count), max(row.max_mm for row in rows), nees / count)


def worst_of(flights: Sequence[FlownScene]) -> FlownScene:
    """The flight that says most against a scene: one that failed, else the one with the largest error over the whole run."""
    failed = [flight for flight in flights if not flight.passed]
    return max(failed or flights, key=lambda flight: -1.0 if math.isnan(flight.max_m) else flight.max_m)


def markdown(flights: Sequence[FlownScene], seeds: int) -> str:
    """The page of evidence."""
    by_scene = {scene: sorted((f for f in flights if f.scene == scene), key=lambda f: f.seed) for scene in SCENES}
    groups = {scene: group for scene, group in by_scene.items() if group}
    lines = [
        "# Every shipped scene, flown whole",
        "",
        f"{evidence.written_by('make scenes')}, seeds 1 to {seeds}.",
        f"{sum(flight.passed for flight in flights)} of {len(flights)} flights passed.",
        "",
        "Each flight is `sim-bridge sil NAME --lockstep --one-process --seed N`. Errors are in mm, against the simulator's",
        "truth, of the worst robot on its worst axis: the worst seed's, and in brackets the median. A real calibration adds",
        "its error. A detour around others is part of the error; the limit there is the distance from the path's end.",
        "",
        "## Flights",
        "",
        *evidence.table(COLUMNS, (_flight_row(scene, group) for scene, group in groups.items())),
        "",
        "## Poses by kind of track",
        "",
        "NEES is 3 where the published covariances are right; target 1.5 to 5. The track is the marker's, or the one in",
        f"brackets. Fewer than {FEWEST} poses are not shown.",
        "",
        *evidence.table(
            ("Scene", "RMS, mm", "Largest, mm", "NEES"),
            (row for scene, group in groups.items() for row in _track_rows(scene, group)),
        ),
        "",
        "## Holds, faults and failures",
        "",
        *(_faults(groups) or ["None in any flight."]),
        "",
    ]
    return "\n".join(lines)


def _flight_row(scene: str, group: Sequence[FlownScene]) -> list[str]:
    poses = "" if load_experiment(scene).localizer.uses_camera else " (no camera)"
    worst = worst_of(group)
    columns = [[f.rms_whole_m for f in group], [f.rms_settled_m for f in group], [f.max_m for f in group]]
    columns += [[f.depth_settled_m for f in group], [f.arrival_m for f in group]]
    nearest = [f.separation_m for f in group if not math.isnan(f.separation_m)]
    cells = [f"{scene}{poses}", *(evidence.spread(column) for column in columns)]
    return [*cells, f"{min(nearest):.3f}" if nearest else "", str(worst.seed)]


def _track_rows(scene: str, group: Sequence[FlownScene]) -> Iterator[list[str]]:
    for track in TRACKS:
        poses = pooled(group, track)
        if poses is not None and poses.count >= FEWEST and poses.rms_mm > 0.0:  # poses of a numeric flight are the truth
            yield [
                scene if track == "marker" else f"{scene} ({track})",
                f"{poses.rms_mm:.2f}",
                f"{poses.max_mm:.1f}",
                f"{poses.nees:.2f}",
            ]


def _faults(groups: dict[str, list[FlownScene]]) -> list[str]:
    lines = []
    for scene, group in groups.items():
        for flight in group:
            words = [*([] if flight.passed else [f"failed: {flight.reason}"]), *_counted(flight.faults)]
            if words:
                lines.append(f"* {scene}, seed {flight.seed}: {'; '.join(words)}")
    return lines


def _counted(faults: Sequence[str]) -> list[str]:
    """Faults in order, those with the same words once, with their number."""
    counts = Counter(fault.rpartition(" (")[0] for fault in faults)
    first = {fault.rpartition(" (")[0]: fault for fault in reversed(faults)}
    return [first[words] if count == 1 else f"{first[words]} and {count - 1} more" for words, count in counts.items()]


def fly_all(
    scenes: Sequence[str], seeds: int, workers: int, console: Console, changes: Sequence[str] = ()
) -> list[FlownScene]:
    """Fly every scene on every seed, with `changes` to it and with progress."""
    pairs = [(scene, seed) for seed in range(1, seeds + 1) for scene in scenes]
    flights: list[FlownScene] = []
    with (
        evidence.progress(console) as progress,
        ThreadPoolExecutor(workers) as pool,  # each thread waits for a process of its own
    ):
        task = progress.add_task("flights", total=len(pairs))
        for future in as_completed([pool.submit(fly, scene, seed, changes) for scene, seed in pairs]):
            flight = future.result()
            flights.append(flight)
            progress.advance(task)
            verdict = "passed" if flight.passed else "failed"
            console.print(
                f"{len(flights)} of {len(pairs)}: {flight.scene}, seed {flight.seed}: {verdict}"
                f" in {flight.took_s:.0f} s, largest error {1e3 * flight.max_m:.0f} mm {flight.reason}",
                highlight=False,
                soft_wrap=True,
            )
    return flights


def main(
    names: Annotated[list[str] | None, typer.Argument(help="Scenes; all shipped ones if none is named.")] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Fly seeds 1 to this.")] = 10,
    workers: Annotated[int | None, typer.Option(min=1, help="Flights at a time; default: one a core.")] = None,
    changes: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Any key of an experiment, for all scenes.")
    ] = None,
    write: Annotated[bool, typer.Option("--write", help="Write docs/evidence/scenes.md and scenes.json.")] = False,
) -> None:
    """Fly shipped scenes whole, as users fly them; print the tables. Exit code 0 if every flight passed."""
    unknown = sorted(set(names or ()) - set(SCENES))
    if unknown:
        raise typer.BadParameter(f"{', '.join(unknown)}: no such scene (allowed: {', '.join(SCENES)})")
    if write and (names or changes):
        raise typer.BadParameter("--write needs all scenes as they are: leave names and --set out")
    console = terminal()
    flights = fly_all(names or SCENES, seeds, workers or os.cpu_count() or 1, console, changes or ())
    page = markdown(flights, seeds)
    console.print(page, markup=False, highlight=False, soft_wrap=True)
    if write:
        rows = [asdict(flight) for flight in sorted(flights, key=lambda flight: (flight.scene, flight.seed))]
        evidence.write(EVIDENCE, page, rows)
    raise typer.Exit(0 if all(flight.passed for flight in flights) else 1)


if __name__ == "__main__":
    typer.run(main)
