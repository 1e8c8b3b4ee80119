"""SHELL: the runs beside the one that a page shows: their list, names, tags and reports, and their end.

A report is asked for by an ordinary link, which carries no token. So each link has a key that only pages which were let in are
told, and that is good for this run as long as this server lives.
"""

import dataclasses
import hmac
import json
import secrets
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from groundstation.analysis.cause import missed
from groundstation.analysis.numbers import mm
from groundstation.analysis.results import WHOLE_RUN, Check
from groundstation.logs import run_folders
from shoal.errors import ConfigError
from shoal.system.printable import printable
from shoal.system.regular_files import read_regular

REPORT = "report.html"
RESULT = "result.json"
WHOLE, SETTLED, ARTICLE = "RMS, whole run", "RMS after 20 s", "the article's"
# A report comes from a log of unknown source: it runs its own script in an origin of its own, and reaches nothing.
REPORT_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:; "
    "sandbox allow-scripts allow-downloads; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)


class RunDesk:
    """The folder in which a run's own folder lies. For use from any thread."""

    def __init__(self, folder: Path | None) -> None:
        """`folder`: that of the run that pages show; None: there is none, and no list."""
        self._shown = folder.resolve() if folder is not None else None
        self._secret = secrets.token_bytes(32)

    def _key(self, run: str) -> str:
        return hmac.new(self._secret, run.encode(), "sha256").hexdigest()

    def _address(self, folder: Path) -> str:
        """Address of a run's report, relative to the page; empty if there is none."""
        run = printable(folder.name)
        return f"runs/{quote(run, safe='')}/{REPORT}?key={self._key(run)}" if _report(folder) else ""

    @property
    def shown_report(self) -> str:
        """Address of the report of the run that is shown; empty if there is none, as while it is flown."""
        return self._address(self._shown) if self._shown is not None else ""

    @property
    def shown_end(self) -> dict[str, Any] | None:
        """End of the run that is shown; None while it is flown."""
        return run_end(self._shown) if self._shown is not None else None

    def empty_listing(self, problem: str) -> dict[str, Any]:
        """A list without runs for the page, and the reason."""
        return {
            "k": "runs",
            "folder": str(self._shown.parent) if self._shown is not None else "",
            "runs": [],
            "problem": problem,
        }

    def listing(self, problem: str = "") -> dict[str, Any]:
        """All runs for the page, the newest first, and what became of its last request."""
        if self._shown is None:
            return self.empty_listing(problem)
        runs = []
        for run in reversed(run_folders.list_runs(self._shown.parent)):
            folder = Path(run.run)
            if folder.is_symlink():  # of another user, and elsewhere
                continue
            own_tags = run_folders.label_of(folder)[1]  # the others are of remarks, and stay
            about = {
                "run": printable(folder.name),
                "given": own_tags,
                "report": self._address(folder),
                "shown": folder == self._shown,
                "mode": run.mode_text,
            }
            runs.append(dataclasses.asdict(run) | about)
        return {"k": "runs", "folder": str(self._shown.parent), "runs": runs, "problem": problem}

    def label(self, run: str, name: str, tags: list[str]) -> dict[str, Any]:
        """Give a run a name and tags, and list all again."""
        try:
            run_folders.give_label(self._named(run), name, tags)
        except ConfigError as error:
            return self.listing(str(error))
        return self.listing()

    def delete(self, run: str) -> dict[str, Any]:
        """Delete a run that is not being flown and that no page shows, and list what is left."""
        try:
            folder = self._named(run)
            if folder == self._shown:
                raise ConfigError(f"{run}: is shown on this page (allowed: any other run)")
            run_folders.delete_run(folder)
        except ConfigError as error:
            return self.listing(str(error))
        return self.listing()

    def report(self, run: str, key: str) -> Path | None:
        """The report of a run; None where there is none, for a wrong key, and for what is no run of this folder."""
        if not hmac.compare_digest(self._key(run).encode(), key.encode()):
            return None
        try:
            return _report(self._named(run))
        except ConfigError:
            return None

    def _named(self, run: str) -> Path:
        if self._shown is None:
            raise ConfigError(f"{run}: no such run")
        return run_folders.run_named(self._shown.parent, run)


def _report(folder: Path) -> Path | None:
    file = folder / REPORT
    return file if file.is_file() and not file.is_symlink() else None


def run_end(folder: Path) -> dict[str, Any] | None:
    """The end of a run for its page, from its result.json; None where there is no result, or one of another version."""
    try:
        result = json.loads(read_regular(folder / RESULT, run_folders.MOST_JSON_BYTES))
        checks = [Check(**check) for check in result["checks"]]
        cause = result["cause"]
        return {
            "verdict": result["verdict"],
            "cause": cause["sentence"] if cause else "",
            "outcome": cause["outcome"] if cause else "",
            "injected": cause["injected"] if cause and cause["time_s"] is not None else "",  # the page says: before
            "notes": list(result["notes"]),
            "figures": _figures(result, checks),
            "requirements": [{"text": missed(check), "met": _met(check)} for check in checks],
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError, ArithmeticError, RecursionError):
        return None


def _met(check: Check) -> str:
    return "yes" if check.passed else "no" if check.value is not None else "not reached"


def _figures(result: dict[str, Any], checks: list[Check]) -> dict[str, Any]:
    """Errors in x and y of each robot and pair in mm, in columns of two; the article's beside those of a whole run."""
    rows = {f"robot {name}": row for name, row in result["robots"].items()}
    rows |= {f"pair {name}": row for name, row in result["pairs"].items()}
    whole = all(check.passed for check in checks if check.name == WHOLE_RUN)
    columns: dict[str, Callable[[Any], Any]] = {WHOLE: lambda row: row["rms_m"]}
    if whole and any(row["article"] for row in rows.values()):
        columns[ARTICLE] = lambda row: row["article"] and row["article"]["rms_m"]
    columns[SETTLED] = lambda row: row["rms_after_20s_m"]
    columns_shown = {head: lengths_of for head, lengths_of in columns.items() if any(map(lengths_of, rows.values()))}

    def cell(lengths_m: Sequence[float] | None) -> list[str]:
        x_m, y_m, *_ = lengths_m or (None, None)
        return [mm(x_m), mm(y_m)]

    return {
        "heads": list(columns_shown),
        "rows": [
            {"name": name, "cells": [cell(lengths_of(row)) for lengths_of in columns_shown.values()]}
            for name, row in rows.items()
        ],
    }
