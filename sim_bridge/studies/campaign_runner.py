"""SHELL: `sim-bridge campaign`: flights on all cores or on a Dask cluster; a journal to resume from; Parquet and a report.

Every finished flight is appended to journal.jsonl at once, so a campaign that dies loses only the flights under way.
"""

import errno
import fcntl
import json
import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from groundstation.analysis.measures import TIMINGS
from groundstation.analysis.statistics import mean
from shoal.config.experiment import NO_CAMERA, Experiment, load_experiment
from shoal.errors import ConfigError, os_errors_as_config_errors
from shoal.runtime.output_files import CAMPAIGN, check_named, check_output, replacing
from shoal.runtime.runtime import Stop
from shoal.runtime.version import are_known, code
from shoal.system.regular_files import open_regular
from sim_bridge import fault_schedule
from sim_bridge.sil.commands import RunOptions, check
from sim_bridge.studies.campaign import Campaign, CampaignFlight, command_of, flights
from sim_bridge.studies.campaign_flight import fly_one
from sim_bridge.studies.dependence import KeyValue, dependences, lines
from sim_bridge.studies.report import write_report
from sim_bridge.studies.worker_pool import worker_pool

JOURNAL, RESULTS, REPORT = "journal.jsonl", "results.parquet", "report.html"
LOOK_EVERY_S = 0.5
TENTHS = 10  # lines of progress where no bar can be drawn
CLUSTER_WITHIN_S = 10.0
IN_THE_AIR = 4  # flights per worker that are handed out at a time


def run(
    campaign: Campaign, folder: Path, *, workers: int | None, scheduler: str | None, resume: bool, stop: Stop, console: Console
) -> int:
    """Fly the flights that are not flown yet, or failed. Returns the exit code: 0 all flown, 1 some were refused or
    failed, 130 interrupted. Raises ConfigError, before any flight, for a value that the experiment refuses."""
    _check_all(campaign, stop)
    journal = folder / JOURNAL
    if journal.exists() and not resume:
        raise ConfigError(f"{folder}: holds a campaign already (--resume goes on with it, --out DIR begins another)")
    for name in CAMPAIGN:
        check_output(folder / name, mine=CAMPAIGN)
    folder.mkdir(parents=True, exist_ok=True)
    total = campaign.flights
    rows: dict[int, dict[str, Any]] = {}
    is_whole = True  # what was flown is in the files
    try:
        with Journal(journal) as kept, _executor(workers, scheduler, console) as executor:
            if kept.doubt:
                console.print(kept.doubt, style="yellow", highlight=False, soft_wrap=True)
            console.print(
                f"{campaign.title or campaign.name}: {total} flights, into {folder}", highlight=False, soft_wrap=True
            )
            window = IN_THE_AIR * (workers or os.cpu_count() or 1)  # no worker waits; a cluster's size is unknown
            for row, is_new in _fly(executor, campaign, kept.rows, window, stop, console):
                rows[row["index"]] = row
                if is_new:
                    kept.add(row)
    except BrokenProcessPool:
        console.print("a worker process has died (out of memory?); --resume goes on", style="red")
    except OSError as error:
        is_whole = False
        console.print(f"{error.filename or journal}: {error.strerror}; --resume goes on", style="red", soft_wrap=True)
    ordered = [rows[index] for index in sorted(rows)]
    key_values = dependences(campaign, ordered)
    for line in (*lines(ordered, key_values), *_method(campaign, ordered)):
        console.print(line, highlight=False, soft_wrap=True)
    _print_outcome(ordered, total, console)
    is_whole = _write_results(campaign, ordered, key_values, folder, console) and is_whole
    if stop.requested:
        console.print(f"interrupted after {len(ordered)} of {total} flights; --resume goes on")
        return 130
    return 0 if is_whole and len(ordered) == total and all(row["status"] == "flown" for row in ordered) else 1


class Journal:
    """The file with a line for each finished flight, and its lock: one program at a time writes it. `doubt` tells where it is
    not known whether this code has flown what it holds."""

    def __init__(self, path: Path) -> None:
        """Raises ConfigError where another program writes it, or where other code has flown what it holds."""
        self._path = path
        with os_errors_as_config_errors(path):
            if path.exists():
                open_regular(path).close()  # a pipe would be waited for
            self._file = path.open("ab", buffering=0)
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            text = path.read_text(encoding="utf-8", errors="replace")
            self.rows = {row["hash"]: row for row in _rows(text) if row["status"] != "failed"}
            self.doubt = ""
            for other in {str(row.get("commit", "")) for row in self.rows.values()}:
                whose = f"{path}: holds flights of {f'commit {other}' if other else 'an earlier version'}"
                if not are_known(other, code().commit):
                    self.doubt = f"{whose}, and this is {code().commit}: nobody knows whether one version flies them all"
                elif other != code().commit:
                    raise ConfigError(
                        f"{whose}, and this is {code().commit}: figures of two versions do not belong together "
                        "(allowed: --resume with that commit, or --out DIR for another campaign)"
                    )
            self._append(b"\n" if text and not text.endswith("\n") else b"")  # behind a line that was torn
        except BlockingIOError:
            self._file.close()
            raise ConfigError(f"{path}: another program flies this campaign (allowed: one at a time)") from None
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> "Journal":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def add(self, row: Mapping[str, Any]) -> None:
        """Add a flight's row. Raises OSError that names the file, which then ends as before."""
        self._append(json.dumps(row).encode() + b"\n")

    def _append(self, data: bytes) -> None:
        """Append a whole line to the journal, or nothing. Raises OSError."""
        size = os.fstat(self._file.fileno()).st_size
        try:
            if self._file.write(data) != len(data):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            check_named(self._file.fileno(), self._path)
        except OSError as error:
            with suppress(OSError):  # where that fails too, the half line is passed over
                os.truncate(self._file.fileno(), size)
            raise OSError(error.errno, error.strerror, str(self._path)) from None


def _write_results(
    campaign: Campaign,
    rows: Sequence[dict[str, Any]],
    key_values: Mapping[str, Sequence[KeyValue]],
    folder: Path,
    console: Console,
) -> bool:
    """Write the table and the report of what was flown. Returns False, after saying why, where that cannot be done."""
    if not rows:
        return True
    try:
        with replacing(folder / RESULTS) as results:
            pq.write_table(_table(campaign, rows), results)
        console.print(f"results: {folder / RESULTS}", soft_wrap=True)
        write_report(campaign, rows, key_values, campaign.flights, folder / REPORT)
        console.print(f"report:  {folder / REPORT}", soft_wrap=True)
    except OSError as error:
        reason = f"no results or report: {error.filename}: {error.strerror}; --resume writes them"
        console.print(reason, style="red", highlight=False, soft_wrap=True)
        return False
    return True


def _method(campaign: Campaign, rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Lines on seeds, intervals, code and control steps behind the figures, as a paper states them."""
    first, last = campaign.end_seeds
    commits = ", ".join(sorted({str(row["commit"]) for row in rows}))
    yield f"n = {len(rows)} flights, seeds {first} to {last}; 95 % bootstrap intervals; commit {commits or code().commit}"
    times = [[row[name] for row in rows if row.get(name) is not None] for name in TIMINGS]
    if all(times):
        yield "control step: median {} µs, 99 % {} µs (means over the flights)".format(*map(mean, times))


def _print_outcome(rows: Sequence[dict[str, Any]], total: int, console: Console) -> None:
    """Print the number of flights that flew, and the first reason of those that did not."""
    count = Counter(row["status"] for row in rows)
    summary = f"{count['flown']} of {total} flights flown, {count['refused']} refused, {count['failed']} failed"
    console.print(summary, style="green" if count["flown"] == total else "red", highlight=False)
    first = next((row for row in rows if row["status"] != "flown"), None)
    if first is not None:
        reason = f"flight {first['index']} (seed {first['seed']}) {first['status']}: {first['reason']}"
        console.print(reason, style="red", highlight=False, soft_wrap=True)


def _check_all(campaign: Campaign, stop: Stop) -> None:
    """Load every flight's experiment, and keep none. Of flights that differ in the seed alone only the first and the last
    seed are loaded."""
    some = flights(campaign) if campaign.draw else (f for f in flights(campaign) if f.seed in campaign.end_seeds)
    for flight in some:
        if stop.requested:
            return
        _experiment(campaign, flight)


def _experiment(campaign: Campaign, flight: CampaignFlight) -> Experiment:
    """The experiment of a flight. Raises ConfigError for one that cannot be flown so."""
    settings = [*flight.settings(campaign), f"seed={flight.seed}"]
    if campaign.camera:
        experiment = load_experiment(campaign.experiment, settings)
        check(experiment, RunOptions(lockstep=True, one_process=True))
        return experiment
    experiment = load_experiment(campaign.experiment, [*settings, NO_CAMERA])
    fault_schedule.require_kinds(experiment, fault_schedule.NUMERIC, "in a numeric flight there is none")
    return experiment


def _rows(journal: str) -> Iterator[dict[str, Any]]:
    """Rows of the journal; the last line may be torn, and others may be no rows."""
    for line in journal.splitlines():
        try:
            row = json.loads(line)
        except ValueError:
            continue
        if isinstance(row, dict) and {"hash", "status"} <= row.keys():
            yield row


@contextmanager
def _executor(workers: int | None, scheduler: str | None, console: Console) -> Iterator[Executor]:
    """Processes on this machine, or a Dask cluster's workers behind the same interface."""
    if scheduler is None:
        with worker_pool(workers or os.cpu_count() or 1) as pool:
            yield pool
        return
    try:
        from distributed import Client
    except ImportError:
        raise ConfigError("--scheduler needs Dask: pip install -c constraints.txt '.[cluster]'") from None
    try:
        client = Client(scheduler, timeout=CLUSTER_WITHIN_S)
    except OSError as error:
        raise ConfigError(f"--scheduler {scheduler}: {error}") from None
    with client, client.get_executor(retries=1, pure=False) as cluster:
        for worker, commit in client.run(_commit).items():
            which = f"--scheduler {scheduler}: its worker {worker} has commit {commit}, and this is {code().commit}"
            if not are_known(commit, code().commit):
                console.print(f"{which}: nobody knows whether that is the same", style="yellow", soft_wrap=True)
            elif commit != code().commit:
                raise ConfigError(f"{which} (allowed: the same on all)")
        yield cluster


def _commit() -> str:
    return code().commit


def _fly(
    executor: Executor, campaign: Campaign, kept: Mapping[str, dict[str, Any]], window: int, stop: Stop, console: Console
) -> Iterator[tuple[dict[str, Any], bool]]:
    """Rows as flights come back, each with True if it is new. Rows of `kept`, by hash, are not flown again. No more than
    `window` flights are prepared at a time. Flights under way when a stop is requested are lost."""
    pending: dict[Future[dict[str, Any]], tuple[CampaignFlight, str]] = {}  # each with its experiment's hash
    missing = set(kept)  # hashes of rows whose flight has not come yet
    coming = flights(campaign)
    flight = next(coming, None)
    with _progress(campaign.flights, console) as advance:
        while (flight is not None or pending) and not stop.requested:
            while flight is not None and len(pending) < window and not stop.requested:
                experiment = _experiment(campaign, flight)
                row = kept.get(experiment.hash)
                if row is not None:
                    missing.discard(experiment.hash)
                    advance()
                    yield {**row, **_named(flight)}, False
                else:
                    pending[executor.submit(fly_one, experiment.model_dump_json())] = (flight, experiment.hash)
                flight = next(coming, None)
            finished, _ = wait(pending, timeout=LOOK_EVERY_S, return_when=FIRST_COMPLETED) if pending else ((), ())
            for future in finished:
                flown, digest = pending.pop(future)
                advance()
                yield {**_named(flown), "hash": digest, "commit": code().commit, **future.result()}, True
        for future in pending:
            future.cancel()
    while flight is not None and missing:  # interrupted: what was flown before still belongs to the results
        row = kept.get(_experiment(campaign, flight).hash)
        if row is not None:
            missing.discard(row["hash"])
            yield {**row, **_named(flight)}, False
        flight = next(coming, None)


def _named(flight: CampaignFlight) -> dict[str, Any]:
    """The columns that say which flight of the campaign a row is."""
    return {"index": flight.index, "seed": flight.seed, **flight.values}


@contextmanager
def _progress(total: int, console: Console) -> Iterator[Callable[[], None]]:
    """Show how many flights are finished: a bar on a terminal, a line each tenth elsewhere. Yields the function to call after
    each flight."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    finished = 0
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("flights", total=total)

        def advance() -> None:
            nonlocal finished
            bar.advance(task)
            has_new_tenth = TENTHS * finished // total < TENTHS * (finished + 1) // total
            finished += 1
            if has_new_tenth and not console.is_terminal:
                console.print(f"{finished} of {total} flights", highlight=False)

        yield advance


def _table(campaign: Campaign, rows: Sequence[dict[str, Any]]) -> pa.Table:
    """All rows with all columns, and the command that flies each row again."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    data = {column: _column([row.get(column) for row in rows]) for column in columns}
    return pa.table({**data, "command": [command_of(campaign, row) for row in rows]})


def _column(values: list[Any]) -> pa.Array:
    """Values as a column; as JSON if a key was given values of several kinds, such as a number and a list."""
    try:
        return pa.array(values)
    except (pa.ArrowException, OverflowError):
        return pa.array([None if value is None else json.dumps(value) for value in values])
