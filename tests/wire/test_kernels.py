"""Rules of compiled kernels, read from the source, and parts of kernels."""

import ast
import builtins
import importlib.util
import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ("groundstation", "localizer", "robot_agent", "sim_bridge", "wire")
LIBRARIES = {"math", "cmath", "np"}

WITH_A_PART = """
from wire.kernels import kernel

NEVER_IN_THE_CACHE = %d

@kernel("f8(f8)", part=True)
def half(x):
    return x / 2.0 + 0.0 * NEVER_IN_THE_CACHE

@kernel("f8(i8)")
def quarter(x):
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
    """Breaches of the rules of wire/kernels.py."""
    kernels = _kernels(tree)
    own = {function.name for function, _ in kernels}
    for function, mark in kernels:
        arguments = mark.args if isinstance(mark, ast.Call) else []
        written = arguments and not isinstance(arguments[0], ast.Constant)  # put together from parts: Numba reads it at import
        signature = arguments[0].value if arguments and isinstance(arguments[0], ast.Constant) else None
        if not (written or (isinstance(signature, str) and signature.endswith(")") and "(" in signature)):
            yield f"{function.name}: no explicit signature"
        if ast.get_docstring(function) is None:
            yield f"{function.name}: no docstring"
        for node in ast.walk(function):
            if isinstance(node, ast.Raise | ast.Try | ast.Assert):
                yield f"{function.name}, line {node.lineno}: raises"
            if isinstance(node, ast.Call) and node not in function.decorator_list:
                called = ast.unparse(node.func)
                module, _, name = called.rpartition(".")
                if module.partition(".")[0] not in LIBRARIES and not (not module and (name in own or hasattr(builtins, name))):
                    yield f"{function.name}, line {node.lineno}: calls {called}"


def _sources() -> list[str]:
    found = (path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py")))
    return [str(path.relative_to(ROOT)) for path in found if "@kernel" in path.read_text(encoding="utf-8")]


def test_the_rules_notice_offenders() -> None:
    offender = """
@kernel
def a(x):
    "Doc."
    return other(x)

@kernel("f8(f8)")
def b(x):
    raise ValueError
"""
    assert len(list(_offences(ast.parse(offender)))) == 4  # no signature, other(); no docstring, raise
    fine = '@kernel("f8(f8)")\ndef c(x):\n    "Doc."\n    return c(math.exp(abs(x)))\n'
    assert not list(_offences(ast.parse(fine)))


@pytest.mark.parametrize("source", _sources())
def test_kernels_have_signatures_and_call_only_kernels_of_their_module(source: str) -> None:
    assert not list(_offences(ast.parse((ROOT / source).read_text(encoding="utf-8"))))


@pytest.mark.skipif("NUMBA_DISABLE_JIT" in os.environ, reason="nothing is compiled")
def test_a_part_is_compiled_for_its_own_signature_and_not_loaded_again(tmp_path: Path) -> None:
    path = tmp_path / "with_a_part.py"
    path.write_text(WITH_A_PART % time.time_ns(), encoding="utf-8")
    for has_compiled in (True, False):
        spec = importlib.util.spec_from_file_location("with_a_part", path)
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        assert [str(of) for of in module.half.overloads] == ["(float64,)"] * has_compiled
        assert module.quarter(3) == 0.75
    assert module.half(3.0) == 1.5  # a test may call it
