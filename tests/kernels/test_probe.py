"""The probe reads a grid as the oracle does, and applies its transpose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests import reference
from tests.support.expected import assert_close
from tests.support.problems import N_SEEDS
from tests.support.small_model import SMALL
from warpnerf.model.interface import Model
from warpnerf.model.models import Rgb
from warpnerf.runtime.parallel import Workers
from warpnerf.verification.gradient_check import ProblemKernels
from warpnerf.verification.problems import make_problem, of_model


@pytest.mark.parametrize("model", [Rgb(), SMALL], ids=lambda model: model.name)
def test_gather_and_its_transpose_against_the_oracle(model: Model, device: str) -> None:
    kernels = ProblemKernels("float64", Workers(device, 2))
    for seed in range(N_SEEDS):
        rng = np.random.default_rng(seed)
        size = rng.integers(2, 7, size=3)
        values = rng.normal(size=(*size, model.n_floats))
        out = rng.normal(size=(40, model.n_floats))
        points = rng.uniform(-1.0, 1.0, size=(40, 3))  # of the box
        points[0], points[1] = -1.0, 1.0
        grid = torch.tensor(values, requires_grad=True)
        u = torch.tensor(0.5 * (points + 1.0) * (size - 1))
        expected = reference.trilinear(grid, u)
        assert_close(kernels.gather(values, points), expected.detach(), 1e-14)
        (gradient,) = torch.autograd.grad(expected, grid, torch.tensor(out))
        problem = replace(of_model(make_problem(0), model), raw=values)
        assert_close(kernels.scatter(problem, points, out), gradient, 1e-14)
