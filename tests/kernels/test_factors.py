"""Factors in float64: what is read, and its transpose, compared with the oracle and differences."""

from typing import Any

import numpy as np
import pytest
import torch
import warp as wp

from tests.reference.factors import PLANES, raw_values
from tests.support.encodings import EncodingProblem
from warpnerf.model.interface import loader

SIZE = (4, 6, 5)
KINDS = [(16, 16, 16), (16, 4, 4), (32, 32, 28)]
"""Numbers of an entry, of a sample, and how many of these are decoded."""


class Numbers(EncodingProblem):
    """Random factors."""

    entries = "planes"

    def __init__(self, width: int, n_floats: int, n_decoded: int, border: float = 0.0) -> None:
        rng, (x, y, z) = np.random.default_rng(width + n_decoded), SIZE
        arrays = {
            "planes": rng.normal(size=(x * y + x * z + y * z, width)),
            "lines": rng.normal(size=(x + y + z, width)),
            "decoder": rng.normal(size=(3 * width, max(16, n_floats))),
        }
        part = loader("float64")("fields.factors").factors(width, n_floats, n_decoded)
        self.width = width
        super().__init__(part, arrays, n_floats, n_decoded, border)

    def params(self, arrays: dict[str, np.ndarray]) -> Any:
        vec3, middle = loader("float64")("base.types").vec3, 0.5 * (np.array(SIZE) - 1)
        params = self.part.Params()
        params.planes = wp.array(arrays["planes"], dtype=wp.types.vector(self.width, wp.float64))
        params.lines = wp.array(arrays["lines"].ravel(), dtype=wp.float64)
        params.decoder = wp.array(arrays["decoder"].ravel(), dtype=wp.float64)
        params.size, params.middle = wp.vec3i(*SIZE), vec3(*middle)
        params.to_nodes = vec3(*(middle / (1.0 + self.border)))
        params.width, params.n_decoded = self.width, self.n_decoded
        return params

    def oracle(self, given: dict[str, torch.Tensor]) -> torch.Tensor:
        sizes = [SIZE[a] * SIZE[b] for a, b in PLANES]
        planes = [
            part.reshape(SIZE[a], SIZE[b], self.width)
            for (a, b), part in zip(PLANES, given["planes"].split(sizes), strict=True)
        ]
        lines = list(given["lines"].split([SIZE[2], SIZE[1], SIZE[0]]))
        middle = 0.5 * (torch.tensor(SIZE, dtype=torch.float64) - 1)
        u = torch.tensor(self.points) / (1.0 + self.border) * middle + middle
        return raw_values(planes, lines, given["decoder"], u)


@pytest.mark.parametrize("border", [0.0, 0.3])
@pytest.mark.parametrize("kind", KINDS)
def test_against_the_oracle(kind: tuple[int, int, int], border: float) -> None:
    Numbers(*kind, border=border).require_oracle()


@pytest.mark.parametrize("kind", KINDS)
def test_against_central_differences(kind: tuple[int, int, int]) -> None:
    Numbers(*kind).require_differences()


def test_flags_are_those_of_pairs() -> None:
    Numbers(16, 16, 16).require_flags_of_pairs(most=6)
