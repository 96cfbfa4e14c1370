"""Photographs that a field does not explain are named."""

from __future__ import annotations

import numpy as np
import pytest

from warpnerf.reports.misfits import in_words, misfits


def psnr_of(deviation: float, *below: float, n: int = 41) -> dict[str, float]:
    """Of ``n`` photographs around 28 dB, and of one for each number, so many dB below."""
    usual = 28.0 + NORMAL_PLACES[n] * deviation
    return {f"{i}.jpg": float(p) for i, p in enumerate([*usual, *(28.0 - np.array(below))])}


def _normal_places(n: int) -> np.ndarray:
    """As many numbers with the quantiles of a normal distribution."""
    rng = np.random.default_rng(0)
    return np.quantile(rng.normal(size=100_001), (np.arange(n) + 0.5) / n)


NORMAL_PLACES = {n: _normal_places(n) for n in (3, 8, 41)}


@pytest.mark.parametrize(
    ("deviation", "below", "found"),
    [
        (0.5, (3.3,), 0),  # many deviations, but few dB
        (1.1, (5.7,), 0),  # few deviations
        (0.7, (5.8, 7.5), 2),
        (1.5, (7.9, 9.9), 1),
        (0.0, (3.4, 3.6), 1),
    ],
)
def test_those_far_below_the_others_are_found(
    deviation: float, below: tuple[float, ...], found: int
) -> None:
    assert (
        misfits(psnr_of(deviation, *below))
        == [f"{41 + i}.jpg" for i in range(len(below))][::-1][:found]
    )


def test_few_photographs_do_not_tell() -> None:
    assert misfits(psnr_of(0.5, 9.0, n=3)) == []
    assert in_words({}) is None


@pytest.mark.parametrize(
    ("below", "says"),
    [
        (
            (8.0,),
            "photograph that the field does not explain: 8.jpg (20.0 dB), where half of all have "
            "27.9 dB or more; poses may be wrong",
        ),
        ((8.0, 9.0), "photographs that the field does not explain: 9.jpg (19.0 dB) and 8.jpg (20"),
        (
            (7.0, 8.0, 9.0, 10.0),
            ": 11.jpg (18.0 dB), 10.jpg (19.0 dB), 9.jpg (20.0 dB) and 1 more,",
        ),
    ],
)
def test_the_worst_are_named_first(below: tuple[float, ...], says: str) -> None:
    sentence = in_words(psnr_of(0.5, *below, n=8))
    assert sentence is not None and says in sentence
    assert sentence.endswith("take such ones out of the scene's folder or file of poses")
