"""Episodes for learning: resets, steps, rewards and ends, and that they leave no file."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import shoal
from shoal.errors import ConfigError
from shoal.frames import Array


def toward(observation: Array) -> Array:
    """A wrench that leads robots back to their reference."""
    error, speed = observation[:, :4], observation[:, 4:8] - observation[:, 8:12]
    surge, heave = -4.0 * error[:, 0] - 6.0 * speed[:, 0], -8.0 * error[:, 2] - 10.0 * speed[:, 2]
    return np.column_stack([surge, heave, -4.0 * error[:, 3] - 2.0 * speed[:, 3] - 3.0 * error[:, 1]])


def test_an_episode_is_led_by_actions_and_ends_with_the_experiment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    env = shoal.Env("numeric", {"duration_s": 12})
    observation, info = env.reset(seed=1)
    assert (observation.shape, env.action_shape, info) == (env.observation_shape, (3, 3), {"time_s": 0.0})
    rewards, truncated, steps = [], False, 0
    while not truncated:
        observation, reward, terminated, truncated, info = env.step(toward(observation))
        rewards.append(reward)
        steps += 1
        assert not terminated
    assert steps == 240 and info["time_s"] == pytest.approx(12.0)
    assert rewards[-1] > -0.02 > -0.3 > rewards[0]
    assert list(tmp_path.iterdir()) == []


def test_the_same_seed_gives_the_same_episode_and_no_seed_another_one() -> None:
    env = shoal.Env("numeric-disturbed", {"sim.plant.gust_mps": 0.05})

    def seen(seed: int | None) -> bytes:
        observation, _ = env.reset(seed=seed)
        for _ in range(40):
            observation, *_ = env.step(np.full(env.action_shape, 0.3))
        return observation.tobytes()

    assert seen(4) == seen(4) != seen(None)
    assert seen(5) == seen(5) and seen(6) == seen(6)


def test_errors_and_velocities_are_on_the_robots_own_axes_and_the_wrench_changes_as_on_a_robot() -> None:
    env = shoal.Env("pool")
    observation, _ = env.reset(seed=1)
    start, reference = env.starts[0], env.trajectories[0].eta[0]
    off = (start[0] - reference[0] + 1j * (start[1] - reference[1])) * np.exp(-1j * start[3])
    np.testing.assert_allclose(observation[0, :2], [off.real, off.imag], atol=1e-6)
    for _ in range(20):
        observation, *_ = env.step(np.tile([1.0, 0.0, 0.0], (2, 1)))
        share = observation[:, 12]
    assert np.all(observation[:, 4] > 0.01) and np.all(np.abs(observation[:, 5]) < 0.01)  # ahead, not sideways
    assert share[0] == pytest.approx(min(20 * env.experiment.wrench_step[0] / env.experiment.vehicle.limits.wrench[0], 1.0))


def test_an_episode_is_over_where_a_robot_meets_the_wall() -> None:
    env = shoal.Env("pool")
    env.reset(seed=1)
    ends = (env.step(np.tile([1.0, 0.0, 0.0], (2, 1))) for _ in range(600))
    terminated_s = next(info["time_s"] for _, _, terminated, _, info in ends if terminated)
    assert 1.0 < terminated_s < 30.0


def test_faults_that_need_a_camera_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"sim\.faults\.0\.what = 'marker 1 lost': in a numeric flight there is none"):
        shoal.Env("pool", {"sim.faults": [{"at_s": 1.0, "what": "marker 1 lost"}]})


def test_a_base_beside_it_is_told_the_seed() -> None:
    class Base:
        def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
            self.given = seed

    class LearningPool(shoal.Env, Base): ...  # as a script does with gymnasium.Env

    pool = LearningPool("pool")
    pool.reset(seed=7)
    assert pool.given == 7
