"""Small rendering problems in plain numbers, for gradient checking: rays, a field, a loss."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace

import numpy as np
import warp as wp

from warpnerf.config import LossConfig
from warpnerf.fields.lattice import Lattice
from warpnerf.fields.storage import Storage
from warpnerf.fields.storages import class_of
from warpnerf.grid_config import Contraction
from warpnerf.model.interface import Model, n_weights
from warpnerf.model.models import Rgb
from warpnerf.model.storage_kinds import DENSE, StorageKind
from warpnerf.rendering.losses import PHOTOMETRIC_ONLY, Objective
from warpnerf.rendering.steps import Steps
from warpnerf.scenes.extent.frustum import Frustum
from warpnerf.scenes.extent.space import Space

DENSITY_SHIFT = 0.3
BOX_MIN, BOX_MAX = np.array([-1.0, -0.8, -1.1]), np.array([1.2, 0.9, 1.0])


@dataclass(frozen=True, kw_only=True, eq=False)
class RayProblem:
    """Rays through a grid, and a loss: the product of what they see with the slopes below."""

    raw: np.ndarray
    """[X, Y, Z, n_floats] raw density, raw features, padding; of a field that is stored otherwise
    nothing but its shape counts."""
    origins: np.ndarray
    """[n_rays, 3] scene units."""
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
    box_min: np.ndarray = field(default_factory=lambda: BOX_MIN)
    """[3] scene units, or coordinates in the frustum."""
    box_max: np.ndarray = field(default_factory=lambda: BOX_MAX)
    """[3] likewise."""
    contraction: Contraction = "none"
    """How space outside the box is contracted, or ndc."""
    border: float = 0.0
    """Width of the shell that holds what is contracted, in half edges of the box."""
    frustum: Frustum | None = None
    """Of normalised device coordinates."""
    density_scale: float = 1.0
    """1 / scene unit."""
    model: Model = field(default_factory=Rgb)
    """What raw values mean."""
    weights: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """[n_weights] of the model's MLP."""
    objective: Objective = PHOTOMETRIC_ONLY
    """What the training launch minimises."""
    stored: StorageKind = DENSE
    """What the field is stored in."""
    tensors: dict[str, np.ndarray] = field(default_factory=dict)
    """Its arrays, by the names of the kind's rules, where it is no dense grid."""

    @property
    def n_rays(self) -> int:
        """How many rays there are."""
        return len(self.origins)

    @property
    def learned(self) -> dict[str, np.ndarray]:
        """What gradients are of: the arrays of the field, and the weights of the MLP."""
        own = self.tensors or {"values": self.raw}
        return own | ({"weights": self.weights} if self.weights.size else {})

    def moved(self, name: str, by: np.ndarray) -> RayProblem:
        """The same where one of these is another one, by so much."""
        if name in self.tensors:
            return replace(self, tensors=self.tensors | {name: self.tensors[name] + by})
        return replace(self, **{"raw" if name == "values" else name: self.learned[name] + by})

    def storage(self, arrays: Mapping[str, wp.array]) -> Storage:
        """The field's storage, as fine as it becomes.

        Args:
            arrays: What is learned of it; see ``Storage.over``.
        """
        of_kind = class_of(self.stored)
        return of_kind.over(self.stored, self.model, _lattice(self), arrays).as_final()

    def rounded(self) -> RayProblem:
        """The same in numbers that float32 holds, so that only arithmetic can differ."""
        exact = {f.name: getattr(self, f.name) for f in fields(self)}
        exact |= {
            name: value.astype(np.float32).astype(np.float64)
            for name, value in exact.items()
            if isinstance(value, np.ndarray) and value.dtype == np.float64
        }
        exact["tensors"] = {
            name: array.astype(np.float32).astype(np.float64)
            for name, array in self.tensors.items()
        }
        if self.frustum is not None:
            exact["frustum"] = replace(
                self.frustum,
                origin=self.frustum.origin.astype(np.float32).astype(np.float64),
                axes=self.frustum.axes.astype(np.float32).astype(np.float64),
                near=float(np.float32(self.frustum.near)),
                depth=float(np.float32(self.frustum.depth)),
            )
        return RayProblem(**exact)


def make_problem(seed: int, n_rays: int = 24, size: tuple[int, int, int] = (7, 8, 6)) -> RayProblem:
    """Random rays, half of them from inside the box, through a random grid."""
    rng = np.random.default_rng(seed)

    def unit(vectors: np.ndarray) -> np.ndarray:
        return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)

    origins = 2.0 * unit(rng.normal(size=(n_rays, 3)))
    origins[::2] *= 0.2
    return RayProblem(
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


def stopping_early(problem: RayProblem) -> RayProblem:
    """The same through a denser medium, with rays that end where little light is left."""
    steps = replace(problem.steps, transmittance_min=0.2)
    return replace(problem, density_scale=2.5, steps=steps)


def partly_free(problem: RayProblem) -> RayProblem:
    """The same where half of 3 x 4 x 5 cells are free."""
    occupied = np.random.default_rng(7).uniform(size=(3, 4, 5)) < 0.5
    return replace(problem, free=np.where(occupied, 0, 1).astype(np.uint8))


def contracted(problem: RayProblem, contraction: Contraction = "linf") -> RayProblem:
    """The same in contracted space, with steps that grow outside the box."""
    steps = replace(problem.steps, far=40.0, n_linear=12, growth=0.09)
    return replace(problem, contraction=contraction, border=0.2, steps=steps)


def in_frustum(problem: RayProblem) -> RayProblem:
    """The same rays through a frustum, turned against the axes: some go away, some come back."""
    rng = np.random.default_rng(5)
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    axes *= np.sign(np.linalg.det(axes))
    return replace(
        problem,
        contraction="ndc",
        frustum=Frustum(origin=-1.4 * axes[2], axes=axes, near=0.6, depth=1.3),
        box_min=np.array([-1.1, -0.8, 0.06]),
        box_max=np.array([0.9, 1.0, 1.3 * 0.999]),
        steps=replace(problem.steps, far=40.0, step=0.043, in_ndc=True),
    )


def with_losses(problem: RayProblem, sample_colour: float = 0.0) -> RayProblem:
    """The same with losses besides the squared error, in a launch that trains."""
    losses = LossConfig(
        photometric="huber",
        distortion=0.3,
        entropy=0.2,
        opacity=0.1,
        sample_colour=sample_colour,
        near_clip=0.1,
        near_clip_distance=0.6,
    )
    return replace(problem, objective=Objective(config=losses, content_distance=1.3))


def of_model(problem: RayProblem, model: Model) -> RayProblem:
    """The same rays through a random grid and MLP of another model."""
    rng = np.random.default_rng(11)
    return replace(
        problem,
        raw=rng.normal(size=(*problem.raw.shape[:3], model.n_floats)),
        model=model,
        weights=rng.normal(size=n_weights(model)) * 0.4,
    )


def stored_in(problem: RayProblem, kind: StorageKind) -> RayProblem:
    """The same rays through random entries and a random decoder."""
    rng = np.random.default_rng(13)
    model, cpu = problem.model, wp.get_device("cpu")
    first = class_of(kind).first(kind, model, _lattice(problem), 0, cpu)
    tensors = {name: rng.normal(size=array.shape) for name, array in first.tensors().items()}
    decoder = tensors["decoder"]
    decoder *= 2.0 / np.sqrt(len(decoder))  # raw values of about 1
    decoder[:, 1 + model.n_features :] = 0.0  # padding
    return replace(problem, stored=kind, tensors=tensors)


def _lattice(problem: RayProblem) -> Lattice:
    space = Space(
        box_min=problem.box_min,
        box_max=problem.box_max,
        contraction=problem.contraction,
        border=problem.border,
        frustum=problem.frustum,
    )
    x, y, z = problem.raw.shape[:3]
    return Lattice.over(space, (x, y, z))


def some_intervals(problem: RayProblem) -> tuple[np.ndarray, np.ndarray]:
    """Intervals of each ray and what they weigh, more than a proposal has for many: edges
    [n_rays, n + 1] in rising order, scene units, and weights [n_rays, n]."""
    rng, n = np.random.default_rng(17), 9
    within = problem.steps.near, problem.steps.far
    edges = np.sort(rng.uniform(*within, (problem.n_rays, n + 1)), axis=1)
    return edges, rng.uniform(0.0, 0.4, (problem.n_rays, n))


@dataclass(frozen=True, kw_only=True, eq=False)
class Found:
    """A gradient."""

    arrays: dict[str, np.ndarray]
    """By name and in the shapes of ``RayProblem.learned``."""

    @property
    def values(self) -> np.ndarray:
        """[X, Y, Z, n_floats] of raw values of a dense grid."""
        return self.arrays["values"]

    def times(self, factor: float, *names: str) -> Found:
        """The same times a factor, or those of it that are named."""
        chosen = names or tuple(self.arrays)
        return Found(arrays=self.arrays | {name: factor * self.arrays[name] for name in chosen})


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderOutputs:
    """What the rays of a problem see."""

    rgb: np.ndarray
    """[n_rays, 3] in [0, 1], with background."""
    opacity: np.ndarray
    """[n_rays] in [0, 1]."""
    depth: np.ndarray
    """[n_rays] scene units."""
    n_samples: np.ndarray
    """[n_rays] visited steps."""

    def loss(self, problem: RayProblem) -> float:
        """The problem's loss."""
        return float(
            np.vdot(problem.rgb_slope, self.rgb)
            + np.vdot(problem.opacity_slope, self.opacity)
            + np.vdot(problem.depth_slope, self.depth)
        )
