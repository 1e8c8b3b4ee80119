"""Sensors that measure nothing any more, alone and in whole control steps."""

import itertools
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from robot_agent.inputs import Inputs
from robot_agent.preflight.rehearsal import ARM_AFTER, rehearse
from robot_agent.safety.sensor_checks import LEVEL_MPS2, NOISE_M, NOISE_RADPS, GravityCheck, GyroscopeCheck, StuckSensorCheck
from shoal.config.experiment import load_experiment

NS = 1_000_000_000
PERIOD_S, LATE_S = 0.05, 0.04  # poses are older than the gyroscope's samples


def gyroscope(
    seconds: float, rate_radps: Callable[[float], float], measured: Callable[[float], float], flips: int = 0
) -> tuple[GyroscopeCheck, float]:
    """A check after a turn at `rate_radps(t)` of which the gyroscope measures `measured(rate)`, and the first time at which it
    found them apart; infinity if it did not. Each `flips`-th heading is the opposite one."""
    check, random, heading_rad, first_s = GyroscopeCheck(), np.random.default_rng(1), 0.0, math.inf
    headings: list[float] = []
    for k in range(round(seconds / PERIOD_S)):
        time_s = k * PERIOD_S
        heading_rad += rate_radps(time_s) * PERIOD_S
        headings.append(heading_rad + random.normal(0.0, 0.009) + (math.pi if flips and k % flips == 0 else 0.0))
        check.note_rate(measured(rate_radps(time_s + 0.5 * PERIOD_S)) + random.normal(0.0, 0.003), round(time_s * NS))
        if k:
            check.note_heading(headings[-2], round((time_s - PERIOD_S) * NS))
        if check.apart_rad and math.isinf(first_s):
            first_s = time_s
    return check, first_s


def slalom(time_s: float) -> float:
    return 0.5 * math.sin(time_s)


@pytest.mark.parametrize(
    ("rate", "measured"),
    [(slalom, lambda r: 0.0), (slalom, lambda r: 2.0 * r), (slalom, lambda r: -r), (lambda t: 0.1, lambda r: 0.2 * r),
     (lambda t: 0.0, lambda r: 0.1)],
    ids=["dead", "double", "reversed", "a fifth of a slow turn", "biased"],
)  # fmt: skip
def test_a_gyroscope_that_measures_another_turn_is_found(
    rate: Callable[[float], float], measured: Callable[[float], float]
) -> None:
    _, first_s = gyroscope(20.0, rate, measured)
    assert first_s < 20.0


@pytest.mark.parametrize(("scale", "is_found"), [(1.0, False), (2.0, True)])
def test_headings_between_two_samples_of_the_gyroscope_are_compared_with_the_turn_up_to_then(
    scale: float, is_found: bool
) -> None:
    """Samples at 5 Hz, poses half way between them: a turn that is read at a sample is off by up to 0.1 rad."""
    check, was_apart = GyroscopeCheck(), False
    for k in range(100):
        check.note_rate(scale * math.cos(0.2 * k), k * NS // 5)
        if k:
            check.note_heading(math.sin(0.2 * k - 0.1), k * NS // 5 - NS // 10)
        was_apart |= check.apart_rad > 0.0
    assert was_apart is is_found


@pytest.mark.parametrize("flips", [0, 5])
def test_a_right_gyroscope_passes_with_bias_and_scale_errors_and_with_headings_that_flip(flips: int) -> None:
    _, first_s = gyroscope(120.0, slalom, lambda r: 1.03 * r + 0.01, flips)
    assert math.isinf(first_s)


def test_a_heading_that_leaps_once_and_a_gap_are_no_turn() -> None:
    check = GyroscopeCheck()
    for k in range(400):
        at_ns = k * NS // 20 + (10 * NS if k >= 200 else 0)
        check.note_rate(0.0, at_ns)
        check.note_heading((0.0, 2.0, -1.0, 0.3)[k // 100], at_ns)
        assert check.apart_rad == 0.0


def stuck(samples: list[float], gap_s: float = 0.0) -> float:
    check = StuckSensorCheck(NOISE_M)
    for k, value in enumerate(samples):
        check.note_sample(value, round((1.0 + k * PERIOD_S + (gap_s if k >= len(samples) // 2 else 0.0)) * NS))
    return check.same_s


def test_a_depth_that_repeats_itself_after_noise_is_found_after_3_s() -> None:
    noise = np.random.default_rng(1).normal(0.3, 0.002, 100).tolist()
    assert stuck(noise + 59 * noise[-1:]) == 0.0
    assert stuck(noise + 62 * noise[-1:]) == pytest.approx(3.1)
    assert stuck([*noise, *62 * noise[-1:], 0.31]) == 0.0


def test_a_depth_without_noise_is_not_judged() -> None:
    """As in a simulation without noise, at rest or coming to rest; and a coarse sensor that shows a step now and then."""
    assert stuck([0.3] * 400) == 0.0
    assert stuck([*(0.3 + 0.1 * math.exp(-0.05 * k) for k in range(200)), *[0.3] * 200]) == 0.0
    assert stuck([0.30, 0.31] + [0.31] * 80 + [0.30] * 80) == 0.0
    assert stuck(np.random.default_rng(1).normal(0.3, 0.002, 2).tolist() * 1, gap_s=20.0) == 0.0


Force = tuple[float, float, float]


def gravity(force_mps2: Callable[[int], Force], noise_mps2: float = 0.03) -> tuple[GravityCheck, float]:
    """A check after 60 s of a specific force with noise, rounded as on the link, and the first time of a doubt."""
    check, random, first_s = GravityCheck(), np.random.default_rng(1), math.inf
    for k in range(1200):
        noise = random.normal(0.0, noise_mps2, 3)
        force = [round(value + more, 2) for value, more in zip(force_mps2(k), noise, strict=True)]
        check.note_sample(force, round((1.0 + k * PERIOD_S) * NS))
        if check.doubt and math.isinf(first_s):
            first_s = k * PERIOD_S
    return check, first_s


def leaning(angle_rad: float) -> tuple[float, float, float]:
    return 0.0, -9.81 * math.sin(angle_rad), -9.81 * math.cos(angle_rad)


@pytest.mark.parametrize("angle_rad", [0.6, math.pi / 2, math.pi])
def test_gravity_that_is_not_below_is_in_doubt_within_2_s(angle_rad: float) -> None:
    check, first_s = gravity(lambda k: leaning(angle_rad))
    assert first_s < 2.0
    assert check.doubt.startswith("off gravity by ") and check.doubt.endswith(": it is wrong or turned, or the robot leans")


def test_an_accelerometer_that_measures_nothing_is_in_doubt() -> None:
    assert gravity(lambda k: (0.0, 0.0, 0.0))[1] < 1.0


def test_a_right_accelerometer_passes_with_offset_and_scale_in_waves_and_with_leaps() -> None:
    """0.08 g of offset and 3 % of scale, as an MPU-6050 may have; 15 degrees of swing; 1 m/s^2 of waves; leaps."""

    def force(k: int) -> tuple[float, float, float]:
        x, y, z = leaning(0.26 * math.sin(0.1 * k))
        wave = math.sin(0.15 * k)
        return (300.0, 0.0, 0.0) if k % 100 == 50 else (x + 0.5 + wave, 1.03 * y + 0.5, 1.03 * z + 0.8 + wave)

    assert math.isinf(gravity(force)[1])


def test_a_force_that_repeats_itself_after_noise_is_found_and_one_without_noise_is_not_judged() -> None:
    check, at_ns = gravity(lambda k: LEVEL_MPS2)[0], 61 * NS
    for k in range(62):
        check.note_sample((0.01, 0.0, -9.8), at_ns + k * NS // 20)
    assert check.doubt == "exactly the same for 3.0 s"
    assert math.isinf(gravity(lambda k: LEVEL_MPS2, 0.0)[1])


def test_a_gyroscope_that_repeats_itself_is_found_without_a_turn() -> None:
    check, random = StuckSensorCheck(NOISE_RADPS), np.random.default_rng(1)
    for k in range(200):
        check.note_sample(random.normal(0.0, 0.001) if k < 120 else 0.0, round((1.0 + k * PERIOD_S) * NS))
    assert check.same_s == pytest.approx(3.95)


def fault_of(change: Callable[[Inputs, int], Inputs], steps: int) -> str:
    """The fault of a rehearsed flight whose inputs are changed from the 60th step on."""
    fault = ""
    for k, (agent, inputs, now_ns) in enumerate(
        itertools.islice(rehearse(load_experiment("pool"), 1), ARM_AFTER + 60 + steps)
    ):
        noisy = replace(inputs.board, depth_m=inputs.board.depth_m + 0.002 * math.sin(17.0 * k))
        inputs = replace(inputs, board=noisy)
        fault = agent.step(change(inputs, k) if k >= ARM_AFTER + 60 else inputs, now_ns).state.fault
    return fault


@pytest.mark.long
def test_a_flight_ends_with_the_name_of_the_sensor() -> None:
    assert fault_of(lambda inputs, k: inputs, 160) == ""
    frozen = fault_of(lambda inputs, k: replace(inputs, board=replace(inputs.board, depth_m=0.3)), 70)
    assert frozen == "depth sensor stuck: exactly the same for 3.0 s"
    dead = fault_of(lambda inputs, k: replace(inputs, board=replace(inputs.board, yaw_rate_radps=0.0)), 160)
    assert dead.startswith("gyroscope in doubt: its turn and the camera's differ by 0.")
    turned = fault_of(
        lambda inputs, k: replace(inputs, board=replace(inputs.board, acceleration_mps2=np.array([0.0, 9.8, 0.0]))), 60
    )
    assert turned.startswith("accelerometer in doubt: off gravity by ")
