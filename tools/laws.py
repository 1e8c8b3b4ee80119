"""SHELL: all control laws on the same seeds: `make laws` flies them, and writes docs/evidence/laws.md and its pictures.

ARGS="--seeds 1-3 --jobs 1" goes to `sim-bridge compare`.
"""

import json
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import matplotlib as mpl

from benchmarks import evidence
from groundstation.analysis.comparison import Comparison
from groundstation.report.controller_comparison import COLUMNS, cells, errors, failures, wanted
from groundstation.report.plotting import STYLE, picture
from shoal.system import programs

DOCS = Path(__file__).parents[1] / "docs"
STEM = DOCS / "evidence" / "laws"
SHOWN = ("rms_after_20s_m", "input_step_rms", "wanted_beyond")
NOISE = ("--set", "sim.numeric.pose_noise_m=0.0015", "--set", "sim.numeric.yaw_noise_rad=0.008")
FLIGHTS = (  # words of `sim-bridge compare`
    ("numeric-disturbed", "--scatter", "0.5", "--duration", "35"),
    ("numeric", "--scatter", "0.5", "--duration", "35"),
    ("pool", "--duration", "30", *NOISE, "--set", "sim.plant.step_s=0.0125"),
)
HEAD = """# Evidence: control laws on the same seeds

{written}. Seeds: {seeds}.

Distance from the reference over all robots, RMS, against the plant's truth: means over the seeds. laws.json has more
figures, and 95 % bootstrap intervals. × is the distance after 20 s over that of the first law, as the geometric mean of the
ratios on the same seeds.
*Wanted beyond*: control steps in which the law wanted more than the limit
of magnitude or of change. What is applied is cut to both limits for every law. Laws, and how their gains were found:
[baselines.md](../baselines.md). Below a table: seeds on which a law was under way in only a part of the control steps.

![Errors by law: every flight, means and intervals](../images/laws-errors.png)

![Surge that each law wants and gets, on the first seed](../images/laws-inputs.png)
"""


def _table(comparison: Comparison) -> list[str]:
    columns = [0, *(1 + k for k, column in enumerate(COLUMNS) if column.key in SHOWN)]
    heads = ["×", *(f"{column.heading}, {column.unit}" for column in COLUMNS)]
    rows = ([f"`{name}`", *(row[k].partition(" [")[0] for k in columns)] for name, row in cells(comparison))
    return evidence.table(["Law", *(heads[k] for k in columns)], rows)


def _failures(comparison: Comparison) -> list[str]:
    """The laws with flights that failed, each with its failures in one line, by seed; and an empty line."""
    by_law: dict[str, list[str]] = {}
    for failure in failures(comparison):
        law, _, what = failure.partition(", seed ")
        by_law.setdefault(law, []).append(what.replace(" of the control steps only", ""))
    return [*(f"* {law}, seed {'; '.join(texts)}" for law, texts in by_law.items()), *[""] * bool(by_law)]


def page(content: dict[str, Any]) -> str:
    """The page of evidence from the content of its JSON file."""
    lines = [HEAD.format(written=content["written"], seeds=content["seeds"])]
    for command, text in content["comparisons"].items():
        comparison = Comparison.from_json(json.dumps(text))
        lines += [f"## {comparison.scene}\n", f"`{command}`\n", *_table(comparison), ""]
        lines += _failures(comparison)
    return "\n".join(lines)


def files() -> dict[Path, str]:
    """The page and its text, if it was ever flown."""
    file = STEM.with_suffix(".json")
    return {STEM.with_suffix(".md"): page(json.loads(file.read_text(encoding="utf-8")))} if file.exists() else {}


def _pictures(first: Comparison, second: Comparison) -> None:
    for name, drawing in (("errors", errors(first)), ("inputs", wanted(second))):
        figure = picture(drawing)
        if figure is not None:
            with mpl.rc_context(STYLE):
                figure.savefig(DOCS / "images" / f"laws-{name}.png", dpi=110)


def _without_traces(comparison: Comparison) -> Comparison:
    """The comparison as the page needs it: a flight to look at is a picture."""
    variants = [replace(v, flights=[replace(f, traces=None) for f in v.flights]) for v in comparison.variants]
    return replace(comparison, variants=variants)


def main(options: Sequence[str]) -> None:
    """Fly all comparisons, and write page, figures and pictures."""
    comparisons: dict[str, Comparison] = {}
    for words in FLIGHTS:
        with tempfile.TemporaryDirectory() as folder:
            programs.start("sim_bridge", ["compare", *words, *options, "--out", folder]).wait()
            text = (Path(folder) / "comparison.json").read_text(encoding="utf-8")
        comparisons[f"sim-bridge compare {' '.join(words)}"] = Comparison.from_json(text)
    first, second, _ = comparisons.values()
    _pictures(first, second)
    content = {
        "written": evidence.written_by(" ".join(["make laws", *([f'ARGS="{" ".join(options)}"'] if options else [])])),
        "seeds": ", ".join(str(flight.seed) for flight in first.variants[0].flights),
        "comparisons": {command: asdict(_without_traces(comparison)) for command, comparison in comparisons.items()},
    }
    evidence.write(STEM, page(content), content)


if __name__ == "__main__":
    main(sys.argv[1:])
