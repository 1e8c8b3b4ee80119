"""The end of `make test`: what was skipped, why, and what brings it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests import skipped
from tests.firmware.mega import simavr_library

ROOT = Path(__file__).parents[1]
TESTS = """
import pytest

@pytest.mark.skipif(True, reason="needs Chromium, and none is installed")
@pytest.mark.parametrize("k", range(3))
def test_page(k): ...

def test_ssh():
    pytest.skip("no sshd here (Debian: apt install openssh-server)")

def test_root():
    pytest.skip("needs root to be allowed everything")
"""


@pytest.mark.long
def test_processes_leave_their_reasons_and_the_end_tells_them_once_with_one_command(tmp_path: Path) -> None:
    """Also where xdist runs them; and a process that nobody collects from tells its own."""
    (tmp_path / "noted").mkdir()
    (tmp_path / "test_here.py").write_text(TESTS)
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "tests.conftest",
        "-p",
        "no:cacheprovider",
        "--rootdir",
        str(tmp_path),
    ]
    environment = {name: value for name, value in os.environ.items() if name != skipped.FOLDER}
    for options in (["-n", "0"], ["-n", "2"]):
        done = subprocess.run(
            [*command, *options, "test_here.py"],
            cwd=tmp_path,
            env={**environment, "PYTHONPATH": str(ROOT), skipped.FOLDER: str(tmp_path / "noted")},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0 and "were skipped" not in done.stdout, done.stdout + done.stderr
    summary = subprocess.run(
        [sys.executable, "-m", "tests.skipped", str(tmp_path / "noted")], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout
    assert summary.splitlines() == [
        "10 tests were skipped:",
        "    6 needs Chromium, and none is installed",
        "    2 needs root to be allowed everything",
        "    2 no sshd here (Debian: apt install openssh-server)",
        "What they lack comes with: sudo apt install --no-install-recommends chromium openssh-server",
    ]


@pytest.mark.parametrize(
    ("programs", "packages"),
    [
        (("make",), "gcc-avr avr-libc libsimavr-dev libelf-dev arduino-core-avr"),
        (("make", "avr-gcc"), "gcc libc6-dev"),
        (("make", "avr-gcc", "gcc"), "libsimavr-dev libelf-dev"),
    ],
)
def test_a_machine_without_the_simulated_arduinos_tools_is_told_all_of_their_packages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, programs: tuple[str, ...], packages: str
) -> None:
    for program in programs:  # a `make` to which all is up to date, and compilers that know no header
        (tmp_path / program).write_text(f"#!/bin/sh\nexit {int(program == 'gcc')}\n")
        (tmp_path / program).chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(pytest.skip.Exception) as reason:
        simavr_library()
    assert list(skipped.summary([str(reason.value)]))[-1].endswith(f"--no-install-recommends {packages}")


def test_the_whole_check_installs_all_that_tests_may_lack() -> None:
    script = (ROOT / ".ci" / "run").read_text()
    packages = {package for packages in skipped.PACKAGES.values() for package in packages.split()}
    assert {package for package in packages if package not in script} == {"npm"}  # of a slow test


def test_nothing_skipped_is_nothing_told() -> None:
    assert not list(skipped.summary([]))
