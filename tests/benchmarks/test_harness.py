"""The stopwatch and its statistics; benchmarks that are offered exist."""

import gc
import importlib.util
import math

import pytest
import typer
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from benchmarks import __main__ as command
from benchmarks import harness
from benchmarks.harness import Row, run_peer, time_us


@given(st.lists(st.integers(0, 1000), min_size=1, max_size=300))
def test_a_percentile_is_the_smallest_sample_that_enough_samples_do_not_exceed(samples: list[int]) -> None:
    row = Row.of("b", "c", "ours", "us", map(float, samples))
    for share, value in ((0.5, row.p50), (0.99, row.p99), (1.0, row.max)):
        enough = math.ceil(round(share * len(samples), 9))
        assert value == min(s for s in samples if sum(other <= s for other in samples) >= enough)
    assert row.n == len(samples)


def test_no_samples_are_no_row() -> None:
    with pytest.raises(ValueError, match="b, c, ours: no samples"):
        Row.of("b", "c", "ours", "us", [])


def test_the_stopwatch_warms_up_and_leaves_the_collector_as_it_was() -> None:
    states: list[bool] = []
    samples = time_us(lambda: states.append(gc.isenabled()), 20)
    assert len(samples) == 20 and min(samples) >= 0.0
    assert states == [True] * 2 + [False] * 20
    assert gc.isenabled()
    with pytest.raises(ZeroDivisionError):
        time_us(lambda: 1 / (len(states) - 22), 20, warm_up=0)
    assert gc.isenabled()


def test_a_peer_that_cannot_run_is_reported_and_left_out(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def no_network(name: str, requirements: object) -> object:
        raise OSError("no network")

    monkeypatch.setattr(harness, "peer_python", no_network)
    assert run_peer("codec_msgspec", ("msgspec",), {}) == []
    assert "peer codec_msgspec not measured: no network" in capsys.readouterr().err


@pytest.mark.parametrize("module", [module for module, _ in command.BENCHMARKS.values()])
def test_every_benchmark_offered_is_a_module(module: str) -> None:
    assert importlib.util.find_spec(f"benchmarks.{module}") is not None


def test_an_unknown_name_is_refused_with_the_choice() -> None:
    app = typer.Typer()
    app.command()(command.main)
    result = CliRunner().invoke(app, ["speed"])
    assert result.exit_code == 2
    assert "speed" in result.output and "codec" in result.output
    assert CliRunner().invoke(app, ["--list"]).output.startswith("codec")
