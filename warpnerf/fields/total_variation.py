"""Total variation regularisation of a dense grid: it must not win where gradients are scaled down.

The distance scaling makes the photometric gradient of what is near to cameras smaller, and with it
the root of the second moment, by which Adam divides. Total variation of one weight for all nodes
would so smooth the more, the nearer a node lies. It is multiplied by what that root is: the root of
the mean square of the scales of a node's rays, of which each camera sends 1 / distance^2.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp
from warpnerf_kernels.base import tiles
from warpnerf_kernels.base.types import vector
from warpnerf_kernels.optim import total_variation
from warpnerf_kernels.optim.total_variation import TV_BLOCK

from warpnerf.config import Scaling
from warpnerf.fields.gradients import Gradients
from warpnerf.fields.lattice import Lattice
from warpnerf.fields.nodes import middles_of_runs
from warpnerf.runtime.parallel import NODES, Workers
from warpnerf.scenes.cameras.camera import Camera

AT_ONCE = 1 << 10
"""Runs of nodes that are looked at together."""
MAX_CAMERAS = 200
"""That are looked at; of more, so many evenly spread ones."""
CLOSEST, FARTHEST = 1e-3, 1e3
"""Content distances: places nearer or farther than these count as being there."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TotalVariation:
    """Total variation regularisation, at the nodes that have a gradient already.

    What is added to the gradients of several steps grows with the root of their number: as their
    noise does at nodes that every step touches, by which Adam divides both.
    """

    values: wp.array
    """[n_nodes] vectors of the grid."""
    size: tuple[int, int, int]
    """Its X, Y, Z."""
    weights: np.ndarray
    """Of each number of a node."""
    strength: wp.array
    """Of nodes in a row, from ``strengths``."""
    n_asked: int
    """Nodes of the grid that the weights are meant for: the final one, or about so."""
    every: int
    """How many updates this one gradient stands for: it is added to the first of so many."""
    until: float
    """Share of the training from which it is added no more."""
    workers: Workers
    """Where to work."""

    def __call__(self, gradients: Gradients, update: int, fraction: float, n_steps: int) -> None:
        """Add it, where it is due; see ``storage.Regulariser``."""
        if update % self.every != 0 or fraction >= self.until:
            return
        face = (self.n_asked / math.prod(self.size)) ** (2.0 / 3.0)
        factor = face * self.every * math.sqrt(n_steps)
        n_floats = len(self.weights)
        self.workers.launch(
            total_variation.total_variation_backward_kernel(n_floats),
            *thread_spans(self.values, self.workers),
            self.values,
            wp.vec3i(*self.size),
            vector(n_floats)(*(factor * self.weights)),
            self.strength,
            gradients.entries("values", "touched"),
            at_once=NODES // tiles.NODES_PER_THREAD,
            cache=gradients.launches,
        )


def tv_weights(
    lattice: Lattice,
    cameras: Sequence[Camera],
    distances: Sequence[float],
    near: float,
    scaling: Scaling,
    workers: Workers,
) -> wp.array:
    """Weights of the total variation, one for each block of nodes, by its middle one.

    Args:
        lattice: Whose nodes.
        cameras: The training cameras.
        distances: Content distance of each, scene units.
        near: Distance before which rays have no samples, scene units.
        scaling: Of gradients. A Jacobian that it takes into account is left out here.
        workers: Where the result shall live.

    Returns:
        [ceil(n_nodes / TV_BLOCK)] root of the mean square of the scales of the rays that a block
        gets, of which those above 1 count as 1; 1 where no camera looks.
    """
    n_nodes = math.prod(lattice.size)
    strength = np.ones(-(-n_nodes // TV_BLOCK), np.float32)
    if scaling != "none":
        cameras, distances = evenly_spread(cameras, distances)
        for begin in range(0, len(strength), AT_ONCE):
            runs = np.arange(begin, min(begin + AT_ONCE, len(strength)))
            strength[runs] = root_mean_square_scale(
                middles_of_runs(lattice, TV_BLOCK, runs), cameras, distances, near
            )
    return wp.array(strength, dtype=wp.float32, device=workers.device)


def evenly_spread(
    cameras: Sequence[Camera], distances: Sequence[float]
) -> tuple[list[Camera], list[float]]:
    """MAX_CAMERAS of some cameras, with their content distances; all where there are fewer."""
    some = np.unique(np.linspace(0, len(cameras) - 1, MAX_CAMERAS).astype(int))
    return [cameras[i] for i in some], [distances[i] for i in some]


def root_mean_square_scale(
    points: np.ndarray, cameras: Sequence[Camera], distances: Sequence[float], near: float = 0.0
) -> np.ndarray:
    """The root of the mean square of the scales of the rays that come by.

    Args:
        points: [n, 3] scene units.
        cameras: Whose rays.
        distances: Content distance of each camera, scene units.
        near: Rays begin at this distance, scene units.

    Returns:
        [n] in [0, 1]; 1 where no ray comes by.
    """
    positions = np.array([camera.position for camera in cameras])
    forward = np.array([camera.forward for camera in cameras])
    edge = np.array([_cosine(camera) for camera in cameras], np.float32)
    unit = np.asarray(distances, np.float64)
    far = FARTHEST * unit.max()
    middle = positions.mean(axis=0)
    p = np.clip(np.nan_to_num(points - middle, nan=far), -far, far)
    c = positions - middle
    # Squared distances and depths by products of matrices.
    square = np.sum(p * p, axis=1)[:, None] + np.sum(c * c, axis=1) - 2.0 * (p @ c.T)
    sampled = square >= near * near
    square = np.clip((square / np.square(unit)).astype(np.float32), CLOSEST**2, FARTHEST**2)
    depth = ((p @ forward.T - np.sum(c * forward, axis=1)) / unit).astype(np.float32)
    seen = sampled & (depth > edge * np.sqrt(square))
    rays = seen / (square * np.square(unit).astype(np.float32))
    total = rays.sum(axis=1)
    mean = (rays * np.square(np.minimum(square, 1.0))).sum(axis=1) / np.maximum(total, 1e-30)
    return np.where(total > 0.0, np.sqrt(mean), 1.0)


def _cosine(camera: Camera) -> float:
    """Of the angle from a camera's axis to the corners of its picture; -1: it sees all around."""
    if camera.fisheye:
        return -1.0
    x = max(camera.cx, camera.width - camera.cx) / camera.fx
    y = max(camera.cy, camera.height - camera.cy) / camera.fy
    return 1.0 / math.sqrt(1.0 + x * x + y * y)


def thread_spans(values: wp.array, workers: Workers) -> tuple[int, int]:
    """How many threads work on the nodes, and on how many each."""
    span = 1 if workers.device.is_cuda else tiles.NODES_PER_THREAD
    return -(-values.shape[0] // span), span
