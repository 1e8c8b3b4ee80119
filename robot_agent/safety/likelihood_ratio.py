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
from itertools import pairwise

import numpy as np

from wire.frames import Array

NS = 1_000_000_000
SPANS_S = (0.5, 1.0, 2.0)
FADES_S = 1000.0
NOISE_S = 10.0  # how fast the noise is learned
SUSPECTED = 3.0  # evidence: what is felt meanwhile is no habit
LEAST = 1e-12  # of what could have been missing: nothing


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
        z = np.array(samples)
        z[:, -1] -= z[:, :-1] @ self._theta
        weighted = z.T * (np.array(seconds) / (self._same_s * (self._variance + np.square(rough))))
        begins = [len(z), *(bisect_left(instants, at_ns - span_s * NS) for span_s in SPANS_S)]
        summed = np.cumsum([weighted[:, begin:end] @ z[begin:end] for end, begin in pairwise(begins)], axis=0)
        return self._missing(summed)

    def _missing(self, summed: Array) -> float:
        """Return the evidence in weighted sums of (x, r) (x, r)' over each span."""
        of_x = summed[:, :-1, :-1] + np.linalg.inv(self._covariance)
        certain = summed - summed[:, :, :-1] @ np.linalg.solve(of_x, summed[:, :-1])  # (x, r)' S^-1 (x, r)
        along, size = -certain[:, -1, : self._parts], certain.diagonal(axis1=1, axis2=2)[:, : self._parts]
        least, most = self._shares
        share = np.minimum(np.maximum(along / np.maximum(size, LEAST), least), most)
        return float((share * (along - 0.5 * share * size)).max())
