"""Random tensors and a tiny problem for the tests of the oracle."""

from typing import Any

import torch
from torch import Tensor


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def normal(*shape: int, seed: int) -> Tensor:
    return torch.randn(*shape, generator=generator(seed), dtype=torch.float64)


def uniform(*shape: int, seed: int) -> Tensor:
    return torch.rand(*shape, generator=generator(seed), dtype=torch.float64)


def tiny_problem(n_rays: int = 6) -> dict[str, Any]:
    """Rays from around a box that is a little off-centre and not a cube."""
    origins = 2.0 * torch.nn.functional.normalize(normal(n_rays, 3, seed=1), dim=-1)
    targets = 0.4 * normal(n_rays, 3, seed=2)
    return {
        "origins": origins,
        "directions": torch.nn.functional.normalize(targets - origins, dim=-1),
        "box_min": (-1.0, -0.8, -1.1),
        "box_max": (1.2, 0.9, 1.0),
        "near": 0.1,
        "far": 4.0,
        "step": 0.23,
        "n_steps": 20,
    }


def tiny_raw(seed: int = 3) -> Tensor:
    return normal(4, 5, 3, 4, seed=seed)
