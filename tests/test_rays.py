"""Batches of random pixels: each ray a function of its step and the seed."""

from dataclasses import fields

import numpy as np
import pytest
from test_determinism import small_scene

from warpnerf.rendering.rays import PixelSampler, RayBatch
from warpnerf.runtime.parallel import Workers

N_RAYS = 64


def sampler(device: str, seed: int = 0) -> PixelSampler:
    return PixelSampler(small_scene().views, 2.0, None, N_RAYS, True, seed, Workers(device, 2))


def drawn(batch: RayBatch) -> dict[str, np.ndarray]:
    return {field.name: getattr(batch, field.name).numpy().copy() for field in fields(batch)}


@pytest.mark.parametrize("n_steps", [1, 2, 5])
def test_batches_of_several_steps_are_those_of_each(n_steps: int, device: str) -> None:
    single, several = sampler(device), sampler(device)
    each = [drawn(single.draw(step)) for step in range(3, 3 + n_steps)]
    for _ in range(2):  # the second time into the same arrays
        together = several.draw(3, n_steps)
        assert together.count == n_steps * N_RAYS
        for name, found in drawn(together).items():
            assert np.array_equal(found, np.concatenate([one[name] for one in each]))
    assert np.array_equal(drawn(several.draw(3))["directions"], each[0]["directions"])


def test_steps_and_seeds_draw_what_is_their_own(device: str) -> None:
    batches = [
        drawn(sampler(device, seed).draw(step))["directions"]
        for seed, step in ((0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (2**63 - 1, 0))
    ]
    for number, one in enumerate(batches):
        for other in batches[:number]:
            assert (one != other).any(axis=1).mean() > 0.9
    repeated = drawn(sampler(device).draw(2**32 // N_RAYS + 1))["directions"]
    assert np.array_equal(repeated, batches[1])
