"""Small changes of the C rules, parameters, signatures and memory, one at a time: which of them does no fast test notice?

    python -m tests.firmware.mutants [FILE.c ...] [--sample N]

Each change is compiled, and the fast tests of the core are run on it in a process of their own. Prints the changes that
nothing noticed. `make mutants` runs it.
"""

import argparse
import os
import random
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tests.firmware.library import CORE_TESTS, FIRMWARE, built

FILES = ("rules.c", "parameters.c", "signing.c", "store.c")
SWAPS = [  # a piece of the code, and what stands there instead
    (r" <= ", (" < ",)), (r" < ", (" <= ",)), (r" >= ", (" > ",)), (r" > ", (" >= ",)),
    (r" == ", (" != ",)), (r" != ", (" == ",)),
    (r" && ", (" || ",)), (r" \|\| ", (" && ",)), (r" \+ ", (" - ",)), (r" - ", (" + ",)), (r"(?<=[(\s])!(?=[\w(])", ("",)),
    (r"\btrue\b", ("false",)), (r"\bfalse\b", ("true",)), (r"\b0\b", ("1",)), (r"\b1\b", ("2",)), (r"\+\+", ("--",)),
    (r"\bfminf\b", ("fmaxf",)), (r"\bfmaxf\b", ("fminf",)), (r" \* ", (" / ",)), (r" / ", (" * ",)),
]  # fmt: skip
STATEMENT = re.compile(
    r"^(\s+)(?!return\b|const\b|static\b|struct\b|uint|int|float|bool|break|case|default|else)[^{}#]*;\s*(/\*.*)?$"
)
LONGEST_S = 60


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
    """The core as objects, of which one is compiled anew for each mutant."""

    def __init__(self, folder: Path) -> None:
        built("build/libboard.so")
        self.folder, include = folder, FIRMWARE / "build"
        made = subprocess.run(["make", "-s", "-C", str(FIRMWARE), "list-library"], capture_output=True, text=True, check=True)
        self._sources = made.stdout.split()
        self._compile = ["gcc", "-std=c99", "-O1", "-fPIC", f"-I{FIRMWARE}", "-isystem", str(include), f"-I{include}", "-w"]
        for source in self._sources:
            self._object(FIRMWARE / source, source)

    def _object(self, path: Path, source: str) -> bool:
        made = folder_of(self.folder, source)
        return subprocess.run([*self._compile, "-c", "-o", made, path], capture_output=True).returncode == 0

    def library(self, mutant: Mutant) -> Path | None:
        """The library with a mutant; None if that is no C."""
        lines = (FIRMWARE / mutant.file).read_text().splitlines()
        lines[mutant.line - 1] = mutant.text
        changed, library = self.folder / mutant.file, self.folder / f"mutant-{os.getpid()}.so"
        changed.write_text("\n".join(lines) + "\n")
        if not self._object(changed, mutant.file):
            return None
        objects = [folder_of(self.folder, source) for source in self._sources]
        subprocess.run(["gcc", "-shared", "-o", library, *objects, "-lm"], check=True)
        self._object(FIRMWARE / mutant.file, mutant.file)
        return library


def folder_of(folder: Path, source: str) -> Path:
    """Place of a source's object."""
    return folder / (Path(source).stem + ".o")


def is_noticed(library: Path) -> bool:
    """True if a fast test of the core fails, crashes or does not end."""
    words = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *CORE_TESTS]
    environment = os.environ | {"SHOAL_CORE_LIBRARY": str(library)}
    try:
        return (
            subprocess.run(words, cwd=FIRMWARE.parent, env=environment, capture_output=True, timeout=LONGEST_S).returncode != 0
        )
    except subprocess.TimeoutExpired:
        return True


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
