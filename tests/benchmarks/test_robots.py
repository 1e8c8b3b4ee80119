"""The grid's figures against the same flights flown and measured another way; its flights are what they claim to be."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from benchmarks import evidence
from benchmarks.robots import program, report
from benchmarks.robots.report import GridRun
from groundstation.planning import planner
from robot_agent.guidance.trajectory_check import unflyable
from shoal.config.experiment import load_experiment
from shoal.messages.messages import CommandKind, Mode, required
from sim_bridge.in_process.fleet import AgentFleet, DirectPlant
from tests.flights.cells import CELLS, draw
from tests.flights.claims import GROUPS, ObserverClaim, nees
from tests.flights.figures import FlightFigures, figures
from tests.flights.grid_flights import fly, square
from tests.flights.vehicles import SPHERICAL, VEHICLES, ScaledVehicle
from tests.flights.water import TrueState

pytestmark = pytest.mark.long

HOLD_S = 30.0


def test_figures_are_those_of_the_plant_on_a_circle() -> None:
    """The flight again without anything of the grid but its settings; the path by the circle's own formula."""
    plan = draw("ordinary", 0)
    assert (plan.scene, plan.rate_hz) == ("circle", 10)
    result = figures(fly(plan, HOLD_S))
    experiment = load_experiment("straight", plan.settings)
    trajectories = planner.plan(experiment)
    starts = planner.start_poses(experiment, trajectories)
    water = DirectPlant(experiment, experiment.seed, np.array([starts[1]]))
    fleet = AgentFleet(experiment, trajectories, water, experiment.seed)
    fleet.start()
    places = []
    while fleet.time_s < CELLS["ordinary"].path_s - 1e-9:
        fleet.step()
        places.append(water.eta[0, :3].copy())
    flown = len(places)
    fleet.order(CommandKind.HOLD, 0)
    while fleet.time_s < CELLS["ordinary"].path_s + HOLD_S - 1e-9:
        fleet.step()
        places.append(water.eta[0, :3].copy())
    track, time_s = np.array(places), 0.1 * np.arange(1, len(places) + 1)
    circle = experiment.path
    assert circle.kind == "circle"
    angle = 2.0 * math.pi * time_s / circle.lap_s
    path = 0.5 * circle.diameter_m * np.column_stack([np.cos(angle), np.sin(angle)])
    off_m = np.hypot(*(track[:, :2] - path).T)[:flown]
    assert result.rms_m == pytest.approx(math.sqrt(np.mean(off_m[200:] ** 2 + (track[200:flown, 2] - 1.0) ** 2)), abs=2e-5)
    assert result.max_m == pytest.approx(off_m[200:].max(), abs=2e-5)
    assert result.settled_s == pytest.approx(time_s[np.flatnonzero(off_m > 0.05)[-1] + 1])
    place = required(fleet.robots[0].states[-1].control).eta_reference[:2]
    held_m = np.hypot(*(track[flown + 100 :, :2] - place).T)
    assert result.hold_m == held_m.max() > 0.0
    assert result.hold_rms_m == pytest.approx(math.sqrt(np.mean(held_m**2)))
    wrench = np.array([required(state.control).wrench for state in fleet.robots[0].states[-len(track) :]])
    assert result.duty == pytest.approx(max(np.mean(np.abs(wrench), axis=0) / [6.0, 3.0, 0.5]))
    assert not result.is_stop and result.left == ""
    assert 0.0 < result.nees["place"] < 10.0 and set(result.nees) <= set(GROUPS)


def test_a_robot_that_is_held_fast_stays_where_it_was_and_its_stop_is_timed() -> None:
    plan = draw("held-path", 0)
    log = fly(plan, HOLD_S)
    assert log.trouble_row is not None
    held = log.truth[log.trouble_row :, 0, :3]
    assert np.ptp(held, axis=0).max() < 1e-12 < np.ptp(log.truth[: log.trouble_row, 0, :2], axis=0).max()
    stops_s = [k / plan.rate_hz for k, state in enumerate(log.states[0], start=1) if state.mode is Mode.FAULT]
    expected_s = min(stops_s) - log.trouble_row / plan.rate_hz if stops_s else math.inf
    assert figures(log).stop_s == pytest.approx(expected_s)
    assert log.trouble_row / plan.rate_hz == pytest.approx(plan.amount, abs=1.0 / plan.rate_hz)


@pytest.mark.parametrize("cell", ["gaps", "turned-57", "meet-4-lost", "swept"])
def test_a_trouble_reaches_the_robot(cell: str) -> None:
    """The same flight without its trouble takes another way."""
    plan = draw(cell, 0)
    base = replace(plan, settings=(*plan.settings, "duration_s=20"))
    short = replace(plan.of, path_s=16.0, holds=False)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(CELLS, cell, short)
        troubled = fly(base, HOLD_S)
        patch.setitem(CELLS, cell, replace(short, trouble=""))
        calm = fly(base, HOLD_S)
    steps = min(len(troubled.truth), len(calm.truth))
    assert np.abs(troubled.truth[:steps] - calm.truth[:steps]).max() > 1e-6


def test_a_flight_of_a_number_is_always_the_same_and_settings_come_last() -> None:
    assert draw("mixed", 5) == draw("mixed", 5) != draw("mixed", 6)
    plan = draw("mixed", 5, ["controller.law=pid"])
    assert plan.settings == (*draw("mixed", 5).settings, "controller.law=pid")
    assert load_experiment("straight", plan.settings).controller.law == "pid"
    drawn = {(draw("ordinary", k).scene, draw("ordinary", k).rate_hz) for k in range(12)}
    assert len(drawn) == 12  # each path at each rate


@pytest.mark.parametrize("cell", list(CELLS))
def test_every_cell_can_be_flown(cell: str) -> None:
    """Robots accept its paths, and current and speed together are within what the robot can do."""
    for number in range(2):
        plan = draw(cell, number)
        experiment = load_experiment("straight", plan.settings)
        trajectories = planner.plan(experiment)
        if plan.scene == "square":
            trajectories = {1: square(experiment, plan.speed_mps, len(trajectories[1].eta))}
        assert [unflyable(t, experiment.pool, experiment.vehicle) for t in trajectories.values()] == [""] * len(trajectories)
        assert plan.speed_mps + math.hypot(*plan.current_mps) <= 0.951 * plan.fastest_mps


def test_a_square_has_sharp_corners_and_its_heading_follows() -> None:
    plan = draw("vehicle-40kg", 3)
    experiment = load_experiment("straight", plan.settings)
    path = square(experiment, plan.speed_mps, 2000)
    x, y = path.eta[:, 0], path.eta[:, 1]
    edge_m = np.minimum(np.minimum(np.abs(x), np.abs(x - 1.5)), np.minimum(np.abs(y), np.abs(y - 1.5)))
    assert edge_m.max() < 1e-9 and np.ptp(x) == pytest.approx(1.5) and np.ptp(y) == pytest.approx(1.5)
    speed = np.hypot(path.velocity[:, 0], path.velocity[:, 1])
    assert np.allclose(speed[speed > 0.0], speed.max()) and speed.max() == pytest.approx(plan.speed_mps, rel=0.01)
    assert np.allclose(np.gradient(path.eta[:, 3], path.period_s), path.velocity[:, 3], atol=0.02)
    assert path.eta[-1, 3] > 0.4 * math.pi


def test_vehicles_are_the_shipped_one_at_its_own_size_and_their_limits_are_steady_speeds() -> None:
    same = load_experiment("straight", ScaledVehicle().settings()).vehicle
    assert same.model_dump(exclude={"limits"}) == SPHERICAL.model_dump(exclude={"limits"})
    for limit in ("speed_mps", "heave_mps", "yaw_rate_radps"):
        assert getattr(same.limits, limit) == pytest.approx(getattr(SPHERICAL.limits, limit), rel=0.02)
    for build in (build for build in VEHICLES.values() if isinstance(build, ScaledVehicle)):
        vehicle = load_experiment("straight", build.settings()).vehicle
        u = vehicle.limits.speed_mps
        assert vehicle.drag.linear[0] * u + vehicle.drag.quadratic[0] * u**2 == pytest.approx(
            vehicle.limits.wrench[0], rel=1e-3
        )


def test_nees_is_one_for_errors_of_the_claimed_covariance() -> None:
    random = np.random.default_rng(3)
    names = tuple(name for group in GROUPS.values() for name in group)
    root = random.standard_normal((8, 8)) * 0.02
    ratios = []
    for _ in range(2000):
        eta, nu, water = (
            random.uniform(-4.0, 4.0, (1, 4)),
            random.uniform(-0.5, 0.5, (1, 4)),
            random.uniform(-0.3, 0.3, (1, 3)),
        )
        turn = np.array([[math.cos(eta[0, 3]), math.sin(eta[0, 3])], [-math.sin(eta[0, 3]), math.cos(eta[0, 3])]])
        u, v = nu[0, :2] - turn @ water[0, :2]
        truth = dict(zip(("x", "y", "yaw", "u", "v", "r"), (*eta[0, :2], eta[0, 3], u, v, nu[0, 3]), strict=True))
        truth |= {"current_x": water[0, 0], "current_y": water[0, 1]}
        mean = np.array([truth[name] for name in names]) + root @ random.standard_normal(8)
        mean[names.index("yaw")] += 2.0 * math.pi
        ratios.append(nees(ObserverClaim(0, names, mean, root @ root.T), TrueState(eta, nu, water), 0))
    for group in GROUPS:
        assert np.mean([f[group] for f in ratios]) == pytest.approx(1.0, abs=0.1)


def test_a_run_comes_back_from_its_file_and_stands_beside_another() -> None:
    flights = (
        FlightFigures(
            "ordinary",
            1,
            "eight",
            20,
            1,
            holds=True,
            settled_s=math.inf,
            never_settled=True,
            rms_m=0.004,
            hold_m=0.03,
            nees={"place": 1.2},
        ),
        FlightFigures("meet-2", 0, "crossing-2", 10, 2, nearest_m=0.7, back_s=12.0),
        FlightFigures("swept", 0, "straight", 10, 1, stop_s=4.0, left="FAULT after 14.00 s: off its path", is_stop=True),
    )
    run = GridRun("law eso-mpc, observer eso", ("a.b=1",), 60.0, "Written", flights)
    again = report.from_json(json.loads(json.dumps(evidence.plain(report.as_json(run)), allow_nan=False)))
    assert repr(again) == repr(run)
    better = replace(run, law="another", flights=(replace(flights[0], hold_m=0.011), *flights[1:]))
    page = report.markdown(better, run)
    assert (
        "| ordinary | never | 4 | 11 |" in page
        and "still water; 1 lost |" in page
        and "| 30 mm; 1 of 1 beyond 20 mm | 11 mm; 0 of 1 beyond 20 mm |" in page
    )
    assert "`python -m benchmarks robots --cells ordinary --flight 1 --set a.b=1 --hold-s 60`" in page
    assert "* FAULT: off its path: 1 swept" in page


def test_a_single_flight_is_told_whole_and_an_unknown_cell_is_refused() -> None:
    app = typer.Typer()
    app.command()(program.main)
    result = CliRunner().invoke(app, ["--cells", "held-start", "--flight", "0", "--hold-s", "20"])
    assert result.exit_code == 0 and "TRACKING" in result.output and "stop_s" in result.output
    assert "held fast from the start" in result.output
    result = CliRunner().invoke(app, ["--cells", "nothing"])
    assert result.exit_code == 2 and "no such cell" in result.output
