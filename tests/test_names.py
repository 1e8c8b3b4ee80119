"""Names and first lines, read from the source: one name for one class, and docstrings that say what a thing is or does."""

import ast
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("wire", "groundstation", "robot_agent", "localizer", "sim_bridge", "benchmarks", "tests")
GENERATED = {"fleet_pb2.py"}
RIDDLES = {"who", "whom", "whose", "whoever", "what", "whatever", "where", "wherever", "how", "why", "whether", "when"}


def sources(*packages: str) -> Iterator[Path]:
    for package in packages:
        yield from (path for path in sorted((ROOT / package).rglob("*.py")) if path.name not in GENERATED)


def first_lines(path: Path) -> Iterator[tuple[str, str]]:
    """Each docstring of a file with the name of what it describes."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            text = ast.get_docstring(node)
            if text:
                yield getattr(node, "name", path.stem), text.partition("\n")[0]


def test_one_class_name_stands_for_one_class() -> None:
    where = defaultdict(list)
    for path in sources(*PACKAGES[:5]):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                where[node.name].append(str(path.relative_to(ROOT)))
    assert {name: files for name, files in where.items() if len(files) > 1} == {}


@pytest.mark.parametrize("package", PACKAGES)
def test_a_docstring_begins_with_what_a_thing_is_or_does(package: str) -> None:
    found = [
        f"{path.relative_to(ROOT)}: {name}: {line}"
        for path in sources(package)
        for name, line in first_lines(path)
        if line.removeprefix("SHELL: ").partition(" ")[0].strip(",.:").lower() in RIDDLES
    ]
    assert not found, "\n".join(found)
