"""The optimiser step against the oracle."""

from typing import Any

import numpy as np
import reference
import torch
from drive import N_SEEDS, Kernels
from warpnerf_kernels.tiles import STRETCH, TILE

RATE = np.array([0.2, 0.1, 0.05, 0.02])
BETA1, BETA2, EPSILON = 0.9, 0.99, 1e-4


def step(
    kernels: Kernels,
    number: int,
    adj: Any,
    values: Any,
    mean: Any,
    square: Any,
    span: int = STRETCH,
    flags: Any = None,
) -> tuple[Any, Any, Any, Any]:
    vec4 = kernels.types.vec4
    gradient = kernels.no_gradient((1, 1, len(adj)), flag=1)
    gradient.values.assign(adj)
    if flags is not None:
        gradient.touched.assign(np.asarray(flags, np.uint8))
    arrays = [kernels.array(a, vec4) for a in (values, mean, square)]
    kernels.workers.launch(
        kernels.module("adam").adam_step,
        -(-len(values) // span),
        span,
        vec4(*RATE),
        BETA1,
        BETA2,
        EPSILON,
        1.0 / (1.0 - BETA1**number),
        1.0 / (1.0 - BETA2**number),
        gradient,
        *arrays,
    )
    values, mean, square = (a.numpy() for a in arrays)
    return gradient.values.numpy(), values, mean, square


def test_against_the_oracle_skipping_exact_zeros(kernels64: Kernels) -> None:
    for seed in range(N_SEEDS):
        rng = np.random.default_rng(seed)
        state = [rng.normal(size=(30, 4)), np.zeros((30, 4)), np.zeros((30, 4))]
        expected = [torch.tensor(s) for s in state]
        for number in range(1, 6):
            adj = rng.normal(size=(30, 4)) * 10.0 ** rng.uniform(-7, 0, size=(30, 4))
            adj[rng.uniform(size=(30, 4)) < 0.3] = 0.0
            adj[:3] = 0.0  # whole nodes as well
            total = torch.tensor(adj)
            before = state
            after, *state = step(kernels64, number, adj, *state)
            assert not after.any()
            expected = list(
                reference.adam(*expected, total, number, torch.tensor(RATE), BETA1, BETA2, EPSILON)
            )
            still = total.numpy() == 0.0
            assert still.any() and not still.all()
            for new, old, exact in zip(state, before, expected, strict=True):
                np.testing.assert_allclose(new, exact, rtol=1e-12, atol=1e-300)
                assert np.array_equal(new[still], old[still])
                assert (new[~still] != old[~still]).all()


def test_tiles_that_are_not_flagged_are_passed_over(kernels64: Kernels) -> None:
    rng = np.random.default_rng(4)
    adj, values = rng.normal(size=(100, 4)), rng.normal(size=(100, 4))
    flags = np.arange(100 // TILE) % 5 == 2
    # The first node of the next tile may have been added to as well.
    flagged = np.repeat(flags | np.roll(flags, 1), TILE)
    counted = np.where(flagged[:, None], adj, 0.0)
    expected = step(kernels64, 1, counted, values, 0 * values, 0 * values)
    for span in (1, TILE, 48):
        found = step(kernels64, 1, adj, values, 0 * values, 0 * values, span, flags)
        for new, exact in zip(found[1:], expected[1:], strict=True):
            assert np.array_equal(new, exact)
        assert not found[0][flagged].any()
        assert np.array_equal(found[0][~flagged], adj[~flagged])
