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
from typing import NamedTuple

import numpy as np

from shoal.frames import Array
from shoal.kernels.decorator import kernel
from shoal.kernels.types import Floats, Ints, Table

NS = 1_000_000_000
SPANS_S = (0.5, 1.0, 2.0)
FADES_S = 1000.0
NOISE_S = 10.0  # how fast the noise is learned
SUSPECTED = 3.0  # evidence: what is felt meanwhile is no habit
KEPT = 256  # samples: half of them are more than the fastest loop takes in the longest span
LEAST = 1e-12  # of what could have been missing: nothing


class Knowledge(NamedTuple):
    """Knowledge of theta: its mean (k,) and its covariance (k, k)."""

    theta: Floats
    covariance: Table


class Sought(NamedTuple):
    """A missing share: of one of the first `parts` of x, from `least` to `most`."""

    parts: int
    least: float
    most: float


class KeptSamples(NamedTuple):
    """Samples not learned yet, in the rows from `first` to `end`."""

    instants_ns: Ints
    xy: Table  # (n, k + 1) x and y
    spread: Table  # (n, 2) seconds for which each stands, and its own standard deviation besides the noise's
    first: int
    end: int


class Weighing(NamedTuple):
    """Numbers that decide how much a sample counts."""

    spans_s: Floats  # looked at
    same_s: float  # samples within this time count once
    variance: float  # of the noise


class Learning(NamedTuple):
    """Numbers of one step of learning."""

    per_sample: float
    fades: float  # share of the knowledge
    renewed: float  # share of the noise's variance that is taken from this sample
    least_variance: float


@kernel(part=True)
def solve(a: Table, b: Table) -> None:
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


@kernel(part=True)
def largest_evidence(xy: Table, weights: Floats, begins: Ints, factor: Knowledge, sought: Sought) -> float:
    """Largest evidence of the module, over the parts and shares that are sought, and the spans of samples from each of
    `begins`, the latest first, to the end.

    `weights` (n,) are the inverse variances of the samples `xy` (n, k + 1). With r = y - theta . x and
    C = sum (x, r) (x, r)' / variance, uncertainty leaves C - C_x' (C_xx + covariance^-1)^-1 C_x of it: (x, r)' S^-1 (x, r).
    """
    theta, parts = factor.theta, sought.parts
    k, best = len(theta), -np.inf
    information = np.eye(k)
    solve(np.copy(factor.covariance), information)
    summed, z, end = np.zeros((k + 1, k + 1)), np.zeros(k + 1), len(xy)
    for begin in begins:
        for i in range(begin, end):
            z[:] = xy[i]
            for j in range(k):
                z[k] -= theta[j] * xy[i, j]
            for row in range(k + 1):
                for column in range(k + 1):
                    summed[row, column] += weights[i] * z[row] * z[column]
        end = begin
        explained = np.copy(summed[:k, :parts])
        solve(summed[:k, :k] + information, explained)
        for part in range(parts):
            along, size = -summed[k, part], summed[part, part]
            for j in range(k):
                along += summed[k, j] * explained[j, part]
                size -= summed[part, j] * explained[j, part]
            share = min(max(along / max(size, LEAST), sought.least), sought.most)
            best = max(best, share * (along - 0.5 * share * size))
    return best


@kernel
def evidence_at(samples: KeptSamples, at_ns: int, weighing: Weighing, knowledge: Knowledge, sought: Sought) -> float:
    """`largest_evidence` of the samples, over the last spans before `at_ns`."""
    first, end, spans_s = samples.first, samples.end, weighing.spans_s
    weights, begins = np.empty(end - first), np.empty(len(spans_s), np.int64)
    for i in range(first, end):
        own = samples.spread[i, 1]
        weights[i - first] = samples.spread[i, 0] / (weighing.same_s * (weighing.variance + own * own))
    for k in range(len(spans_s)):
        begins[k] = 0
        while begins[k] < end - first and samples.instants_ns[first + begins[k]] < at_ns - spans_s[k] * NS:
            begins[k] += 1
    return float(largest_evidence(samples.xy[first:end], weights, begins, knowledge, sought))


@kernel
def learn(knowledge: Knowledge, prior: Table, sample: Floats, rough: float, variance: float, learning: Learning) -> float:
    """Do one step of recursive least squares with a `sample` (x, y), in what is known:

        C = covariance + fades (prior - covariance)    gain = C x / (x . C x + (variance + rough^2) per_sample)

    The noise's variance takes the share `renewed` of what this sample says of it. Returns the new one.
    """
    theta, covariance, fades = knowledge.theta, knowledge.covariance, learning.fades
    k, missed, doubt = len(theta), sample[len(theta)], 0.0
    toward = np.zeros(k)
    for i in range(k):
        missed -= theta[i] * sample[i]
        for j in range(k):
            covariance[i, j] += fades * (prior[i, j] - covariance[i, j])
            toward[i] += covariance[i, j] * sample[j]
        doubt += sample[i] * toward[i]
    noise = max(missed * missed - doubt - rough * rough, learning.least_variance)
    variance += learning.renewed * (noise - variance)
    per = 1.0 / (doubt + (variance + rough * rough) * learning.per_sample)
    for i in range(k):
        theta[i] += toward[i] * per * missed
        for j in range(k):
            covariance[i, j] -= toward[i] * per * toward[j]
    return variance


class LikelihoodRatioTest:
    """Test of one number y against its regressors x (k,)."""

    def __init__(
        self, prior: Array, noise: float, least_noise: float, same_s: float, parts: int, shares: tuple[float, float]
    ) -> None:
        """`prior` (k, k): covariance of theta at first; `noise`: standard deviation of y at first, `least_noise`: at least.
        Samples within `same_s` of each other are correlated and count once. A missing share, from least to most in `shares`,
        is sought in each of the first `parts` of x."""
        least_share, most_share = shares
        self._prior = prior
        self._least_variance = least_noise**2
        self._same_s = same_s
        self._sought = Sought(parts, least_share, most_share)
        self._spans_s = np.array(SPANS_S)
        self.evidence = 0.0  # that a part is missing now

        # What was learned from all samples but the newest
        self._theta = np.zeros(len(prior))
        self._covariance = prior.copy()
        self._variance = noise**2

        # Covariance of changes that the caller has told and that is not yet in `_covariance`: it is added when the first
        # sample after them is learned
        self._doubt = np.zeros_like(prior)
        self._changed_ns = 0

        # Samples that are not learned yet: the rows from `first` to `end` of three tables
        self._instants_ns = np.zeros(KEPT, np.int64)
        self._samples = np.zeros((KEPT, len(prior) + 1))  # x, y
        self._spread = np.zeros((KEPT, 2))  # seconds since the sample before, and roughness
        self._first = self._end = 0

    def note_sample(self, x: Array, y: float, rough: float, elapsed_s: float, at_ns: int) -> None:
        """Take in y with x at an instant, `elapsed_s` after the last sample; `rough` is an additional standard deviation
        of y."""
        if self._end == KEPT:
            self._make_room()
        row = self._end
        self._instants_ns[row], self._samples[row, :-1], self._samples[row, -1] = at_ns, x, y
        self._spread[row] = elapsed_s, rough
        self._end += 1
        while self._instants_ns[self._first] <= at_ns - SPANS_S[-1] * NS:
            self._learn_first()
        first = max(self._first, int(np.searchsorted(self._instants_ns[: self._end], self._changed_ns)))
        samples = KeptSamples(self._instants_ns, self._samples, self._spread, first, self._end)
        knowledge = Knowledge(self._theta, self._covariance + self._doubt)
        weighing = Weighing(self._spans_s, self._same_s, self._variance)
        self.evidence = evidence_at(samples, at_ns, weighing, knowledge, self._sought)

    def note_change(self, covariance: Array, at_ns: int) -> None:
        """Note that theta has changed at an instant by an unknown amount with this `covariance` (k, k). It adds to theta's own
        at once, scaled so that no variance exceeds the prior's. The test then looks at later samples only."""
        changed = np.diag(covariance) > 0.0
        room = np.diag(self._prior - self._covariance - self._doubt)[changed] / np.diag(covariance)[changed]
        self._doubt += min(max(float(room.min(initial=1.0)), 0.0), 1.0) * covariance
        self._changed_ns = at_ns

    def _learn_first(self) -> None:
        """Learn the oldest sample, unless something is suspected."""
        if self._instants_ns[self._first] >= self._changed_ns:
            self._covariance += self._doubt
            self._doubt[:] = 0.0
        if self.evidence < SUSPECTED:
            seconds, rough = self._spread[self._first].tolist()
            learning = Learning(
                self._same_s / seconds,
                -math.expm1(-seconds / FADES_S),
                -math.expm1(-seconds / NOISE_S),
                self._least_variance,
            )
            knowledge, sample = Knowledge(self._theta, self._covariance), self._samples[self._first]
            self._variance = learn(knowledge, self._prior, sample, rough, self._variance, learning)
        self._first += 1

    def _make_room(self) -> None:
        """Move the samples to the first rows. Of more than half of KEPT the oldest are learned early."""
        while self._end - self._first > KEPT // 2:
            self._learn_first()
        for column in (self._instants_ns, self._samples, self._spread):
            column[: self._end - self._first] = column[self._first : self._end]
        self._first, self._end = 0, self._end - self._first
