"""Means, intervals and ratios of a comparison, and the report made of them."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from typer.testing import CliRunner

from groundstation.__main__ import cli
from groundstation.analysis.comparison import StepTimes, Variant
from groundstation.analysis.statistics import mean
from groundstation.report.controller_comparison import cells, failures, ratio
from shoal.errors import ConfigError
from tests.groundstation.report.comparisons import COMMIT, comparison, variant


def test_ratios_are_taken_seed_by_seed() -> None:
    """Everyone has the same luck on a seed: three times the error is certain, though the errors themselves vary fourfold."""
    quotient = ratio(variant("pid", 3.0), variant("eso-mpc", 1.0))
    assert (quotient.value, quotient.low, quotient.high) == pytest.approx((3.0, 3.0, 3.0))
    average = mean([f.figures.rms_after_20s_m for f in variant("pid", 3.0).flights])
    assert average.low is not None and average.high is not None and average.high - average.low > 0.01


def test_the_intervals_are_those_of_another_bootstrap_and_never_below_zero() -> None:
    values = [0.1, 4.5, 0.2, 5.0, 0.3, 30.0]
    average, other = mean(values), stats.bootstrap((values,), np.mean, n_resamples=20000, method="percentile", rng=1)
    assert [average.low, average.high] == pytest.approx(list(other.confidence_interval), rel=0.1)
    assert average.low is not None and average.low > 0.0


@pytest.mark.long
def test_a_report_says_what_a_paper_needs_to_say_about_its_figures(tmp_path: Path) -> None:
    """n and the seeds, how the intervals were found, the commit, and what a control step takes, on terminal and page."""
    timed = variant("eso-mpc", 1.0)
    steps = [dataclasses.replace(f, step_us=StepTimes(100.0 * k, 300.0 * k, 900.0)) for k, f in enumerate(timed.flights, 1)]
    _, output = report(tmp_path, dataclasses.replace(timed, flights=steps), variant("pid", 2.0))
    page = (tmp_path / "comparison.html").read_text(encoding="utf-8")
    for place in (" ".join(output.split()), page):
        assert "n = 4 seeds (1 to 4)" in place
        assert "95 % bootstrap intervals of the means, 1000 resamples" in place and f"commit {COMMIT}" in place
    assert page.count("control step, ") == 2 and "<td>–</td><td>–</td>" in page
    assert "<td>250 <small>[" in page and "<td>750 <small>[" in page
    assert "250" in output and "750" in output


def test_every_variant_has_a_row_in_order() -> None:
    rows = cells(comparison(variant("eso-mpc", 1.0), variant("pid", 3.0), variant("lqr", 2.0, seeds=4)))
    assert [name for name, _ in rows] == ["eso-mpc", "pid", "lqr"]
    assert rows[0][1][0] == "1" and rows[1][1][0] == "3.00 [3.00, 3.00]"
    assert cells(comparison(variant("eso-mpc", 1.0, 1), variant("pid", 3.0, 1)))[1][1][0] == "3.00"


def report(folder: Path, *variants: Variant) -> tuple[int, str]:
    (folder / "comparison.json").write_text(comparison(*variants).to_json(), encoding="utf-8")
    result = CliRunner().invoke(cli, ["benchmark", "report", str(folder)])
    return result.exit_code, result.output


@pytest.mark.long
def test_the_report_shows_table_and_figures(tmp_path: Path) -> None:
    code, output = report(tmp_path, variant("eso-mpc", 1.0), variant("backstepping", 2.0))
    assert code == 0 and re.search(r"backstepping.*\b2\.00 .*\n.*\[2\.00, 2\.00\]", output)
    assert max(len(line) for line in output.splitlines() if line[:1] in "┃│") <= 110
    html = (tmp_path / "comparison.html").read_text(encoding="utf-8")
    assert (
        html.count("<figure ") == html.count('<template data-columns="1"><svg ') == 4  # each for both widths of a paper
        and "Two robots &lt;&amp;&gt;" in html
        and "controller.law=backstepping" in html
    )
    assert "http" not in html.replace("http://www.w3.org", "")  # nothing is fetched


@pytest.mark.long
def test_flights_that_failed_are_named_and_make_it_fail(tmp_path: Path) -> None:
    broken = variant("pid", 3.0)
    figures = dataclasses.replace(broken.flights[2].figures, under_way=0.4)
    broken.flights[2] = dataclasses.replace(broken.flights[2], figures=figures)
    code, output = report(tmp_path, variant("eso-mpc", 1.0), broken)
    assert code == 1 and "pid, seed 3: under way in 40.0 %" in output
    assert "pid, seed 3" in (tmp_path / "comparison.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"variants": [{"name": "x"}]}', '{"variants": [], "other": 1}'])
def test_a_folder_without_a_comparison_is_refused_by_name(tmp_path: Path, text: str) -> None:
    (tmp_path / "comparison.json").write_text(text, encoding="utf-8")
    result = CliRunner().invoke(cli, ["benchmark", "report", str(tmp_path)])
    assert isinstance(result.exception, ConfigError) and str(tmp_path / "comparison.json") in str(result.exception)


def test_robots_that_came_too_close_are_a_failure() -> None:
    compared = dataclasses.replace(comparison(variant("pid", 1.0, 1)), separation_m=0.8)
    assert failures(compared) == ["pid, seed 1: two robots came to 0.700 m of one another (allowed: 0.8 m)"]
    assert failures(dataclasses.replace(compared, separation_m=0.6)) == []
