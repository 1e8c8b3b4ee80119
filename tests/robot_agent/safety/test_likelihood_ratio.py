"""Evidence against densities of the normal distribution, and what is learned against a batch fit, both by other hands."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

import robot_agent.safety.likelihood_ratio
from robot_agent.safety.likelihood_ratio import FADES_S, SPANS_S, SUSPECTED, LikelihoodRatioTest
from shoal.frames import Array

NS = 1_000_000_000
STEP_S = 0.05
PRIOR = np.diag(np.square([0.2, 0.2, 0.3, 0.004]))
PRIOR[:2, :2] += 0.2**2
NOISE = 0.001
SHARES = (0.6, 2.0)


def samples(theta: Array, seconds: float, seed: int) -> tuple[Array, Array]:
    """Two parts, another cause and a constant (n, 4), and what comes of them with white noise (n,)."""
    random = np.random.default_rng(seed)
    t = STEP_S * np.arange(round(seconds / STEP_S))
    x = np.column_stack(
        [
            0.03 * np.sin(0.9 * t + random.uniform(0.0, 6.0)),
            0.02 * np.sin(1.3 * t),
            0.02 * np.sin(0.4 * t),
            np.ones_like(t),
        ]
    )
    return x, x @ theta + NOISE * random.standard_normal(len(t))


def teach(test: LikelihoodRatioTest, x: Array, y: Array, begin: int = 0, rough: float = 0.0) -> LikelihoodRatioTest:
    for k in range(len(x)):
        test.note_sample(x[k], float(y[k]), rough, STEP_S, round((begin + k) * STEP_S * NS))
    return test


def fresh() -> LikelihoodRatioTest:
    return LikelihoodRatioTest(PRIOR, NOISE, NOISE / 10.0, STEP_S, 2, SHARES)


def likelier(x: Array, y: Array, noise: float, mean: Array, covariance: Array) -> float:
    """Log-likelihood ratio of y with a share missing, over all shares, parts and spans, tried one by one."""
    ratios = []
    for span_s in SPANS_S:
        a, b = x[-round(span_s / STEP_S) - 1 :], y[-round(span_s / STEP_S) - 1 :]
        spread = noise**2 * np.eye(len(a)) + a @ covariance @ a.T
        usual = multivariate_normal(a @ mean, spread)
        ratios += [
            usual.logpdf(b + share * a[:, part]) - usual.logpdf(b) for part in (0, 1) for share in np.linspace(*SHARES, 57)
        ]
    return float(max(ratios))


@pytest.mark.parametrize("missing", [0.0, 0.25, 0.5, 0.8, 1.0, 2.0])
def test_evidence_is_a_ratio_of_likelihoods(missing: float) -> None:
    x, y = samples(np.zeros(4), 1.5, 3)
    y = y - missing * x[:, 0]
    assert teach(fresh(), x, y).evidence == pytest.approx(likelier(x, y, NOISE, np.zeros(4), PRIOR), rel=2e-3, abs=2e-3)


@pytest.mark.parametrize("missing", [0.0, 0.3, 1.0])
def test_recursion_learns_what_a_batch_fit_of_all_samples_finds(missing: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """But of those that are still looked at. The fit knows the noise, and neither forgets anything."""
    monkeypatch.setattr(robot_agent.safety.likelihood_ratio, "FADES_S", 1e9)
    theta = np.array([-0.25, 0.2, 0.3, 0.003])
    x, y = samples(theta, 32.0, 1)
    young = round(SPANS_S[-1] / STEP_S)
    y[-young // 2 :] -= missing * x[-young // 2 :, 1]
    covariance = np.asarray(np.linalg.inv(np.linalg.inv(PRIOR) + x[:-young].T @ x[:-young] / NOISE**2), dtype=np.float64)
    fitted = covariance @ (x[:-young].T @ y[:-young] / NOISE**2)
    expected = likelier(x, y, NOISE, fitted, covariance)
    assert teach(fresh(), x, y).evidence == pytest.approx(expected, rel=0.15, abs=0.5)
    assert (expected > 20.0) is (missing == 1.0)


def test_constant_lack_becomes_a_habit() -> None:
    """A quarter of both parts and a little more of one, from the beginning: never evidence worth the name."""
    x, y = samples(np.array([-0.4, -0.25, 0.0, 0.0]), 40.0, 2)
    test = fresh()
    assert max(teach(test, x[k : k + 1], y[k : k + 1], k).evidence for k in range(len(x))) < SUSPECTED


def test_change_is_doubted_at_once_and_settled_by_later_samples_only() -> None:
    """Both parts lose a third at an instant. Told so, it is no evidence; untold it is."""
    x, y = samples(np.zeros(4), 40.0, 8)
    begin = round(20.0 / STEP_S)
    y[begin:] -= 0.33 * x[begin:, :2].sum(axis=1)
    alike = np.zeros((4, 4))
    alike[:2, :2] = 0.33**2

    def most(is_settled: bool) -> float:
        test = teach(fresh(), x[:begin], y[:begin])
        if is_settled:
            test.note_change(alike, begin * round(STEP_S * NS))
        return max(teach(test, x[k : k + 1], y[k : k + 1], k).evidence for k in range(begin, len(x)))

    assert most(is_settled=True) < SUSPECTED < 8.0 < most(is_settled=False)


def test_however_many_changes_are_told_no_less_is_known_than_at_first() -> None:
    x, y = samples(np.zeros(4), 22.0, 9)
    begin = round(20.0 / STEP_S)
    y[begin:] -= x[begin:, 0]
    test = teach(fresh(), x[:begin], y[:begin])
    for _ in range(100):
        test.note_change(PRIOR, begin * round(STEP_S * NS))
    at_first = teach(fresh(), x[begin:], y[begin:]).evidence
    assert teach(test, x[begin:], y[begin:], begin).evidence > 0.9 * at_first > SUSPECTED


def test_suspected_sample_does_not_become_a_habit() -> None:
    """However long it lasts."""
    x, y = samples(np.zeros(4), 60.0, 4)
    begin = round(20.0 / STEP_S)
    y[begin:] -= x[begin:, 0]
    test = teach(fresh(), x[:begin], y[:begin])
    assert test.evidence < SUSPECTED
    late = [teach(test, x[k : k + 1], y[k : k + 1], k).evidence for k in range(begin, len(x))][-round(20.0 / STEP_S) :]
    assert np.median(late) > 20.0


def test_habit_that_is_not_seen_any_more_is_doubted_again() -> None:
    x, y = samples(np.zeros(4), 30.0, 5)
    broken = y[-20:] - 0.8 * x[-20:, 0]
    evidence = teach(teach(fresh(), x[:-20], y[:-20]), x[-20:], broken, len(x) - 20).evidence
    test, idle = teach(fresh(), x[:-20], y[:-20]), round(FADES_S / STEP_S)
    teach(test, np.tile([0.0, 0.0, 0.0, 1.0], (idle, 1)), np.zeros(idle), len(x))
    doubted = teach(test, x[-20:], broken, len(x) + idle).evidence
    assert 1.0 < doubted < 0.5 * evidence


def test_rough_samples_are_less_evidence() -> None:
    """Samples after larger noise, and samples known to be rough."""
    x, y = samples(np.zeros(4), 30.0, 6)
    broken = y - np.where(np.arange(len(y)) > len(y) - 20, x[:, 0], 0.0)
    calm = teach(fresh(), x, broken).evidence
    assert teach(fresh(), x, broken + 4.0 * y).evidence < 0.5 * calm
    assert teach(fresh(), x, broken, rough=4.0 * NOISE).evidence < 0.5 * calm


def test_of_more_samples_than_there_is_room_for_the_oldest_are_learned_early() -> None:
    """A thousand in the last second: nothing is missing, then most of a part is."""
    x, y = samples(np.zeros(4), 60.0, 7)
    test, step_ns = fresh(), NS // 1000
    for k in range(1000):
        test.note_sample(x[k], float(y[k]), 0.0, STEP_S, k * step_ns)
    assert test.evidence < SUSPECTED
    for k in range(1000, 1100):
        test.note_sample(x[k], float(y[k] - 0.8 * x[k, 0]), 0.0, STEP_S, k * step_ns)
    assert test.evidence > SUSPECTED
