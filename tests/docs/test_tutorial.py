"""docs/tutorial.md and docs/scripting.md, done step by step in an empty folder."""

import ast
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from groundstation.planning import planner
from shoal.config.experiment import load_experiment
from tests.forked import ended

pytestmark = pytest.mark.long

DOCS = Path(__file__).parents[2] / "docs"


def shell_lines(page: str) -> list[str]:
    """The commands of a page's shell blocks, without their remarks."""
    blocks = re.findall(r"```sh\n(.*?)```", (DOCS / page).read_text(encoding="utf-8"), re.DOTALL)
    return [line.partition("  #")[0].strip() for block in blocks for line in block.splitlines()]


def without_comment_signs(text: str, section: str) -> str:
    """The file after the `#` before a section and its keys were taken away."""
    before, sign, rest = text.partition(f"# {section}")
    block, gap, after = (sign + rest).partition("\n\n")
    return before + "\n".join(line.removeprefix("# ") for line in block.splitlines()) + gap + after


def test_the_commands_of_the_tutorial_do_what_it_says_one_after_the_other(tmp_path: Path) -> None:
    activates, *before, with_camera = shell_lines("tutorial.md")
    assert activates == ". .venv/bin/activate" and len(before) == 6 and "--one-process" in with_camera
    for line in before:
        line = f"{line} --duration 6" if "numeric" in line else line  # of 60 s
        code, output, errors = ended(*shlex.split(line), folder=tmp_path)
        assert code == 0, f"{line}\n{output}{errors}"
    code, _, _ = ended(*shlex.split(before[0]), folder=tmp_path)
    assert code == 2  # sim-bridge new again
    assert list(tmp_path.glob("runs/lab-*/report.html"))
    file = tmp_path / "lab.toml"
    code, _, errors = ended(*shlex.split(with_camera), folder=tmp_path)
    assert code == 2 and "camera: missing" in errors
    file.write_text(without_comment_signs(file.read_text(), "[camera]"))
    _, output, errors = ended(*shlex.split(with_camera.replace("--duration 3", "--duration 1")), folder=tmp_path)
    assert "exposure" not in errors, errors
    assert list(tmp_path.glob("runs/lab-*/logs/localizer.log")), output + errors


def test_another_robot_and_a_change_of_the_formation_can_be_flown(tmp_path: Path) -> None:
    ended("sim-bridge", "new", "lab", folder=tmp_path)
    file = tmp_path / "lab.toml"
    more = re.findall(r"```toml\n(.*?)```", (DOCS / "tutorial.md").read_text(encoding="utf-8"), re.DOTALL)[0]
    shape, robot = more[: more.index("[[robots]]")], more[more.index("[[robots]]") :]
    text = file.read_text()
    old = text[text.index("[formation]") : text.index("# [[formation.changes]]")]
    four = text.replace(old, f"{shape}\n") + f"\n{robot}"
    for changed in (four, without_comment_signs(text, "[[formation.changes]]"), without_comment_signs(text, "[camera]")):
        file.write_text(changed)
        settings = [] if changed.count("\n[camera]") else ["localizer.uses_camera=false"]
        loaded = load_experiment(str(file), settings)
        assert set(planner.plan(loaded)) == set(loaded.robot_ids)
    assert 4 not in loaded.robot_ids and load_experiment(str(file)).formation.changes == ()


def test_the_page_about_scripts_has_code_that_runs(tmp_path: Path) -> None:
    lead, simulate, learn = re.findall(r"```python\n(.*?)```", (DOCS / "scripting.md").read_text(encoding="utf-8"), re.DOTALL)
    ast.parse(lead)  # tests/shoal and tests/examples run its calls
    done = subprocess.run(
        [sys.executable, "-c", simulate], cwd=tmp_path, capture_output=True, text=True, timeout=500, check=False
    )
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) == 2
    done = subprocess.run(
        [sys.executable, "-c", learn], cwd=tmp_path, capture_output=True, text=True, timeout=500, check=False
    )
    assert done.returncode == 0, done.stderr
