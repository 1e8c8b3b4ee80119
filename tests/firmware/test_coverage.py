"""Each line and each branch of the C rules, parameters, signatures and memory is run by the fast tests."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.firmware.library import CORE_TESTS, FIRMWARE, built

pytestmark = pytest.mark.long

COVERED = ("rules.c", "parameters.c", "signing.c", "store.c")


def measured(folder: Path) -> dict[str, list[dict[str, Any]]]:
    """The lines of each file, as gcov counts them, after a run of the core's fast tests."""
    built("build/libboard.so")
    core = subprocess.run(
        ["make", "-s", "-C", str(FIRMWARE), "list-library"], capture_output=True, text=True, check=True
    ).stdout.split()
    library, include = folder / "covered.so", FIRMWARE / "build"
    options = ["-std=c99", "-O0", "--coverage", "-fPIC", "-shared", "-isystem", str(include), f"-I{include}"]
    subprocess.run(["gcc", *options, "-o", library, *(FIRMWARE / name for name in core), "-lm"], check=True, cwd=folder)
    words = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *CORE_TESTS]
    environment = os.environ | {"SHOAL_CORE_LIBRARY": str(library)}
    subprocess.run(words, check=True, cwd=FIRMWARE.parent, env=environment, stdout=subprocess.DEVNULL)
    lines_by_file: dict[str, list[dict[str, Any]]] = {}
    for data in folder.glob("*.gcda"):
        output = subprocess.run(
            ["gcov", "--json-format", "--branch-probabilities", "--branch-counts", "--stdout", str(data)],
            capture_output=True,
            check=True,
        )
        for line in output.stdout.splitlines():
            for file in json.loads(line)["files"]:
                if (name := Path(file["file"]).name) in COVERED:
                    lines_by_file[name] = file["lines"]
    return lines_by_file


@pytest.fixture(scope="module")
def coverage(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[dict[str, Any]]]:
    return measured(tmp_path_factory.mktemp("coverage"))


@pytest.mark.parametrize("name", COVERED)
def test_every_line_and_every_branch_is_run(coverage: dict[str, list[dict[str, Any]]], name: str) -> None:
    source = (FIRMWARE / name).read_text().splitlines()
    missing = [
        f"{name}:{line['line_number']}: {source[line['line_number'] - 1].strip()}"
        + (f"  (branches {[branch['count'] for branch in line['branches']]})" if line["count"] else "")
        for line in coverage[name]
        if line["count"] == 0 or any(branch["count"] == 0 for branch in line["branches"])
    ]
    assert not missing, "\n".join(missing)
