"""SHELL: a campaign's report: distributions, dependence on the varied keys, the worst flights and the commands that repeat
them."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from sim_bridge.studies.campaign import Campaign, command_of
from sim_bridge.studies.metrics import MEASURES
from sim_bridge.studies.statistics import Interval, distribution, rate
from wire.process.output_files import replace_text

SHOWN = ("rms_after_20s_m", "max_after_20s_m", "wrench_step_rms")  # metrics shown against the varied keys
WORST = 10
BLUE, INK = "#0072b2", "#1c2733"

Row = dict[str, Any]


def write_report(campaign: Campaign, rows: Sequence[Row], wanted: int, file: Path) -> None:
    """Write the page. `rows` are the journal's, at least one; `wanted` is the campaign's number of flights."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("sim_bridge.studies"), autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True
    )
    environment.filters |= {"interval": _interval, "figure": _figure, "percent": _percent}
    page = environment.get_template("campaign.html").render(**_content(campaign, rows, wanted))
    replace_text(file, page)


def _content(campaign: Campaign, rows: Sequence[Row], wanted: int) -> dict[str, Any]:
    flown = [row for row in rows if row["status"] == "flown"]
    values = {name: [row[name] for row in flown if row.get(name) is not None] for name in MEASURES}
    main = next((name for name in SHOWN if values[name]), "rms_m")
    shown = [main, *(name for name in SHOWN if values[name] and name != main)]
    ranked = sorted((row for row in flown if row[main] is not None), key=lambda row: -row[main])
    return {
        "campaign": campaign,
        "title": campaign.title or f"Campaign {campaign.name}",
        "facts": _facts(campaign, rows, flown, wanted),
        "summary": [(name, MEASURES[name], distribution(found)) for name, found in values.items() if found],
        "histograms": [(_histogram(found), MEASURES[name]) for name, found in values.items() if len(set(found)) > 1],
        "groups": [(key, _groups(key, flown, shown)) for key in campaign.sweep],
        "scatters": [(_scatter(key, main, flown), f"{main} against {key}") for key in campaign.draw if _is_number(key, flown)],
        "shown": shown,
        "worst": [
            {"index": row["index"], "value": row[main], "reason": row["reason"], "command": command_of(campaign, row)}
            for row in ranked[:WORST]
        ],
        "trouble": [{**row, "command": command_of(campaign, row)} for row in rows if row["status"] != "flown"],
    }


def _facts(campaign: Campaign, rows: Sequence[Row], flown: Sequence[Row], wanted: int) -> list[tuple[str, str]]:
    facts = [
        ("flights", f"{len(rows)} of {wanted}"),
        ("refused or failed", str(len(rows) - len(flown))),
        ("seeds", f"{campaign.first_seed} to {campaign.first_seed + campaign.seeds - 1}"),
        ("computing", f"{sum(row['wall_s'] for row in rows):.0f} s of one core"),
    ]
    if flown:
        facts.insert(1, ("within every limit", _percent(rate(sum(bool(row["passed"]) for row in flown), len(flown)))))
    return facts


def _groups(key: str, flown: Sequence[Row], shown: Sequence[str]) -> list[dict[str, Any]]:
    """One line for each value of a swept key, in the file's order."""
    lines = []
    for value in dict.fromkeys(str(row[key]) for row in flown):
        members = [row for row in flown if str(row[key]) == value]
        found = {name: [row[name] for row in members if row[name] is not None] for name in shown}
        lines.append(
            {
                "value": value,
                "n": len(members),
                "passed": rate(sum(bool(row["passed"]) for row in members), len(members)),
                "means": [distribution(numbers).mean if numbers else None for numbers in found.values()],
            }
        )
    return lines


def _is_number(key: str, flown: Sequence[Row]) -> bool:
    return bool(flown) and all(isinstance(row[key], int | float) for row in flown)


def _histogram(found: Sequence[float]) -> Markup:
    figure = Figure(figsize=(4.6, 2.4))
    axes = figure.subplots()
    axes.hist(found, bins="auto" if len(found) < 1000 else 60, color=BLUE)
    axes.axvline(float(np.median(found)), color=INK, linewidth=1.0, linestyle="--")
    axes.set_ylabel("flights")
    return _svg(figure)


def _scatter(key: str, measure: str, flown: Sequence[Row]) -> Markup:
    figure = Figure(figsize=(4.6, 2.8))
    axes = figure.subplots()
    pairs = [(row[key], row[measure]) for row in flown if row[measure] is not None]
    axes.plot(*zip(*pairs, strict=True), ".", color=BLUE, markersize=4)
    axes.set_xlabel(key)
    axes.set_ylabel(measure)
    return _svg(figure)


def _svg(figure: Figure) -> Markup:
    for axes in figure.axes:
        axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    text = io.StringIO()
    figure.savefig(text, format="svg", metadata={"Date": None})
    return Markup(text.getvalue()[text.getvalue().index("<svg") :])  # our own drawing; matplotlib has escaped its texts


def _interval(interval: Interval | None) -> str:
    if interval is None:
        return "–"
    ends = ("?" if end is None else _figure(end) for end in (interval.low, interval.high))
    return f"{_figure(interval.value)} [{', '.join(ends)}]"


def _percent(interval: Interval) -> str:
    ends = "–".join(f"{100 * (end or 0.0):.0f}" for end in (interval.low, interval.high))
    return f"{100 * interval.value:.0f} % [{ends}]"


def _figure(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}"
