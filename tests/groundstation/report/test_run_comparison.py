"""Runs side by side, and runs as tables: true to their logs."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from groundstation.__main__ import cli
from groundstation.logs.reader import is_complete
from groundstation.report.report import evaluated, write_figures
from groundstation.report.run_comparison import ComparedRun, differences, metric_rows, plots
from shoal.errors import ConfigError
from tests.forked import ended
from tests.groundstation.synthetic import AMPLITUDE_M, Script, write_run

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two runs, one of them with other settings."""
    folders = [tmp_path_factory.mktemp(name) for name in ("plain", "other")]
    write_run(folders[0], Script(duration_s=25.0))
    write_run(
        folders[1],
        Script(duration_s=25.0, settings=("controller.mpc.horizon=40", "seed=7"), missed=lambda r, t: 3 if t > 10.0 else 0),
    )
    return folders


def read(folders: list[Path]) -> list[ComparedRun]:
    out = []
    for folder in folders:
        series, _, result = evaluated(folder)
        out.append(ComparedRun(folder.name, series, result))
    return out


def test_figures_are_those_of_the_results(runs: list[Path]) -> None:
    both = read(runs)
    rows = {row.name: row.values for row in metric_rows(both)}
    assert rows["missed deadlines"] == (0.0, 6.0)
    worst = max(max(error.rms_after_20s_m or (0.0,)) for error in both[0].result.robots.values())
    assert rows["tracking, RMS after 20 s"] == pytest.approx((1e3 * worst, 1e3 * worst))  # mm
    # from 20 s to 25 s: half a period of the sine of robot 1, whose late amplitude is the largest error on any axis
    assert worst == pytest.approx(max(AMPLITUDE_M[1][1], 0.0) / np.sqrt(2.0), rel=0.03)


def test_a_run_in_which_one_robot_has_no_errors_has_no_worst_robot(runs: list[Path]) -> None:
    """Else a run in which the worse robot never flew is the better one."""
    one, other = read(runs)
    lame = dataclasses.replace(other.result.robots["1"], rms_after_20s_m=None)
    other = dataclasses.replace(other, result=dataclasses.replace(other.result, robots={**other.result.robots, "1": lame}))
    rows = {row.name: row.values for row in metric_rows([one, other])}
    assert rows["tracking, RMS after 20 s"][0] is not None and rows["tracking, RMS after 20 s"][1] is None


def test_only_what_differs_is_told(runs: list[Path]) -> None:
    assert differences(read(runs)) == [("controller.mpc.horizon", ("50", "40")), ("seed", ("1", "7"))]
    assert differences(read([runs[0], runs[0]])) == []


def test_curves_are_the_errors_of_each_run(runs: list[Path]) -> None:
    both = read(runs)
    (_, _, tracking), (_, _, formation), _ = plots(both)
    assert [len(panel.lines) for panel in tracking.panels] == [2, 2] and len(formation.panels) == 1
    error = np.linalg.norm(both[1].series.robots[2].error[:, :3], axis=1)
    assert np.array_equal(tracking.panels[1].lines[1].values, 1e3 * error, equal_nan=True)  # mm


def test_the_command_prints_a_table_and_writes_a_page(runs: list[Path], tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    code, output, errors = ended("groundstation", "log", "compare", *map(str, runs), "--out", str(page))
    assert code == 0, errors
    assert "controller.mpc.horizon" in output and "[mm]" in output
    text = page.read_text()
    assert "controller.mpc.horizon" in text and text.count('class="plot"') == 3
    assert "src=" not in text and "href=" not in text
    code, _, errors = ended("groundstation", "log", "compare", str(runs[0]))
    assert code == 2 and "two runs or more" in errors
    code, _, errors = ended("groundstation", "log", "compare", str(runs[0]), str(tmp_path))
    assert code == 2 and "run.mcap and experiment.toml are missing there" in errors


def test_figures_for_a_paper(runs: list[Path], tmp_path: Path) -> None:
    written = write_figures(runs[0], tmp_path / "figures")
    assert {"tracking.pdf", "formation.pdf", "inputs.pdf"} <= {path.name for path in written}
    assert all(path.read_bytes().startswith(b"%PDF") for path in written)


def test_runs_of_different_code_or_mode_compare_as_different(runs: list[Path]) -> None:
    (one,) = read(runs[:1])
    other = dataclasses.replace(one, result=dataclasses.replace(one.result, commit="b" * 40, mode="numeric"))
    assert differences([one, other]) == [
        ("(mode)", ("simulated time", "numeric")),
        ("(commit)", (one.result.commit, "b" * 40)),
    ]


def test_a_comparison_leaves_the_runs_as_they_are(runs: list[Path], tmp_path: Path) -> None:
    """Also a run whose log was cut and whose experiment is only in the log; and no page is written over a run's file."""
    folder = tmp_path / "cut"
    folder.mkdir()
    whole = (runs[0] / "run.mcap").read_bytes()
    (folder / "run.mcap").write_bytes(whole[: len(whole) // 2])
    done = CliRunner().invoke(cli, ["log", "compare", str(runs[0]), str(folder), "--out", str(tmp_path / "page.html")])
    assert done.exit_code == 0, done.output
    assert "cut: Cut log:" in done.output
    assert [path.name for path in folder.iterdir()] == ["run.mcap"]
    assert (folder / "run.mcap").read_bytes() == whole[: len(whole) // 2]
    for out in (runs[0] / "experiment.toml", runs[1] / "run.mcap", folder / "result.json"):
        done = CliRunner().invoke(cli, ["log", "compare", *map(str, runs), "--out", str(out)])
        assert isinstance(done.exception, ConfigError) and str(out) in str(done.exception)
    assert (runs[0] / "run.mcap").read_bytes() == whole


def test_a_cut_log_is_mended_on_request(runs: list[Path], tmp_path: Path) -> None:
    whole, cut = (runs[0] / "run.mcap").read_bytes(), tmp_path / "run.mcap"
    cut.write_bytes(whole[: len(whole) // 2])
    assert not is_complete(cut)
    code, output, _ = ended("groundstation", "log", "repair", str(cut))
    assert code == 0 and "the original is kept beside it" in output and is_complete(cut)
    code, output, _ = ended("groundstation", "log", "repair", str(cut))
    assert "nothing to mend" in output
    code, _, _ = ended("groundstation", "log", "repair", str(tmp_path / "none.mcap"))
    assert code == 2
