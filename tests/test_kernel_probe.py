"""The probe reads a grid as the oracle does, and hands back its transpose."""

from __future__ import annotations

import numpy as np
import reference
import torch
from drive import N_SEEDS, assert_close

from warpnerf.parallel import Workers
from warpnerf.trial import TrialKernels


def test_gather_and_its_transpose_against_the_oracle(device: str) -> None:
    kernels = TrialKernels("float64", Workers(device, 2))
    for seed in range(N_SEEDS):
        rng = np.random.default_rng(seed)
        size = tuple(int(n) for n in rng.integers(2, 7, size=3))
        values, out = rng.normal(size=(*size, 4)), rng.normal(size=(40, 4))
        points = rng.uniform(size=(40, 3)) * (np.array(size) - 1)
        points[0], points[1] = 0.0, np.array(size) - 1
        grid = torch.tensor(values, requires_grad=True)
        expected = reference.trilinear(grid, torch.tensor(points))
        assert_close(kernels.gather(values, points), expected.detach(), 1e-14)
        (gradient,) = torch.autograd.grad(expected, grid, torch.tensor(out))
        assert_close(kernels.scatter(size, points, out), gradient, 1e-14)
