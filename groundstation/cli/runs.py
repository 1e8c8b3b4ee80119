"""SHELL: commands for recorded runs: `groundstation log report|compare|export|repair`, and `benchmark report`."""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from shoal.errors import ConfigError
from shoal.runtime.cli_options import AsJson, RunFolder, as_run
from shoal.runtime.output import terminal
from shoal.runtime.output_files import RUN, check_output
from shoal.system.printable import printable

PROGRESS_S = 10.0  # between two lines about a film that is being written


def report(
    run_folder: RunFolder,
    pdf: Annotated[Path | None, typer.Option(metavar="FOLDER", help="Write every figure there as a PDF, too.")] = None,
    flight: Annotated[int | None, typer.Option(min=1, help="Of several flights in one log: which. Default: the last.")] = None,
    as_json: AsJson = False,
) -> None:
    """Write result.json and report.html of a run again, from its log, and print what they say.

    What is wrong with the log as a whole (none, empty, cut off, gaps) is the first line; then the cause of a failure, and the
    errors of each robot. Exit code 0 if the run passed, 1 if
    it did not or its log is not whole.

    Example:  groundstation log report runs/pool-20260101-120000 --pdf figures
    """
    from groundstation.report import report as reporting
    from groundstation.report import terminal

    result = reporting.write_report(run_folder, flight)
    figures = reporting.write_figures(run_folder, pdf, flight) if pdf is not None else []
    if as_json:
        typer.echo(result.to_json(), nl=False)
        raise typer.Exit(0 if result.passed else 1)
    for line in terminal.lines(result):
        typer.echo(printable(line))
    typer.echo(f"report: {run_folder / 'report.html'} ({result.verdict})")
    for path in figures:
        typer.echo(path)
    raise typer.Exit(0 if result.passed else 1)


def compare(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN", help="Folders of two or more runs.", callback=as_run)],
    out: Annotated[Path, typer.Option(metavar="FILE", help="The page to write.")] = Path("compare.html"),
    as_json: AsJson = False,
) -> None:
    """Put runs side by side: their figures, in what their experiments differ, and a page with their errors over time.

    Example:  groundstation log compare runs/pool-20260101-120000 runs/pool-20260101-130000 --out why.html
    """
    from rich.table import Table

    from groundstation.report import report as reporting
    from groundstation.report.run_comparison import ComparedRun, differences, metric_rows

    if len(runs) < 2:
        raise ConfigError("compare: two runs or more are needed")
    check_output(out, [run / name for run in runs for name in RUN])
    missing = [str(run) for run in runs if not (run / "run.mcap").is_file()]
    if missing:
        raise ConfigError(f"{missing[0]}: no run.mcap there")
    names = [run.resolve().name for run in runs]
    names = names if len(set(names)) == len(names) else [str(run) for run in runs]
    read = []
    for name, folder in zip(names, runs, strict=True):
        series, _, result = reporting.evaluated(folder)
        read.append(ComparedRun(name, series, result))
        if result.log_trouble:
            typer.echo(printable(f"{name}: {result.log_trouble}"), err=True)
    reporting.write_comparison(read, out)
    if as_json:
        figures = [{"name": row.name, "unit": row.unit, "values": row.values} for row in metric_rows(read)]
        changed = [{"key": key, "values": values} for key, values in differences(read)]
        typer.echo(json.dumps({"runs": names, "figures": figures, "differences": changed}, indent=1))
        return
    console = terminal()
    for title, rows in (
        ("figures", [(f"{row.name} [{row.unit}]" if row.unit else row.name, *row.cells) for row in metric_rows(read)]),
        ("what was different", [(key, *values) for key, values in differences(read)]),
    ):
        table = Table(title=title)
        for column in ("", *names):
            table.add_column(column, overflow="fold")
        for row in rows:
            table.add_row(*row)
        console.print(table)
    console.print(f"page: {out}", soft_wrap=True)


def export(
    run_folder: RunFolder,
    out: Annotated[Path | None, typer.Option(metavar="FOLDER", help="Where the files go.")] = None,
    video: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The camera's film as this MP4, what the robots did drawn over it.")
    ] = None,
    camera: Annotated[str, typer.Option(metavar="NAME", help="With --video: one of several cameras.")] = "",
    parquet: Annotated[bool, typer.Option("--parquet", help="Parquet instead of CSV.")] = False,
    foxglove: Annotated[bool, typer.Option("--foxglove", help="For Foxglove-family viewers instead.")] = False,
    as_json: AsJson = False,
) -> None:
    """Write every recorded message of a run as tables, one per topic and robot, with columns of named units.

    The first column, time_s, is 0 where the report's is. Or, for 3-D viewers, the log with the scene in it, and a layout that
    shows it. Exit code 1 if the log is not whole or holds messages that cannot be decoded.

    Examples:  groundstation log export runs/pool-20260101-120000 --out tables
               groundstation log export runs/pool-20260101-120000 --out viewer --foxglove
              groundstation log export runs/pool-20260101-120000 --video pool.mp4
    """
    from groundstation.export import film, foxglove_file, tables
    from groundstation.logs.reader import read_log

    if (out is None) == (video is None):
        raise typer.BadParameter("either --out FOLDER or --video FILE")
    if video is not None:
        check_output(video, [run_folder / name for name in RUN])
        count, left_out = film.write_film(run_folder, video, camera, _progress_of_film(video))
        typer.echo(f"{video}: {count} pictures")
        undecodable = f"{left_out} pictures of the log cannot be decoded, and are left out" if left_out else ""
        lost = [line for line in (read_log(run_folder / "run.mcap", ()).trouble, undecodable) if line]
        for line in lost:
            typer.echo(line, err=True)
        raise typer.Exit(1 if lost else 0)
    assert out is not None
    written: list[tuple[Path, int | None]]
    trouble: list[str] = []
    if foxglove:
        written = [(path, None) for path in foxglove_file.export(run_folder, out)]
        trouble += [read_log(run_folder / "run.mcap", ()).trouble]
    else:
        exported = tables.export(run_folder, out, parquet)
        written = [*exported.files]
        trouble += [exported.trouble]
        trouble += [f"{exported.undecodable} messages cannot be decoded: they are in no table"] if exported.undecodable else []
    trouble = [line for line in trouble if line]
    for line in trouble:
        typer.echo(line, err=True)
    if as_json:
        typer.echo(json.dumps([{"file": str(path), "rows": rows} for path, rows in written], indent=1))
    else:
        for path, rows in written:
            typer.echo(path if rows is None else f"{path}: {rows} rows")
    raise typer.Exit(1 if trouble else 0)


def _progress_of_film(video: Path) -> Callable[[int, int], None]:
    """A line on standard error every few seconds: a long film takes minutes."""
    begin_s = said_s = time.monotonic()

    def report(written: int, of: int) -> None:
        nonlocal said_s
        now_s = time.monotonic()
        if now_s - said_s >= PROGRESS_S:
            said_s, left_s = now_s, (now_s - begin_s) * (of / written - 1.0)
            typer.echo(f"{video}: {written} of {of} pictures, about {left_s:.0f} s left", err=True)

    return report


def repair(
    log_file: Annotated[Path, typer.Argument(metavar="FILE", help="A log that was cut off.")], as_json: AsJson = False
) -> None:
    """Make a cut or damaged log whole: every part that can be read, and the index that other programs want. The original is
    kept beside it. Reports and replays need none of this.

    Example:  groundstation log repair runs/pool-20260101-120000/run.mcap
    """
    from groundstation.logs.reader import read_log
    from groundstation.logs.repair import recover

    mended = recover(log_file)
    if as_json:
        typer.echo(json.dumps({"file": str(log_file), "mended": mended}))
        return
    lost = f"without what is damaged ({read_log(log_file, ()).damage}); the original is kept beside it"
    typer.echo(f"{log_file}: {f'mended, {lost}' if mended else 'is whole, nothing to mend'}")


def benchmark_report(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="Where comparison.json is, as `sim-bridge compare` writes it.")
    ],
) -> None:
    """Print the table of a comparison and write comparison.html beside it. Exit code 1 if a flight failed.

    Example:  groundstation benchmark report runs/compare-pool
    """
    from groundstation.report import compare_report

    raise typer.Exit(0 if compare_report.write(folder) else 1)
