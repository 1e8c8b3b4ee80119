"""SHELL: from a run's folder to result.json and one self-contained report.html; runs side by side; figures for a paper."""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import matplotlib as mpl
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure

from groundstation.analysis.alignment import align
from groundstation.analysis.metrics import evaluate
from groundstation.analysis.results import Errors, Result
from groundstation.analysis.series import Series, TimelineEvent
from groundstation.logs.reader import RunLog, read_log
from groundstation.logs.repair import recover
from groundstation.report.figures import FIGURES
from groundstation.report.plotting import to_svg
from groundstation.report.run_comparison import ComparedRun, differences, drawn, metric_rows
from wire.config.experiment import ArticleRow, Experiment, load_experiment
from wire.process.output_files import replace_text, replacing
from wire.process.runtime import log
from wire.process.version import code
from wire.toml_loader import ConfigError

MOST_HAPPENINGS = 400
NOTHING = "–"
ERRORS_AGAINST = {"truth": "the plant's truth", "localizer": "the localizer's poses"}


@dataclass(frozen=True)
class Drawn:
    """A figure in the report; no SVG if the run has nothing to draw."""

    name: str
    title: str
    caption: str
    svg: Markup | None


def write_report(run_dir: Path, flight: int | None = None) -> Result:
    """Evaluate a run's folder (run.mcap, experiment.toml) and write result.json and report.html into it; of several flights
    the one of that number, else the last.

    A log that was cut off is mended first, if there is room. A run of any length gives a report. Raises ConfigError if the
    experiment is neither in the folder nor in the log, or there is no such flight.
    """
    recorded = _read(run_dir / "run.mcap", mend=True)
    experiment = _experiment(run_dir, recorded, put_back=True)
    series = align(experiment, recorded, flight)
    result = replace(evaluate(series, recorded), evaluated_by=code().commit)
    replace_text(run_dir / "result.json", result.to_json())
    replace_text(run_dir / "report.html", render(series, recorded, result))
    return result


def evaluated(run_dir: Path, flight: int | None = None) -> tuple[Series, RunLog, Result]:
    """A run's folder read and evaluated, and left as it is. Raises ConfigError as `write_report`."""
    recorded = _read(run_dir / "run.mcap", mend=False)
    series = align(_experiment(run_dir, recorded, put_back=False), recorded, flight)
    return series, recorded, evaluate(series, recorded)


def write_comparison(runs: Sequence[ComparedRun], path: Path) -> None:
    """One self-contained page with all runs side by side."""
    figures = [(title, caption, _svg(figure, f"compare-{title}")) for title, caption, figure in drawn(runs)]
    page = environment().get_template("side_by_side.html")
    replace_text(path, page.render(runs=runs, rows=metric_rows(runs), differences=differences(runs), drawn=figures))


def write_figures(run_dir: Path, folder: Path, flight: int | None = None) -> list[Path]:
    """Every figure of a run's report as a PDF for a paper. Returns the files."""
    series, _, _ = evaluated(run_dir, flight)
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for kind in FIGURES:
        figure = kind.draw(series)
        if figure is not None:
            written.append(folder / f"{kind.name}.pdf")
            write_pdf(figure, written[-1])
    return written


def write_pdf(figure: Figure, path: Path) -> None:
    """A figure as a PDF, the same bytes for the same figure."""
    with mpl.rc_context({"pdf.fonttype": 42}), replacing(path) as file:  # text stays text, as journals want it
        figure.savefig(file, format="pdf", metadata={"CreationDate": None})


def render(series: Series, recorded: RunLog, result: Result) -> str:
    """The report as HTML."""
    shown = _most_telling(series.timeline_events)
    return (
        environment()
        .get_template("report.html")
        .render(
            title=series.experiment.title or series.experiment.name,
            result=result,
            errors_against=ERRORS_AGAINST.get(result.errors_against or ""),
            facts=_facts(recorded, result),
            rows=_rows(result),
            article_axes=_article_axes(series.experiment),
            timings=[("control step [µs]", result.control_step_us), ("exposure to PWM [ms]", result.exposure_to_pwm_ms)]
            + [(f"of it: {hop} [ms]", found) for hop, found in result.latency_hops_ms.items()],
            figures=[_draw(series, index) for index in range(len(FIGURES))],
            timeline_events=shown,
            omitted=len(series.timeline_events) - len(shown),
        )
    )


def environment() -> Environment:
    """Jinja for the pages of this folder."""
    found = Environment(
        loader=PackageLoader("groundstation.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    found.filters.update(fixed=_fixed, figure=_figure)
    found.globals.update(compared=_compared, article_cell=_article_cell, article_yaw=_article_yaw)
    return found


def _read(path: Path, mend: bool) -> RunLog:
    if not path.exists():
        return RunLog(found=False)
    if mend:
        try:
            if recover(path):
                log.warning("%s was cut off: mended up to the cut", path)
        except OSError as error:
            log.warning("%s is not whole and cannot be mended (%s); reading what is there", path, error.strerror)
    return read_log(path)


def _experiment(run_dir: Path, recorded: RunLog, put_back: bool) -> Experiment:
    """The experiment as run; from the log if the folder has lost it, and then put back there if it is to be."""
    path = run_dir / "experiment.toml"
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


def _draw(series: Series, index: int) -> Drawn:
    kind = FIGURES[index]
    return Drawn(kind.name, kind.title, kind.caption, _svg(kind.draw(series), kind.name))


def _svg(figure: Figure | None, name: str) -> Markup | None:
    """Our own figure, with texts that matplotlib has escaped."""
    return Markup(to_svg(figure, name)) if figure is not None else None


def _facts(recorded: RunLog, result: Result) -> list[tuple[str, str]]:
    factor = result.real_time_factor
    known = {"scene", "seed", "mode", "experiment_hash", "hash", "version", "commit"}
    return [
        ("seed", str(result.seed)),
        ("mode", result.mode),
        ("evaluated", f"{result.duration_s:.1f} s of {result.planned_duration_s:g} s"),
        *([("flight", f"{result.flight} of {len(result.flights)}")] if len(result.flights) > 1 else []),
        ("speed", f"{factor:.2f} × real time" if factor is not None else NOTHING),
        ("late control steps", f"{result.missed_deadlines} of {sum(r.control_steps for r in result.robots.values())}"),
        ("faults", str(len(result.faults))),
        ("version", result.version),
        ("commit", result.commit),
        *((name, value) for name, value in sorted(recorded.metadata.items()) if name not in known),
        ("experiment hash", result.experiment_hash),
    ]


def _rows(result: Result) -> list[tuple[str, Errors]]:
    return [
        *((f"robot {robot}", found) for robot, found in result.robots.items()),
        *((f"pair {pair}", found) for pair, found in result.pairs.items()),
    ]


def _article_axes(experiment: Experiment) -> list[str]:
    """Which columns the article's table has: x and y, sometimes z, sometimes yaw."""
    width = max([2, *(len(row.rms_m) for row in experiment.article)])
    yaw = any(row.rms_yaw_rad is not None for row in experiment.article)
    return [*"xyz"[:width], *(["yaw"] if yaw else [])]


def _article_cell(article: ArticleRow | None, axis: str) -> float | None:
    if article is None:
        return None
    if axis == "yaw":
        return article.rms_yaw_rad
    index = "xyz".index(axis)
    return article.rms_m[index] if index < len(article.rms_m) else None


def _article_yaw(article: ArticleRow | None) -> tuple[float | None, ...]:
    """The article's yaw where `_compared` looks for a fourth axis."""
    return (None, None, None, article.rms_yaw_rad if article is not None else None)


def _compared(values: Sequence[float | None] | None, axis: int, other: Sequence[float | None] | None) -> Markup:
    """A table cell, marked where the article has a figure to compare with."""
    value = values[axis] if values is not None and axis < len(values) else None
    theirs = other[axis] if other is not None and axis < len(other) else None
    classes, sign = ["first"] if axis == 0 else [], ""
    if value is not None and theirs is not None:
        better = value < theirs
        classes.append("good" if better else "bad")
        sign = "✓ " if better else "✗ "
    return Markup('<td class="{}">{}{}</td>').format(" ".join(classes), sign, _fixed(value))


def _most_telling(timeline_events: Sequence[TimelineEvent]) -> Sequence[TimelineEvent]:
    """All of them, or when there are too many the faults first."""
    if len(timeline_events) <= MOST_HAPPENINGS:
        return timeline_events
    kept = sorted(range(len(timeline_events)), key=lambda i: (not timeline_events[i].fault, i))[:MOST_HAPPENINGS]
    return [timeline_events[i] for i in sorted(kept)]


def _fixed(value: float | None) -> str:
    """Metres or radians, to the millimetre; what is below a centimetre, to 10 um."""
    return NOTHING if value is None else f"{value:.3f}" if abs(value) >= 0.01 or value == 0.0 else f"{value:.5f}"


def _figure(value: float | None) -> str:
    """A figure of any size, to what can be read."""
    if value is None:
        return NOTHING
    return f"{value:.4g}" if abs(value) >= 1.0 else f"{value:.3g}"
