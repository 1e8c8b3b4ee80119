"""The vehicle file, and the thrust curve against its measured points and its own inverse."""

import copy
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from hypothesis import given
from hypothesis import strategies as st

from shoal.config.experiment import load_experiment
from shoal.config.loader import check
from shoal.config.vehicle import VEHICLES, FixedThruster, Thruster, Vehicle, load_vehicle
from shoal.errors import ConfigError
from shoal.messages.messages import required

SPHERICAL = load_vehicle("spherical")
CURVE = np.array(SPHERICAL.thruster.curve)
LOWEST_N, HIGHEST_N = float(CURVE[0, 1]), float(CURVE[-1, 1])


def _thruster(curve: list[tuple[int, float]], neutral_us: int = 1500) -> Thruster:
    table = {
        "max_thrust_n": max(curve[-1][1], 1e-3),
        "lag_s": 0.1,
        "dead_time_s": 0.05,
        "neutral_us": neutral_us,
        "curve": curve,
    }
    return check(Thruster, table, "thruster.toml")


@st.composite
def thrusters(draw: st.DrawFn) -> Thruster:
    """Any usable thruster: rising branches of any shape on both sides of a dead zone of any width, even none."""
    steps_us = st.lists(st.integers(20, 120), min_size=2, max_size=4)
    steps_n = st.floats(0.01, 3.0)
    left, right = draw(st.integers(0, 60)), draw(st.integers(1, 60))
    forward, us, newtons = [(1500 + right, 0.0)], 1500 + right, 0.0
    for step in draw(steps_us):
        us, newtons = us + step, newtons + draw(steps_n)
        forward.append((us, newtons))
    reverse, us, newtons = [(1500 - left, 0.0)], 1500 - left, 0.0
    for step in draw(steps_us):
        us, newtons = us - step, newtons - draw(steps_n)
        reverse.insert(0, (us, newtons))
    return _thruster(reverse + forward)


def _some_forces(thruster: Thruster, fractions: list[float]) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Forces within reach, fractions from -1 (full reverse) to 1 (full ahead)."""
    f = np.array(fractions)
    return np.where(f > 0, f * thruster.curve[-1][1], -f * thruster.curve[0][1])


fractions = st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=20)


def test_the_curve_goes_through_its_measured_points() -> None:
    np.testing.assert_array_equal(SPHERICAL.thruster.force_n(CURVE[:, 0]), CURVE[:, 1])


@given(thrusters(), fractions)
def test_pulse_and_force_are_inverse(thruster: Thruster, parts: list[float]) -> None:
    force_n = _some_forces(thruster, parts)
    np.testing.assert_allclose(thruster.force_n(thruster.pulse_us(force_n)), force_n, atol=1e-9)


@given(thrusters(), st.floats(1400.0, 1600.0))
def test_outside_the_dead_zone_the_pulse_comes_back_too(thruster: Thruster, pulse_us: float) -> None:
    force_n = thruster.force_n(np.array(pulse_us))
    if force_n != 0.0 and thruster.curve[0][0] <= pulse_us <= thruster.curve[-1][0]:
        assert float(thruster.pulse_us(force_n)) == pytest.approx(pulse_us, abs=1e-6)


@given(thrusters())
def test_zero_is_neutral_and_the_smallest_force_is_not(thruster: Thruster) -> None:
    """A force of any size lands at the edge of the dead zone or beyond, on its own side."""
    neutral, ahead, astern = thruster.pulse_us(np.array([0.0, 1e-12, -1e-12]))
    assert neutral == thruster.neutral_us
    zone_us = [us for us, newtons in thruster.curve if newtons == 0.0]
    assert ahead == pytest.approx(max(zone_us), abs=1e-6)
    assert astern == pytest.approx(min(zone_us), abs=1e-6)


@given(thrusters(), fractions)
def test_more_force_never_means_a_shorter_pulse(thruster: Thruster, parts: list[float]) -> None:
    force_n = np.sort(_some_forces(thruster, [*parts, 0.0]))
    assert np.all(np.diff(thruster.pulse_us(force_n)) >= 0.0)


@pytest.mark.parametrize(("force_n", "pulse_us"), [(1e9, 1900), (-1e9, 1100), (np.inf, 1900), (-np.inf, 1100), (np.nan, 1500)])
def test_an_impossible_force_stays_on_the_curve(force_n: float, pulse_us: float) -> None:
    """Beyond the ends: the ends. No number at all: neutral."""
    assert SPHERICAL.thruster.pulse_us(np.array(force_n)) == pulse_us


def test_shapes_are_kept() -> None:
    force_n = np.linspace(LOWEST_N, HIGHEST_N, 12).reshape(3, 4)
    assert SPHERICAL.thruster.pulse_us(force_n).shape == (3, 4)
    assert SPHERICAL.thruster.force_n(SPHERICAL.thruster.pulse_us(force_n)).shape == (3, 4)


@pytest.mark.parametrize(
    ("curve", "neutral_us", "complaint"),
    [
        ([(1100, -3.0), (1500, 0.0), (1400, 0.1), (1900, 3.0)], 1500, "curve must rise"),
        ([(1100, -3.0), (1400, 0.0), (1400, 0.0), (1900, 3.0)], 1400, "curve must rise"),
        ([(1100, -3.0), (1300, -3.5), (1500, 0.0), (1900, 3.0)], 1500, "curve must rise"),
        ([(1100, 0.0), (1300, 0.0), (1500, 0.0), (1900, 3.0)], 1500, "curve must reach from reverse"),
        ([(1100, -3.0), (1300, -1.0), (1500, 0.0), (1900, 0.0)], 1500, "curve must reach from reverse"),
        ([(1100, -3.0), (1450, 0.0), (1550, 0.0), (1900, 3.0)], 1551, "neutral_us = 1551 must lie in the curve's dead zone"),
        ([(1100, -3.0), (1450, 0.0), (1900, 3.0)], 1450, "curve = .* at least 4"),
        ([(1100, -3.0), (1450, 0.0), (1550, 0.0), (2600, 3.0)], 1500, r"curve\.3\.0 = 2600: .*2500"),
        ([(1100, -3.0), (1450, 0.0), (1550, 0.0), (1900, 3.0)], 400, "neutral_us = 400: .*500"),
        ([(1100, -3.0), (1450, 0.0), (1550, 0.0), (1900, float("nan"))], 1500, r"curve\.3\.1 = nan: .*finite"),
    ],
)
def test_a_bad_curve_is_refused_by_name(curve: list[tuple[int, float]], neutral_us: int, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        _thruster(curve, neutral_us)


def test_thrust_that_the_curve_does_not_reach_is_refused() -> None:
    table = SPHERICAL.thruster.model_dump() | {"max_thrust_n": 3.1}
    with pytest.raises(ConfigError, match=r"max_thrust_n = 3\.1 is more than the curve's 3\.0 N"):
        check(Thruster, table, "thruster.toml")


def test_a_curve_without_a_dead_zone_is_a_curve() -> None:
    thruster = _thruster([(1100, -3.0), (1300, -1.0), (1700, 1.0), (1900, 3.0)])
    force_n = np.array([-3.0, -0.5, 0.0, 0.5, 3.0])
    np.testing.assert_allclose(thruster.pulse_us(force_n), [1100, 1400, 1500, 1600, 1900])


# --- the file


def test_the_articles_robot() -> None:
    np.testing.assert_array_equal(SPHERICAL.inertia, [12.0, 12.0, 16.0, 0.12])
    np.testing.assert_array_equal(SPHERICAL.drag_linear, [3.0, 3.0, 4.0, 0.08])
    np.testing.assert_array_equal(SPHERICAL.drag_quadratic, [20.0, 20.0, 30.0, 0.10])
    assert SPHERICAL.limits.wrench == (6.0, 3.0, 0.5)


def test_the_stated_limits_are_where_drag_balances_full_thrust() -> None:
    """speed, heave and yaw rate at which linear v + quadratic v^2 equals the largest wrench, to what the file rounds."""
    stated = (SPHERICAL.limits.speed_mps, SPHERICAL.limits.heave_mps, SPHERICAL.limits.yaw_rate_radps)
    for axis, limit, wrench in zip((0, 2, 3), stated, SPHERICAL.limits.wrench, strict=True):
        linear, quadratic = SPHERICAL.drag_linear[axis], SPHERICAL.drag_quadratic[axis]
        assert max(np.roots([quadratic, linear, -wrench])) == pytest.approx(limit, rel=0.03)


def test_one_side_full_ahead_gives_the_articles_surge_and_yaw() -> None:
    """Two thrusters of 3 N at 0.0833 m: 6 N and 0.5 N m (article, Table 2 and equation 39)."""
    starboard_y = [y for _, y in required(SPHERICAL.legs).position_m if y > 0]
    assert SPHERICAL.thruster.max_thrust_n * len(starboard_y) == SPHERICAL.limits.wrench[0]
    assert SPHERICAL.thruster.max_thrust_n * sum(starboard_y) == pytest.approx(SPHERICAL.limits.wrench[2], rel=1e-3)


@pytest.mark.parametrize("path", sorted(VEHICLES.glob("*.toml")), ids=lambda path: path.stem)
def test_every_shipped_vehicle_loads(path: Path) -> None:
    vehicle = load_vehicle(path.stem)
    assert isinstance(vehicle, Vehicle)
    assert vehicle.name == path.stem
    assert vehicle.thruster.max_thrust_n <= vehicle.thruster.curve[-1][1]


def test_a_vehicle_of_ones_own(tmp_path: Path) -> None:
    table = copy.deepcopy(SPHERICAL.model_dump(mode="json"))
    table["mass"]["surge_kg"] = 20.0
    (tmp_path / "mine.toml").write_text(tomli_w.dumps(table))
    assert load_vehicle("mine.toml", tmp_path).inertia[0] == 20.0
    assert load_vehicle(str(tmp_path / "mine.toml")).inertia[0] == 20.0
    table["battery"]["no_arm_v"] = 11.0
    (tmp_path / "mine.toml").write_text(tomli_w.dumps(table))
    with pytest.raises(ConfigError, match=re.escape(f"{tmp_path / 'mine.toml'}: battery: must fall in this order")):
        load_vehicle("mine.toml", tmp_path)


def test_an_unknown_vehicle_is_refused_with_the_choice() -> None:
    with pytest.raises(ConfigError, match=r"vehicle = 'shark': no such vehicle \(allowed: .*spherical.*, or a path"):
        load_vehicle("shark")
    with pytest.raises(ConfigError, match=r"shark\.toml: no such file"):
        load_vehicle("shark.toml")


@pytest.mark.parametrize("legs", [3, 5, 6])
def test_a_vehicle_with_another_number_of_legs_is_refused(legs: int) -> None:
    given = [[0.2, 0.1], [0.2, -0.1], [-0.2, 0.1], [-0.2, -0.1], [0.0, 0.1], [0.0, -0.1]][:legs]
    with pytest.raises(ConfigError, match=rf"has {legs} legs .*exactly 4; this version models four steerable legs"):
        load_experiment("pool", [f"vehicle.legs.position_m={given}"])


# --- thrusters that do not turn

VECTORED = load_vehicle("vectored").model_dump(mode="json")


def changed(**changes: Any) -> dict[str, Any]:
    """The vectored vehicle's table with other values; a dotted name as `limits__wrench`."""
    table = copy.deepcopy(VECTORED)
    for name, value in changes.items():
        node, *rest = name.split("__")
        if rest:
            table[node][rest[0]] = value
        else:
            table[node] = value
    return table


def test_thrusters_give_the_wrench_of_their_places_and_directions() -> None:
    """Forces at 45 degrees: by hand, the vectored thrusters' levers, and the vertical ones' heave."""
    vehicle = check(Vehicle, VECTORED, "mine.toml")
    half = 0.5**0.5
    np.testing.assert_allclose(vehicle.mixing[:, 0], [half, 0.0, -half * (0.14 + 0.092), -half], atol=1e-12)
    np.testing.assert_allclose(vehicle.mixing[:, 4], [0.0, 1.0, 0.0, 0.0], atol=1e-12)
    assert vehicle.limits.has_sway and vehicle.neutral_us == (1500,) * 8
    turned = [{**one, "direction": [-3.0 * d for d in one["direction"]]} for one in VECTORED["thrusters"]]
    np.testing.assert_allclose(check(Vehicle, changed(thrusters=turned), "mine.toml").mixing, -vehicle.mixing, atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"thrusters": []}, "has neither .allowed: a table .legs., or tables ..thrusters"),
        ({"legs": SPHERICAL.model_dump(mode="json")["legs"]}, "has both"),
        ({"thrusters": VECTORED["thrusters"][:4]}, "cannot give heave without another axis"),
        ({"thrusters": VECTORED["thrusters"][2:]}, "cannot give (surge|yaw|sway) without another axis"),
        ({"thrusters": [{**one, "channel": 3} for one in VECTORED["thrusters"][:2]]}, "channel 3 is given twice"),
        ({"thrusters": [{**VECTORED["thrusters"][0], "channel": 9}]}, "channel"),
        ({"thrusters": [{**VECTORED["thrusters"][0], "direction": [0.0, 0.0, 0.0]}]}, "must be a vector with a length"),
        ({"limits__wrench": [60.0, 20.0, 5.0, 15.0]}, "60 of surge is more than the thrusters give alone, 56.6"),
        ({"limits__wrench": [20.0, 20.0, 5.0, 65.0]}, "65 of sway is more than the thrusters give alone"),
        ({"limits__wrench_rate_per_s": [20.0, 20.0, 20.0]}, "has 3 numbers, wrench has 4"),
    ],
)
def test_thrusters_that_cannot_do_what_the_file_claims_are_refused(changes: dict[str, Any], reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        check(Vehicle, changed(**changes), "mine.toml")


def test_legs_push_no_robot_sideways_and_laws_of_three_axes_refuse_one_that_is_pushed() -> None:
    table = SPHERICAL.model_dump(mode="json")
    table["limits"] |= {"wrench": [6.0, 3.0, 0.5, 1.0], "wrench_rate_per_s": [6.0, 6.0, 2.0, 6.0]}
    with pytest.raises(ConfigError, match="legs do not push sideways"):
        check(Vehicle, table, "mine.toml")
    for law in ("eso-mpc-article", "pid"):
        with pytest.raises(ConfigError, match=f"'vectored' has side thrust, which controller.law = '{law}' does not know"):
            load_experiment("pool", ["vehicle=vectored", f"controller.law={law}"])
    steps = load_experiment("pool", ["vehicle=vectored", "controller.law=nmpc"]).wrench_step
    assert steps == pytest.approx((1.0, 1.0, 1.0, 0.75))


@pytest.mark.parametrize("axis", range(4))
def test_a_vehicle_may_claim_all_that_its_thrusters_give_and_no_more(axis: int) -> None:
    vehicle = check(Vehicle, VECTORED, "mine.toml")
    least_n = min(vehicle.thruster.max_thrust_n, -vehicle.thruster.curve[0][1])
    most = least_n / float(np.abs(np.linalg.pinv(vehicle.mixing)[:, axis]).max())
    for limit, fits in ((most, True), (most * 1.001, False)):
        wrench = [limit if k == axis else value for k, value in enumerate(VECTORED["limits"]["wrench"])]
        if fits:
            assert check(Vehicle, changed(limits__wrench=wrench), "mine.toml").limits.wrench[axis] == limit
        else:
            with pytest.raises(ConfigError, match="is more than the thrusters give alone"):
                check(Vehicle, changed(limits__wrench=wrench), "mine.toml")


def test_thrusters_have_places_directions_and_names_by_the_output_that_they_are_on() -> None:
    legs = SPHERICAL.legs
    assert legs is not None
    assert SPHERICAL.thruster_places == [[x, y, 0.0, 1.0, 0.0, 0.0] for x, y in legs.position_m]
    assert [SPHERICAL.thruster_name(output) for output in range(4)] == ["front left", "front right", "rear left", "rear right"]
    assert SPHERICAL.thruster_channels == (1, 2, 3, 4) and SPHERICAL.thruster_count == 4
    fixed = [
        {"position_m": [0.1, -0.1, 0.0], "direction": [0.0, 0.0, -2.0], "channel": 3},
        {"position_m": [-0.1, 0.1, 0.2], "direction": [3.0, 0.0, 4.0], "channel": 1},
        {"position_m": [0.0, -0.1, 0.0], "direction": [0.0, 1.0, 1.0], "channel": 6},
    ]
    vehicle = SPHERICAL.model_copy(update={"legs": None, "thrusters": tuple(map(FixedThruster.model_validate, fixed))})
    assert (vehicle.thruster_count, vehicle.thruster_channels) == (8, (1, 3, 6))
    places = np.array(vehicle.thruster_places)
    assert places[[0, 2]].tolist() == [[-0.1, 0.1, 0.2, 0.6, 0.0, 0.8], [0.1, -0.1, 0.0, 0.0, 0.0, -1.0]]
    assert not places[[1, 3, 4, 6, 7]].any()
    names = [vehicle.thruster_name(output) for output in (0, 1, 2, 5)]
    assert names == ["rear right, vertical", "output 2", "front left, vertical", "rear left"]
