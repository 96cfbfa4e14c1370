"""Decay of raw densities near cameras: a weight decay, as far as the distance scaling would scale.

Scaled gradients keep floaters from growing where rays come from near, but Adam divides by their
root mean square, and nothing removes what has grown. So each update that moves a raw density lowers
it besides, the further the nearer the cameras are that see its node.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import warp as wp
from warpnerf_kernels.base.tiles import TILE
from warpnerf_kernels.base.types import mat33, vec2, vec3
from warpnerf_kernels.optim import near_decay as kernels

from warpnerf.fields.lattice import Lattice
from warpnerf.fields.nodes import middles_of_runs, voxel_edges
from warpnerf.fields.total_variation import FARTHEST, evenly_spread
from warpnerf.runtime.parallel import NODES, Workers
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.undistort import directions

AT_ONCE = 1 << 16
"""Tiles whose places are in memory together."""
N_EDGE = 9
"""Positions along each side of a picture that tell how far it reaches where a lens bends it."""


def near_decay(
    lattice: Lattice,
    cameras: Sequence[Camera],
    distances: Sequence[float],
    near: float,
    strength: float,
    workers: Workers,
) -> wp.array:
    """How far an update lowers the raw density of nodes besides, by the middle node of each tile.

    strength (1 - S) with S, as ``warpnerf_kernels.optim.near_decay`` has it, the mean scale of the
    rays that come by: a camera sends the more, the larger a node is in its picture. Frusta are
    grown by a voxel, as samples in them reach nodes that far outside. What stands between camera
    and node is not looked at.

    Args:
        lattice: Whose nodes.
        cameras: The training cameras.
        distances: Content distance of each, scene units.
        near: Distance before which rays have no samples, scene units.
        strength: ``OptimConfig.near_decay``.
        workers: Where to work, and where the result shall live.

    Returns:
        [ceil(n_nodes / TILE)] in learning rates; 0 where no camera looks, and infinitely far away.
    """
    cameras, distances = evenly_spread(cameras, distances)
    middle = np.mean([camera.position for camera in cameras], axis=0)
    far = FARTHEST * max(distances)
    observers = wp.array(
        [_observer(c, d, middle) for c, d in zip(cameras, distances, strict=True)],
        dtype=kernels.Observer,
        device=workers.device,
    )
    n_tiles = -(-math.prod(lattice.size) // TILE)
    decay = wp.empty(n_tiles, dtype=wp.float32, device=workers.device)
    for begin in range(0, n_tiles, AT_ONCE):
        end = min(begin + AT_ONCE, n_tiles)
        points = middles_of_runs(lattice, TILE, np.arange(begin, end))
        with np.errstate(invalid="ignore"):
            margins = np.nan_to_num(voxel_edges(lattice, points), nan=far)
        places = np.clip(np.nan_to_num(points - middle, nan=far), -far, far)
        workers.launch(
            kernels.find_near_decay,
            end - begin,
            wp.array(places.astype(np.float32), dtype=vec3, device=workers.device),
            wp.array(np.minimum(margins, far), dtype=wp.float32, device=workers.device),
            observers,
            near,
            strength,
            decay[begin:end],
            at_once=max(1, NODES // len(cameras)),
        )
    return decay


def _observer(camera: Camera, content_distance: float, middle: np.ndarray) -> kernels.Observer:
    """A camera as kernels take it; its frustum is the pyramid around all that its picture shows."""
    observer = kernels.Observer()
    observer.position = vec3(*(camera.position - middle))
    right, up, back = camera.c2w[:, :3].T
    observer.axes = mat33(*right, *-up, *-back)
    u, v = np.linspace(0.0, camera.width, N_EDGE), np.linspace(0.0, camera.height, N_EDGE)
    pixels = np.stack(np.meshgrid(u, v), axis=2).reshape(-1, 2)
    shown = directions(camera, pixels) * [1.0, -1.0, -1.0]
    observer.fisheye, observer.cosine = int(camera.fisheye), float(shown[:, 2].min())
    if not camera.fisheye:
        on_plane = shown[:, :2] / shown[:, 2:]
        observer.low, observer.high = vec2(*on_plane.min(axis=0)), vec2(*on_plane.max(axis=0))
    observer.pixels = camera.fx * camera.fy
    observer.content_distance = content_distance
    return observer
