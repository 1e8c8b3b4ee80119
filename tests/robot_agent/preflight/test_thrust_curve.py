"""A thruster's curve from a kitchen scale: bad rows, the fit against a known curve, and the curve on a board."""

import re
import tomllib
from pathlib import Path
from socket import SOCK_DGRAM

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import isotonic_regression
from typer.testing import CliRunner

from robot_agent.__main__ import cli
from robot_agent.host.params import ParameterSession
from robot_agent.preflight.identify import write_curve
from robot_agent.preflight.thrust_curve import ThrustReading, fit, interpolate, read_rows
from shoal.config.experiment import load_experiment
from shoal.config.vehicle import load_vehicle
from shoal.errors import ConfigError
from shoal.mavlink.board_port import UdpLink
from shoal.mavlink.parameters import ParameterClient
from sim_bridge.sil.ports import free_port
from tests.sim_bridge.boards import board

TRUE = load_vehicle("spherical").thruster
PULSES = [*range(1100, 1901, 25), 1477, 1523]
G = 9.80665e-3  # N per gram


def measured(scale: float = 1.0, noise_g: float = 1.0, seed: int = 1) -> list[str]:
    """A scale's readings of the shipped thruster, `scale` times as strong, each pulse measured twice."""
    random = np.random.default_rng(seed)
    force_n = TRUE.force_n(np.array(PULSES * 2, dtype=np.float64)) * scale
    grams = force_n / G + random.normal(0.0, noise_g, len(force_n)) * (force_n != 0.0)
    return ["pulse_us,grams", *(f"{pulse},{each:.1f}" for pulse, each in zip(PULSES * 2, grams.tolist(), strict=True))]


def test_fitted_curve_is_the_thrusters_within_the_scales_noise() -> None:
    result = fit(read_rows(measured(), "scale.csv"), "scale.csv", 12, 0.03)
    assert len(result.curve) == 12
    off = [abs(interpolate(result.curve, pulse) - float(TRUE.force_n(np.array(float(pulse))))) for pulse in PULSES]
    assert max(off) < 0.05, "N; the scale is 0.01 N off, and twelve points are a little less than the whole"
    assert result.rms_n < 0.03
    assert np.all(np.diff(result.curve, axis=0)[:, 0] > 0) and np.all(np.diff(result.curve, axis=0)[:, 1] >= 0)


def test_the_readings_in_the_manual_are_enough() -> None:
    page = (Path(__file__).parents[3] / "docs" / "hardware.md").read_text(encoding="utf-8")
    (readings,) = re.findall(r"^pulse_us,grams\n[^`]+", page, re.MULTILINE)
    assert len(fit(read_rows(readings.splitlines(), "scale.csv"), "scale.csv", 12, 0.03).curve) >= 4


@pytest.mark.long
@given(st.lists(st.tuples(st.floats(-5, 5), st.integers(1, 4)), min_size=6, max_size=30))
def test_readings_that_fall_are_levelled_as_isotonic_regression_does(rows: list[tuple[float, int]]) -> None:
    readings = [ThrustReading(1, 1000 + 10 * i, force) for i, (force, times) in enumerate(rows) for _ in range(times)]
    expected = isotonic_regression([force for force, _ in rows], weights=[float(times) for _, times in rows]).x
    try:
        result = fit(readings, "x", len(rows), 0.0)
    except ConfigError:
        return  # no thruster's: its reasons are tested below
    assert [force for _, force in result.curve] == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("1600", "line 2: 1 columns"),
        ("1600,49,x", "line 2: 3 columns"),
        ("1600,abc", "line 2: grams = 'abc': not a number"),
        ("1600,nan", "line 2: grams = 'nan': not a number"),
        ("inf,5", "line 2: pulse_us = 'inf': not a number"),
        ("2600,5", "line 2: pulse_us = 2600 (allowed: whole numbers from 500 to 2500)"),
        ("1600.5,5", "line 2: pulse_us = 1600.5"),
    ],
)
def test_a_bad_row_is_named(line: str, says: str) -> None:
    with pytest.raises(ConfigError) as error:
        read_rows(["pulse_us,grams", line], "scale.csv")
    assert f"scale.csv: {says}" in str(error.value)


@pytest.mark.parametrize(
    ("lines", "says"),
    [
        (["us,g", "1600,5"], "line 1: 'us,g' is not the head (allowed: pulse_us,grams)"),
        ([], "line 1: '' is not the head"),
        (["pulse_us,grams", "1500,0", "1500,1"], "1 different pulses (allowed: 6 or more)"),
        (["pulse_us,grams", *(f"{pulse},{pulse - 1490}" for pulse in range(1500, 1900, 50))], "must reach from astern"),
        (["pulse_us,grams", *(f"{pulse},{pulse - 1510}" for pulse in range(1300, 1700, 25))], "no two pulses at which"),
        ([*measured(noise_g=0.0), "1700,-50"], f"line {2 * len(PULSES) + 2}: -0.49 N at 1700 us is"),
    ],
)
def test_readings_of_no_thruster_are_refused_with_the_reason(lines: list[str], says: str) -> None:
    with pytest.raises(ConfigError) as error:
        fit(read_rows(lines, "scale.csv"), "scale.csv", 12, 0.03)
    assert says in str(error.value)


def test_command_prints_what_an_experiment_takes(tmp_path: Path) -> None:
    (tmp_path / "scale.csv").write_text("\n".join(measured(scale=2.0)), encoding="utf-8")
    result = CliRunner().invoke(cli, ["identify", "thrust", str(tmp_path / "scale.csv"), "--lever", "0.4"])
    printed = tomllib.loads(result.stdout)["vehicle"]
    curve = printed["thruster"]["curve"]
    flown = load_experiment("pool", [f"vehicle={{like='spherical', thruster={{curve={curve}, max_thrust_n=2.3}}}}"])
    assert float(flown.vehicle.thruster.force_n(np.array(1900.0))) == pytest.approx(0.8 * 3.0, abs=0.05)
    assert printed["thruster"]["max_thrust_n"] == pytest.approx(0.8 * 3.0, abs=0.05)
    missing = CliRunner().invoke(cli, ["identify", "thrust", str(tmp_path / "none.csv")])
    assert "none.csv" in str(missing.exception)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("pulse_us,grams\n1100,-5 µg\n".encode("latin-1"), "scale.csv: cannot be read: 'utf-8' codec can't decode byte 0xb5"),
        ("pulse_us,grams\n1100,-5\n".encode("utf-16"), "save it as CSV in UTF-8"),
        (b"pulse_us,grams\n" + b"1" * 200_000 + b",3\n", "scale.csv: line 2: field larger than field limit"),
    ],
    ids=["latin-1", "utf-16", "one endless number"],
)
def test_a_file_that_is_no_table_is_refused_by_name(content: bytes, says: str, tmp_path: Path) -> None:
    (tmp_path / "scale.csv").write_bytes(content)
    result = CliRunner().invoke(cli, ["identify", "thrust", str(tmp_path / "scale.csv")])
    assert isinstance(result.exception, ConfigError) and says in str(result.exception), result.output


def test_a_board_that_tells_a_part_of_its_parameters_is_not_taken_for_one_with_a_shorter_curve(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    session = ParameterSession(UdpLink("127.0.0.1", free_port(SOCK_DGRAM)), ParameterClient(1))
    monkeypatch.setattr(session, "until", lambda done, ask: False)
    session.client.values["CRV01_US"] = 1100.0
    with pytest.raises(ConfigError, match="the board told 1 parameters, and then no more: nothing of it was changed"):
        write_curve(session, fit(read_rows(measured(), "scale.csv"), "scale.csv", 12, 0.03))


@pytest.mark.real_time
def test_command_writes_the_curve_to_a_board_and_says_what_it_refuses(tmp_path: Path) -> None:
    where = f"udp:127.0.0.1:{free_port(SOCK_DGRAM)}"
    file = tmp_path / "scale.csv"
    file.write_text("\n".join(measured(scale=0.5)), encoding="utf-8")
    with board(where, tmp_path / "kept"):
        written = CliRunner().invoke(cli, ["identify", "thrust", str(file), "--link", where])
        assert written.exit_code == 0, written.output
        curve = tomllib.loads(written.stdout)["vehicle"]["thruster"]["curve"]
        listed = CliRunner().invoke(cli, ["params", "list", "--link", where]).stdout.splitlines()
        values = {name: float(value) for name, value in map(str.split, listed)}
        assert [[values[f"CRV{i:02}_US"], values[f"CRV{i:02}_N"]] for i in range(1, 13)] == [
            pytest.approx(point, abs=1e-5) for point in curve
        ]
        narrow = [line for line in measured() if not line.startswith("1100")]
        file.write_text("\n".join(narrow), encoding="utf-8")
        refused = CliRunner().invoke(cli, ["identify", "thrust", str(file), "--link", where])
        assert "CRV01_US = 1125: CRV01_US: does not fit the others" in str(refused.exception)
