"""Paired differences and their intervals, against tables and by hand."""

from __future__ import annotations

import math

import pytest

from warpnerf.reports.paired import paired_difference, t_probability, t_quantile


@pytest.mark.parametrize(
    ("degrees", "quantile"),
    [(1, 12.7062), (2, 4.30265), (3, 3.18245), (4, 2.77645), (9, 2.26216), (30, 2.04227)],
)
def test_quantiles_are_those_of_tables(degrees: int, quantile: float) -> None:
    assert t_quantile(degrees, 0.975) == pytest.approx(quantile, abs=1e-4)


def test_the_distribution_is_cauchys_and_the_normal_one_at_its_ends() -> None:
    assert t_probability(1, 1.0) == pytest.approx(0.75)
    assert t_probability(1000, 1.0) == pytest.approx(0.5 + 0.5 * math.erf(0.5**0.5), abs=1e-3)
    assert t_probability(7, 0.0) == 0.5


def test_seeds_are_paired() -> None:
    """Seeds differ by much more than the configurations do."""
    found = paired_difference([11.0, 22.0, 33.0], [10.0, 20.0, 30.0])
    half = 4.30265 * 1.0 / 3**0.5
    assert found.mean == 2.0 and found.low == pytest.approx(2.0 - half, abs=1e-4)
    assert found.high == pytest.approx(2.0 + half, abs=1e-4)
    assert not found.significant
    assert paired_difference([10.9, 21.0, 31.1], [10.0, 20.0, 30.0]).significant
    assert paired_difference([-0.9, -1.0, -1.1], [0.0, 0.0, 0.0]).significant


def test_one_seed_says_nothing() -> None:
    found = paired_difference([2.0], [1.0])
    assert (found.mean, found.low, found.high, found.significant) == (1.0, None, None, False)
