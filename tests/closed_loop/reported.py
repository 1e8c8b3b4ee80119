"""The report of a run whose processes have ended."""

import json
from pathlib import Path

from tests.forked import ended


def assert_passed(run: Path) -> None:
    """Have the command make a run's report. Raises AssertionError with its checks unless all of them passed."""
    code, output, errors = ended("groundstation", "log", "report", str(run))
    assert (run / "result.json").exists(), output + errors
    result = json.loads((run / "result.json").read_text())
    assert (code, result["passed"]) == (0, True), result["checks"]
