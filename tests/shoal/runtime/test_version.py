"""Which code this is: from git in a work tree, from what the build wrote down, else unknown."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from typer.testing import CliRunner

from groundstation.logs.recorder import run_metadata
from shoal.config.experiment import load_experiment
from shoal.runtime import version
from shoal.runtime.version import UNKNOWN, Code, are_known, commit

pytestmark = pytest.mark.real_time

ROOT = Path(__file__).parents[3]


def git(root: Path, *arguments: str) -> str:
    who = ("-c", "user.name=somebody", "-c", "user.email=somebody@example.org")
    return subprocess.run(["git", *who, *arguments], cwd=root, capture_output=True, text=True, check=True).stdout.strip()


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    (tmp_path / "shoal" / "runtime").mkdir(parents=True)
    (tmp_path / "shoal" / "runtime" / "version.py").write_text("one = 1\n")
    git(tmp_path, "init", "--quiet")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "--quiet", "-m", "one")
    return tmp_path


def test_two_states_of_the_code_are_two_and_one_is_one(tree: Path) -> None:
    clean, file = commit(tree), tree / "shoal" / "runtime" / "version.py"
    assert clean == git(tree, "rev-parse", "HEAD")
    (tree / "notes.txt").write_text("no code")
    assert commit(tree) == clean
    file.write_text("one = 2\n")
    changed = commit(tree)
    assert changed.startswith(f"{clean}+changed.")
    file.write_text("one = 3\n")
    assert commit(tree) not in (clean, changed)
    file.write_text("one = 2\n")
    assert commit(tree) == changed
    file.write_text("one = 1\n")
    (tree / "shoal" / "new.py").write_text("two = 2\n")
    assert commit(tree) not in (clean, changed)
    (tree / "shoal" / "new.py").unlink()
    assert commit(tree) == clean


def test_a_package_within_somebody_elses_work_tree_does_not_take_its_commit(tree: Path) -> None:
    installed = tree / ".venv" / "lib"
    (installed / "shoal" / "runtime").mkdir(parents=True)
    (installed / "shoal" / "runtime" / "version.py").write_text("")
    assert commit(installed) == UNKNOWN
    (installed / "shoal" / version.RECORDED).write_text("a" * 40 + "\n")
    assert commit(installed) == "a" * 40


def test_the_commit_is_unknown_without_git(tree: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    assert commit(tree) == UNKNOWN


def test_git_that_does_not_answer_leaves_the_commit_unknown_whatever_a_build_has_left_there(
    tree: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It takes too long at any of its answers, or is killed."""
    (tree / "shoal" / version.RECORDED).write_text("a" * 40 + "\n")
    real = shutil.which("git")
    for begins, does in (("ls-files --error", "sleep 60"), ("diff", "sleep 60"), ("ls-files --error", "kill -9 $$")):
        folder = tmp_path / f"bin {begins} {does}"
        folder.mkdir()
        (folder / "git").write_text(f'#!/bin/sh\ncase "$*" in "{begins}"*) {does};; esac\nexec {real} "$@"\n')
        (folder / "git").chmod(0o700)
        with monkeypatch.context() as around:
            around.setenv("PATH", f"{folder}:{os.environ['PATH']}")
            around.setattr(version, "PATIENCE_S", 1.0)
            assert commit(tree) == UNKNOWN


def test_an_unknown_commit_is_neither_the_same_as_another_nor_different() -> None:
    assert are_known("1.0 abc", "1.0 abd", "")
    assert not are_known(str(Code("1.0", UNKNOWN).short), "1.0 abc") and not are_known(UNKNOWN, UNKNOWN)
    assert are_known(Code(UNKNOWN, "a" * 40).short)


def test_git_variables_of_the_environment_do_not_change_the_commit(tree: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clean = commit(tree)
    monkeypatch.setenv("GIT_DIR", "/nowhere")
    assert commit(tree) == clean


@pytest.mark.parametrize("program", ["groundstation", "robot_agent", "localizer", "sim_bridge"])
def test_every_program_says_it(program: str) -> None:
    module = __import__(f"{program}.__main__", fromlist=["cli"])
    done = CliRunner().invoke(module.cli, ["--version"])
    assert (done.exit_code, done.output) == (0, f"{version.code()}\n")


def test_a_log_and_so_its_result_names_version_and_commit() -> None:
    metadata = run_metadata(load_experiment("pool"), "lockstep")
    assert (metadata["version"], metadata["commit"]) == (version.code().version, version.code().commit)


def test_the_build_writes_the_commit_down(tmp_path: Path) -> None:
    """setup.py as pip runs it, on a small tree."""
    for name in (
        "shoal",
        "groundstation",
        "groundstation/web",
        "robot_agent",
        "robot_agent/control",
        "localizer",
        "sim_bridge",
    ):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").touch()
    for name in ("setup.py", "pyproject.toml", "README.md", "LICENSE", "shoal/runtime/version.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes((ROOT / name).read_bytes())
    git(tmp_path, "init", "--quiet")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "--quiet", "-m", "one")
    expected = commit(tmp_path)
    command = [sys.executable, "setup.py", "--quiet", "bdist_wheel", "--dist-dir", str(tmp_path / "out")]
    subprocess.run(command, cwd=tmp_path, capture_output=True, check=True)
    (wheel,) = (tmp_path / "out").glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        assert archive.read(f"shoal/{version.RECORDED}").decode().strip() == expected
