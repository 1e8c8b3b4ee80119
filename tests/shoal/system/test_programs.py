"""Child processes of the project's own programs: what they import, what they speak, and when they end."""

import os
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from shoal.system import programs
from tests.planted import executed, plant
from tests.source_tree import ROOT
from tests.waiting import eventually

PACKAGES = ("shoal", "groundstation", "robot_agent", "localizer", "sim_bridge")


def test_programs_are_started_in_one_place() -> None:
    starting = {
        str(path.relative_to(ROOT))
        for package in PACKAGES
        for path in (ROOT / package).rglob("*.py")
        if "sys.executable" in (text := path.read_text(encoding="utf-8")) and "subprocess" in text
    }
    assert starting == {"shoal/system/programs.py"}


@pytest.mark.long
def test_nothing_is_imported_from_the_working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(plant(tmp_path))
    done = programs.ask("groundstation", ["--version"])
    assert done.returncode == 0 and done.stdout.startswith("shoal "), done.stderr
    assert not executed(tmp_path)


def test_a_child_runs_its_parents_code_and_not_another_checkout(tmp_path: Path) -> None:
    """`python -m` in a second checkout runs that one, and so do its children, though this one is installed."""
    package = tmp_path / "shoal"
    (package / "system").mkdir(parents=True)
    (package / "__init__.py").touch()
    (package / "system" / "programs.py").write_text((ROOT / "shoal/system/programs.py").read_text())
    (package / "parent.py").write_text("from shoal.system import programs\nprint(programs.ask('shoal.child', []).stdout)")
    (package / "child.py").write_text("print('of the second checkout')")
    words = [sys.executable, "-m", "shoal.parent"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "of the second checkout"


@pytest.mark.long
def test_parent_and_child_speak_utf8_whatever_the_locale(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PYTHONIOENCODING", "ascii")
    missing = tmp_path / "Wel\N{LATIN SMALL LETTER O WITH DIAERESIS} \N{EN DASH}"
    done = programs.ask("groundstation", ["log", "report", str(missing)])
    assert str(missing) in done.stderr


@pytest.mark.real_time
@pytest.mark.parametrize("number", [9, 15], ids=["killed", "ended"])
def test_a_child_ends_with_its_parent(number: int, tmp_path: Path) -> None:
    """The child is a program that would wait for a station for ever."""
    script = """
import subprocess, sys, time
from shoal.system import programs
words = ["run", "pool", "--robot", "1", "--station", "tcp/127.0.0.1:9", "--link", "udp:127.0.0.1:9"]
child = programs.start("robot_agent", words, stdout=subprocess.DEVNULL, stderr=open(sys.argv[1], "wb"))
print(child.pid, flush=True)
time.sleep(600)
"""
    log = tmp_path / "log"
    words = [sys.executable, "-c", script, str(log)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        child = psutil.Process(int(parent.stdout.readline()))
        assert eventually(lambda: log.exists() and "waiting for the station" in log.read_text())
        os.kill(parent.pid, number)
    assert eventually(lambda: not child.is_running() or child.status() == psutil.STATUS_ZOMBIE)


@pytest.mark.real_time
def test_a_child_whose_parent_has_ended_before_it_began_ends(tmp_path: Path) -> None:
    script = "from shoal.system.programs import end_with_parent\nend_with_parent()\nprint('goes on')"
    around = {**programs.environment(), programs.PARENT: "1"}
    done = subprocess.run([sys.executable, "-c", script], env=around, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (1, "")
