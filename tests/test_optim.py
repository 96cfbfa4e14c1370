"""The host's side of the optimiser."""

import numpy as np
import pytest
import reference
import torch
import warp as wp
from warpnerf_kernels.types import vec4

from warpnerf.adjoint import Gradients
from warpnerf.config import OptimConfig
from warpnerf.grid import VoxelGrid
from warpnerf.optim import adam_step, add_total_variation, no_moments
from warpnerf.parallel import Workers


@pytest.mark.parametrize("coarser", [1, 8])
def test_total_variation_counts_the_face_between_two_nodes(coarser: int, device: str) -> None:
    """Of eight times fewer nodes each pair stands for four times the area."""
    size, workers = (4, 5, 3), Workers(device, 2)
    raw = torch.tensor(np.random.default_rng(0).normal(size=(*size, 4)), requires_grad=True)
    weights = torch.tensor([3e-2, 2e-3, 2e-3, 2e-3], dtype=torch.float64)
    every, n_steps = 5, 4
    reference.total_variation(raw, coarser ** (2 / 3) * every * n_steps**0.5 * weights).backward()
    grid = VoxelGrid(
        values=wp.array(raw.detach().numpy().reshape(-1, 4), dtype=vec4, device=workers.device),
        size=size,
        box_min=np.zeros(3),
        box_max=np.ones(3),
    )
    gradients = Gradients.zeros(size, workers)
    gradients.values.fill_(1.0)
    gradients.touched.fill_(1)
    config = OptimConfig(tv_density=3e-2, tv_rgb=2e-3, tv_every=every)
    add_total_variation(grid, gradients, coarser * 60, n_steps, config, workers)
    added = gradients.values.numpy().reshape(*size, 4) - 1.0
    assert raw.grad is not None
    np.testing.assert_allclose(added, raw.grad.numpy(), atol=1e-6)


def test_updates_pack_their_launches_once(monkeypatch: pytest.MonkeyPatch, on_cpu: None) -> None:
    """And take what they are given: another grid, another rate."""
    size, workers = (10, 10, 10), Workers("cpu", 2)
    config = OptimConfig(tv_density=1e-2, tv_rgb=1e-3)
    rng = np.random.default_rng(0)
    raw = rng.normal(size=(2, 1000, 4)).astype(np.float32)
    updates = [(0, 1, 1.0), (0, 2, 0.5), (1, 1, 3.0)]  # of which grid, number, factor

    def results(in_one: bool) -> list[np.ndarray]:
        grids = [
            VoxelGrid(
                values=wp.array(values, dtype=vec4, device="cpu"),
                size=size,
                box_min=np.zeros(3),
                box_max=np.ones(3),
            )
            for values in raw
        ]
        moments = [no_moments(grid, workers) for grid in grids]
        gradients = Gradients.zeros(size, workers)
        found = []
        for which, number, factor in updates:
            gradients.values.fill_(1.0)
            gradients.touched.fill_(1)
            add_total_variation(grids[which], gradients, 1000, 1, config, workers)
            found.append(gradients.values.numpy().copy())
            adam_step(grids[which], moments[which], gradients, number, factor, config, workers)
            found.append(grids[which].values.numpy().copy())
            if in_one:
                monkeypatch.setattr(wp, "launch", None)  # nothing is packed from now on
            else:
                gradients = Gradients.zeros(size, workers)
        return found

    expected = results(in_one=False)
    assert all(np.abs(tv - 1.0).max() > 1e-3 for tv in expected[::2])
    assert np.abs(expected[0] - expected[4]).max() > 1e-3
    for got, wanted in zip(results(in_one=True), expected, strict=True):
        assert np.array_equal(got, wanted)
