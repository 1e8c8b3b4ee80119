"""The scripts of examples/, run as a user would: in a folder of the user's own, in software."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"
SAYS = {
    "change_formation": r"20 s: 3\.0\d m apart\n  26 s: 2\.5\d m apart",
    "compare_settings": r"True: worst error \d\.\d mm.*\n.*False: worst error \d{3}\.\d mm",
    "emergency_stop": r"stopped: \(1, 2\)",
    "lead_a_fleet": r"RUNNING",
    "watch_fleet": r"mission: DONE",
}
# One of them in every run: they make the same calls.
CONNECTED = {"lead_a_fleet": [], "emergency_stop": [pytest.mark.slow], "watch_fleet": [pytest.mark.slow]}


def said(name: str, folder: Path) -> str:
    done = subprocess.run(
        [sys.executable, str(EXAMPLES / f"{name}.py")], cwd=folder, capture_output=True, text=True, timeout=500, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.long
@pytest.mark.parametrize("name", sorted(set(SAYS) - set(CONNECTED)))
def test_a_script_that_simulates_prints_its_result_and_leaves_a_run(name: str, tmp_path: Path) -> None:
    assert re.search(SAYS[name], said(name, tmp_path))
    assert all((run / "report.html").exists() for run in (tmp_path / "runs").iterdir())


@pytest.mark.real_time
@pytest.mark.parametrize("name", [pytest.param(name, marks=marks) for name, marks in CONNECTED.items()])
def test_a_script_that_leads_a_fleet_comes_to_its_end(name: str, tmp_path: Path) -> None:
    assert re.search(SAYS[name], said(name, tmp_path))
    (run,) = (tmp_path / "runs").iterdir()
    assert (run / "result.json").exists()


def test_each_script_is_run() -> None:
    assert {path.stem for path in EXAMPLES.glob("*.py")} == set(SAYS)
