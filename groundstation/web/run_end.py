"""SHELL: an ended run for its page, from its result.json: verdict, cause, figures, requirements, as people read them."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from groundstation.analysis.cause import missed
from groundstation.analysis.numbers import mm
from groundstation.analysis.results import WHOLE_RUN, Check
from groundstation.logs.run_folders import MOST_JSON_BYTES
from shoal.system.regular_files import read_regular

RESULT = "result.json"
WHOLE, SETTLED, ARTICLE = "RMS, whole run", "RMS after 20 s", "the article's"


def run_end(folder: Path) -> dict[str, Any] | None:
    """The end of a run for its page; None where there is no result, or one of another version."""
    try:
        result = json.loads(read_regular(folder / RESULT, MOST_JSON_BYTES))
        checks = [Check(**check) for check in result["checks"]]
        cause = result["cause"]
        return {
            "verdict": result["verdict"],
            "cause": cause["sentence"] if cause else "",
            "outcome": cause["outcome"] if cause else "",
            "injected": cause["injected"] if cause else "",
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
    columns_shown = {head: values for head, values in columns.items() if any(values(row) for row in rows.values())}
    return {
        "heads": list(columns_shown),
        "rows": [
            {"name": name, "cells": [[mm(v) for v in (values(row) or (None, None))[:2]] for values in columns_shown.values()]}
            for name, row in rows.items()
        ],
    }
