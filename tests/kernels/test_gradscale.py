"""The distance scaling by itself: every variant against the oracle, and its exact limits."""

from typing import Any

import numpy as np
import pytest
import torch

from tests import reference
from tests.support import probe_kernels
from tests.support.kernel_runner import Kernels
from tests.support.problems import N_SEEDS
from warpnerf.rendering.structs import JACOBIANS, SCALINGS


def scale(kernels: Kernels, t: Any, content: Any, det: Any, scaling: str, jacobian: str) -> Any:
    out = kernels.zeros(len(t))
    kernels.workers.launch(
        probe_kernels.of(kernels).scale_distances,
        len(t),
        kernels.array(t),
        kernels.array(content),
        kernels.array(det),
        SCALINGS[scaling],
        JACOBIANS[jacobian],
        out,
    )
    return out.numpy()


@pytest.mark.parametrize("jacobian", list(JACOBIANS))
@pytest.mark.parametrize("scaling", list(SCALINGS))
def test_against_the_oracle(scaling: str, jacobian: str, kernels64: Kernels) -> None:
    for seed in range(N_SEEDS):
        rng = np.random.default_rng(seed)
        t, content = rng.uniform(0.0, 5.0, 200), rng.uniform(0.5, 4.0, 200)
        det = 10.0 ** rng.uniform(-3.0, 0.0, 200)
        expected = reference.distance_scale(
            torch.tensor(t)[:, None],
            torch.tensor(content),
            scaling,
            torch.tensor(det)[:, None],
            jacobian,
        )
        found = scale(kernels64, t, content, det, scaling, jacobian)
        np.testing.assert_allclose(found, expected[:, 0], rtol=1e-13)
        if scaling == "clamped":
            assert (found == 1.0).any() and (found < 1.0).any()


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_limits_are_exact(precision: str, device: str) -> None:
    kernels = Kernels(precision, device)
    rng = np.random.default_rng(0)
    t = rng.uniform(0.0, 5.0, 2000).astype(np.float32)
    one = np.ones_like(t)
    for scaling in ("quadratic", "clamped"):
        assert (scale(kernels, 0 * t, one, one, scaling, "none") == 0.0).all()
        assert (scale(kernels, t, t, one, scaling, "none") == 1.0).all()
    farther = t * (1.0 + rng.uniform(0.0, 1.0, 2000)).astype(np.float32)
    assert (scale(kernels, farther, t, one, "clamped", "none") == 1.0).all()
    tiny = scale(kernels, t[t > 1e-3], 1e-30 + 0 * t[t > 1e-3], one, "clamped", "none")
    assert (tiny == 1.0).all()
    assert (scale(kernels, t, one, 0.5 * one, "none", "density") == 1.0).all()
    half = scale(kernels, t, 2 * t, one, "clamped", "none")
    assert (half == 0.25).all()
