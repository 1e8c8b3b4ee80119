"""SHELL: pictures of docs/baselines.md and, on standard output, its tables, from the folders of comparisons:
`python -m docs.laws NUMERIC_DISTURBED NUMERIC POOL`."""

import sys
from pathlib import Path

import matplotlib as mpl

from groundstation.analysis.comparison import Comparison
from groundstation.report.controller_comparison import COLUMNS, cells, errors, wanted
from groundstation.report.plotting import STYLE

IMAGES = Path(__file__).parent / "images"
TOLD = ("rms_m", "rms_after_20s_m", "formation_after_20s_m", "input_step_rms", "wanted_beyond", "wanted_most")


def table(comparison: Comparison) -> str:
    """A comparison's table in Markdown."""
    columns = [0, *(1 + k for k, column in enumerate(COLUMNS) if column.key in TOLD)]
    heads = ["×", *(f"{column.heading}, {column.unit}" for column in COLUMNS)]
    rows = [["", *(heads[k] for k in columns)], ["---"] * (1 + len(columns))]
    rows += [[f"`{name}`", *(row[k] for k in columns)] for name, row in cells(comparison)]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def main() -> None:
    """Errors of the first comparison, inputs of the second, tables of all."""
    found = [Comparison.from_json((Path(folder) / "comparison.json").read_text(encoding="utf-8")) for folder in sys.argv[1:]]
    for name, comparison, draw in (("errors", found[0], errors), ("inputs", found[1], wanted)):
        figure = draw(comparison)
        if figure is not None:
            with mpl.rc_context(STYLE):
                figure.savefig(IMAGES / f"laws-{name}.png", dpi=110)
    for comparison in found:
        print(f"{comparison.scene}, {len(comparison.variants[0].flights)} seeds:\n\n{table(comparison)}\n")


if __name__ == "__main__":
    main()
