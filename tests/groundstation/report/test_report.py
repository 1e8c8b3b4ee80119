"""The report: complete, self-contained, true to the log, and there whatever became of the run."""

import base64
import json
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from mcap.writer import Writer

from groundstation.analysis.alignment import align
from groundstation.analysis.series import Series
from groundstation.analysis.statistics import three
from groundstation.logs.reader import read_log
from groundstation.logs.recorder import Recorder
from groundstation.report import figures, figures_control, figures_errors, figures_paths, terminal
from groundstation.report.drawing import MOST_POINTS, Curve, Panel, TimePlot, embedded, thin
from groundstation.report.plotting import COLUMN_IN, WIDTH_IN, picture, to_svg
from groundstation.report.report import write_report
from shoal.config.experiment import dump_experiment, load_experiment
from shoal.config.simulation import Drifter
from shoal.errors import ConfigError
from shoal.frames import Array
from shoal.messages import topics
from shoal.messages.codec import Header, encode
from shoal.messages.messages import Event, Mode
from tests.groundstation import synthetic
from tests.groundstation.synthetic import Script, write_run

pytestmark = pytest.mark.long

VOID = {"meta", "br", "img", "input", "link", "hr"}


class PageStructure(HTMLParser):
    """A page's structure for the tests: open tags, ids, addresses, cells."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.addresses: list[str] = []
        self.tags: Counter[str] = Counter()
        self.cells: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags[tag] += 1
        if tag not in VOID:
            self.open.append(tag)
        if tag == "td":
            self.cells.append("")
        for name, value in attrs:
            if name == "id" and value:
                self.ids.append(value)
            if name in ("src", "href", "xlink:href") and value:
                self.addresses.append(value)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "td":
            self.cells[-1] += data


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    write_run(folder)
    write_report(folder)
    return folder


@pytest.fixture(scope="module")
def page(folder: Path) -> PageStructure:
    return PageStructure((folder / "report.html").read_text())


@pytest.fixture(scope="module")
def series(folder: Path) -> Series:
    return align(load_experiment(str(folder / "experiment.toml")), read_log(folder / "run.mcap"))


def test_page_is_whole_and_needs_nothing_from_outside(folder: Path, page: PageStructure) -> None:
    assert page.open == []
    assert [a for a in page.addresses if not a.startswith(("#", "data:"))] == []
    assert page.tags["link"] == 0
    assert "url(http" not in (folder / "report.html").read_text()


def test_ids_are_unique_and_every_reference_has_its_target(folder: Path, page: PageStructure) -> None:
    """Thirteen SVGs share one page: a clip path of one must not fall on another."""
    assert [name for name, count in Counter(page.ids).items() if count > 1] == []
    wanted = {a[1:] for a in page.addresses if a.startswith("#")}
    wanted |= set(re.findall(r"url\(#([^)]+)\)", (folder / "report.html").read_text()))
    assert wanted <= set(page.ids)


def test_every_figure_is_there(page: PageStructure) -> None:
    # robots that keep their depth need no picture in space; no limit was active; nothing says where the time went
    assert page.tags["figure"] == len(figures.FIGURES) - 3
    assert page.tags["svg"] == 2 * 2  # seen from above, each for both widths of a paper; the rest are plots over time


def test_table_shows_ours_beside_the_articles(folder: Path, page: PageStructure) -> None:
    result = json.loads((folder / "result.json").read_text())
    for subject in (result["robots"]["1"], result["pairs"]["1-2"]):
        for axis in (0, 1):
            assert f"✓ {three(1e3 * subject['rms_m'][axis])}" in page.cells  # mm
            assert three(1e3 * subject["article"]["rms_m"][axis]) in page.cells
    assert three(1e3 * result["robots"]["1"]["baseline"]["rms_m"][0]) in page.cells
    assert "✗" not in "".join(page.cells)


def test_worse_than_the_article_is_marked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(synthetic.OFFSET_Y_M, 1, 0.2)
    write_run(tmp_path, Script(duration_s=25.0))
    write_report(tmp_path)
    cells = PageStructure((tmp_path / "report.html").read_text()).cells
    assert "✗ 200" in cells  # the article has 110 mm for robot 1 in y


def test_a_broken_run_names_its_cause_and_is_not_held_against_the_article(tmp_path: Path) -> None:
    script = Script(until_s=9.0, mode=lambda robot, at_s: (Mode.FAULT, "no pose") if at_s > 8.0 else (Mode.TRACKING, ""))
    write_run(tmp_path, script)
    result = write_report(tmp_path)
    text = (tmp_path / "report.html").read_text()
    assert result.cause is not None and result.cause.text == "fault: no pose"
    assert text.index(f"{result.cause.sentence}</p>") < text.index("<h2>Requirements")
    assert "Beside the article" not in text
    lines = list(terminal.lines(result))
    assert re.fullmatch(rf"cause: robot 1 at {result.cause.time_s:.1f} s, at x \S+, y \S+ m: fault: no pose", lines[0])
    assert "article" not in "".join(lines)


@pytest.mark.parametrize(
    ("mode", "text"), [("lockstep", "simulated time"), ("real-time", "by the wall clock"), ("numeric", "numeric")]
)
def test_a_summary_says_how_time_went(tmp_path: Path, mode: str, text: str) -> None:
    """Simulated time may go as fast as the clock: `lockstep` would read as if it had not."""
    write_run(tmp_path, Script(until_s=3.0, metadata={"mode": mode, "version": "0.1.0"}))
    result = write_report(tmp_path)
    assert any(f"seed 1, {text}, " in line for line in terminal.lines(result))
    assert f"<dt>mode</dt><dd>{text}</dd>" in (tmp_path / "report.html").read_text()


def test_the_terminals_table_has_a_labelled_row_a_robot_in_80_columns(folder: Path) -> None:
    result = write_report(folder)
    lines = list(terminal.lines(result))
    assert max(len(line) for line in lines) <= 80
    columns = next(line for line in lines if line.split() == ["x", "y", "z", "yaw", "x", "y", "z", "yaw", "x", "y"])
    for name, row in (("robot 1", result.robots["1"]), ("robot 2", result.robots["2"])):
        (line,) = (line for line in lines if line.startswith(name))
        assert len(line) == len(columns)
        assert row.rms_m is not None and row.rms_yaw_rad is not None
        shown = [float(cell) for cell in line.removeprefix(name).split()[:4]]
        assert shown == pytest.approx([1e3 * v for v in row.rms_m] + [np.degrees(row.rms_yaw_rad)], rel=5e-3, abs=1e-3)


def test_same_log_same_report(folder: Path) -> None:
    before = {name: (folder / name).read_bytes() for name in ("report.html", "result.json")}
    write_report(folder)
    assert {name: (folder / name).read_bytes() for name in before} == before
    assert not list(folder.glob("*.new"))


def write_events(folder: Path, messages: list[str]) -> None:
    text = dump_experiment(load_experiment("pool"))
    recorder = Recorder(folder / "run.mcap", text, {"mode": "real-time", "version": "<b>"})
    for k, message in enumerate(messages):
        event = Event(4 if k % 2 else 2, "agent-1", message)
        recorder.put(topics.EVENT, "shoal/event", Header(1, k + 1, k * 10**8), encode(event, k * 10**8), k * 10**8)
    recorder.close()


def test_words_from_the_network_are_escaped(tmp_path: Path) -> None:
    write_events(tmp_path, ["<script>alert(1)</script>"])
    write_report(tmp_path)
    text = (tmp_path / "report.html").read_text()
    assert "<script>alert(1)" not in text
    assert "<script>alert(1)</script>" in PageStructure(text).cells  # as text


def test_thousands_of_events_keep_the_faults(tmp_path: Path) -> None:
    write_events(tmp_path, [f"line {k}" for k in range(3000)])
    result = write_report(tmp_path)
    assert len(result.faults) == 1500
    text = (tmp_path / "report.html").read_text()
    assert "2600 more lines" in text
    assert "line 1" in text
    assert "line 0<" not in text


def test_a_cut_log_is_left_alone_and_gives_back_the_experiment(tmp_path: Path) -> None:
    """All that a power cut left of the folder is the front half of the log."""
    experiment = write_run(tmp_path, Script(duration_s=30.0))
    (tmp_path / "experiment.toml").unlink()
    path = tmp_path / "run.mcap"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    cut = path.read_bytes()
    result = write_report(tmp_path)
    assert 1.0 < result.duration_s < 29.0
    assert not result.passed
    for again in (result, write_report(tmp_path)):
        assert path.read_bytes() == cut
        assert not again.log_complete
        text = (tmp_path / "report.html").read_text()
        assert "The run is not complete" in text and "Cut log: run.mcap ends before its run does" in text
    assert load_experiment(str(tmp_path / "experiment.toml")).hash == result.experiment_hash == experiment.hash


@pytest.mark.parametrize(
    ("script", "words"),
    [
        (Script(until_s=1.0), "The run is not complete: 1.0 s of 40 s"),
        (Script(started=False), "No robot was ever under way"),
        (Script(until_s=-1.45), "No robot was ever under way"),
        (Script(until_s=0.05), "The run is not complete"),
        (Script(until_s=2.0, trajectories=False), "The run is not complete"),
        (Script(until_s=3.0, truth=False), "errors against the localizer"),
    ],
)
def test_every_outcome_of_a_run_gets_a_report(tmp_path: Path, script: Script, words: str) -> None:
    write_run(tmp_path, script)
    assert not write_report(tmp_path).passed
    text = (tmp_path / "report.html").read_text()
    assert words in text
    assert PageStructure(text).open == []
    assert ">nan<" not in text.lower()


def test_without_any_log_the_report_says_so(tmp_path: Path) -> None:
    (tmp_path / "experiment.toml").write_text(dump_experiment(load_experiment("pool")))
    assert not write_report(tmp_path).passed
    assert "No robot was ever under way" in (tmp_path / "report.html").read_text()


def test_without_log_and_experiment_it_is_an_error_with_a_name(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"experiment\.toml: no such file"):
        write_report(tmp_path)


def test_a_log_of_another_system_is_called_that(tmp_path: Path) -> None:
    with (tmp_path / "run.mcap").open("wb") as file:
        writer: Any = Writer(file)  # Any: mcap is typed in part
        writer.start()
        for topic in ("/mavros/state", "/odom"):
            channel = writer.register_channel(topic, "json", writer.register_schema(topic, "jsonschema", b"{}"))
            writer.add_message(channel, 1, b"{}", 1)
        writer.finish()
    trouble = "Log of another system: none of its topics is recorded here (/mavros/state, /odom)."
    with pytest.raises(ConfigError, match=rf"run\.mcap: {re.escape(trouble)}"):
        write_report(tmp_path)
    (tmp_path / "experiment.toml").write_text(dump_experiment(load_experiment("pool")))
    assert write_report(tmp_path).log_trouble == trouble


# --- the figures themselves


def drawn(figure: Figure | None) -> Figure:
    assert figure is not None
    return figure


def test_tracking_figure_plots_the_errors(series: Series) -> None:
    figure = drawn(picture(figures_errors.tracking_errors(series)))
    for axis, axes in enumerate(figure.axes):
        curves = {line.get_label(): np.asarray(line.get_ydata()) for line in axes.lines}
        for robot in (1, 2):
            expected = [synthetic.tracking_error(robot, t)[axis] for t in series.time_s]
            np.testing.assert_allclose(curves[f"robot {robot}"], 1e3 * np.array(expected), atol=1.0)  # mm
    assert figure.axes[-1].get_xlabel() == "time since the start [s]"


def values_in(plot: TimePlot) -> list[dict[str, tuple[Array, Array]]]:
    """Times and values of each panel's curves, by label, where there are any."""
    panels = []
    for panel in plot.panels:
        shown = {line.label: (line.time_s, line.values, np.isfinite(line.values)) for line in panel.lines}
        assert shown and all(there.mean() > 0.9 for *_, there in shown.values()), panel.label
        panels.append({label: (time_s[there], values[there]) for label, (time_s, values, there) in shown.items()})
    return panels


def test_figures_of_errors_hold_those_of_the_run(series: Series) -> None:
    def errors(robot: int, time_s: Array) -> Array:
        return np.array([synthetic.tracking_error(robot, t) for t in time_s])

    for axis, (panel, factor) in enumerate(
        zip(values_in(figures_errors.formation_errors(series)), (1e3, 1e3, 1e3, np.degrees(1.0)), strict=True)
    ):
        time_s, values = panel["pair 1-2"]
        expected = (errors(1, time_s) - errors(2, time_s))[:, axis] * factor
        np.testing.assert_allclose(values, expected, atol=1.0)  # mm or deg
    tangent, command = values_in(figures_errors.yaw(series))
    place, heading = values_in(figures_errors.pose_error(series))
    inner = slice(1, -1)  # at the ends the motion has a kink between two samples
    for robot in (1, 2):
        time_s, values = tangent[f"robot {robot}"]
        np.testing.assert_allclose(values[inner], np.degrees(errors(robot, time_s)[inner, 3]), atol=0.02)
        np.testing.assert_allclose(command[f"robot {robot}"][1][inner], np.degrees(synthetic.COMMAND_OFFSET_RAD), atol=0.02)
        np.testing.assert_allclose(place[f"robot {robot}"][1][inner], 1e3 * np.hypot(*synthetic.POSE_OFFSET_M), atol=0.3)
        np.testing.assert_allclose(heading[f"robot {robot}"][1][inner], np.degrees(0.002), atol=0.02)
    plot = figures_errors.separation(series)
    centres_m = {robot: series.robots[robot].reference[:, :3] + errors(robot, series.time_s)[:, :3] for robot in (1, 2)}
    apart_mm = 1e3 * np.linalg.norm(centres_m[1] - centres_m[2], axis=1)
    np.testing.assert_allclose(values_in(plot)[0]["pair 1-2"][1], apart_mm, atol=2.0)
    assert plot.panels[0].floor == pytest.approx(2e3 * series.experiment.safety.radius_m)


def test_figures_of_control_hold_what_the_robots_said(series: Series) -> None:
    limits = series.experiment.limits.model_copy(update={"exposure_to_pwm_p99_ms": 80.0})
    experiment = series.experiment.model_copy(update={"limits": limits})
    series, step_s = replace(series, experiment=experiment), synthetic.PERIOD_S

    def are(plot: TimePlot, expected: Callable[[int, Array, Array], Sequence[Any]], limits: Sequence[float | None]) -> None:
        """Each panel has these values, by robot, time and number of the step."""
        assert [panel.limit for panel in plot.panels] == [limit if limit is None else pytest.approx(limit) for limit in limits]
        for axis, panel in enumerate(values_in(plot)):
            for robot in (1, 2):
                time_s, values = panel[f"robot {robot}"]
                at = expected(robot, time_s, np.rint(time_s / step_s))[axis]
                np.testing.assert_allclose(values, np.broadcast_to(at, values.shape), atol=2e-3)

    def wrench(robot: int, t: Array, k: Array) -> Sequence[Any]:
        return 0.3 * np.sin(t), 0.2, 0.05 * np.cos(t)

    are(figures_control.inputs(series), wrench, experiment.vehicle.limits.wrench)
    swing = {0.0: -0.03, 1.0: 0.03}
    are(
        figures_control.input_steps(series),
        lambda robot, t, k: (np.array([swing[odd] for odd in k % 2.0]), 0.01, 0.02 * robot),
        experiment.wrench_step,
    )
    are(figures_control.step_times(series), lambda robot, t, k: (200.0 + k % 100,), [0.5e6 * step_s])
    are(figures_control.latency(series), lambda robot, t, k: (30.0 + k % 10,), [80.0])
    ((time_s, took_ms),) = values_in(figures_control.frame_times(series))[0].values()
    np.testing.assert_allclose(took_ms, 2.0 + 0.1 * (np.rint(time_s / step_s) % 7))
    for panel, true, estimated in zip(
        values_in(figures_control.disturbance(series)), (0.02, 0.01, 0.0, 0.05), (0.03, 0.01, 0.0, 0.05), strict=True
    ):
        np.testing.assert_allclose(panel["robot 2, true"][1], true)
        np.testing.assert_allclose(panel["robot 2, estimated"][1], estimated)


def test_the_figure_of_pulses_has_the_echoes_of_the_boards(series: Series) -> None:
    robot = next(iter(series.robots.values()))
    flown = robot.states.tracking
    assert np.array_equal(
        np.unique(robot.states.board(lambda b: b.echo_us)[flown], axis=0), [[1550, 1550, 1450, 1440, 1500, 1500, 1510, 1490]]
    )
    echoes = [curve for curve in figures_control.pulses(series).panels[0].lines if curve.label.endswith(", echo")]
    assert [curve.values[np.isfinite(curve.values)].mean() for curve in echoes] == [1550, 1550, 1450, 1440]


def test_paths_are_seen_from_above(series: Series) -> None:
    axes = drawn(picture(figures_paths.paths(series))).axes[0]
    bottom, top = axes.get_ylim()
    assert bottom > 1.25 > -1.25 > top  # y grows downwards, and the whole pool is in view
    assert axes.get_aspect() == 1.0


def test_a_ball_in_the_water_is_in_the_figure_of_paths_where_and_as_large_as_it_was(series: Series) -> None:
    sim = series.experiment.sim.model_copy(update={"drifters": (Drifter(radius_m=0.15, start_m=(0.4, -0.2, 0.3)),)})
    crossed = replace(series, experiment=series.experiment.model_copy(update={"sim": sim}))
    patches = drawn(picture(figures_paths.paths(crossed))).axes[0].patches
    discs = [patch for patch in patches if isinstance(patch, Circle) and patch.get_label() == "obstacle"]
    assert [[*np.ravel(disc.get_center()), disc.get_radius()] for disc in discs] == [[0.4, -0.2, 0.15]]


def test_a_ball_that_drifts_has_its_way_until_the_end_in_the_figure_of_paths(series: Series) -> None:
    from_s, velocity_mps = 2.0, (-0.05, 0.03, 0.0)
    ball = Drifter(radius_m=0.15, start_m=(0.4, -0.2, 0.3), velocity_mps=velocity_mps, from_s=from_s)
    late = Drifter(radius_m=0.1, start_m=(0.0, 0.0, 0.3), velocity_mps=velocity_mps, from_s=series.end_s + 1.0)
    sim = series.experiment.sim.model_copy(update={"drifters": (ball, late)})
    crossed = replace(series, experiment=series.experiment.model_copy(update={"sim": sim}))
    axes = drawn(picture(figures_paths.paths(crossed))).axes[0]
    assert [patch.get_radius() for patch in axes.patches if isinstance(patch, Circle) and patch.get_label() == "obstacle"] == [
        0.15
    ]
    (way,) = (np.array(line.get_xydata(), dtype=np.float64) for line in axes.lines if line.get_linestyle() == ":")
    lasts_s = series.end_s - from_s
    assert way == pytest.approx(np.array([[0.4, -0.2], [0.4 - 0.05 * lasts_s, -0.2 + 0.03 * lasts_s]]))


def test_robots_that_dive_are_drawn_in_space_with_depth_downwards(series: Series) -> None:
    def diving(depth_m: float) -> Series:
        robots = {}
        for robot, r in series.robots.items():
            deeper_m = np.zeros_like(r.reference)
            deeper_m[:, 2] = np.linspace(0.0, depth_m, len(deeper_m))
            robots[robot] = replace(r, reference=r.reference + deeper_m, truth=r.truth + deeper_m)
        return replace(series, robots=robots)

    assert figures_paths.space(diving(0.02)) is None  # seen from above it is all there
    figure = picture(figures_paths.space(diving(0.5)))
    assert figure is not None
    (axes,) = figure.axes
    shallow_m, deep_m = axes.get_zlim()  # type: ignore[attr-defined]  # mpl_toolkits ships no types
    assert shallow_m > deep_m and shallow_m - deep_m > 0.5
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [f"robot {robot}" for robot in series.robots]


def test_limits_are_drawn_when_near_and_told_when_far() -> None:
    time_s = np.linspace(0.0, 10.0, 50)
    for amplitude, drawn_lines in ((0.25, 3), (0.01, 1)):
        line = Curve("robot 1", time_s, amplitude * np.sin(time_s), "#000000")
        axes = drawn(picture(TimePlot([Panel("surge [N]", [line], limit=0.3, unit="N")]))).axes[0]
        assert len(axes.lines) == drawn_lines
        assert (axes.get_title(loc="right") == "limit ±0.3 N") == (drawn_lines == 1)


def test_rounding_noise_does_not_fill_a_panel() -> None:
    time_s = np.linspace(0.0, 10.0, 50)
    line = Curve("robot 1", time_s, 0.03 + 1e-14 * np.sin(time_s), "#000000")
    low, high = drawn(picture(TimePlot([Panel("z error [m]", [line])]))).axes[0].get_ylim()
    assert high - low == pytest.approx(0.01)
    assert low < 0.03 < high


def test_nothing_to_draw_is_none() -> None:
    assert picture(TimePlot([Panel("x", [Curve("robot 1", np.zeros(3), np.full(3, np.nan), "#000000")])])) is None


def test_an_embedded_plot_holds_the_values_and_shares_their_times() -> None:
    time_s = np.linspace(0.0, 1.0, 5)
    curves = [Curve(name, time_s, time_s * k, "#000000") for k, name in enumerate(("a", "b"))]
    plot = embedded(TimePlot([Panel("x", curves[:1]), Panel("y", curves[1:])]))
    assert len(plot["times"]) == 1
    values = np.frombuffer(base64.b64decode(plot["panels"][1]["lines"][0]["values"]), "<f4")
    np.testing.assert_array_equal(values, time_s.astype(np.float32))


def test_svg_keeps_text_as_text(series: Series) -> None:
    svg = to_svg(drawn(picture(figures_errors.tracking_errors(series))), "tracking")
    assert ">robot 1<" in svg
    assert "x error [mm]" in svg
    assert svg.startswith("<svg")


@given(st.integers(MOST_POINTS + 1, 20_000), st.integers(0, 2**31))
@settings(max_examples=25, deadline=None)
def test_thinned_curves_keep_their_peaks_and_their_order(count: int, seed: int) -> None:
    values = np.random.default_rng(seed).normal(size=count)
    values[seed % count] = 100.0  # a single spike must stay visible
    time_s, kept = thin(np.arange(count, dtype=np.float64), values)
    assert len(kept) <= MOST_POINTS
    assert kept.max() == 100.0
    assert kept.min() == values.min()
    assert np.all(np.diff(time_s) > 0)
    np.testing.assert_array_equal(values[time_s.astype(int)], kept)


def test_thinned_curves_keep_their_gaps() -> None:
    values = np.sin(np.arange(10_000) / 100.0)
    values[4000:5000] = np.nan
    time_s, kept = thin(np.arange(10_000, dtype=np.float64), values)
    assert np.isnan(kept[(time_s > 4010) & (time_s < 4990)]).all()
    assert np.isfinite(kept[(time_s < 3990) | (time_s > 5010)]).all()


@pytest.mark.parametrize("width_in", [WIDTH_IN, COLUMN_IN])
def test_a_legend_of_long_names_lies_whole_above_the_plots(width_in: float) -> None:
    t, ends = np.linspace(0.0, 1.0, 9), ("", ", echo")
    names = [f"{place}{end}" for place in ("front left", "front right", "rear left", "rear right") for end in ends]
    figure = picture(TimePlot([Panel("a [m]", [Curve(name, t, t, "#000000") for name in names])] * 2), width_in)
    assert figure is not None
    figure.draw_without_rendering()
    drawn, plot = (part.get_window_extent() for part in (figure.legends[0], figure.axes[0]))
    assert len(figure.legends[0].get_texts()) == 8
    assert drawn.x0 >= 0.0 and drawn.x1 <= figure.bbox.x1 and drawn.y1 <= figure.bbox.y1 and drawn.y0 >= plot.y1
    assert plot.height == pytest.approx(1.35 * figure.dpi, rel=0.01), "the plots keep their height"
