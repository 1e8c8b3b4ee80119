"""SHELL: a campaign's report: distributions, dependence on the varied keys, the worst flights and the commands that repeat
them."""

import io
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import jinja2
import matplotlib as mpl
import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure
from matplotlib.text import Text

from groundstation.analysis.measures import LABELS, MEASURES
from groundstation.analysis.statistics import Interval
from groundstation.report.plotting import COLUMN_IN, WIDTH_IN
from groundstation.report.report import saving_script
from shoal.config.key_reference import tables
from shoal.runtime.output_files import replace_text
from sim_bridge.studies.campaign import Campaign, command_of
from sim_bridge.studies.dependence import KeyValue, reasons, shown_measures, unit_of
from sim_bridge.studies.statistics import distribution, rate

WORST = 10
BLUE, INK = "#0072b2", "#1c2733"
TALL_IN = 2.4  # of figures
FONT = 8.0  # points

Row = dict[str, Any]


def write_report(
    campaign: Campaign, rows: Sequence[Row], by_key: Mapping[str, Sequence[KeyValue]], wanted: int, file: Path
) -> None:
    """Write the page. `rows` are the journal's, at least one; `by_key` are their `dependences`; `wanted` is the campaign's
    number of flights."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("sim_bridge.studies"), autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True
    )
    environment.filters |= {"interval": _interval, "figure": _figure, "percent": _percent}
    page = environment.get_template("campaign.html").render(
        script=Markup(saving_script()), **_content(campaign, rows, by_key, wanted)
    )
    replace_text(file, page)


def _content(campaign: Campaign, rows: Sequence[Row], by_key: Mapping[str, Sequence[KeyValue]], wanted: int) -> dict[str, Any]:
    """Values for the campaign's page template."""
    flown = [row for row in rows if row["status"] == "flown"]
    pooled = [] if by_key else flown  # flights of a sweep are not of one kind
    values = {name: [row[name] for row in pooled if row.get(name) is not None] for name in MEASURES}
    shown = shown_measures(flown)
    main = shown[0]
    ranked = sorted((row for row in flown if row[main] is not None), key=lambda row: -row[main])
    return {
        "campaign": campaign,
        "title": campaign.title or f"Campaign {campaign.name}",
        "facts": _facts(campaign, rows, flown, wanted),
        "summary": [(name, MEASURES[name], distribution(numbers)) for name, numbers in values.items() if numbers],
        "histograms": [
            (name, _svg(partial(_histogram, numbers, name)), MEASURES[name])
            for name, numbers in values.items()
            if len(set(numbers)) > 1
        ],
        "groups": [(key, lines, _against(key, lines, shown)) for key, lines in by_key.items()],
        "scatters": [
            (name, _svg(partial(_scatter, name, main, pairs)), f"{LABELS[main]} against {name}")
            for key in campaign.draw
            for name, pairs in _components(key, main, flown)
        ],
        "shown": [(name, LABELS[name], unit_of(name)[0]) for name in shown],
        "reasons": reasons(rows),
        "worst": [
            {
                "index": row["index"],
                "value": unit_of(main)[1] * row[main],
                "reason": row["reason"],
                "command": command_of(campaign, row),
            }
            for row in ranked[:WORST]
        ],
        "trouble": [{**row, "command": command_of(campaign, row)} for row in rows if row["status"] != "flown"],
    }


def _facts(campaign: Campaign, rows: Sequence[Row], flown: Sequence[Row], wanted: int) -> list[tuple[str, str]]:
    """Facts at the head of the report, as name and text."""
    facts = [
        ("flights n", f"{len(rows)} of {wanted}"),
        ("refused or failed", str(len(rows) - len(flown))),
        ("seeds", f"{campaign.first_seed} to {campaign.first_seed + campaign.seeds - 1}"),
        ("commit", ", ".join(sorted({str(row["commit"]) for row in rows}))),
        ("computing", f"{sum(row['wall_s'] for row in rows):.0f} s of one core"),
    ]
    if flown:
        facts.insert(1, ("within every limit", _percent(rate(sum(bool(row["passed"]) for row in flown), len(flown)))))
    return facts


def _components(key: str, measure: str, flown: Sequence[Row]) -> list[tuple[str, list[tuple[float, float]]]]:
    """Scatters of a measure over a key that is drawn at random, each as name and pairs (drawn number, measure): one for a
    number, one for each component of a list that varies; none for texts."""
    drawn = [(row[key], row[measure]) for row in flown if row.get(measure) is not None]
    if not drawn or not all(np.asarray(value).dtype.kind in "if" for value, _ in drawn):
        return []
    first_value, _ = drawn[0]
    if not np.ndim(first_value):
        return [(key, drawn)]
    scatters = []
    for k in range(len(first_value)):
        pairs = [(value[k], result) for value, result in drawn]
        varies = len({number for number, _ in pairs}) > 1
        if varies:
            scatters.append((f"{key}[{k}]", pairs))
    return scatters


def _against(key: str, lines: Sequence[KeyValue], measures: Sequence[str]) -> list[tuple[str, Markup]]:
    """Each measure against a swept key, with its label: a dot per flight, means with their intervals."""
    numbers = [_number(line.value) for line in lines]
    places = [n for n in numbers if n is not None]
    if len(places) < len(lines):
        places = [float(k) for k in range(len(lines))]
    return [(LABELS[measure], _svg(partial(_panel, key, lines, places, measure))) for measure in measures]


def _panel(key: str, lines: Sequence[KeyValue], places: Sequence[float], measure: str, width_in: float) -> Figure:
    """A measure over the values of one key: a dot for each flight, and the mean with its interval."""
    figure = Figure(figsize=(width_in, TALL_IN))
    axes = figure.subplots()
    for x, line in zip(places, lines, strict=True):
        axes.plot([x] * len(line.points[measure]), line.points[measure], ".", color=BLUE, markersize=4, alpha=0.4)
    intervals = [(x, i) for x, line in zip(places, lines, strict=True) if (i := line.means[measure]) is not None]
    axes.plot([x for x, _ in intervals], [i.value for _, i in intervals], "-", color=INK, linewidth=1.0)
    for x, interval in intervals:
        ends = [end if end is not None else interval.value for end in (interval.low, interval.high)]
        axes.plot([x, x], ends, color=INK, linewidth=2.0)
        axes.plot(x, interval.value, "o", color=INK, markersize=4)
    axes.set_xticks(places, [line.value for line in lines])
    axes.set(xlabel=_with_unit(key), ylabel=axis_of(measure))
    most = max((value for line in lines for value in line.points[measure]), default=0.0)
    axes.set_ylim(0.0, 1.08 * most or 1.0)
    return figure


def axis_of(measure: str) -> str:
    """Quantity and unit of a measure, for an axis."""
    return f"{LABELS[measure]} [{unit_of(measure)[0]}]"


def _with_unit(name: str) -> str:
    """Name of a key, or of a component of it, for an axis."""
    unit = _units().get(name.partition("[")[0])
    return f"{name} [{unit}]" if unit else name


@cache
def _units() -> dict[str, str]:
    """Units of the keys that have one."""
    return {entry.name: entry.unit for table in tables("experiment") for entry in table.entries if entry.unit}


def _number(text: str) -> float | None:
    """Parse a number; None if the text is none."""
    try:
        return float(text)
    except ValueError:
        return None


def _histogram(numbers: Sequence[float], measure: str, width_in: float) -> Figure:
    """A measure's distribution over the flights, with its median."""
    figure = Figure(figsize=(width_in, TALL_IN))
    axes = figure.subplots()
    shown = unit_of(measure)[1] * np.asarray(numbers)
    axes.hist(shown, bins="auto" if len(numbers) < 1000 else 60, color=BLUE)
    axes.axvline(float(np.median(shown)), color=INK, linewidth=1.0, linestyle="--")
    axes.set(xlabel=axis_of(measure), ylabel="number of flights")
    axes.locator_params(axis="x", nbins=5)
    return figure


def _scatter(key: str, measure: str, pairs: Sequence[tuple[float, float]], width_in: float) -> Figure:
    """Plot a measure of flights over the value of a key, a dot for each flight."""
    figure = Figure(figsize=(width_in, TALL_IN))
    axes = figure.subplots()
    axes.plot([x for x, _ in pairs], [unit_of(measure)[1] * y for _, y in pairs], ".", color=BLUE, markersize=4)
    axes.set(xlabel=_with_unit(key), ylabel=axis_of(measure))
    return figure


def _svg(draw: Callable[[float], Figure]) -> Markup:
    """A figure as drawn for one column, and in a template for two, which is saved."""
    narrow, wide = (_outlined(draw(width_in)) for width_in in (COLUMN_IN, WIDTH_IN))
    return Markup(f'{narrow}<template data-columns="2">{wide}</template>')  # our own; matplotlib has escaped its texts


def _outlined(figure: Figure) -> str:
    """A figure as SVG, in which text stays text."""
    for axes in figure.axes:
        axes.spines[["top", "right"]].set_visible(False)
    for label in figure.findobj(Text):
        label.set_fontsize(FONT)
    figure.tight_layout()
    text = io.StringIO()
    with mpl.rc_context({"svg.fonttype": "none"}):  # text stays text, also in what is saved of it
        figure.savefig(text, format="svg", metadata={"Date": None})
    return text.getvalue()[text.getvalue().index("<svg") :]


def _interval(interval: Interval) -> str:
    """A figure with its interval; a bound that too few flights give is left open."""
    if interval.low is None and interval.high is None:
        return _figure(interval.value)
    ends = ("…" if end is None else _figure(end) for end in (interval.low, interval.high))
    return f"{_figure(interval.value)} [{', '.join(ends)}]"


def _percent(interval: Interval) -> str:
    ends = "–".join(f"{100 * (end or 0.0):.0f}" for end in (interval.low, interval.high))
    return f"{100 * interval.value:.0f} % [{ends}]"


def _figure(value: float | None) -> str:
    """A figure as text, in SI units, with a power of ten where it is small."""
    return "–" if value is None else f"{value:.3g}"
