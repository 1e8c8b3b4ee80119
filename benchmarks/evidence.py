"""Pages of evidence: Markdown tables, JSON beside them, and the progress of the flights that they are made of."""

import json
import math
import os
import platform
from collections.abc import Iterable, Sequence
from datetime import date
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from shoal.runtime.output_files import replace_text
from shoal.runtime.version import code

NEVER = "never"  # infinity, as JSON has none


def written_by(command: str) -> str:
    """The sentence that says when, from which commit, and on which machine a page was written."""
    machine = f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"
    return f"Written by `{command}` on {date.today().isoformat()}: commit {code().commit[:12]}, {machine}"


def table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Lines of a Markdown table."""
    return [f"| {' | '.join(columns)} |", f"|{'---|' * len(columns)}", *(f"| {' | '.join(row)} |" for row in rows)]


def of_benchmark(content: dict[str, Any]) -> str:
    """The page of one benchmark: `content` is that of its JSON file."""
    seeds = f" Seeds: {content['seeds']}." if content["seeds"] else ""
    heads = [f"# Evidence: {content['name']}", "", f"{content['written']}.{seeds}", "", content["about"], ""]
    single = [row for row in content["rows"] if row["n"] == 1]
    spreads = [row for row in content["rows"] if row["n"] > 1]
    tables = [[*table(*of_rows(rows)), ""] for of_rows, rows in ((_of_single, single), (_of_spreads, spreads)) if rows]
    return "\n".join([*heads, *(line for lines in tables for line in lines)])


def _of_single(rows: Sequence[dict[str, Any]]) -> tuple[Sequence[str], list[list[str]]]:
    """Columns and cells of figures that are one number: a row for each case and unit, a column for each subject."""
    subjects = list(dict.fromkeys(row["subject"] for row in rows))
    cases: dict[tuple[str, str], dict[str, dict[str, Any]]] = {}
    for row in rows:
        cases.setdefault((row["case"], row["unit"]), {})[row["subject"]] = row
    cells = [
        [case, unit, *(short(of[s]["p50"]) if s in of else "" for s in subjects), next((r["target"] for r in of.values()), "")]
        for (case, unit), of in cases.items()
    ]
    return ("Case", "Unit", *subjects, "Target"), cells


def _of_spreads(rows: Sequence[dict[str, Any]]) -> tuple[Sequence[str], list[list[str]]]:
    """Columns and cells of figures with a spread."""
    columns = ("Case", "Subject", "Median", "99 %", "Largest", "Unit", "n", "Target")
    cells = [
        [
            row["case"],
            row["subject"],
            *(short(row[k]) for k in ("p50", "p99", "max")),
            row["unit"],
            str(row["n"]),
            row["target"],
        ]
        for row in rows
    ]
    return columns, cells


def spread(values: Iterable[float], scale: float = 1e3) -> str:
    """The largest, and in brackets the median, times a scale; empty where nothing is known."""
    numbers = sorted(scale * value for value in values if not math.isnan(value))
    return f"{short(numbers[-1])} ({short(numbers[len(numbers) // 2])})" if numbers else ""


def short(value: float) -> str:
    """Three digits; of a larger number those before its point."""
    return NEVER if math.isinf(value) else f"{value:.0f}" if abs(value) >= 100.0 else f"{value:.3g}"


def plain(value: Any) -> Any:
    """The value for JSON: None for every number that is not known, NEVER for infinity."""
    if isinstance(value, dict):
        return {key: plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [plain(inner) for inner in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else NEVER
    return value


def write(stem: Path, page: str, content: Any) -> None:
    """Write a page, and its content as JSON beside it."""
    stem.parent.mkdir(exist_ok=True)
    replace_text(stem.with_suffix(".md"), page)
    write_json(stem.with_suffix(".json"), content)


def write_json(file: Path, content: Any) -> None:
    """Write values of any kind that `plain` knows."""
    replace_text(file, json.dumps(plain(content), indent=1, allow_nan=False) + "\n")


def progress(console: Console) -> Progress:
    """A bar with numbers and times, if the console is a terminal."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    return Progress(*columns, console=console, disable=not console.is_terminal)
