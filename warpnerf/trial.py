"""Small rendering problems in plain numbers, put to the kernels in either precision and form."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
import warp as wp
from warpnerf_kernels import precision, tiles

from warpnerf.adjoint import AdjointLaunch, gradient_struct, n_tiles
from warpnerf.config import Contraction, Scaling
from warpnerf.grid import CONTRACTIONS, free_struct, grid_struct
from warpnerf.parallel import Workers
from warpnerf.render import JACOBIANS, KEPT_PACKS, SCALINGS, Steps, scratch

DENSITY_SHIFT = 0.3


@dataclass(frozen=True, kw_only=True, eq=False)
class Trial:
    """Rays through a grid, and a loss: the product of what they see with the slopes below."""

    raw: np.ndarray
    """[X, Y, Z, 4] raw density and raw rgb."""
    origins: np.ndarray
    """[n_rays, 3] scene units; the box is [-1, 1.2] x [-0.8, 0.9] x [-1.1, 1]."""
    directions: np.ndarray
    """[n_rays, 3] unit vectors."""
    background: np.ndarray
    """[n_rays, 3] in [0, 1]."""
    target: np.ndarray
    """[n_rays, 3] in [0, 1], for the training launch, which has its own loss."""
    rgb_slope: np.ndarray
    """[n_rays, 3] dL/drgb."""
    opacity_slope: np.ndarray
    """[n_rays] dL/dopacity."""
    depth_slope: np.ndarray
    """[n_rays] dL/ddepth."""
    steps: Steps
    """How rays are marched."""
    offsets: np.ndarray
    """[n_rays] in [0, 1): where in its step a sample sits."""
    content_distance: np.ndarray
    """[n_rays] scene units."""
    free: np.ndarray = field(default_factory=lambda: np.zeros((1, 1, 1), np.uint8))
    """[MX, MY, MZ] cells to the nearest occupied one."""
    contraction: Contraction = "none"
    """How space outside the box is folded in."""
    border: float = 0.0
    """Width of the shell that holds it, in half edges of the box."""
    density_scale: float = 1.0
    """1 / scene unit."""

    @property
    def n_rays(self) -> int:
        """How many rays there are."""
        return len(self.origins)

    def rounded(self) -> Trial:
        """The same in numbers that float32 holds, so that only arithmetic can differ."""
        exact = {f.name: getattr(self, f.name) for f in fields(self)}
        exact |= {
            name: value.astype(np.float32).astype(np.float64)
            for name, value in exact.items()
            if isinstance(value, np.ndarray) and value.dtype == np.float64
        }
        return Trial(**exact)


BOX_MIN, BOX_MAX = np.array([-1.0, -0.8, -1.1]), np.array([1.2, 0.9, 1.0])


def make_trial(seed: int, n_rays: int = 24, size: tuple[int, int, int] = (7, 8, 6)) -> Trial:
    """Random rays, half of them from inside the box, through a random grid."""
    rng = np.random.default_rng(seed)

    def unit(vectors: np.ndarray) -> np.ndarray:
        return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)

    origins = 2.0 * unit(rng.normal(size=(n_rays, 3)))
    origins[::2] *= 0.2
    return Trial(
        raw=rng.normal(size=(*size, 4)),
        origins=origins,
        directions=unit(0.5 * rng.normal(size=(n_rays, 3)) - origins),
        background=rng.uniform(size=(n_rays, 3)),
        target=rng.uniform(size=(n_rays, 3)),
        rgb_slope=rng.normal(size=(n_rays, 3)),
        opacity_slope=rng.normal(size=n_rays),
        depth_slope=rng.normal(size=n_rays),
        steps=Steps(near=0.07, far=2.9, step=0.11),
        offsets=rng.uniform(size=n_rays),
        content_distance=rng.uniform(0.5, 3.0, size=n_rays),
    )


def stopping_early(trial: Trial) -> Trial:
    """The same through denser matter, with rays that end where little light is left."""
    steps = replace(trial.steps, transmittance_min=0.2)
    return replace(trial, density_scale=2.5, steps=steps)


def partly_free(trial: Trial) -> Trial:
    """The same where half of 3 x 4 x 5 cells are free."""
    occupied = np.random.default_rng(7).uniform(size=(3, 4, 5)) < 0.5
    return replace(trial, free=np.where(occupied, 0, 1).astype(np.uint8))


def folded(trial: Trial, contraction: Contraction = "linf") -> Trial:
    """The same in folded space, with steps that grow outside the box."""
    steps = replace(trial.steps, far=40.0, n_linear=12, growth=0.09)
    return replace(trial, contraction=contraction, border=0.2, steps=steps)


@dataclass(frozen=True, kw_only=True, eq=False)
class Seen:
    """What the rays of a trial see."""

    rgb: np.ndarray
    """[n_rays, 3] in [0, 1], with background."""
    opacity: np.ndarray
    """[n_rays] in [0, 1]."""
    depth: np.ndarray
    """[n_rays] scene units."""
    n_samples: np.ndarray
    """[n_rays] visited steps."""

    def loss(self, trial: Trial) -> float:
        """The trial's loss."""
        return float(
            np.vdot(trial.rgb_slope, self.rgb)
            + np.vdot(trial.opacity_slope, self.opacity)
            + np.vdot(trial.depth_slope, self.depth)
        )


class TrialKernels:
    """The kernels in one precision and form, on one device."""

    def __init__(self, name: str, workers: Workers, packed: bool = False) -> None:
        """Choose them.

        Args:
            name: float32 or float64.
            workers: Where to work.
            packed: Sixteen samples at a time; in float32 on the CPU.
        """
        self._workers = workers
        self._packed = packed
        self._dtype = np.dtype(name).type
        self._types = precision.load(name, "types")
        self._render = precision.load(name, "render")
        self._probe = precision.load(name, "probe")

    def see(self, trial: Trial) -> Seen:
        """The forward launch."""
        rgb, transmittance, depth, n_samples = (a.numpy() for a in self._forward(trial))
        return Seen(rgb=rgb, opacity=1.0 - transmittance, depth=depth, n_samples=n_samples)

    def gradient(self, trial: Trial, scaling: Scaling = "none") -> np.ndarray:
        """The backward launch: the gradient [X, Y, Z, 4] of the trial's loss."""
        gradient = self._no_gradient(trial.raw.shape)
        variant = self._variant(trial, scaling)
        self._adjoint(trial, self._render.render_backward_kernel(variant), variant).run(
            trial.n_rays,
            gradient,
            *self._scene(trial),
            *self._rays(trial),
            self._array(trial.content_distance),
            *self._forward(trial),
            self._array(trial.rgb_slope, self._types.vec3),
            self._array(trial.opacity_slope),
            self._array(trial.depth_slope),
            *scratch(self._render, variant, 1, self._workers),  # nothing is kept between launches
        )
        return _found(gradient).reshape(trial.raw.shape)

    def train(self, trial: Trial, scaling: Scaling = "none") -> tuple[np.ndarray, np.ndarray]:
        """The training launch: squared errors [n_rays], the gradient [X, Y, Z, 4] of their mean."""
        error, n_samples = self._zeros(trial.n_rays), self._zeros(trial.n_rays, wp.int32)
        gradient = self._no_gradient(trial.raw.shape)
        variant = self._variant(trial, scaling)
        self._adjoint(trial, self._render.render_train_kernel(variant), variant).run(
            trial.n_rays,
            gradient,
            *self._scene(trial),
            *self._rays(trial),
            self._array(trial.content_distance),
            self._array(trial.target, self._types.vec3),
            1.0 / trial.n_rays,
            *scratch(self._render, variant, KEPT_PACKS, self._workers),
            error,
            n_samples,
        )
        return error.numpy(), _found(gradient).reshape(trial.raw.shape)

    def gather(self, values: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Values [X, Y, Z, 4] at points [n, 3] in grid coordinates: [n, 4]."""
        out = self._zeros(len(points), self._types.vec4)
        self._workers.launch(
            self._probe.gather_forward,
            len(points),
            self._array(values.reshape(-1, 4), self._types.vec4),
            wp.vec3i(*values.shape[:3]),
            self._array(points, self._types.vec3),
            out,
        )
        return out.numpy().astype(np.float64)

    def scatter(self, size: tuple[int, ...], points: np.ndarray, out: np.ndarray) -> np.ndarray:
        """The transpose of ``gather``, which hands [n, 4] to the nodes: [X, Y, Z, 4]."""
        gradient = self._no_gradient(size)
        workers = self._workers if self._workers.device.is_cuda else Workers("cpu", 1)
        workers.launch(
            self._probe.gather_backward,
            len(points),
            wp.vec3i(*size),
            self._array(points, self._types.vec3),
            self._array(out, self._types.vec4),
            gradient,
        )
        return _found(gradient).reshape(*size, 4)

    def _forward(self, trial: Trial) -> tuple[wp.array, ...]:
        out = (
            self._zeros(trial.n_rays, self._types.vec3),
            self._zeros(trial.n_rays),
            self._zeros(trial.n_rays),
            self._zeros(trial.n_rays, wp.int32),
        )
        variant = self._variant(trial, "none")
        self._workers.launch_owned(
            self._render.render_forward_kernel(variant),
            trial.n_rays,
            *self._scene(trial),
            *self._rays(trial),
            *scratch(self._render, variant, 1, self._workers),
            *out,
        )
        return out

    def _variant(self, trial: Trial, scaling: Scaling) -> Any:
        return self._render.Variant(
            CONTRACTIONS[trial.contraction],
            SCALINGS[scaling],
            JACOBIANS["none"],
            packed=self._packed,
        )

    def _scene(self, trial: Trial) -> tuple[Any, ...]:
        x, y, z = trial.raw.shape[:3]
        grid = grid_struct(
            self._types,
            self._array(trial.raw.reshape(-1, 4), self._types.vec4),
            (x, y, z),
            BOX_MIN,
            BOX_MAX,
            trial.border,
            DENSITY_SHIFT,
            trial.density_scale,
        )
        x, y, z = trial.free.shape
        distance = wp.array(trial.free.ravel(), dtype=wp.uint8, device=self._workers.device)
        free = free_struct(self._types, distance, (x, y, z), trial.border)
        return grid, free, trial.steps.struct(self._types)

    def _rays(self, trial: Trial) -> tuple[wp.array, ...]:
        return (
            self._array(trial.origins, self._types.vec3),
            self._array(trial.directions, self._types.vec3),
            self._array(trial.offsets),
            self._array(trial.background, self._types.vec3),
        )

    def _no_gradient(self, size: tuple[int, ...]) -> Any:
        """A kernel's Gradient of a grid [X, Y, Z, ...], zero."""
        x, y, z = size[:3]
        values = self._zeros(x * y * z, self._types.vec4)
        return gradient_struct(self._types, values, self._zeros(n_tiles((x, y, z)), wp.uint8))

    def _adjoint(self, trial: Trial, kernel: wp.Kernel, variant: Any) -> AdjointLaunch:
        length = float(np.linalg.norm(BOX_MAX - BOX_MIN))
        return AdjointLaunch(
            kernel,
            variant,
            trial.steps.most(math.inf if trial.contraction != "none" else length),
            trial.n_rays,
            self._workers,
        )

    def _array(self, values: np.ndarray, dtype: Any = None) -> wp.array:
        dtype = dtype or self._types.real
        values = np.ascontiguousarray(values, self._dtype)
        return wp.array(values, dtype=dtype, device=self._workers.device)

    def _zeros(self, shape: int | tuple[int, ...], dtype: Any = None) -> wp.array:
        return wp.zeros(shape, dtype=dtype or self._types.real, device=self._workers.device)


def _found(gradient: Any) -> np.ndarray:
    """What was added, [n_nodes, 4] float64.

    NaN in tiles that hold gradient and are not flagged: the optimiser would not see them.
    """
    found = gradient.values.numpy().astype(np.float64)
    flags = np.pad(gradient.touched.numpy(), (1, 0)) != 0
    tile = 1 + np.arange(len(found)) // tiles.TILE
    seen = flags[tile] | flags[tile - 1]
    found[found.any(axis=1) & ~seen] = np.nan
    return np.asarray(found)
