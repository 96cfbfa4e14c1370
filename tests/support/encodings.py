"""Encodings in float64: random contents, points, and what flows back to them."""

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import torch
import warp as wp

from tests.support.expected import assert_close
from warpnerf.model.interface import loader
from warpnerf.runtime.parallel import Workers

Arrays = dict[str, np.ndarray]


class EncodingProblem(ABC):
    """An encoding with entries and a decoder, read at points inside and on the corners."""

    entries: str
    """The array of entries, which has flags of tiles."""

    def __init__(
        self, part: Any, arrays: Arrays, n_floats: int, n_decoded: int, border: float
    ) -> None:
        """For an encoding, and what is stored in it by name."""
        rng, reach = np.random.default_rng(n_floats + n_decoded), 1.0 + border
        corners = np.stack(np.meshgrid(*[[-reach, reach]] * 3), axis=-1).reshape(-1, 3)
        self.points = np.concatenate([rng.uniform(-reach, reach, (40, 3)), corners])
        self.adj_raw = rng.normal(size=(len(self.points), n_floats))
        self.adj_raw[:, n_decoded:] = 0.0
        self.part, self.arrays, self.n_decoded, self.border = part, arrays, n_decoded, border
        self.probe = loader("float64")("launch.probe").probe(part)
        self.workers = Workers("cpu", 1)

    @abstractmethod
    def params(self, arrays: Arrays) -> Any:
        """The encoding's ``Params``."""

    @abstractmethod
    def oracle(self, given: dict[str, torch.Tensor]) -> torch.Tensor:
        """Raw values at the points, [n_points, n], by torch."""

    def _points(self) -> wp.array:
        return wp.array(self.points, dtype=wp.types.vector(3, wp.float64))

    def read(self, arrays: Arrays) -> np.ndarray:
        n, dtype = len(self.points), wp.types.vector(self.adj_raw.shape[1], wp.float64)
        out = wp.zeros(n, dtype=dtype)
        self.workers.launch(self.probe.read_forward, n, self.params(arrays), self._points(), out)
        return out.numpy()

    def adjoint(self) -> Arrays:
        """The gradient of the products with adj_raw; ``touched`` are the flags that it set."""
        n, dtype = len(self.points), wp.types.vector(self.adj_raw.shape[1], wp.float64)
        gradient = self.part.Gradient()
        gradient.weights = wp.zeros((1, 0), dtype=wp.float64)
        for name, array in self.arrays.items():
            if name == self.entries:
                zeros = wp.zeros(len(array), dtype=wp.types.vector(array.shape[1], wp.float64))
                gradient.touched = wp.zeros(-(-len(array) // 4), dtype=wp.uint8)
            else:
                zeros = wp.zeros((1, array.size), dtype=wp.float64)
            setattr(gradient, name, zeros)
        adj, params = wp.array(self.adj_raw, dtype=dtype), self.params(self.arrays)
        self.workers.launch(self.probe.read_backward, n, params, self._points(), adj, gradient)
        self.touched = gradient.touched.numpy()
        return {
            name: getattr(gradient, name).numpy().reshape(array.shape)
            for name, array in self.arrays.items()
        }

    def expected(self) -> tuple[np.ndarray, Arrays]:
        """Of the oracle: values at the points, and the gradient."""
        given = {name: torch.tensor(x, requires_grad=True) for name, x in self.arrays.items()}
        raw = self.oracle(given)[:, : self.n_decoded]
        (raw * torch.tensor(self.adj_raw[:, : self.n_decoded])).sum().backward()
        return raw.detach().numpy(), {name: x.grad.numpy() for name, x in given.items()}

    def require_oracle(self) -> None:
        raw, gradient = self.expected()
        found = self.read(self.arrays)
        assert_close(found[:, : self.n_decoded], raw, 1e-12)
        assert (found[:, self.n_decoded :] == 0.0).all()
        for name, array in self.adjoint().items():
            assert_close(array, gradient[name], 1e-12)

    def require_differences(self) -> None:
        """Central ones, in a random direction of each array."""
        rng = np.random.default_rng(5)
        for name, found in self.adjoint().items():
            direction = rng.normal(size=found.shape)
            ends = (
                self.read(self.arrays | {name: self.arrays[name] + h * direction})
                for h in (1e-5, -1e-5)
            )
            up, down = ((raw * self.adj_raw).sum() for raw in ends)
            assert_close([np.vdot(found, direction)], [(up - down) / 2e-5], 1e-7)

    def require_flags_of_pairs(self, most: int) -> None:
        """For one point: a tile is flagged if a pair of entries with gradient begins in it."""
        self.points, self.adj_raw = self.points[:1], self.adj_raw[:1]
        found = np.abs(self.adjoint()[self.entries]).max(axis=1) > 0.0
        pairs = np.flatnonzero(found[:-1] & found[1:])
        expected = np.zeros(len(self.touched), np.uint8)
        expected[pairs // 4] = 1
        assert (self.touched == expected).all() and 0 < expected.sum() <= most
