"""Visibility: what of a field its cameras see, and in which colours.

Space that no photograph shows may hold anything, and a colour that is seen from some sides only is
nowhere else defined. So both are taken from the training cameras' own pixels.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp
from warpnerf_kernels.base.types import real, vec3, vector

from warpnerf.checked import checked_arguments
from warpnerf.checks import InputError
from warpnerf.fields.dense import DenseGrid
from warpnerf.fields.nodes import values_at
from warpnerf.model.models import Rgb
from warpnerf.rendering.field import Field
from warpnerf.rendering.rays import RayBatch, camera_rays
from warpnerf.rendering.render import TrainingPass
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.undistort import seen_pixels
from warpnerf.scenes.scene import View

SEEN = 0.1
"""Pixels whose light comes from a node that counts as seen, at least."""

MAX_RAYS = 3_000_000
"""Looked along in all, about; of more pixels, some stand for those around them."""

GREY = 0.5
SIGMOID_SLOPE = 0.25
"""Of a colour whose raw value is 0: the sigmoid is GREY there, and rises by so much."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Visibility:
    """Visibility of a grid's nodes from cameras."""

    light: np.ndarray
    """[X, Y, Z] float32, pixels: the sum over pixels, and over samples of their rays, of a sample's
    weight times the node's trilinear share of it. What is 0 is in none of the pictures."""
    colour: np.ndarray
    """[X, Y, Z, 3] float32: the same sum of the pixels' colours."""

    def rgb_at(self, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The mean RGB colour of the pixels that see a place.

        Args:
            nodes: [n, 3] node coordinates.

        Returns:
            [n, 3] float32 in [0, 1], and whether it is seen at all, [n].
        """
        light = values_at(self.light, nodes)
        sums = [values_at(self.colour[..., c], nodes) for c in range(3)]
        rgb = np.stack(sums, axis=1) / np.maximum(light, SEEN)[:, None]
        return rgb.clip(0.0, 1.0).astype(np.float32), light > SEEN


@checked_arguments
def visibility(
    field: Field,
    views: Sequence[View | Camera],
    on_camera: Callable[[int], None] | None = None,
) -> Visibility:
    """Compute the visibility of a field's nodes through cameras, where masks leave pixels.

    The sums are transposes of rendering, so the adjoint computes them: of a field with the same
    density that is grey all over, before a grey background. Every ray's colour is 0.5 there, and
    dL/drgb of its squared error against the target 0.5 - v / 2 is v. A node's raw colour then gets
    1/4 of the sum of weight times share times v, with v = 1 or the colour that the field shows, and
    0 in pixels that do not count.

    Args:
        field: What is looked at.
        views: From where, at least one; a camera without a photograph sees in all pixels but those
            around a fisheye's circle.
        on_camera: Called with the number of cameras that are done.

    Returns:
        What they see.

    Raises:
        InputError: There are no views.
    """
    if not views:
        raise InputError("look wants at least one view or camera, such as scene.training_cameras.")
    cameras = [view.camera if isinstance(view, View) else view for view in views]
    workers, lattice, rgb = field.workers, field.lattice, Rgb()
    device = workers.device
    n_pixels = sum(camera.width * camera.height for camera in cameras)
    factor = max(1, math.ceil(math.sqrt(n_pixels / MAX_RAYS)))
    edges = [min(factor, camera.width, camera.height) for camera in cameras]
    looks = [camera.downscaled(edge) for camera, edge in zip(cameras, edges, strict=True)]

    values = np.zeros((math.prod(lattice.size), rgb.n_floats), np.float32)
    values[:, 0] = field.storage.raw_densities(workers).ravel()
    grey = DenseGrid(
        lattice=lattice,
        density_shift=field.storage.density_shift,
        density_scale=field.storage.density_scale,
        values=wp.array(values, dtype=vector(rgb.n_floats), device=device),
    )
    nothing = wp.zeros(0, dtype=wp.float32, device=device)
    most = max(camera.width * camera.height for camera in looks)
    light, colour = (
        TrainingPass(most, rgb, grey, nothing, field.steps, "none", "none", workers)
        for _ in range(2)
    )
    for done, (camera, view, edge) in enumerate(zip(looks, views, edges, strict=True), 1):
        origins, directions = camera_rays(camera, workers)
        shown = field.render(camera).rgb.reshape(-1, 3)
        counts = _share_that_counts(view, camera, edge).reshape(-1, 1)
        for adjoint, passed_down in ((light, np.ones_like(shown)), (colour, shown)):
            batch = RayBatch(
                origins=origins,
                directions=directions,
                offsets=wp.full(1, 0.5, dtype=real, device=device),
                background=wp.full(1, vec3(GREY, GREY, GREY), dtype=vec3, device=device),
                content_distance=wp.full(1, 1.0, dtype=real, device=device),
                target_rgb=wp.array(GREY - 0.5 * counts * passed_down, dtype=vec3, device=device),
            )
            adjoint.run(field.free, batch, n_batches=len(shown))  # a sum, not a mean
        if on_camera is not None:
            on_camera(done)

    def total(adjoint: TrainingPass, channels: slice) -> np.ndarray:
        gradient = adjoint.gradients.values.numpy()[:, channels]
        sums = gradient * np.float32(factor**2 / SIGMOID_SLOPE)
        return sums.reshape(*lattice.size, -1)

    return Visibility(light=total(light, slice(1, 2))[..., 0], colour=total(colour, slice(1, 4)))


def _share_that_counts(view: View | Camera, camera: Camera, edge: int) -> np.ndarray:
    """Of the block of a view's pixels that each of a camera's stands for, [H, W] in [0, 1]."""
    share = np.ones((camera.height, camera.width), np.float32)
    mask = view.mask if isinstance(view, View) else None
    if isinstance(view, View) and mask is not None:
        blocks = mask[: camera.height * edge, : camera.width * edge]
        blocks = blocks.reshape(camera.height, edge, camera.width, edge)
        share = blocks.mean(axis=(1, 3), dtype=np.float32)
    seen = seen_pixels(camera)
    return share if seen is None else share * seen
