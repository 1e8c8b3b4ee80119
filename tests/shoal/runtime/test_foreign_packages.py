"""Packages of another installation on PYTHONPATH, in a real process."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = """
from shoal.runtime.runtime import run_app
run_app(lambda: __import__("{module}"))
"""


def ran(module: str, folder: Path) -> subprocess.CompletedProcess[str]:
    (folder / f"{module}.py").write_text('raise RuntimeError("made for another NumPy")\n')
    command = [sys.executable, "-c", PROGRAM.format(module=module)]
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    return subprocess.run(command, env=environment, capture_output=True, text=True, encoding="utf-8", check=False)


@pytest.mark.long
def test_a_package_that_is_before_our_own_is_named(tmp_path: Path) -> None:
    done = ran("scipy", tmp_path)
    assert done.returncode == 2 and "Traceback" not in done.stderr
    error, why = done.stderr.splitlines()
    assert error == "RuntimeError: made for another NumPy"
    assert why.startswith(f"PYTHONPATH={tmp_path}: puts {tmp_path / 'scipy.py'} before this program's own scipy")


@pytest.mark.long
def test_a_bug_of_a_persons_own_module_is_a_traceback(tmp_path: Path) -> None:
    done = ran("my_own_law", tmp_path)
    assert done.returncode == 1 and "Traceback" in done.stderr
