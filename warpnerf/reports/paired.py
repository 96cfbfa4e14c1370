"""Paired differences: mean over seeds, and Student's interval."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

CONFIDENCE = 0.95
"""Of intervals."""


@dataclass(frozen=True, kw_only=True)
class Difference:
    """By how much one configuration's figures exceed another's, seed by seed."""

    mean: float
    """Over seeds."""
    low: float | None
    """Lower end of the interval; None: one seed has none."""
    high: float | None
    """Upper end."""
    seeds: int
    """How many."""

    @property
    def significant(self) -> bool:
        """Whether the interval leaves 0 out."""
        return self.low is not None and self.high is not None and not self.low <= 0.0 <= self.high


def paired_difference(values: Sequence[float], against: Sequence[float]) -> Difference:
    """Mean of paired differences, with Student's interval at CONFIDENCE: mean +- t s / sqrt(n).

    Args:
        values: Of each seed.
        against: Of the same seeds.
    """
    apart = np.subtract(values, against)
    mean, n = float(apart.mean()), len(apart)
    if n < 2:
        return Difference(mean=mean, low=None, high=None, seeds=n)
    half = t_quantile(n - 1, 0.5 + CONFIDENCE / 2.0) * float(apart.std(ddof=1)) / math.sqrt(n)
    return Difference(mean=mean, low=mean - half, high=mean + half, seeds=n)


def t_quantile(degrees: int, probability: float) -> float:
    """Quantile of Student's t distribution.

    Args:
        degrees: Of freedom, at least 1.
        probability: In (0.5, 1).

    Returns:
        Where the distribution function has that value; found by bisection.
    """
    low, high = 0.0, 1.0
    while t_probability(degrees, high) < probability:
        high *= 2.0
    for _ in range(100):
        middle = 0.5 * (low + high)
        if t_probability(degrees, middle) < probability:
            low = middle
        else:
            high = middle
    return high


def t_probability(degrees: int, t: float) -> float:
    """Student's distribution function at t >= 0, for whole degrees of freedom.

    Finite sums in cos(theta) and sin(theta) with theta = atan(t / sqrt(degrees)): Abramowitz &
    Stegun 26.7.3 and 26.7.4.
    """
    theta = math.atan(t / math.sqrt(degrees))
    cosine, sine = math.cos(theta), math.sin(theta)
    term, total = (cosine, 0.0) if degrees % 2 else (1.0, 0.0)
    for k in range(degrees % 2, degrees - 1, 2):
        total += term
        term *= cosine * cosine * (k + 1) / (k + 2)
    both_sides = sine * total
    if degrees % 2:
        both_sides = 2.0 / math.pi * (theta + sine * total)
    return 0.5 + 0.5 * both_sides
