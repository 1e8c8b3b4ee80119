"""SHELL: from comparison.json to a table and one self-contained comparison.html."""

from pathlib import Path

from markupsafe import Markup
from rich.table import Table

from groundstation.analysis.comparison import Comparison
from groundstation.analysis.statistics import CONFIDENCE, RESAMPLES
from groundstation.report.controller_comparison import (
    COLUMNS,
    STEP_HEADINGS,
    cells,
    closest,
    course,
    demands,
    errors,
    failures,
    seeds_of,
    step_cells,
    wanted,
)
from groundstation.report.plotting import on_page
from groundstation.report.report import environment, saving_script
from shoal.errors import ConfigError
from shoal.runtime.output import terminal
from shoal.runtime.output_files import replace_text
from shoal.system.regular_files import read_regular

FIGURES = (
    ("errors", "Errors, law by law", "A dot per seed; bars are means with their 95 % confidence intervals.", errors),
    (
        "course",
        "Over time",
        "Distance from the reference, RMS over the robots, on the first seed. "
        "What comes after the dotted line is in the columns after 20 s.",
        course,
    ),
    (
        "wanted",
        "What the laws want, and what they get",
        "Surge on the first seed, of the robot that wants most (the article's Figure 14). What is applied keeps the limit.",
        wanted,
    ),
    (
        "demands",
        "Limits and wear",
        "Steps in which more was wanted than is allowed; and how much what was applied changes.",
        demands,
    ),
)
MOST_BYTES = 100_000_000  # of comparison.json
CAPTION = "RMS distances from the reference; largest, yaw and formation after 20 s; wanted: before limits cut it off"
HEADINGS = ("×", *(f"{c.heading} [{c.unit}]" for c in COLUMNS), *STEP_HEADINGS)
INTERVALS = f"in brackets {100 * CONFIDENCE:.0f} % bootstrap intervals of the means, {RESAMPLES} resamples"


def write(folder: Path) -> bool:
    """Print the table and write comparison.html. Returns whether everybody was under way all the time."""
    path = folder / "comparison.json"
    try:
        comparison = Comparison.from_json(read_regular(path, MOST_BYTES).decode())
    except (OSError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: no comparison that can be read: {error!r}") from None
    failed = failures(comparison)
    replace_text(folder / "comparison.html", _render(comparison, failed))
    console = terminal()
    console.width = max(console.width, 110)  # a table that wraps cannot be read
    for title, caption, columns in (
        (_title(comparison), None, slice(0, 5)),
        ("", CAPTION, slice(5, 10)),
        ("", None, slice(10, None)),
    ):
        console.print(_table(comparison, title, caption, columns))
    console.print(_method(comparison), highlight=False, soft_wrap=True)
    for line in failed:
        console.print(line, style="red", soft_wrap=True)
    console.print(f"report: {folder / 'comparison.html'}", soft_wrap=True)
    return not failed


def _table(comparison: Comparison, title: str, caption: str | None, columns: slice) -> Table:
    """Some of the columns, intervals below their figures: half the table's width."""
    table = Table(title=title, caption=caption, padding=(0, 1, 0, 0), show_lines=True)
    table.add_column("", no_wrap=True)
    for heading in HEADINGS[columns]:
        table.add_column(heading.replace(" [", "\n").rstrip("]"), justify="right", no_wrap=True)
    for name, row in _rows(comparison):
        table.add_row(name, *(cell.replace(" [", "\n[") for cell in row[columns]))
    return table


def _rows(comparison: Comparison) -> list[tuple[str, list[str]]]:
    """The whole table: the figures, and what a control step takes."""
    steps = {variant.name: step_cells(variant) for variant in comparison.variants}
    return [(name, [*row, *steps[name]]) for name, row in cells(comparison)]


def _title(comparison: Comparison) -> str:
    moved = f"starts moved by up to {comparison.scatter:g} m and rad"
    return f"{comparison.scene}: {comparison.duration_s:g} s, {seeds_of(comparison)}, {moved}"


def _method(comparison: Comparison) -> str:
    """Intervals, times and code behind the figures, as a paper states them."""
    return f"{INTERVALS}; control steps in processor time of this machine; commit {comparison.commit}"


def _render(comparison: Comparison, failed: list[str]) -> str:
    """The comparison's page as HTML."""
    drawn = [(name, title, caption, draw(comparison)) for name, title, caption, draw in FIGURES]
    page = environment().get_template("comparison.html")
    return page.render(
        comparison=comparison,
        title=_title(comparison),
        headings=HEADINGS,
        method=_method(comparison),
        rows=_rows(comparison),
        failed=failed,
        script=Markup(saving_script()),
        closest=closest(comparison),
        # our own figures, with texts that matplotlib has escaped
        figures=[(n, t, c, Markup(on_page(figure, n))) for n, t, c, figure in drawn if figure is not None],
    )
