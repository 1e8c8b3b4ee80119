"""The report of a run whose processes have ended."""

import json
import subprocess
import sys
from pathlib import Path


def assert_passed(run: Path) -> None:
    """Have the command make a run's report. Raises AssertionError with its checks unless all of them passed."""
    command = [sys.executable, "-m", "groundstation", "log", "report", str(run)]
    report = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (run / "result.json").exists(), report.stdout + report.stderr
    result = json.loads((run / "result.json").read_text())
    assert (report.returncode, result["passed"]) == (0, True), result["checks"]
