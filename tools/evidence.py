"""Pages of docs/evidence that come from the JSON files beside them, and the list of everything that can be measured."""

import json
from collections.abc import Iterator
from pathlib import Path

from benchmarks.__main__ import BENCHMARKS
from benchmarks.evidence import of_benchmark, table
from benchmarks.robots import report

EVIDENCE = Path(__file__).parents[1] / "docs" / "evidence"
HEAD = """# Evidence

What has been measured. Each page states commit, machine, seeds and targets, and has its
figures as JSON beside it. Times depend on the machine: compare rows of one page only. This list is written by `make docs`.

"""
OTHERS = {  # pages with commands of their own
    "robots": ("python -m benchmarks robots", "robots, currents and model errors that nobody tuned for"),
    "scenes": ("make scenes", "every shipped scene flown whole, with its camera (half an hour)"),
    "laws": ("make laws", "control laws on the same seeds (half an hour)"),
    "faults": ("make faults", "every fault injected many times into real processes (hours)"),
}


def _rows() -> Iterator[list[str]]:
    """Each page that is written, and its command."""
    commands = {name: (f"make evidence ARGS={name}", what) for name, (_, what) in BENCHMARKS.items()}
    for name, (command, what) in {**OTHERS, **commands}.items():
        if (EVIDENCE / f"{name}.md").exists():
            yield [f"[{what}]({name}.md)", f"`{command}`"]


def _unwritten() -> str:
    """The benchmarks without a page, by their names."""
    names = ", ".join(f"`{name}`" for name in BENCHMARKS if not (EVIDENCE / f"{name}.md").exists())
    return f"""
More benchmarks: {names}. `python -m benchmarks --list` says what each measures. `make evidence ARGS=NAME` writes its page,
`make bench ARGS=NAME` only measures.
"""


def files() -> dict[Path, str]:
    """The list, and the page of each benchmark that has figures."""
    pages = {EVIDENCE / "README.md": HEAD + "\n".join(table(("What", "Command"), _rows())) + "\n" + _unwritten()}
    robots = EVIDENCE / "robots.json"
    pages[robots.with_suffix(".md")] = report.markdown(report.from_json(json.loads(robots.read_text(encoding="utf-8"))))
    for name in BENCHMARKS:
        file = EVIDENCE / f"{name}.json"
        if file.exists():
            pages[EVIDENCE / f"{name}.md"] = of_benchmark(json.loads(file.read_text(encoding="utf-8")))
    return pages
