"""Rules of compiled kernels, read from the source, and parts of kernels."""

import ast
import importlib.util
import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.source_tree import ROOT, nodes, tree_of

PACKAGES = ("groundstation", "localizer", "robot_agent", "sim_bridge", "shoal")

WITH_A_PART = """
from shoal.kernels.decorator import kernel

NEVER_IN_THE_CACHE = %d

@kernel(part=True)
def half(x: float) -> float:
    return x / 2.0 + 0.0 * NEVER_IN_THE_CACHE

@kernel
def quarter(x: int) -> float:
    return half(x) / 2.0
"""


def _kernels(tree: ast.Module) -> list[tuple[ast.FunctionDef, ast.expr]]:
    """Functions under the decorator, with the decorator."""
    return [
        (node, mark)
        for node in tree.body
        if isinstance(node, ast.FunctionDef)
        for mark in node.decorator_list
        if ast.unparse(mark).partition("(")[0].rpartition(".")[2] == "kernel"
    ]


def _offences(tree: ast.Module) -> Iterator[str]:
    """Breaches of the rules of the decorator. (That a kernel calls only kernels, its stamp refuses at the import.)"""
    for function, _ in _kernels(tree):
        parameters = function.args.args
        if not (function.returns and all(parameter.annotation for parameter in parameters)):
            yield f"{function.name}: no types"
        if ast.get_docstring(function) is None:
            yield f"{function.name}: no docstring"
        for node in ast.walk(function):
            if isinstance(node, ast.Raise | ast.Try | ast.Assert):
                yield f"{function.name}, line {node.lineno}: raises"


def _sources() -> list[str]:
    paths = (path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py")))
    return [str(path.relative_to(ROOT)) for path in paths if "@kernel" in path.read_text(encoding="utf-8")]


def test_the_rules_notice_offenders() -> None:
    offender = """
@kernel
def a(x):
    "Doc."
    return other(x)

@kernel
def b(x: float) -> float:
    raise ValueError
"""
    assert len(list(_offences(ast.parse(offender)))) == 3  # no types; no docstring, raise
    fine = '@kernel(part=True)\ndef c(x: float) -> float:\n    "Doc."\n    return c(math.exp(abs(x)))\n'
    assert not list(_offences(ast.parse(fine)))


@pytest.mark.parametrize("source", _sources())
def test_kernels_have_types_and_raise_nothing(source: str) -> None:
    assert not list(_offences(tree_of(source)))


def _called_from_python() -> set[str]:
    """Full names of what code outside kernels mentions: by its name, as an import, or as `module.name`."""
    mentioned: set[str] = set()
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            tree = tree_of(str(path.relative_to(ROOT)))
            own, kernels = _module(path), {id(function) for function, _ in _kernels(tree)}
            imports = [node for node in nodes(tree) if isinstance(node, ast.ImportFrom)]
            full = {alias.asname or alias.name: f"{node.module}.{alias.name}" for node in imports for alias in node.names}
            for node in (inner for top in tree.body if id(top) not in kernels for inner in ast.walk(top)):
                if isinstance(node, ast.Name):
                    mentioned.add(full.get(node.id, f"{own}.{node.id}"))
                if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                    mentioned.add(f"{full.get(node.value.id)}.{node.attr}")
    return mentioned


def _module(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts)


def test_parts_are_the_kernels_that_only_kernels_call() -> None:
    """A kernel of its own costs time and memory at each start; a part that Python calls is compiled in flight."""
    mentioned, wrong = _called_from_python(), []
    for source in _sources():
        for function, mark in _kernels(tree_of(source)):
            name = f"{_module(ROOT / source)}.{function.name}"
            is_part = isinstance(mark, ast.Call) and any(keyword.arg == "part" for keyword in mark.keywords)
            if is_part is (name in mentioned):
                wrong.append(f"{name}: {'called from Python' if is_part else 'should be a part'}")
    assert not wrong, "\n".join(wrong)


@pytest.mark.skipif("NUMBA_DISABLE_JIT" in os.environ, reason="nothing is compiled")
def test_a_part_is_compiled_for_its_own_signature_and_not_loaded_again(tmp_path: Path) -> None:
    path = tmp_path / "with_a_part.py"
    path.write_text(WITH_A_PART % time.time_ns(), encoding="utf-8")
    for has_compiled in (True, False):
        spec = importlib.util.spec_from_file_location("with_a_part", path)
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        assert [str(of) for of in module.half.dispatcher.overloads] == ["(float64,)"] * has_compiled
        assert module.quarter(3) == 0.75
    assert module.half(3.0) == 1.5  # a test may call it
