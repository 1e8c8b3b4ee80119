"""Names and first lines obey their rules: one name for one class, nouns for values, docstrings that say what a thing is.

Tests are named by what they do, begin with what they prove, and use public names. All of it is read from the source.
"""

import ast
import io
import re
import tokenize
from collections import defaultdict
from collections.abc import Iterator

import pytest

from tests.source_tree import ROOT, nodes, sources, tree_of

PACKAGES = ("shoal", "groundstation", "robot_agent", "localizer", "sim_bridge", "benchmarks", "tests")
PUBLIC = {"_replace", "_asdict", "_fields", "_exit"}  # of named tuples and of `os`: documented in spite of the underscore
DIRECTIVE = re.compile(r"#\s*(type: ignore|noqa|fmt:|pragma:)[^#]*")  # a comment for a tool, which gives no reason
VAGUE = re.compile(r"test_(who|what|whoever|somebody|nobody)_")
PARTICIPLES = {"told", "found", "known", "seen", "said", "heard", "meant", "asked"}  # they leave open what was told or found
KEPT_NAMES = {  # fields that logs and boards' memories have under these names
    ("shoal/messages/messages.py", "heard"),
    ("sim_bridge/thruster_board/board.py", "heard"),
}
SHORTEST = 7  # words of the first line of a test file: fewer name a topic, not a behaviour
RIDDLES = {"who", "whom", "whose", "whoever", "what", "whatever", "where", "wherever", "how", "why", "whether", "when"}


def first_lines(source: str) -> Iterator[tuple[str, str]]:
    """Each docstring of a file with the name of what it describes."""
    for node in nodes(tree_of(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            text = ast.get_docstring(node)
            if text:
                yield getattr(node, "name", source), text.partition("\n")[0]


def test_one_class_name_stands_for_one_class() -> None:
    where = defaultdict(list)
    for source in sources(*PACKAGES):
        for node in nodes(tree_of(source)):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                where[node.name].append(str(source))
    assert {name: files for name, files in where.items() if len(files) > 1} == {}


@pytest.mark.parametrize("package", PACKAGES)
def test_a_docstring_begins_with_what_a_thing_is_or_does(package: str) -> None:
    offences = [
        f"{source}: {name}: {line}"
        for source in sources(package)
        for name, line in first_lines(source)
        if line.removeprefix("SHELL: ").partition(" ")[0].strip(",.:").lower() in RIDDLES
    ]
    assert not offences, "\n".join(offences)


def value_names(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Each name that a file gives to a value, with its line: of a variable, a loop variable, a parameter, an attribute."""
    for node in nodes(tree):
        if isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.id if isinstance(node, ast.Name) else node.attr
        elif isinstance(node, ast.arg):
            yield node.lineno, node.arg
        elif isinstance(node, ast.ExceptHandler | ast.MatchAs | ast.MatchStar) and node.name:
            yield node.lineno, node.name


@pytest.mark.parametrize("package", [*PACKAGES, "tools"])
def test_a_value_is_named_by_a_noun(package: str) -> None:
    offences = [
        f"{source}:{line}: {name}"
        for source in sources(package)
        for line, name in value_names(tree_of(source))
        if name.strip("_") in PARTICIPLES and (source, name) not in KEPT_NAMES
    ]
    assert not offences, "\n".join(offences)


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("told = 1", ["told"]),
        ("told: int = 1", ["told"]),
        ("told += 1", ["told"]),
        ("a, told = 1, 2", ["a", "told"]),
        ("self._told = 1", ["_told"]),
        ("(told := 1)", ["told"]),
        ("for told in a: pass", ["told"]),
        ("[1 for told in a]", ["told"]),
        ("with a as told: pass", ["told"]),
        ("def f(a, told=1): pass", ["a", "told"]),
        ("lambda told: 1", ["told"]),
        ("try: pass\nexcept E as told: pass", ["told"]),
        ("match a:\n case told: pass", ["told"]),
        ("f(told=1), a.told, told(), told", []),
    ],
)
def test_names_of_values_are_those_that_a_file_gives(text: str, names: list[str]) -> None:
    assert sorted(name for _, name in value_names(ast.parse(text))) == names


def test_heads_of_modules_name_functions_and_files_that_exist() -> None:
    """Shorter names are those of equations."""
    files = [source for package in PACKAGES for source in sources(package)]
    words = {word for source in files for word in _words(tree_of(source))}
    offences = []
    for source in files:
        head = ast.get_docstring(tree_of(source)) or ""
        offences += [f"{source}: {name}()" for name in re.findall(r"(\w{4,})\(", head) if name not in words]
        paths = re.findall(r"\b([a-z_]+(?:/[a-z_]+)*\.py)\b", head)
        offences += [
            f"{source}: {path}" for path in paths if not any(f"/{file}".endswith(f"/{path}") for file in [*files, "setup.py"])
        ]
    assert not offences, "\n".join(offences)


def _words(tree: ast.Module) -> set[str]:
    """All names and words in the strings of a file, but for its docstrings."""
    docstrings = {
        id(node.body[0].value)
        for node in nodes(tree)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        and node.body
        and isinstance(node.body[0], ast.Expr)
    }
    values = (value for node in nodes(tree) if id(node) not in docstrings for value in vars(node).values())
    return set(re.findall(r"\w+", " ".join({value for value in values if isinstance(value, str)})))


def imported_modules(node: ast.AST) -> list[str]:
    """Names of the modules that a statement may import."""
    if isinstance(node, ast.ImportFrom):
        return [node.module or "", *(f"{node.module}.{alias.name}" for alias in node.names)]
    return [alias.name for alias in node.names] if isinstance(node, ast.Import) else []


def private_names(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Each private name of something else that a file uses, with its line."""
    for node in nodes(tree):
        if isinstance(node, ast.Attribute):
            if not (isinstance(node.value, ast.Name) and node.value.id in ("self", "cls")):
                yield node.end_lineno or node.lineno, node.attr
        elif isinstance(node, ast.ImportFrom):
            yield from ((alias.lineno, alias.name) for alias in node.names)


def lines_with_reasons(text: str) -> set[int]:
    """Lines that end in a comment for people, and lines below a line that is nothing but one."""
    explained_lines = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT and DIRECTIVE.sub("", token.string).strip("# "):
            line, column = token.start
            explained_lines |= {line} if token.line[:column].strip() else {line, line + 1}
    return explained_lines


def unexplained(text: str, tree: ast.Module) -> list[tuple[int, str]]:
    """Private names that a file uses without a reason beside them, with their lines."""
    private = [(line, name) for line, name in private_names(tree) if re.match(r"_[^_]", name) and name not in PUBLIC]
    explained = lines_with_reasons(text) if private else set()
    return [(line, name) for line, name in private if line not in explained]


def test_a_private_name_is_used_in_tests_only_with_a_reason_beside_it() -> None:
    offences = [
        f"{source}:{line}: {name}"
        for source in sources("tests")
        for line, name in unexplained((ROOT / source).read_text(encoding="utf-8"), tree_of(source))
    ]
    assert not offences, "\n".join(offences)


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("a._b", ["_b"]),
        ("from a import _b", ["_b"]),
        ("a._b = 1  # type: ignore[method-assign]", ["_b"]),
        ("# noqa: SLF001\na._b", ["_b"]),
        ("# a reason\n\na._b", ["_b"]),
        ("c = 1  # a reason for another line\na._b", ["_b"]),
        ("a._b['#']", ["_b"]),
        ("a._b  # type: ignore[attr-defined]  # a reason", []),
        ("# a reason\na._b", []),
        ("a._replace(b=1), self._b, a.__dict__", []),
    ],
)
def test_a_comment_for_a_tool_or_on_another_line_is_no_reason(text: str, names: list[str]) -> None:
    assert [name for _, name in unexplained(text, ast.parse(text))] == names


def test_a_test_is_named_by_what_it_does() -> None:
    offences = [
        f"{source}: {node.name}"
        for source in sources("tests")
        for node in nodes(tree_of(source))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and VAGUE.match(node.name)
    ]
    assert not offences, "\n".join(offences)


def test_a_test_file_begins_with_what_it_proves() -> None:
    """In a sentence of one line."""
    offences = [
        f"{source}: {line}"
        for source in sources("tests")
        if source.rpartition("/")[2].startswith("test_")
        for line in [(ast.get_docstring(tree_of(source)) or "").partition("\n")[0]]
        if not line.endswith(".") or len(line.split()) < SHORTEST
    ]
    assert not offences, "\n".join(offences)


def test_no_test_module_imports_from_another() -> None:
    """Helpers that two of them share are in a module of their own, so that either can be moved or run alone."""
    offences = [
        f"{source}: {name}"
        for source in sources("tests")
        for node in nodes(tree_of(source))
        for name in imported_modules(node)
        if name.startswith("tests.") and any(part.startswith("test_") for part in name.split("."))
    ]
    assert not offences, "\n".join(offences)
