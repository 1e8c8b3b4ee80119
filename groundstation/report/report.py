"""SHELL: from a run's folder to result.json and one self-contained report.html; runs side by side; figures for a paper."""

import json
import tempfile
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any

import matplotlib as mpl
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure

from groundstation.analysis.alignment import align
from groundstation.analysis.cause import title
from groundstation.analysis.metrics import evaluate
from groundstation.analysis.numbers import deg, mm, with_unit
from groundstation.analysis.results import Result
from groundstation.analysis.series import Series, TimelineEvent
from groundstation.analysis.statistics import three
from groundstation.analysis.timeline import is_injection
from groundstation.logs.reader import RunLog, read_log
from groundstation.report.drawing import PaperFigure, TimePlot, embedded
from groundstation.report.figures import FIGURES, Kind
from groundstation.report.plotting import on_page, picture
from groundstation.report.report_tables import tables
from groundstation.report.run_comparison import ComparedRun, differences, metric_rows, plots
from shoal.config.experiment import Experiment, load_experiment
from shoal.errors import ConfigError
from shoal.runtime.output_files import replace_text, replacing, replacing_together
from shoal.runtime.version import code

MOST_HAPPENINGS = 400
TOGETHER_S = 0.15  # robots that do the same within this time are one line
ERRORS_AGAINST = {"truth": "the plant's truth", "localizer": "the localizer's poses"}
TEMPLATES = resources.files("groundstation.report") / "templates"


@dataclass(frozen=True)
class Drawn:
    """A figure in the report: a plot's data for plots.js, or a picture."""

    name: str
    title: str
    caption: str
    plot: Markup | None
    svg: Markup | None


def write_report(run_dir: Path, flight: int | None = None) -> Result:
    """Evaluate a run's folder (run.mcap, experiment.toml) and write result.json and report.html into it; of several flights
    the one of that number, else the last.

    A log that was cut off is read as far as it goes, and stays as it is. A run of any length gives a report. Raises
    ConfigError if the experiment is neither in the folder nor in the log, or there is no such flight.
    """
    recorded = _read(run_dir / "run.mcap")
    experiment = _experiment(run_dir, recorded, put_back=True)
    series = align(experiment, recorded, flight)
    result = replace(evaluate(series, recorded), evaluated_by=code().commit)
    page = render(series, recorded, result)
    with replacing_together() as opened:
        opened(run_dir / "result.json").write(result.to_json().encode())
        opened(run_dir / "report.html").write(page.encode())
    return result


def evaluated(run_dir: Path, flight: int | None = None) -> tuple[Series, RunLog, Result]:
    """A run's folder read and evaluated, and left as it is. Raises ConfigError as `write_report`."""
    recorded = _read(run_dir / "run.mcap")
    series = align(_experiment(run_dir, recorded, put_back=False), recorded, flight)
    return series, recorded, evaluate(series, recorded)


def write_comparison(runs: Sequence[ComparedRun], path: Path) -> None:
    """One self-contained page with all runs side by side."""
    drawings = [(title, caption, _json(embedded(plot))) for title, caption, plot in plots(runs)]
    page = environment().get_template("side_by_side.html")
    rows = metric_rows(runs)
    replace_text(path, page.render(runs=runs, rows=rows, differences=differences(runs), plots=drawings, **_live()))


def write_figures(run_dir: Path, folder: Path, flight: int | None = None) -> list[Path]:
    """Every figure of a run's report as a PDF for a paper. Returns the files."""
    series, _, _ = evaluated(run_dir, flight)
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for kind in FIGURES:
        figure = picture(kind.draw(series))
        if figure is not None:
            written.append(folder / f"{kind.name}.pdf")
            write_pdf(figure, written[-1])
    return written


def write_pdf(figure: Figure, path: Path) -> None:
    """A figure as a PDF, the same bytes for the same figure."""
    with mpl.rc_context({"pdf.fonttype": 42}), replacing(path) as file:  # text stays text, as journals want it
        figure.savefig(file, format="pdf", metadata={"CreationDate": None})


def render(series: Series, recorded: RunLog, result: Result) -> str:
    """The report's page as HTML."""
    events = _together(series.timeline_events)
    key_events = _most_telling(events)
    figures = [_draw(kind, series) for kind in FIGURES]
    timings = {"control step [µs]": result.control_step_us, "exposure to PWM [ms]": result.exposure_to_pwm_ms}
    timings |= {f"of it: {hop} [ms]": values for hop, values in result.latency_hops_ms.items()}
    return (
        environment()
        .get_template("report.html")
        .render(
            title=series.experiment.title or series.experiment.name,
            result=result,
            errors_against=ERRORS_AGAINST.get(result.errors_against or ""),
            facts=_facts(recorded, result),
            tables=tables(result),
            timings=[(name, values) for name, values in timings.items() if values],
            figures=[figure for figure in figures if figure.plot or figure.svg],
            absent=[figure.title for figure in figures if not figure.plot and not figure.svg],
            marks=_json([{"time": e.time_s, "fault": e.fault} for e in key_events if e.fault or is_injection(e)]),
            timeline_events=key_events,
            omitted=len(events) - len(key_events),
            **_live(),
        )
    )


def environment() -> Environment:
    """Jinja for the pages of this folder."""
    jinja = Environment(
        loader=PackageLoader("groundstation.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    jinja.globals.update(three=three, mm=mm, deg=deg, with_unit=with_unit, title_of=title)
    return jinja


def saving_script() -> str:
    """The script by which a page saves its figures and tables; `paper.tables()` gives each of them a menu."""
    return (TEMPLATES / "paper.js").read_text(encoding="utf-8")


def _live() -> dict[str, Markup]:
    """The scripts and the style of live plots, as every page carries them."""
    scripts = "\n".join((TEMPLATES / name).read_text(encoding="utf-8") for name in ("uplot.min.js", "paper.js", "plots.js"))
    return {"scripts": Markup(scripts), "plot_style": Markup((TEMPLATES / "uplot.min.css").read_text(encoding="utf-8"))}


def _json(data: Any) -> Markup:
    """Data within a script element, which no text in it can end."""
    return Markup(json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c"))


def _read(path: Path) -> RunLog:
    return read_log(path) if path.exists() else RunLog(exists=False)


def _experiment(run_dir: Path, recorded: RunLog, put_back: bool) -> Experiment:
    """The experiment as run; from the log if the folder has lost it, and then put back there if it is to be."""
    path = run_dir / "experiment.toml"
    if recorded.foreign and not path.exists():
        raise ConfigError(f"{run_dir / 'run.mcap'}: {recorded.trouble}")
    if path.exists() or not recorded.experiment_toml:
        return load_experiment(str(path))
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / path.name
        copy.write_text(recorded.experiment_toml, encoding="utf-8")
        try:
            experiment = load_experiment(str(copy))
        except ConfigError as error:
            raise ConfigError(str(error).replace(str(copy), f"{path} (from the log)")) from None
    if put_back:
        replace_text(path, recorded.experiment_toml)
    return experiment


def _draw(kind: Kind, series: Series) -> Drawn:
    """Draw a figure of a kind: numbers for the page's plots, or an SVG."""
    plot = kind.draw(series)
    if plot is None or isinstance(plot, PaperFigure):
        # our own picture, with texts that matplotlib has escaped
        svg = Markup(on_page(plot, kind.name)) if plot is not None else None
        return Drawn(kind.name, kind.title, kind.caption, None, svg)
    empty = isinstance(plot, TimePlot) and plot.is_empty
    return Drawn(kind.name, kind.title, kind.caption, None if empty else _json(embedded(plot)), None)


def _facts(recorded: RunLog, result: Result) -> list[tuple[str, str]]:
    """Names and values of the report's table of facts about the run."""
    factor = result.real_time_factor
    flown_s = result.flights[result.flight - 1].flown_s if result.flights else 0.0  # without the times of a hold
    names = {"scene", "seed", "mode", "experiment_hash", "hash", "version", "commit"}
    return [
        ("seed", str(result.seed)),
        ("mode", result.mode_text),
        ("evaluated", f"{result.duration_s:.1f} s"),
        *([("along the path", f"{flown_s:.1f} s of {result.planned_duration_s:.1f} s")] if result.flights else []),
        *([("flight", f"{result.flight} of {len(result.flights)}")] if len(result.flights) > 1 else []),
        ("speed", f"{three(factor)} × real time"),
        ("late control steps", f"{result.missed_deadlines} of {sum(r.control_steps for r in result.robots.values())}"),
        ("faults", str(len(result.faults))),
        ("version", result.version),
        ("commit", _short_commit(result.commit)),
        *((name, value) for name, value in sorted(recorded.metadata.items()) if name not in names),
        *([("tags", " ".join(f"#{tag}" for tag in result.tags))] if result.tags else []),
        ("experiment hash", result.experiment_hash[:12]),
    ]


def _short_commit(commit: str) -> str:
    """A commit as git shortens it, and whether files were changed since."""
    head, _, changed = commit.partition("+")
    return head[:12] + (" + changed files" if changed else "")


def _together(events: Sequence[TimelineEvent]) -> Sequence[TimelineEvent]:
    """Merge events of robots that do the same at the same time into one line."""
    lines: list[TimelineEvent] = []
    for event in events:
        first_near = bisect_left(lines, event.time_s - TOGETHER_S, key=lambda line: line.time_s)
        before = next((k for k in range(first_near, len(lines)) if _is_same(lines[k], event)), None)
        if before is None:
            lines.append(event)
        else:
            first = lines[before].source.removeprefix("robots ").removeprefix("robot ")
            lines[before] = replace(lines[before], source=f"robots {first}, {event.source.removeprefix('robot ')}")
    return lines


def _is_same(line: TimelineEvent, event: TimelineEvent) -> bool:
    robots = event.source.startswith("robot ") and line.source.startswith("robot")
    return robots and line.text == event.text and line.times == event.times == 1


def _most_telling(timeline_events: Sequence[TimelineEvent]) -> Sequence[TimelineEvent]:
    """The marks that are drawn: all, or when there are too many the faults first."""
    if len(timeline_events) <= MOST_HAPPENINGS:
        return timeline_events
    kept = sorted(range(len(timeline_events)), key=lambda i: (not timeline_events[i].fault, i))[:MOST_HAPPENINGS]
    return [timeline_events[i] for i in sorted(kept)]
