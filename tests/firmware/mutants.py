"""Small changes of the C rules, parameters, signatures and memory, one at a time: which of them does no fast test notice?

    python -m tests.firmware.mutants [FILE.c ...] [--sample N]

Each change is compiled, and the fast tests of the core are run on it in a process of their own. Prints the changes that
nothing noticed. `make mutants` runs it.
"""

import argparse
import ctypes
import importlib
import inspect
import os
import random
import re
import resource
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.firmware.library import CORE_TESTS, FIRMWARE, built, load

FILES = ("rules.c", "parameters.c", "signing.c", "store.c")
SWAPS = [  # a piece of the code, and what stands there instead
    (r" <= ", (" < ",)), (r" < ", (" <= ",)), (r" >= ", (" > ",)), (r" > ", (" >= ",)),
    (r" == ", (" != ",)), (r" != ", (" == ",)),
    (r" && ", (" || ",)), (r" \|\| ", (" && ",)), (r" \+ ", (" - ",)), (r" - ", (" + ",)), (r"(?<=[(\s])!(?=[\w(])", ("",)),
    (r"\btrue\b", ("false",)), (r"\bfalse\b", ("true",)), (r"\b0\b", ("1",)), (r"\b1\b", ("2",)), (r"\+\+", ("--",)),
    (r"\bfminf\b", ("fmaxf",)), (r"\bfmaxf\b", ("fminf",)), (r" \* ", (" / ",)), (r" / ", (" * ",)),
]  # fmt: skip
STATEMENT = re.compile(
    r"^(\s+)(?!\s|return\b|const\b|static\b|struct\b|uint|int|float|bool|break|case|default|else)[^{}#]*;\s*(/\*.*)?$"
)
LONGEST_S = 12  # of the processor, for tests that take 4


@dataclass(frozen=True)
class Mutant:
    """A line of a file, and what it says instead."""

    file: str
    line: int  # from 1 on
    text: str

    def __str__(self) -> str:
        return f"{self.file}:{self.line}: {self.text.strip()}"


def mutants_of(file: str) -> Iterator[Mutant]:
    """Every change of one operator, constant or statement."""
    inside = False
    for number, line in enumerate((FIRMWARE / file).read_text().splitlines(), start=1):
        code = line.split("/*")[0]
        inside = (inside or line.lstrip().startswith("/*")) and "*/" not in line
        if inside or not code.strip() or code.lstrip().startswith(("#", "*", "enum", "typedef")) or "PSTR" in code:
            continue
        for pattern, replacements in SWAPS:
            for match in re.finditer(pattern, code):
                for replacement in replacements:
                    yield Mutant(file, number, line[: match.start()] + replacement + line[match.end() :])
        if STATEMENT.match(line) and code.count("(") == code.count(")"):
            yield Mutant(file, number, re.match(r"\s*", line)[0] + ";")  # type: ignore[index]


class Workshop:
    """The core as objects, of which one is another for each mutant."""

    def __init__(self, folder: Path) -> None:
        built("build/libboard.so")
        self.folder, include = folder, FIRMWARE / "build"
        made = subprocess.run(["make", "-s", "-C", str(FIRMWARE), "list-library"], capture_output=True, text=True, check=True)
        self._objects = {Path(source).name: folder / (Path(source).stem + ".o") for source in made.stdout.split()}
        self._compile = ["gcc", "-std=c99", "-O1", "-fPIC", f"-I{FIRMWARE}", "-isystem", str(include), f"-I{include}", "-w"]
        self._compile += ["-fsanitize=bounds,shift,null,unreachable", "-fsanitize-undefined-trap-on-error"]  # ends a mutant
        for source in made.stdout.split():
            subprocess.run([*self._compile, "-c", "-o", self._objects[Path(source).name], FIRMWARE / source], check=True)

    def library(self, mutant: Mutant) -> Path | None:
        """The library with a mutant; None if that is no C."""
        lines = (FIRMWARE / mutant.file).read_text().splitlines()
        lines[mutant.line - 1] = mutant.text
        source, changed, library = (self.folder / name for name in (mutant.file, "mutant.o", "mutant.so"))
        source.write_text("\n".join(lines) + "\n")
        if subprocess.run([*self._compile, "-c", "-o", changed, source], capture_output=True).returncode != 0:
            return None
        objects = [changed if name == mutant.file else of_source for name, of_source in self._objects.items()]
        subprocess.run(["gcc", "-shared", "-o", library, *objects, "-lm"], check=True)
        return library


def is_noticed(library: Path) -> bool:
    """True if a fast test of the core fails, crashes or does not end. The tests run in a copy of this process, which has
    imported what they need: those without fixtures of their own as plain calls, then all by pytest."""
    copy = os.fork()
    if copy == 0:
        resource.setrlimit(resource.RLIMIT_CPU, (LONGEST_S, LONGEST_S))
        for stream in (1, 2):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
        os.environ["SHOAL_CORE_LIBRARY"] = str(library)
        os.chdir(FIRMWARE.parent)
        try:
            call_tests(load(library))
        finally:
            os._exit(1 if sys.exc_info()[0] else int(pytest.main(["-q", "-x", "-n0", "-p", "no:cacheprovider", *CORE_TESTS])))
    return os.waitpid(copy, 0)[1] != 0


def call_tests(library: ctypes.CDLL) -> None:
    """Call the tests that need nothing but the library, and the memory of a board with a key."""
    rules, memory = (importlib.import_module(f"tests.firmware.{name}") for name in ("test_rules", "test_memory"))
    given = {"library": library, "keyed": memory.keyed_memory(library)}
    for module in (memory, rules):
        for name, test in vars(module).items():
            needs = inspect.signature(test).parameters if name.startswith("test_") else {"": None}
            if needs.keys() <= given.keys() and not hasattr(test, "pytestmark"):
                test(**{need: given[need] for need in needs})


def main() -> None:
    """Try all mutants of the files, or a sample, and print those that nothing noticed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="*", default=FILES)
    parser.add_argument("--sample", type=int, help="so many of each file, by chance")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        workshop = Workshop(Path(folder))
        for file in options.files:
            mutants, left, invalid = list(mutants_of(file)), 0, 0
            if options.sample is not None:
                mutants = random.Random(1).sample(mutants, min(options.sample, len(mutants)))
            for mutant in mutants:
                library = workshop.library(mutant)
                invalid += library is None
                if library is not None and not is_noticed(library):
                    left += 1
                    print(mutant, flush=True)
            print(f"{file}: {len(mutants) - invalid} mutants, {left} not noticed", flush=True)


if __name__ == "__main__":
    main()
