"""How well each photograph is explained late in a training."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import warpnerf as wn
from tests.support.tiny_trainings import NO_GROWTH, ball, early_growth, tiny_config
from warpnerf.optim_config import OptimConfig
from warpnerf.reports.misfits import misfits
from warpnerf.training import photograph_errors
from warpnerf.training.photograph_errors import FEWEST_RAYS, LATE, PhotographErrors

__all__ = ["early_growth"]

SLOW = OptimConfig(learning_rate_density=0.3, accumulate_at=())
"""Rates at which nothing that photographs show is lost for good within a short training."""


def test_late_rays_of_opaque_pixels_count() -> None:
    errors = PhotographErrors(3)
    n = FEWEST_RAYS
    views = np.repeat([0, 1, 2, -1], [n, n - 1, n // 2, 50])
    squared = np.array([0.03, 0.003, 0.3, 9.0])[views]
    errors.add(views, squared, LATE - 0.01)
    assert errors.psnr("abc") == {}
    errors.add(views, squared, LATE)
    assert errors.psnr("abc") == {"a": pytest.approx(20.0)}
    errors.add(views, squared, 1.0)
    assert errors.psnr("abc") == {
        "a": pytest.approx(20.0),
        "b": pytest.approx(30.0),
        "c": pytest.approx(10.0),
    }


def test_a_photograph_of_something_else_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """A ball is red from two dozen sides but one, in grainy photographs."""
    monkeypatch.setattr(photograph_errors, "FEWEST_RAYS", 20)
    plain = ball()
    views = []
    rng = np.random.default_rng(0)
    for number in range(24):
        c, s = np.cos(number * np.pi / 12.0), np.sin(number * np.pi / 12.0)
        c2w = np.array([[c, 0.0, s, 2.5 * s], [0.0, 1.0, 0.0, 0.1], [-s, 0.0, c, 2.5 * c]])
        image = plain.views[0].image.copy()
        image[..., :3] = [40, 60, 200] if number == 7 else [200, 60, 40]
        image[..., :3] += rng.integers(0, 50, image[..., :3].shape, np.uint8)
        camera = replace(plain.views[0].camera, c2w=c2w)
        views.append(replace(plain.views[0], name=f"{number}.png", camera=camera, image=image))
    scene = replace(plain, views=views, splits={"train": tuple(range(24)), "test": ()})
    result = wn.train(scene, tiny_config(grid=NO_GROWTH, steps=100, rays_per_step=900, optim=SLOW))
    found = result.photograph_psnr
    assert len(found) == 24 and "7.png" in misfits(found)
    assert found.pop("7.png") < min(found.values()) - 6.0
