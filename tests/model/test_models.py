"""What models begin with, and how fast they learn."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.support.model_problems import layers_of, sizes_of
from warpnerf.model.interface import Model
from warpnerf.model.models import Deferred, PerSample, Rgb, SphericalHarmonics
from warpnerf.optim_config import OptimConfig

OPTIM = OptimConfig(learning_rate_density=0.7, learning_rate_rgb=0.3, tv_density=2e-9, tv_rgb=5e-10)
MLP = {"learning_rate_features": 0.11, "learning_rate_mlp": 0.013}


@pytest.mark.parametrize(
    ("model", "rates"),
    [
        (Rgb(), [0.7, 0.3, 0.3, 0.3]),
        # The constant harmonic is 1 / (2 sqrt(pi)): a coefficient moves colour by that.
        (
            SphericalHarmonics(degree=1, learning_rate_sh=0.05),
            [0.7, *3 * [0.3 * 2.0 * math.sqrt(math.pi)], *9 * [0.05]],
        ),
        (Deferred(specular=4, **MLP), [0.7, *3 * [0.3], *4 * [0.11]]),
        (PerSample(features=5, **MLP), [0.7, *3 * [0.3], *2 * [0.11]]),
        (PerSample(features=5, residual=False, **MLP), [0.7, *5 * [0.11]]),
    ],
)
def test_each_number_of_a_node_learns_at_its_rate(model: Model, rates: list[float]) -> None:
    padding = [0.0] * (model.n_floats - len(rates))
    np.testing.assert_allclose(model.learning_rates(OPTIM), rates + padding, rtol=1e-6)
    variation = [2e-9, *model.n_features * [5e-10]]
    np.testing.assert_array_equal(model.variation(OPTIM), variation + padding)
    assert model.learning_rate_mlp == (0.013 if sizes_of(model) else 0.0)


@pytest.mark.parametrize(
    ("model", "of_output"),
    [
        (Deferred(), 0.1),  # so that diffuse colour is learned first
        (PerSample(), 0.1),
        (PerSample(residual=False), 1.0),
    ],
)
def test_first_weights_are_uniform_and_those_of_the_output_small(
    model: Model, of_output: float
) -> None:
    layers = layers_of(model, model.first_weights(3))
    for number, (weights, bias) in enumerate(zip(layers[::2], layers[1::2], strict=True)):
        last = 2 * number + 2 == len(layers)
        limit = (of_output if last else 1.0) / math.sqrt(len(weights))
        scaled = weights / limit
        assert 0.9 < np.abs(scaled).max() <= 1.0 and abs(scaled.mean()) < 0.15
        assert scaled.std() == pytest.approx(1.0 / math.sqrt(3.0), rel=0.15)
        assert not bias.any() if last else 0.5 < np.abs(bias / limit).max() <= 1.0
    np.testing.assert_array_equal(model.first_weights(3), model.first_weights(3))
    assert not np.array_equal(model.first_weights(3), model.first_weights(4))
    assert not Rgb().first_weights(0).size
