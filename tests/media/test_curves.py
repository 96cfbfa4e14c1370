"""The picture of a training's curves."""

from __future__ import annotations

import numpy as np
import pytest

from warpnerf.media.curves import _TEST, SIZE, CurvePoint, curves, running_mean
from warpnerf.media.plots import _round_numbers, _ticks


def point(step: int, test: float | None = None) -> CurvePoint:
    return CurvePoint(step=step, seconds=0.5 * step, loss=1.0 / step, psnr=20.0, test_psnr=test)


def red(picture: np.ndarray) -> int:
    return int((picture == _TEST).all(axis=-1).sum())


def test_test_views_are_there_where_they_were_measured() -> None:
    points = [point(step) for step in range(1, 100)]
    plain = curves(points, "room")
    tested = curves([*points, point(100, 18.0)], "room")
    assert plain.shape == tested.shape == (SIZE[1], SIZE[0], 3) and plain.dtype == np.uint8
    assert red(plain) == 0 and red(tested) > 40


def test_a_single_report_is_drawn() -> None:
    assert curves([CurvePoint(step=0, seconds=0.0, loss=0.0, psnr=0.0)], "room").std() > 5


def test_the_mean_runs_through_the_middle() -> None:
    line = np.linspace(0.0, 1.0, 200)
    noise = 0.1 * (-1.0) ** np.arange(200)
    np.testing.assert_allclose(running_mean(line), line, atol=1e-12)
    assert np.abs(running_mean(line + noise) - line)[10:-10].max() < 0.02


@pytest.mark.parametrize(("low", "high"), [(0.0, 4000.0), (17.3, 31.2), (-3.0, -2.9), (0.0, 1e-9)])
def test_round_numbers(low: float, high: float) -> None:
    numbers = _round_numbers(low, high)
    assert 2 <= len(numbers) <= 8
    assert min(numbers) >= low - 1e-9 and max(numbers) <= high + 1e-9


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (0.5, 70.0, [0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0]),
        (0.01, 3000.0, [0.01, 0.1, 1.0, 10.0, 100.0, 1000.0]),
        (2.1, 4.9, [2.5, 3.0, 3.5, 4.0, 4.5]),
        (1e-9, 1e9, [1e-5, 1.0, 1e5]),
    ],
)
def test_ticks_of_logarithmic_axes(low: float, high: float, expected: list[float]) -> None:
    found = [10.0**value for value in _ticks(np.log10(low), np.log10(high), logarithmic=True)]
    np.testing.assert_allclose(found, expected, rtol=1e-9)
