"""Rays of cameras, and batches of rays through pixels of photographs, in a random order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from types import ModuleType
from typing import Any

import numpy as np
import warp as wp
from warpnerf_kernels.base.types import mat33, real, vec2, vec3
from warpnerf_kernels.launch import assembly
from warpnerf_kernels.sampling import coverage
from warpnerf_kernels.space import camera as kernels

from warpnerf.checks import InputError
from warpnerf.fields.lattice import Lattice
from warpnerf.fields.occupancy import FreeCells
from warpnerf.runtime.parallel import RAYS, LaunchCache, Workers
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.fisheye import largest_angle
from warpnerf.scenes.images.pixel_file import expect_random_reads
from warpnerf.scenes.scene import View

MOST_BLOCKS = 2**20
"""Blocks of pixels in all photographs together: testing all of them takes under a second."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RayBatch:
    """Rays on a device, and what they should see."""

    origins: wp.array
    """[n_rays] vec3, scene units."""
    directions: wp.array
    """[n_rays] vec3 of unit length."""
    offsets: wp.array
    """[n_rays] or [1]: where in its step a sample sits, [0, 1)."""
    background: wp.array
    """[n_rays] or [1] vec3, rgb in [0, 1]."""
    content_distance: wp.array
    """[n_rays] or [1], scene units."""
    target_rgb: wp.array
    """[n_rays] vec3, pixels over their background in [0, 1]; beyond that where exposures are taken
    out of them."""
    views: wp.array | None = None
    """[n_rays] int32, whose pixel that is, -1 where it is not opaque, or the mean of some that are
    cut off; None: not drawn from any."""

    @property
    def count(self) -> int:
        """n_rays."""
        return self.origins.shape[0]

    @cached_property
    def struct(self) -> assembly.Rays:
        """The rays as kernels take them."""
        return rays_struct(
            assembly,
            self.origins,
            self.directions,
            self.offsets,
            self.background,
            self.content_distance,
        )


def rays_struct(
    assembly: ModuleType,
    origins: wp.array,
    directions: wp.array,
    offsets: wp.array,
    background: wp.array,
    content_distance: wp.array | None = None,
) -> Any:
    """Rays as kernels take them, in the precision of the given ``launch.assembly``."""
    rays = assembly.Rays()
    rays.origins, rays.directions, rays.offsets = origins, directions, offsets
    rays.background = background
    if content_distance is not None:
        rays.content_distance = content_distance
    return rays


def view_struct(camera: Camera) -> kernels.CameraParams:
    """A camera as kernels take it, without a photograph."""
    view = kernels.CameraParams()
    view.rotation = mat33(*camera.c2w[:, :3].ravel())
    view.position = vec3(*camera.c2w[:, 3])
    view.focal = vec2(camera.fx, camera.fy)
    view.principal = vec2(camera.cx, camera.cy)
    view.radial = vec3(camera.k1, camera.k2, camera.k3)
    view.tangential = vec2(camera.p1, camera.p2)
    if camera.fisheye:
        view.fisheye = 1
        view.k4 = camera.k4
        view.angle_max = largest_angle(camera.radial)
    elif camera.rational:
        view.rational = 1
        view.divisor = vec3(camera.k4, camera.k5, camera.k6)
    view.width, view.height = camera.width, camera.height
    return view


def camera_rays(camera: Camera, workers: Workers) -> tuple[wp.array, wp.array]:
    """The rays through all pixel centres, row by row.

    Returns:
        origins [H * W] vec3 in scene units, and directions [H * W] vec3 of unit length.

    Raises:
        InputError: They are more than kernels count.
    """
    n = camera.width * camera.height
    if n >= 2**31:
        raise InputError(
            f"a picture must have fewer than 2^31 pixels, not {camera.width} x {camera.height}; "
            "render it in parts, or smaller."
        )
    origins = wp.empty(n, dtype=vec3, device=workers.device)
    directions = wp.empty(n, dtype=vec3, device=workers.device)
    workers.launch(kernels.camera_rays, n, view_struct(camera), origins, directions)
    return origins, directions


class PixelSampler:
    """Photographs, from which batches of pixels are drawn, in a random order."""

    def __init__(
        self,
        views: Sequence[View],
        content_distances: np.ndarray,
        background: tuple[float, float, float] | None,
        n_rays: int,
        jitter: bool,
        seed: int,
        workers: Workers,
    ) -> None:
        """Take the photographs, which must stay as they are; on CUDA copies of them.

        Args:
            views: What to draw from.
            content_distances: Of the rays of each view, [n_views] scene units.
            background: rgb in [0, 1]; None: a random colour for each ray.
            n_rays: Rays in the batch of one step.
            jitter: Whether samples are shifted by a random part of a step.
            seed: Of all that is random here.
            workers: Where to work.
        """
        self._workers = workers
        self._n_rays = n_rays
        self._draw = kernels.Draw()
        self._draw.seed = int(np.random.SeedSequence(seed).generate_state(1)[0] >> 1)
        if background is None:
            self._draw.background_mode = kernels.RANDOM_BACKGROUND
        else:
            self._draw.background = vec3(*background)
        self._draw.jitter = int(jitter)
        # Views of the kernel only point to these.
        self._photographs: list[wp.array] = []
        self._kept: list[np.ndarray] = []
        self._runs: list[wp.array] = []
        self._n_pixels = 0
        self._cameras = [view.camera for view in views]
        self._masks = [view.mask for view in views]
        self._structs = [self._add(view) for view in views]
        self._source = source = kernels.PixelSource()
        source.views = wp.array(self._structs, dtype=kernels.CameraParams, device=workers.device)
        source.n_pixels = self._n_pixels
        source.average = 1.0
        source.content_distances = wp.array(content_distances, dtype=real, device=workers.device)
        self._draw_anywhere()
        self._launches = LaunchCache()
        self._room = _Room(n_rays, workers)
        self._batch = self._room.rays

    def _add(self, view: View) -> kernels.CameraParams:
        """A photograph as the kernel takes it: on the CPU where it lies, on CUDA a copy there."""
        image = np.ascontiguousarray(view.image)
        expect_random_reads(image)
        if self._workers.device.is_cuda:
            pixels = wp.array(image.ravel(), dtype=wp.uint8, device=self._workers.device)
        else:
            pixels = wp.array(ptr=image.ctypes.data, shape=image.size, dtype=wp.uint8, device="cpu")
            self._kept.append(image)
        self._photographs.append(pixels)
        struct = view_struct(view.camera)
        struct.first_pixel = self._n_pixels
        struct.channels = image.shape[2]
        struct.pixels = pixels
        mask = view.mask
        if mask is None or mask.all():
            self._n_pixels += view.camera.width * view.camera.height
        else:
            struct.runs = wp.array(runs_of(mask), dtype=wp.vec2i, device=self._workers.device)
            self._runs.append(struct.runs)
            self._n_pixels += int(np.count_nonzero(mask))
        return struct

    def take_out_exposures(self, gains: wp.array, offsets: wp.array) -> None:
        """From now on draw (pixel - offset) / gain in place of the photographs' pixels.

        Args:
            gains: [n_views] vec3 above 0, read at each draw.
            offsets: [n_views] vec3, likewise.
        """
        self._source.gains, self._source.offsets = gains, offsets

    def average_over(self, edge: float) -> None:
        """From now on draw in place of a pixel the mean over a square around its middle.

        Photographs that have masks are taken as they are.

        Args:
            edge: Of the square, pixels; 1: the pixel itself.
        """
        self._source.average = edge

    def cull_background(self, lattice: Lattice, free: FreeCells) -> float:
        """From now on draw no pixels whose rays, and those of all around them, meet nothing.

        Such rays see the background, whatever is trained. Pixels are told apart in square blocks.
        Batches are what is left of those of all pixels.

        Args:
            lattice: Without contraction.
            free: Of this lattice.

        Returns:
            The share of the pixels that are drawn from, (0, 1]: all where none shows anything.
        """
        self._draw_anywhere()
        edge = _block_edge(self._cameras, lattice, free)
        counts = [_n_blocks(camera, edge) for camera in self._cameras]
        first = np.cumsum([0, *counts])
        covered = wp.empty(int(first[-1]), dtype=wp.uint8, device=self._workers.device)
        for struct, before, count in zip(self._structs, first, counts, strict=False):
            self._workers.launch(
                coverage.cover_blocks,
                count,
                *(struct, lattice.box, free.struct, edge, int(before), covered),
                at_once=RAYS,
            )
        n_pixels = np.concatenate(
            [
                _pixels_of_blocks(*size, edge)
                for size in zip(self._cameras, self._masks, strict=True)
            ]
        )
        share = float(n_pixels[covered.numpy() != 0].sum()) / self._n_pixels
        if 0.0 < share < 1.0:
            self._source.block, self._source.covered = edge, covered
            device = self._workers.device
            self._source.first_blocks = wp.array(first[:-1], dtype=wp.int32, device=device)
        return share or 1.0

    def _draw_anywhere(self) -> None:
        """No blocks are left out."""
        self._source.block = 1
        self._source.first_blocks = wp.empty(0, dtype=wp.int32, device=self._workers.device)
        self._source.covered = wp.empty(0, dtype=wp.uint8, device=self._workers.device)

    def count(self, n_steps: int = 1) -> int:
        """Rays of the batches of some steps, those that are left out included."""
        return n_steps * self._n_rays

    def draw(self, step: int, n_steps: int = 1, share: tuple[int, int] = (0, 1)) -> RayBatch:
        """The batches of some steps as one, or a share of it.

        No pixel is drawn again before all have been: one after the other in a random order, each
        time in another one. What is drawn is a function of the steps, the seed, and of what
        ``cull_background`` and ``average_over`` were given. A batch of several steps is made of
        those of each.

        Args:
            step: The first.
            n_steps: How many.
            share: (k, n): of n parts that make the batch, part k.

        Returns:
            ``count`` rays or their share, less those that are left out, but one at least; in the
            same memory from one call to the next as long as there is room.
        """
        part, parts = share
        n_rays = max(parts, self.count(n_steps))
        begin, end = (n_rays * k // parts for k in (part, part + 1))
        if self._room.rays.count < end - begin:
            self._room = _Room(end - begin, self._workers)
            self._batch = self._room.rays
        picked = self._room.picked_views, self._room.picked_pixels
        self._draw.rays_before = step * self._n_rays + begin
        self._workers.launch(
            kernels.pick_pixels,
            end - begin,
            *(self._source, self._draw, *picked),
            cache=self._launches,
        )
        picks, count = self._left(end - begin)
        if self._batch.count != count:
            self._batch = _first_rays(self._room.rays, count)
        batch = self._batch
        self._workers.launch(
            kernels.sample_pixels,
            batch.count,
            *(self._source, *picked, picks, self._draw),
            *(batch.struct, batch.target_rgb, batch.views),
            cache=self._launches,
        )
        return batch

    def _left(self, n_picked: int) -> tuple[wp.array, int]:
        """Which of the picked pixels rays are drawn through, and how many: one at least."""
        room = self._room
        if self._source.covered.shape[0] == 0:
            return room.all, n_picked
        covered = np.flatnonzero(room.picked_views.numpy()[:n_picked] >= 0).astype(np.int32)
        if covered.size == 0:
            covered = np.zeros(1, np.int32)
        wp.copy(room.covered, wp.array(covered, device="cpu"), count=covered.size)
        return room.covered, int(covered.size)


class _Room:
    """Arrays for a batch: the pixels that are picked, and rays through those that are left."""

    def __init__(self, n_rays: int, workers: Workers) -> None:
        """For so many."""
        device = workers.device
        self.rays = _batch(n_rays, workers)
        self.picked_views = wp.zeros(n_rays, dtype=wp.int32, device=device)
        self.picked_pixels = wp.zeros(n_rays, dtype=wp.int32, device=device)
        self.all = wp.array(np.arange(n_rays), dtype=wp.int32, device=device)
        self.covered = wp.zeros(n_rays, dtype=wp.int32, device=device)


def _n_blocks(camera: Camera, edge: int) -> int:
    """Blocks of a photograph, those cut off by its edges included."""
    return -(-camera.width // edge) * -(-camera.height // edge)


def _pixels_of_blocks(camera: Camera, mask: np.ndarray | None, edge: int) -> np.ndarray:
    """How many pixels of each block count, [n_blocks], block by block, row by row."""
    rows, columns = (np.arange(0, n, edge) for n in (camera.height, camera.width))
    if mask is None:
        heights, widths = (
            np.minimum(edge, camera.height - rows),
            np.minimum(edge, camera.width - columns),
        )
        return np.outer(heights, widths).ravel()
    of_rows = np.add.reduceat(mask.astype(np.int64), rows, axis=0)
    return np.add.reduceat(of_rows, columns, axis=1).ravel()


def _block_edge(cameras: Sequence[Camera], lattice: Lattice, free: FreeCells) -> int:
    """Pixels along the edge of a block: a power of two from 4, which stays within MOST_BLOCKS.

    At most as wide as a cell in the middle of the box: cones are compared with whole cells, so
    smaller blocks would hardly leave out more.
    """
    cell = float(((lattice.box_max - lattice.box_min) / np.array(free.size)).min())
    centre = 0.5 * (lattice.box_min + lattice.box_max)
    away = [float(np.linalg.norm(camera.position - centre)) for camera in cameras]
    pixels = [cell * c.fx / max(d, cell) for c, d in zip(cameras, away, strict=True)]
    edge = 4
    while edge <= 0.5 * np.median(pixels):
        edge *= 2
    while sum(_n_blocks(camera, edge) for camera in cameras) > MOST_BLOCKS:
        edge *= 2
    return edge


def runs_of(mask: np.ndarray) -> np.ndarray:
    """Where the pixels that count lie, as ``View.runs`` of the kernels.

    Args:
        mask: [H, W] bool, true where a pixel counts.

    Returns:
        [n_runs, 2] int32: for each run of such pixels, row by row, how many come before it, and
        its first pixel.
    """
    flat = mask.ravel()
    edges = np.flatnonzero(np.diff(flat, prepend=False, append=False))
    begins, ends = edges[::2], edges[1::2]
    before = np.concatenate([[0], np.cumsum(ends - begins)[:-1]])
    return np.stack([before, begins], axis=1).astype(np.int32)


def _first_rays(batch: RayBatch, count: int) -> RayBatch:
    """So many rays of a batch, in the same memory."""
    arrays = {field.name: getattr(batch, field.name)[:count] for field in fields(batch)}
    return RayBatch(**arrays)


def _batch(n_rays: int, workers: Workers) -> RayBatch:
    """Arrays for that many rays, not filled yet."""

    def empty(dtype: type) -> wp.array:
        return wp.empty(n_rays, dtype=dtype, device=workers.device)

    return RayBatch(
        origins=empty(vec3),
        directions=empty(vec3),
        offsets=empty(real),
        background=empty(vec3),
        content_distance=empty(real),
        target_rgb=empty(vec3),
        views=empty(wp.int32),
    )
