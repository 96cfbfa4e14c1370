"""One rendering problem in plain numbers, driven through the kernels and through the oracle."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import reference
import torch
import warp as wp
from numpy.typing import NDArray
from warpnerf_kernels.base import precision, tiles

from warpnerf.model.grid import (
    box_struct,
    density_struct,
    free_struct,
    frustum_struct,
    grid_struct,
)
from warpnerf.model.interface import Model
from warpnerf.model.models import Rgb
from warpnerf.rendering.adjoint import AdjointLaunch, gradient_struct
from warpnerf.rendering.losses import PLAIN, Minimised
from warpnerf.rendering.rays import rays_struct
from warpnerf.rendering.render import (
    Steps,
    scene_struct,
    scratch_struct,
    seen_struct,
    variant_of,
)
from warpnerf.runtime.parallel import Workers
from warpnerf.scenes.frustum import Frustum

Float64 = NDArray[np.float64]

N_SEEDS = 20

RGB = reference.RgbHead()


def none_free() -> NDArray[np.uint8]:
    """Free space of one cell that is occupied."""
    return np.zeros((1, 1, 1), np.uint8)


@dataclass(frozen=True, kw_only=True)
class Problem:
    """Rays through a grid."""

    raw: Float64  # [X, Y, Z, n_floats]
    box_min: Float64  # [3]
    box_max: Float64  # [3]
    origins: Float64  # [n_rays, 3]
    directions: Float64  # [n_rays, 3] unit
    background: Float64  # [n_rays, 3] or [1, 3]
    target: Float64  # [n_rays, 3]
    adj_rgb: Float64  # [n_rays, 3]
    adj_opacity: Float64  # [n_rays]
    adj_depth: Float64  # [n_rays]
    steps: Steps
    offsets: Float64 = field(default_factory=lambda: np.array([0.5]))  # [n_rays] or [1]
    content_distance: Float64 = field(default_factory=lambda: np.array([1.0]))  # likewise
    contraction: str = "none"
    border: float = 0.0
    frustum: Frustum | None = None  # with ndc: box_min and box_max are in its coordinates
    density_shift: float = 0.3
    density_scale: float = 1.0
    free: NDArray[np.uint8] = field(default_factory=none_free)  # [MX, MY, MZ] distances, cells
    model: Model = field(default_factory=Rgb)
    weights: Float64 = field(default_factory=lambda: np.zeros(0))  # [n_weights]
    minimised: Minimised = PLAIN

    @property
    def n_rays(self) -> int:
        return len(self.origins)


def unit(vectors: Float64) -> Float64:
    """Vectors over their length."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def make_problem(
    seed: int, n_rays: int = 12, size: tuple[int, int, int] = (5, 6, 4), **changes: Any
) -> Problem:
    """Random rays, half of them from inside an off-centre box, a random grid and adjoints."""
    rng = np.random.default_rng(seed)
    box_min, box_max = np.array([-1.0, -0.8, -1.1]), np.array([1.2, 0.9, 1.0])
    origins = 2.0 * unit(rng.normal(size=(n_rays, 3)))
    origins[::2] *= 0.2
    aim = 0.5 * rng.normal(size=(n_rays, 3))
    problem = Problem(
        raw=rng.normal(size=(*size, 4)),
        box_min=box_min,
        box_max=box_max,
        origins=origins,
        directions=unit(aim - origins),
        background=rng.uniform(size=(n_rays, 3)),
        target=rng.uniform(size=(n_rays, 3)),
        adj_rgb=rng.normal(size=(n_rays, 3)),
        adj_opacity=rng.normal(size=n_rays),
        adj_depth=rng.normal(size=n_rays),
        steps=Steps(near=0.07, far=2.9, step=0.11),
    )
    return replace(problem, **changes)


def in_frustum(problem: Problem, seed: int = 0) -> Problem:
    """The same rays through a grid in a turned frustum: they go away, come back, and pass by."""
    rng = np.random.default_rng(300 + seed)
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    axes *= np.sign(np.linalg.det(axes))
    origin = 0.2 * rng.normal(size=3) - 1.4 * axes[2]
    return replace(
        problem,
        contraction="ndc",
        frustum=Frustum(origin=origin, axes=axes, near=0.6, depth=1.3),
        box_min=np.array([-1.1, -0.8, 0.06]),
        box_max=np.array([0.9, 1.0, 1.3 * 0.999]),
        steps=replace(problem.steps, near=0.07, far=40.0, step=0.043, in_ndc=True),
    )


def unbounded(problem: Problem, contraction: str, border: float) -> Problem:
    """The same in a contracted space, with growing steps; or in a frustum."""
    if contraction == "ndc":
        return in_frustum(problem)
    steps = Steps(near=0.07, far=40.0, step=0.11, n_linear=12, growth=0.09)
    return replace(problem, contraction=contraction, border=border, steps=steps)


@dataclass(frozen=True, kw_only=True)
class Rendered:
    """What rays see, in numpy."""

    rgb: Float64  # [n_rays, 3]
    opacity: Float64  # [n_rays]
    depth: Float64  # [n_rays]
    n_samples: NDArray[np.int32]  # [n_rays]


def in_float32(p: Problem) -> Problem:
    """The same with numbers that float32 holds, so that only arithmetic can differ."""
    if p.frustum is not None:
        origin, axes = (
            v.astype(np.float32).astype(np.float64) for v in (p.frustum.origin, p.frustum.axes)
        )
        p = replace(p, frustum=replace(p.frustum, origin=origin, axes=axes))
    rounded = {
        name: value.astype(np.float32).astype(np.float64)
        for name, value in vars(p).items()
        if isinstance(value, np.ndarray) and value.dtype == np.float64
    }
    return replace(p, **rounded)


class Kernels:
    """The rendering kernels in one precision, on one device."""

    def __init__(self, name: str, device: str, threads: int = 1, packed: bool = False) -> None:
        self.workers = Workers(device, threads)
        self.device = self.workers.device
        # One thread, for plain kernels that add.
        self.alone = self.workers if self.device.is_cuda else Workers(device, 1)
        self.packed = packed
        self.precision = name
        self.assembly = precision.load(name, "launch.assembly")
        self.types = precision.load(name, "base.types")
        self.dtype = np.float64 if name == "float64" else np.float32

    def module(self, name: str) -> Any:
        """Another module of the kernels in this precision."""
        return precision.load(self.precision, name)

    def array(self, values: Any, dtype: Any = None) -> wp.array:
        """[...] numbers, or [..., n] of a vector type, on the device."""
        dtype = dtype or self.types.real
        return wp.array(np.ascontiguousarray(values, self.dtype), dtype=dtype, device=self.device)

    def zeros(self, n: int | tuple[int, ...], dtype: Any = None) -> wp.array:
        return wp.zeros(n, dtype=dtype or self.types.real, device=self.device)

    def grid(self, p: Problem) -> Any:
        """The problem's grid as kernels take it."""
        n_floats = p.raw.shape[3]
        values = self.array(p.raw.reshape(-1, n_floats), self.types.vector(n_floats))
        size = (p.raw.shape[0], p.raw.shape[1], p.raw.shape[2])
        return grid_struct(self.module("fields.dense"), values, size, p.border)

    def box(self, p: Problem) -> Any:
        """Its box likewise."""
        box = box_struct(self.types, p.box_min, p.box_max, p.border)
        if p.frustum is not None:
            box.frustum = frustum_struct(self.types, p.frustum, p.steps.near, p.steps.far)
        return box

    def density(self, p: Problem) -> Any:
        """And what its densities mean."""
        return density_struct(self.types, p.density_shift, p.density_scale)

    def march(self, p: Problem) -> Any:
        """And how it is marched."""
        return p.steps.struct(self.module("sampling.steps"))

    def scene(self, p: Problem, workers: Workers | None = None) -> Any:
        """What rays are marched through."""
        distance = wp.array(p.free.ravel(), dtype=wp.uint8, device=self.device)
        size = (p.free.shape[0], p.free.shape[1], p.free.shape[2])
        return scene_struct(
            p.model,
            self.precision,
            box=self.box(p),
            free=free_struct(self.types, distance, size, p.border),
            steps=p.steps,
            grid=self.grid(p),
            density=self.density(p),
            weights=self.array(p.weights),
            workers=workers or self.workers,
            minimised=p.minimised,
        )

    def rays(self, p: Problem) -> Any:
        """The rays."""
        vec3 = self.types.vec3
        return rays_struct(
            self.assembly,
            self.array(p.origins, vec3),
            self.array(p.directions, vec3),
            self.array(p.offsets),
            self.array(p.background, vec3),
            self.array(p.content_distance),
        )

    def variant(self, p: Problem, scaling: str = "none", jacobian: str = "none") -> Any:
        return variant_of(
            p.model,
            self.precision,
            p.contraction,
            scaling,
            jacobian,
            self.packed,
            p.minimised.config,
        )

    def scratch(self, variant: Any, capacity: int, workers: Workers | None = None) -> Any:
        """Room to keep so many packs of each worker."""
        return scratch_struct(variant, capacity, workers or self.workers, self.assembly)

    def seen(self, p: Problem) -> Any:
        """What the forward launch writes."""
        variant = self.variant(p)
        seen = seen_struct(variant, p.n_rays, self.workers, self.assembly)
        self.workers.launch_owned(
            self.assembly.render_forward_kernel(variant),
            -(-p.n_rays // variant.batch),
            p.n_rays,
            self.scene(p),
            self.rays(p),
            self.scratch(variant, 0),
            seen,
        )
        return seen

    def forward(self, p: Problem) -> Rendered:
        """Render."""
        seen = self.seen(p)
        return Rendered(
            rgb=seen.rgb.numpy(),
            opacity=1.0 - seen.transmittance.numpy(),
            depth=seen.depth.numpy(),
            n_samples=seen.n_samples.numpy(),
        )

    def backward(self, p: Problem, scaling: str = "none", jacobian: str = "none") -> Float64:
        """The gradient [X, Y, Z, n_floats] of the outputs' product with the problem's adjoints."""
        gradient = self.no_gradient(p)
        self.add_backward(p, gradient, scaling, jacobian)
        return found_gradient(gradient).reshape(p.raw.shape)

    def both_backward(
        self, p: Problem, scaling: str = "none", jacobian: str = "none"
    ) -> tuple[Float64, Float64]:
        """That, and the gradient of the weights."""
        gradient = self.no_gradient(p)
        self.add_backward(p, gradient, scaling, jacobian)
        weights = gradient.weights.numpy().sum(axis=0)
        return found_gradient(gradient).reshape(p.raw.shape), weights

    def add_backward(
        self, p: Problem, gradient: Any, scaling: str = "none", jacobian: str = "none"
    ) -> None:
        """Add that to a kernel's Gradient."""
        variant = self.variant(p, scaling, jacobian)
        launch = self.adjoint(p, self.assembly.render_backward_kernel(variant), variant)
        launch.run(
            p.n_rays,
            gradient,
            self.scene(p, launch.workers),
            self.rays(p),
            self.seen(p),
            self.array(p.adj_rgb, self.types.vec3),
            self.array(p.adj_opacity),
            self.array(p.adj_depth),
            self.scratch(variant, 0, launch.workers),
        )

    def adjoint(self, p: Problem, kernel: wp.Kernel, variant: Any) -> AdjointLaunch:
        """How to launch a kernel that ends in a gradient."""
        length = float(np.linalg.norm(p.box_max - p.box_min))
        most = p.model.most_steps(p.steps, math.inf if p.contraction != "none" else length)
        return AdjointLaunch(kernel, variant, most, p.n_rays, self.workers)

    def no_gradient(self, p: Problem) -> Any:
        """A kernel's Gradient for a problem, zero."""
        n_nodes, n_floats = math.prod(p.raw.shape[:3]), p.raw.shape[3]
        return self.gradient(n_nodes, n_floats, n_weights=len(p.weights))

    def gradient(self, n_nodes: int, n_floats: int, *, n_weights: int = 0, flag: int = 0) -> Any:
        """A kernel's Gradient, zero, all tiles flagged alike."""
        touched = wp.full(-(-n_nodes // tiles.TILE), flag, dtype=wp.uint8, device=self.device)
        return gradient_struct(
            self.types,
            self.zeros(n_nodes, self.types.vector(n_floats)),
            touched,
            self.zeros((self.workers.count, n_weights)),
        )

    def train(
        self, p: Problem, scaling: str = "none", jacobian: str = "none", capacity: int = 64
    ) -> tuple[Float64, Float64]:
        """Losses of rays [n_rays], and the gradient [X, Y, Z, n_floats] of their mean."""
        return self.both_train(p, scaling, jacobian, capacity)[:2]

    def both_train(
        self, p: Problem, scaling: str = "none", jacobian: str = "none", capacity: int = 64
    ) -> tuple[Float64, Float64, Float64]:
        """That, and the gradient of the weights."""
        error, loss = self.zeros(p.n_rays), self.zeros(p.n_rays)
        n_samples = self.zeros(p.n_rays, wp.int32)
        gradient = self.no_gradient(p)
        variant = self.variant(p, scaling, jacobian)
        launch = self.adjoint(p, self.assembly.render_train_kernel(variant), variant)
        launch.run(
            p.n_rays,
            gradient,
            self.scene(p, launch.workers),
            self.rays(p),
            self.array(p.target, self.types.vec3),
            1.0 / p.n_rays,
            self.scratch(variant, capacity, launch.workers),
            error,
            loss,
            n_samples,
        )
        found = found_gradient(gradient).reshape(p.raw.shape)
        return loss.numpy(), found, gradient.weights.numpy().sum(axis=0)


def found_gradient(gradient: Any) -> Float64:
    """What a kernel has added [n_nodes, n_floats]; every tile that holds some must be flagged."""
    values = gradient.values.numpy()
    flags = np.pad(gradient.touched.numpy(), (0, 1))
    tile = np.flatnonzero(values.any(axis=1)) // tiles.TILE
    assert (flags[tile] | flags[tile - 1]).all()
    return np.asarray(values)


def oracle(
    p: Problem,
    raw: torch.Tensor,
    scaling: str = "none",
    jacobian: str = "none",
    head: reference.Head = RGB,
) -> reference.Rendering:
    """The same problem in the reference, raw a tensor that may want a gradient."""
    n_steps, frustum = 1, None
    if p.frustum is not None:
        n_steps = int(4.0 * np.linalg.norm(p.box_max - p.box_min) / p.steps.step)
        frustum = reference.Frustum(
            torch.tensor(p.frustum.origin),
            torch.tensor(p.frustum.axes),
            p.frustum.near,
            p.frustum.depth,
        )
    while p.frustum is None and last_edge(p.steps, n_steps) < min(p.steps.far, 50.0):
        n_steps += 1
    offsets, content = torch.tensor(p.offsets), torch.tensor(p.content_distance)
    return reference.render(
        raw,
        torch.tensor(p.origins),
        torch.tensor(p.directions),
        box_min=torch.tensor(p.box_min),
        box_max=torch.tensor(p.box_max),
        near=p.steps.near,
        far=p.steps.far,
        step=p.steps.step,
        n_steps=n_steps,
        growth=p.steps.growth,
        n_linear=p.steps.n_linear,
        offset=offsets.expand(p.n_rays),
        norm="none" if frustum else p.contraction,
        frustum=frustum,
        border=p.border,
        density_shift=p.density_shift,
        density_scale=p.density_scale,
        background=torch.tensor(p.background).expand(p.n_rays, 3),
        mask=torch.tensor(p.free == 0),
        transmittance_min=p.steps.transmittance_min,
        scaling=scaling,
        content_distance=content.expand(p.n_rays),
        jacobian=jacobian,
        head=head,
    )


def last_edge(steps: Steps, k: int) -> float:
    """Where step k begins."""
    if steps.growth == 0.0 or k <= steps.n_linear:
        return steps.near + k * steps.step
    linear = steps.near + steps.n_linear * steps.step
    return float(linear * (1.0 + steps.growth) ** (k - steps.n_linear))


def oracle_gradient(p: Problem, scaling: str = "none", jacobian: str = "none") -> Float64:
    """What Kernels.backward must return."""
    raw = torch.tensor(p.raw, requires_grad=True)
    out = oracle(p, raw, scaling, jacobian)
    adjoints = [torch.tensor(a) for a in (p.adj_rgb, p.adj_opacity, p.adj_depth)]
    (gradient,) = torch.autograd.grad([out.rgb, out.opacity, out.depth], raw, adjoints)
    return gradient.numpy()


def oracle_train(
    p: Problem, scaling: str = "none", jacobian: str = "none"
) -> tuple[Float64, Float64]:
    """What Kernels.train must return."""
    raw = torch.tensor(p.raw, requires_grad=True)
    out = oracle(p, raw, scaling, jacobian)
    target = torch.tensor(p.target)
    (gradient,) = torch.autograd.grad(reference.photometric_loss(out.rgb, target), raw)
    return ((out.rgb - target) ** 2).sum(-1).detach().numpy(), gradient.numpy()


def directional_differences(
    f: Callable[[Float64], float], x: Float64, directions: Float64, h: float = 1e-4
) -> Float64:
    """Central differences of f at x along directions [n, *x.shape], to order h^4: [n]."""

    def difference(d: Float64, h: float) -> float:
        return (f(x + h * d) - f(x - h * d)) / (2.0 * h)

    return np.array([(4.0 * difference(d, h) - difference(d, 2.0 * h)) / 3.0 for d in directions])


def assert_close(value: Any, expected: Any, tolerance: float) -> None:
    """Elementwise error over the largest entry, and the angle; the expected must say something."""
    value, expected = np.asarray(value, np.float64), np.asarray(expected, np.float64)
    assert value.shape == expected.shape
    largest = np.abs(expected).max()
    assert largest > 1e-6, "the reference is next to zero: a comparison with it shows nothing"
    error = np.abs(value - expected).max() / largest
    assert error <= tolerance, f"relative error {error:.3g} > {tolerance:.3g}"
    cosine = np.vdot(value, expected) / (np.linalg.norm(value) * np.linalg.norm(expected))
    assert cosine >= 1.0 - max(tolerance, 1e-12)
