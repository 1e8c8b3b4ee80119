"""Syntax trees of the project's source files, each parsed and flattened once in a test process."""

import ast
import gc
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]


def sources(*packages: str) -> list[str]:
    """Python files of some packages, by their paths below the project's root."""
    paths = (path for package in packages for path in sorted((ROOT / package).rglob("*.py")))
    return [str(path.relative_to(ROOT)) for path in paths]


@cache
def tree_of(source: str) -> ast.Module:
    """Syntax tree of a file. All together have a million objects, which live as long as the tests: the collector leaves them
    alone, and takes a fifth of the time."""
    gc.disable()
    tree = ast.parse((ROOT / source).read_text(encoding="utf-8"))
    gc.freeze()
    gc.enable()
    return tree


@cache
def nodes(tree: ast.Module) -> tuple[ast.AST, ...]:
    """All nodes below a tree, in the order of `ast.walk`."""
    return tuple(ast.walk(tree))
