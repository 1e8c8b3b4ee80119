"""SHELL: from comparison.json to a table and one self-contained comparison.html."""

from pathlib import Path

from markupsafe import Markup
from rich.table import Table

from groundstation.analysis.comparison import Comparison
from groundstation.report.controller_comparison import COLUMNS, cells, closest, course, demands, errors, failures, wanted
from groundstation.report.plotting import to_svg
from groundstation.report.report import environment, saving_script
from shoal.errors import ConfigError
from shoal.runtime.output import terminal
from shoal.runtime.output_files import replace_text
from shoal.system.regular_files import read_regular

FIGURES = (
    ("errors", "Errors, law by law", "A dot per seed; bars are means with their 95 % confidence intervals.", errors),
    ("course", "Over time", "On the first seed. What comes after the dotted line is in the columns after 20 s.", course),
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
HEADINGS = ("×", *(f"{c.heading} [{c.unit}]" for c in COLUMNS))


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
    for title, caption, columns in ((_title(comparison), None, slice(0, 5)), ("", CAPTION, slice(5, None))):
        console.print(_table(comparison, title, caption, columns))
    for line in failed:
        console.print(line, style="red", soft_wrap=True)
    console.print(f"report: {folder / 'comparison.html'}", soft_wrap=True)
    return not failed


def _table(comparison: Comparison, title: str, caption: str | None, columns: slice) -> Table:
    """Some of the columns, intervals below their figures: half the table's width."""
    table = Table(title=title, caption=caption, padding=(0, 1, 0, 0), show_lines=True)
    table.add_column("", no_wrap=True)
    for c in ("×", *(f"{c.heading}\n{c.unit}" for c in COLUMNS))[columns]:
        table.add_column(c, justify="right", no_wrap=True)
    for name, row in cells(comparison):
        table.add_row(name, *(cell.replace(" [", "\n[") for cell in row[columns]))
    return table


def _title(comparison: Comparison) -> str:
    flights = comparison.variants[0].flights
    seeds = f"{len(flights)} seeds" if len(flights) > 1 else "1 seed"
    return f"{comparison.scene}: {comparison.duration_s:g} s, {seeds}, starts moved by up to {comparison.scatter:g} m and rad"


def _render(comparison: Comparison, failed: list[str]) -> str:
    drawn = [(name, title, caption, draw(comparison)) for name, title, caption, draw in FIGURES]
    page = environment().get_template("comparison.html")
    return page.render(
        comparison=comparison,
        title=_title(comparison),
        headings=HEADINGS,
        rows=cells(comparison),
        failed=failed,
        script=Markup(saving_script()),
        closest=closest(comparison),
        # our own figures, with texts that matplotlib has escaped
        figures=[(n, t, c, Markup(to_svg(figure, n))) for n, t, c, figure in drawn if figure is not None],
    )
