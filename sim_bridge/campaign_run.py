"""SHELL: `sim-bridge campaign`: flights on all cores, or on a Dask cluster; a journal to resume from; Parquet and a report.

Every finished flight is a line of journal.jsonl at once, so a campaign that dies loses only what was in the air.
"""

import json
import multiprocessing
import os
import signal
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from sim_bridge import faults
from sim_bridge.campaign import Campaign, Flight, flights
from sim_bridge.campaign_flight import fly_one, one_thread
from sim_bridge.campaign_report import write_report
from wire.experiment import Experiment, load_experiment
from wire.outputs import CAMPAIGN, check_output, replacing
from wire.runtime import Stop
from wire.toml_file import ConfigError

JOURNAL, RESULTS, REPORT = "journal.jsonl", "results.parquet", "report.html"
LOOK_EVERY_S = 0.5


def run(
    campaign: Campaign, folder: Path, *, workers: int | None, scheduler: str | None, resume: bool, stop: Stop, console: Console
) -> int:
    """Fly what is not flown yet. Returns the exit code: 0 all flown, 1 some were refused or failed, 130 interrupted."""
    wanted = [(flight, _experiment(campaign, flight)) for flight in flights(campaign)]
    journal = folder / JOURNAL
    if journal.exists() and not resume:
        raise ConfigError(f"{folder}: holds a campaign already (--resume goes on with it, --out DIR begins another)")
    for name in CAMPAIGN:
        check_output(folder / name, mine=CAMPAIGN)
    folder.mkdir(parents=True, exist_ok=True)
    said = journal.read_text(encoding="utf-8") if journal.exists() else ""
    kept = {row["hash"]: row for row in _rows(said)}
    found = ((flight, kept.get(experiment.hash)) for flight, experiment in wanted)  # flown as it is wanted now
    rows = {f.index: {**row, "index": f.index, "seed": f.seed, **f.values} for f, row in found if row is not None}
    todo = [(flight, experiment) for flight, experiment in wanted if flight.index not in rows]
    console.print(f"{campaign.title or campaign.name}: {len(wanted)} flights, {len(rows)} flown already, into {folder}")
    try:
        with journal.open("a", encoding="utf-8") as file, _executor(workers, scheduler) as executor:
            file.write("\n" if said and not said.endswith("\n") else "")  # behind a line that was torn
            for row in _fly(executor, todo, len(wanted), stop, console):
                rows[row["index"]] = row
                file.write(json.dumps(row) + "\n")
                file.flush()
    except BrokenProcessPool:
        console.print("[red]a worker process has died (out of memory?); --resume goes on[/]")
    ordered = [rows[index] for index in sorted(rows)]
    if ordered:
        with replacing(folder / RESULTS) as results:
            pq.write_table(_table(campaign, ordered), results)
        write_report(campaign, ordered, len(wanted), folder / REPORT)
        console.print(f"results: {folder / RESULTS}\nreport:  {folder / REPORT}", soft_wrap=True)
    if stop.requested:
        console.print(f"interrupted after {len(ordered)} of {len(wanted)} flights; --resume goes on")
        return 130
    return 0 if len(ordered) == len(wanted) and all(row["status"] == "flown" for row in ordered) else 1


def _experiment(campaign: Campaign, flight: Flight) -> Experiment:
    experiment = load_experiment(campaign.experiment, [*flight.settings(campaign), f"seed={flight.seed}"])
    faults.only(experiment, faults.NUMERIC, "in a numeric flight there is none")
    return experiment


def _rows(journal: str) -> Iterator[dict[str, Any]]:
    """Its lines; the last may be torn."""
    for line in journal.splitlines():
        try:
            yield json.loads(line)
        except ValueError:
            continue


@contextmanager
def _executor(workers: int | None, scheduler: str | None) -> Iterator[Executor]:
    """Processes on this machine, or a Dask cluster's workers behind the same interface."""
    one_thread()
    if scheduler is None:
        spawn = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(workers or os.cpu_count(), spawn, initializer=_ignore_interrupts) as pool:
            yield pool
        return
    try:
        from distributed import Client
    except ImportError:
        raise ConfigError("--scheduler needs Dask: pip install -c constraints.txt '.[cluster]'") from None
    try:
        client = Client(scheduler, timeout=10)
    except OSError as error:
        raise ConfigError(f"--scheduler {scheduler}: {error}") from None
    with client, client.get_executor(retries=1, pure=False) as cluster:
        yield cluster


def _ignore_interrupts() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's business


def _fly(
    executor: Executor, todo: list[tuple[Flight, Experiment]], total: int, stop: Stop, console: Console
) -> Iterator[dict[str, Any]]:
    """Rows, as flights come back. What is in the air when a stop is asked for is lost."""
    pending: dict[Future[dict[str, Any]], tuple[Flight, str]] = {}
    for flight, experiment in todo:
        pending[executor.submit(fly_one, experiment.model_dump_json())] = (flight, experiment.hash)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("flights", total=total, completed=total - len(todo))
        while pending and not stop.requested:
            done, _ = wait(pending, timeout=LOOK_EVERY_S, return_when=FIRST_COMPLETED)
            for future in done:
                flight, digest = pending.pop(future)
                progress.advance(task)
                yield {"index": flight.index, "seed": flight.seed, **flight.values, "hash": digest, **future.result()}
        for future in pending:
            future.cancel()


def _table(campaign: Campaign, rows: list[dict[str, Any]]) -> pa.Table:
    """All rows with all columns; how to fly a row again is a column too."""
    commands = {flight.index: flight.command(campaign) for flight in flights(campaign)}
    columns = list(dict.fromkeys(key for row in rows for key in row))
    data = {column: _column([row.get(column) for row in rows]) for column in columns}
    return pa.table({**data, "command": [commands[row["index"]] for row in rows]})


def _column(values: list[Any]) -> pa.Array:
    """As they are; as JSON where a key was given values of several kinds, such as a number and a list."""
    try:
        return pa.array(values)
    except (pa.ArrowException, OverflowError):
        return pa.array([None if value is None else json.dumps(value) for value in values])
