"""Recursive least squares with a generalised likelihood ratio test for a missing part (Willsky and Jones 1976). Pure.

The model is y = theta . x + noise, with a prior: theta is about zero, with a given covariance. Knowledge of theta fades back
to the prior in FADES_S. The noise variance is learned too: in rough water little is known of theta for longer.

A missing share q of the part that goes with x_k leaves -q x_k in y. The evidence is the log-likelihood ratio of the newest
samples with and without that. The uncertainty of theta enters it, so that an effect not learned yet is no evidence. With r = y
- theta . x, and S the covariance of noise and theta's uncertainty together,

    evidence = -q x_k' S^-1 r - q^2 / 2 x_k' S^-1 x_k        at its largest over k, q, and the last SPANS_S

Samples are learned only after they have been tested for the longest span, and not while evidence exceeds SUSPECTED: otherwise
a fault would be learned as normal.
"""

import math
from bisect import bisect_left
from collections import deque

import numpy as np
from numpy.typing import NDArray

from wire.frames import Array
from wire.kernels import kernel

NS = 1_000_000_000
SPANS_S = (0.5, 1.0, 2.0)
FADES_S = 1000.0
NOISE_S = 10.0  # how fast the noise is learned
SUSPECTED = 3.0  # evidence: what is felt meanwhile is no habit
LEAST = 1e-12  # of what could have been missing: nothing


@kernel("void(f8[:,::1], f8[:,::1])")
def solve(a: Array, b: Array) -> None:
    """Solve a X = b for a positive definite `a` (k, k) by Gaussian elimination, in both arrays: X (k, m) stands in `b`."""
    for i in range(len(a)):
        for row in range(len(a)):
            if row != i:
                share = a[row, i] / a[i, i]
                for j in range(i, len(a)):
                    a[row, j] -= share * a[i, j]
                for j in range(b.shape[1]):
                    b[row, j] -= share * b[i, j]
    for i in range(len(a)):
        for j in range(b.shape[1]):
            b[i, j] /= a[i, i]


@kernel("f8(f8[:,::1], f8[::1], i8[::1], f8[::1], f8[:,::1], i8, f8, f8)")
def largest_evidence(
    samples: Array,
    weights: Array,
    begins: NDArray[np.int64],
    theta: Array,
    covariance: Array,
    parts: int,
    least: float,
    most: float,
) -> float:
    """Largest evidence of the module, over the first `parts` of x, shares from `least` to `most`, and the spans of samples
    from each of `begins`, the latest first, to the end.

    `samples` (n, k + 1) are (x, y), `weights` (n,) their inverse variances, `covariance` (k, k) that of theta. With
    r = y - theta . x and C = sum (x, r) (x, r)' / variance, uncertainty leaves C - C_x' (C_xx + covariance^-1)^-1 C_x of it:
    (x, r)' S^-1 (x, r).
    """
    k, best = len(theta), -np.inf
    information, known = np.eye(k), np.copy(covariance)
    solve(known, information)
    summed, z, end = np.zeros((k + 1, k + 1)), np.zeros(k + 1), len(samples)
    for begin in begins:
        for i in range(begin, end):
            z[:] = samples[i]
            for j in range(k):
                z[k] -= theta[j] * samples[i, j]
            for row in range(k + 1):
                for column in range(k + 1):
                    summed[row, column] += weights[i] * z[row] * z[column]
        end = begin
        explained = np.copy(summed[:k])
        solve(summed[:k, :k] + information, explained)
        for part in range(parts):
            along, size = -summed[k, part], summed[part, part]
            for j in range(k):
                along += summed[k, j] * explained[j, part]
                size -= summed[part, j] * explained[j, part]
            share = min(max(along / max(size, LEAST), least), most)
            best = max(best, share * (along - 0.5 * share * size))
    return best


class LikelihoodRatioTest:
    """Test of one number y against its regressors x (k,)."""

    def __init__(
        self, prior: Array, noise: float, least_noise: float, same_s: float, parts: int, shares: tuple[float, float]
    ) -> None:
        """`prior` (k, k): covariance of theta at first; `noise`: standard deviation of y at first, `least_noise`: at least.
        Samples within `same_s` of each other are correlated and count once. A missing share, from least to most in `shares`,
        is sought in each of the first `parts` of x."""
        self._prior, self._least_variance, self._same_s = prior, least_noise**2, same_s
        self._theta, self._covariance, self._variance = np.zeros(len(prior)), prior, noise**2
        self._parts, self._shares = parts, shares
        self._young: deque[tuple[int, float, float, Array]] = deque()  # instant, seconds, roughness, (x, y)
        self.evidence = 0.0  # that a part is missing now

    def note_sample(self, x: Array, y: float, rough: float, elapsed_s: float, at_ns: int) -> None:
        """Take in y with x at an instant, `elapsed_s` after the last sample; `rough` is an additional standard deviation
        of y."""
        self._young.append((at_ns, elapsed_s, rough, np.append(x, y)))
        while self._young[0][0] <= at_ns - SPANS_S[-1] * NS:
            _, seconds, roughness, sample = self._young.popleft()
            if self.evidence < SUSPECTED:
                self._learn(sample[:-1], float(sample[-1]), roughness, seconds)
        self.evidence = self._look(at_ns)

    def _learn(self, x: Array, y: float, rough: float, seconds: float) -> None:
        missed = y - float(self._theta @ x)
        known = self._covariance + -math.expm1(-seconds / FADES_S) * (self._prior - self._covariance)
        toward = known @ x
        doubt = float(x @ toward)
        noise = max(missed**2 - doubt - rough**2, self._least_variance)
        self._variance += -math.expm1(-seconds / NOISE_S) * (noise - self._variance)
        gain = toward / (doubt + (self._variance + rough**2) * self._same_s / seconds)
        self._theta = self._theta + gain * missed
        self._covariance = known - np.outer(gain, toward)

    def _look(self, at_ns: int) -> float:
        """Return the evidence in the young samples."""
        instants, seconds, rough, samples = zip(*self._young, strict=True)
        weights = np.array(seconds) / (self._same_s * (self._variance + np.square(rough)))
        begins = np.array([bisect_left(instants, at_ns - span_s * NS) for span_s in SPANS_S])
        return largest_evidence(np.array(samples), weights, begins, self._theta, self._covariance, self._parts, *self._shares)
