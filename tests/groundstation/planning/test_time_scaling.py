"""Slowed paths: the same way, derivatives that belong together, limits held, and no slower than they must be."""

import numpy as np
import pytest

from groundstation.planning.feasibility import PlanError
from groundstation.planning.planner import plan
from groundstation.planning.straight_sides import make_path
from groundstation.planning.time_scaling import TimeScaledPath
from shoal.config.experiment import Experiment, load_experiment
from shoal.config.scene import Waypoints
from shoal.frames import Array
from shoal.messages.messages import Trajectory

PERIOD_S = 0.05
ROTATING = ("formation.mode=rotate",)  # its outer robots would fly 0.56 m/s


def scene(*settings: str) -> Experiment:
    return load_experiment("numeric", settings)


def taken(experiment: Experiment, trajectory: Trajectory) -> dict[str, Array]:
    """Share of its limits that a robot uses along a trajectory, from its poses alone by central differences."""
    vehicle = experiment.vehicle
    eta = trajectory.eta
    v = (eta[2:] - eta[:-2]) / (2.0 * PERIOD_S)
    a = (eta[2:] - 2.0 * eta[1:-1] + eta[:-2]) / PERIOD_S**2
    speed = np.linalg.norm(v[:, :2], axis=1)
    drag = 3.0 + 20.0 * speed
    thrust = np.linalg.norm(12.0 * a[:, :2] + drag[:, None] * v[:, :2], axis=1)
    limits = vehicle.limits
    return {
        "speed": speed / limits.speed_mps,
        "heave": np.abs(v[:, 2]) / limits.heave_mps,
        "yaw rate": np.abs(v[:, 3]) / limits.yaw_rate_radps,
        "thrust": thrust / limits.wrench[0],
    }


def test_derivatives_of_a_slowed_path_are_those_of_its_positions() -> None:
    waypoints = load_experiment("numeric").path
    assert isinstance(waypoints, Waypoints)
    tau = np.arange(400) * PERIOD_S
    path = TimeScaledPath(make_path(waypoints), 0.6 + 0.4 * np.cos(0.7 * tau), PERIOD_S)
    time_s, h = np.linspace(1.0, 19.0, 300), 1e-5
    before, now, after = path.at(time_s - h), path.at(time_s), path.at(time_s + h)
    np.testing.assert_allclose((after.position_m - before.position_m) / (2 * h), now.velocity_mps, atol=1e-8)
    np.testing.assert_allclose((after.velocity_mps - before.velocity_mps) / (2 * h), now.acceleration_mps2, atol=1e-6)
    np.testing.assert_allclose((after.yaw_rad - before.yaw_rad) / (2 * h), now.yaw_rate_radps, atol=1e-8)
    np.testing.assert_allclose(
        (after.yaw_rate_radps - before.yaw_rate_radps) / (2 * h), now.yaw_acceleration_radps2, atol=1e-6
    )


def test_a_formation_that_would_be_too_fast_is_slowed_on_the_same_way() -> None:
    with pytest.raises(PlanError, match="speed"):
        plan(scene(*ROTATING))
    experiment = scene(*ROTATING, "path.slow=true")
    slow = plan(experiment)
    quick = plan(scene(*ROTATING, "vehicle.limits.speed_mps=2.0", "vehicle.limits.wrench=[60.0, 30.0, 5.0]"))
    for robot, trajectory in slow.items():
        for what, share in taken(experiment, trajectory).items():
            assert share.max() <= 1.0 + 2e-3, f"robot {robot}: {what}"  # central differences are right to 1e-3 here
        step_m = np.linalg.norm(np.diff(quick[robot].eta[:, :3], axis=0), axis=1).max()
        for point in trajectory.eta[::40, :3]:
            assert np.linalg.norm(quick[robot].eta[:, :3] - point, axis=1).min() <= 0.51 * step_m
    for i, j, length in ((1, 2, 4.0), (1, 3, 8**0.5), (2, 3, 8**0.5)):
        np.testing.assert_allclose(np.linalg.norm(slow[i].eta[:, :3] - slow[j].eta[:, :3], axis=1), length)


def test_it_is_slowed_no_more_and_no_longer_than_needed() -> None:
    experiment = scene(*ROTATING, "path.slow=true")
    slow = plan(experiment)
    most = np.max([np.max(list(taken(experiment, t).values()), axis=0) for t in slow.values()], axis=0)
    assert most.max() > 0.97
    centre = np.mean([t.velocity[1:-1, :2] for t in slow.values()], axis=0)  # of the triangle: what the path itself does
    pace = np.linalg.norm(centre, axis=1) / 0.3
    assert pace.max() <= 1.0 + 1e-6
    assert np.mean(pace > 0.999) > 0.5  # most of the way needs no slowing at all
    assert most[pace < 0.95].max() > 0.97


@pytest.mark.parametrize(
    ("settings", "limit"),
    [
        (("path.speed_mps=0.9", "duration_s=20.0"), "thrust"),
        (("path.dive_mps=0.5",), "heave"),  # as the article prints it (ambiguity A12)
        (("vehicle.limits.yaw_rate_radps=0.1",), "yaw rate"),
    ],
)
def test_each_limit_slows(settings: tuple[str, ...], limit: str) -> None:
    with pytest.raises(PlanError, match=limit):
        plan(scene(*settings))
    experiment = scene(*settings, "path.slow=true")
    shares = [taken(experiment, trajectory)[limit] for trajectory in plan(experiment).values()]
    assert 0.97 < np.max(shares) <= 1.0 + 2e-3


def test_a_feasible_path_is_not_slowed() -> None:
    for robot, trajectory in plan(scene("path.slow=true")).items():
        as_is = plan(scene())[robot]
        np.testing.assert_allclose(trajectory.eta, as_is.eta, atol=1e-12)
        np.testing.assert_allclose(trajectory.velocity, as_is.velocity, atol=1e-12)
        np.testing.assert_allclose(trajectory.acceleration, as_is.acceleration, atol=1e-10)


def test_where_slowing_does_not_help_the_plan_is_refused() -> None:
    with pytest.raises(PlanError, match=r"robot 1: heave .* exceeds the limit 0\.26"):
        plan(scene("path.dive_mps=20.0", "path.slow=true"))


def test_a_slowed_path_ends_later() -> None:
    waypoints = load_experiment("numeric").path
    assert isinstance(waypoints, Waypoints)
    path = make_path(waypoints)
    half = TimeScaledPath(path, np.full(2000, 0.5), PERIOD_S)
    assert half.end_s == pytest.approx(2.0 * path.end_s)
    assert TimeScaledPath(path, np.full(100, 0.5), PERIOD_S).end_s == float("inf")
