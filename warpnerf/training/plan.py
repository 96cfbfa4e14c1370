"""Training plan: a configuration, resolved once for a scene. Needs no Warp.

What is auto in a configuration is decided here and nowhere else, so that what ``inspect`` prints is
what ``train`` runs. A checkpoint holds the plan, and a resumed training goes by it: another machine
may round what is estimated of the cameras otherwise, and another version may decide otherwise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from warpnerf.checks import InputError, require_one_of, require_positive
from warpnerf.config import MIN_COARSE_STEPS, LossConfig, TrainConfig
from warpnerf.model.interface import Model
from warpnerf.model.sampler_kinds import MARCHED, SamplerKind
from warpnerf.model.spaces import SPACES, SpaceKind
from warpnerf.optim_config import SceneKind
from warpnerf.rendering.steps import Steps
from warpnerf.runtime.memory import usable_cores
from warpnerf.scenes.extent.points import ObservedExtent, with_extent
from warpnerf.scenes.extent.sharpness import Sharpness, sharpness
from warpnerf.scenes.extent.space import Space, grid_size
from warpnerf.scenes.extent.space_plan import resolve_space
from warpnerf.scenes.scene import Scene
from warpnerf.training import extent
from warpnerf.training.extent import content_distances, march_steps
from warpnerf.training.schedule import Schedule

STEPS_SHARE = 0.1
"""Of a training's steps, that a short one which looks for the extent takes at most."""

RAY_BYTES = 116
"""Memory of a ray of an update: where it comes from and goes, and what it should be and is."""

RECORD_BYTES = 1 << 29
"""What gradients of samples on their way take at most; ``warpnerf.rendering.adjoint.RECORDS``."""

SAMPLES_IN_FOG = 180
"""Of a ray that is marched while nothing is known to be free, about."""

PROCESS_BYTES = 250_000_000
"""What a training takes besides grid and photographs: Python, Warp, compiled kernels, pictures."""

_COLOURS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0), "random": (1.0, 1.0, 1.0)}


@dataclass(frozen=True, kw_only=True)
class Stage:
    """A grid between two growths, in the first box: a bounded scene's gets tighter as it grows."""

    begins: float
    """Share of the training; 0 for the first."""
    nodes: int
    """About how many there are; the numbers along the axes are whole."""
    size: tuple[int, int, int]
    """Along each axis."""
    steps: Steps
    """How rays are marched, until the training settles (``TrainConfig.settle_at``)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TrainingPlan:
    """All that a training goes by."""

    config: TrainConfig
    """What was requested."""
    kind: SceneKind
    """Of the scene, by which defaults go."""
    space: Space
    """That the first grid fills."""
    content_distance: float
    """Of the scene, scene units."""
    content_distances: tuple[float, ...]
    """Of the training views, up to which their gradients are scaled, scene units."""
    reach: float
    """From the outermost training camera to the farthest corner of the box, scene units."""
    losses: LossConfig
    """What is minimised; nothing of it is auto."""
    background: tuple[float, float, float]
    """What a field is shown before, rgb; while training, too, unless that is random."""
    random_background: bool
    """Whether training rays see random colours behind the scene."""
    schedule: Schedule
    """When the grid grows, and how many steps an update takes."""
    stages: tuple[Stage, ...]
    """The grid before each growth, and after the last."""
    voxel_pixels: Sharpness
    """How many pixels wide voxels of the last are in the photographs."""
    memory: int
    """Bytes that it takes on the CPU: grid, optimiser, gradients, photographs, the process."""
    looks_first: bool
    """Whether the extent is looked for first. Space and distances are then what the
    cameras suggest, and those of the plan that follows may be other ones."""

    def __post_init__(self) -> None:
        """Refuse what no training can go by."""
        _require_space(self.space)
        for stage in self.stages:
            if min(stage.size) < 2 or stage.nodes < 1:
                raise InputError(f"plan.stages must have two nodes on each axis, not {stage.size}.")
        require_positive("plan.content_distance", self.content_distance)
        for distance in self.content_distances:
            require_positive("plan.content_distances", distance)
        if len(self.stages) != len(self.schedule.grow_at) + 1:
            raise InputError(
                f"plan.stages must be one more than growths, not {len(self.stages)} for "
                f"{len(self.schedule.grow_at)}."
            )
        if isinstance(self.losses.opacity, str):
            raise InputError(f"plan.losses.opacity must be a number, not {self.losses.opacity!r}.")

    @property
    def sampler(self) -> SamplerKind:
        """Where rays are sampled; not auto."""
        return self.config.sampler_in(self.space.kind)

    def require_fits(self, scene: Scene) -> None:
        """Raise InputError unless a training of a scene can go by this."""
        n_views, n_distances = len(scene.splits["train"]), len(self.content_distances)
        if n_distances != n_views:
            raise InputError(
                f"the plan of the training has {n_distances} content distances, but {scene.name} "
                f"{n_views} training views; resolve it for this scene, or train again."
            )
        if self.looks_first:
            raise InputError(
                f"the plan of the training waits for a short one that looks for the extent of "
                f"{scene.name}; give it to training.coarse.prepare_trainer, or resolve it with "
                "looked=True."
            )


def _require_space(space: Space) -> None:
    """Raise InputError where a plan's space is none that there is."""
    require_one_of("plan.space.contraction", space.contraction, tuple(SPACES))
    content = np.zeros((2, 3)) if space.content is None else space.content
    box = np.array([space.box_min, space.box_max])
    if box.shape != (2, 3) or content.shape != (2, 3) or not (box[0] < box[1]).all():
        raise InputError(f"plan.space must be a box with two corners, not {box.tolist()}.")
    frustum = space.frustum
    if (frustum is not None) != space.kind.has_frustum or (
        frustum is not None and (frustum.origin.shape, frustum.axes.shape) != ((3,), (3, 3))
    ):
        raise InputError(f"plan.space.frustum does not fit the space {space.contraction}.")


def resolve(
    scene: Scene,
    config: TrainConfig,
    observed: ObservedExtent | None = None,
    *,
    looked: bool = False,
) -> TrainingPlan:
    """Resolve a configuration for a scene: decide all that its training goes by.

    Args:
        scene: What is trained on.
        config: How.
        observed: What was found before: content distances in place of the scene's, and
            its box where the scene's is a guess.
        looked: Whether the extent will not be looked for, or has been, in vain.

    Raises:
        InputError: The scene has no frustum, or no content distances that are requested; or an
            option does nothing in its space, or contradicts its photographs.
    """
    if observed is not None:
        scene = with_extent(scene, observed)
    config = config.for_kind(scene.kind)
    space = resolve_space(scene, config)
    looks_first = not looked and needs_search(scene, config, space.kind)
    if looks_first and config.content_distance == "per-camera":  # they are not known yet
        one, each = scene.content_distance, [scene.content_distance] * len(scene.splits["train"])
    else:
        one, each = content_distances(scene, config)
    plan = planned(
        scene, config, space, one, each, extent.reach(scene, space), looks_first=looks_first
    )
    _require_useful(scene, plan)
    return plan


def planned(
    scene: Scene,
    config: TrainConfig,
    space: Space,
    content_distance: float,
    distances: list[float],
    reach: float,
    *,
    looks_first: bool = False,
) -> TrainingPlan:
    """The plan of a training whose extent is known.

    Args:
        scene: What is trained on.
        config: How.
        space: That the first grid fills.
        content_distance: Of the scene, scene units.
        distances: Of the training views, scene units.
        reach: ``TrainingPlan.reach``.
        looks_first: ``TrainingPlan.looks_first``.
    """
    kind, voxels = scene.kind, config.grid.n_nodes
    schedule = Schedule.of(config, kind)
    behind = config.background
    if behind == "auto":
        behind = "white" if scene.has_alpha else "black"
    assert isinstance(config.model, Model)
    images = sum(view.camera.width * view.camera.height * view.channels for view in scene.views)
    stages = []
    for grown, begins in enumerate((0.0, *schedule.grow_at)):
        nodes = config.grid.nodes_after(grown, kind)
        size = grid_size(space.extent, nodes)
        steps = march_steps(config.march, space, size, reach)
        stages.append(Stage(begins=begins, nodes=nodes, size=size, steps=steps))
    of_field = config.field.training_bytes(config.model, stages[-1].size)
    sampler = config.sampler_in(space.kind)
    of_rays = bytes_of_rays(config, schedule, sampler)
    of_samples = bytes_of_samples(config, schedule, sampler)
    return TrainingPlan(
        config=config,
        kind=kind,
        space=space,
        content_distance=content_distance,
        content_distances=tuple(distances),
        reach=reach,
        losses=config.losses_for(kind),
        background=_COLOURS[behind] if isinstance(behind, str) else behind,
        random_background=behind == "random",
        schedule=schedule,
        stages=tuple(stages),
        voxel_pixels=sharpness(scene, space, voxels, config.field.box_is_fixed),
        memory=of_field + of_rays + of_samples + images + PROCESS_BYTES,
        looks_first=looks_first,
    )


def bytes_of_rays(config: TrainConfig, schedule: Schedule, sampler: SamplerKind) -> int:
    """Memory in bytes of the rays of an update, and of what the sampler keeps.

    Args:
        config: Of the training.
        schedule: How many steps an update has.
        sampler: Where rays are sampled.

    Raises:
        InputError: There are more rays than kernels can count.
    """
    steps = schedule.most_steps_an_update
    n_rays = config.rays_per_step * steps
    if n_rays >= 2**31:
        raise InputError(
            f"rays_per_step is {config.rays_per_step}, and an update has up to {steps} steps "
            "(optim.accumulate_at); use fewer, together below 2^31."
        )
    return n_rays * RAY_BYTES + sampler.training_bytes(n_rays)


def bytes_of_samples(config: TrainConfig, schedule: Schedule, sampler: SamplerKind) -> int:
    """Memory in bytes of the samples' gradients of an update on their way between threads.

    As much as there is room for, where free space has not been found; on one thread and on CUDA
    there is no such way.

    Args:
        config: Of the training.
        schedule: How many steps an update has.
        sampler: Where rays are sampled.
    """
    if (config.threads or usable_cores()) == 1 or not config.device.startswith("cpu"):
        return 0
    n_rays = config.rays_per_step * schedule.most_steps_an_update
    samples = n_rays * math.ceil(sampler.samples_of(SAMPLES_IN_FOG))
    return min(RECORD_BYTES, samples * config.field.sample_bytes)


def needs_search(scene: Scene, config: TrainConfig, space: SpaceKind) -> bool:
    """Whether a better extent than the scene's is of use, and training long enough to look for it.

    Args:
        scene: Where it brings points, these tell; cameras of an object with alpha stand around it.
        config: Where it says content distance and box, only a box that is a guess is looked for.
        space: That its grid fills, of what kind.
    """
    if scene.content_distances is not None or coarse_steps(config) < MIN_COARSE_STEPS:
        return False
    if config.content_distance == "per-camera":
        return True
    if not scene.unbounded:
        return config.content_distance == "auto" and not scene.has_alpha
    if space.bounded:
        return False
    if config.content_distance == "auto":
        return True
    box = config.grid.box
    return not space.has_frustum and (box == "auto" or (box == "scene" and scene.guessed))


def coarse_steps(config: TrainConfig) -> int:
    """Steps of a short training before one of this configuration."""
    return min(config.coarse_steps, int(STEPS_SHARE * config.steps))


def _require_useful(scene: Scene, plan: TrainingPlan) -> None:
    """Raise InputError where an option does nothing here, or contradicts the photographs."""
    config = plan.config
    if plan.kind == "object" and plan.losses.opacity != 0.0:
        raise InputError(
            f"loss.opacity is above 0, but photographs of {scene.name} have alpha, and where "
            "they show nothing, nothing should be; set it to 0 or auto."
        )
    if plan.space.frustum is not None and plan.sampler != MARCHED:
        raise InputError(
            f"sampler {plan.sampler.name} draws distances in the scene, but the grid of "
            f"{scene.name} lies in normalised device coordinates; set grid.contraction to linf, or "
            "sampler to march."
        )
    idle = config.scaling == "none" or not plan.space.contracted
    if idle and config.jacobian != "none":
        raise InputError(
            f"jacobian {config.jacobian} does nothing where gradients are not scaled or space "
            f"is not contracted: here scaling is {config.scaling} and grid.contraction "
            f"{plan.space.contraction}; set it to none."
        )


@dataclass(frozen=True, kw_only=True)
class OlderPlan:
    """What a checkpoint of an older format holds of its plan."""

    config: TrainConfig
    content_distance: float
    content_distances: tuple[float, ...] | None = None
    """None: they are all that one."""
    reach: float

    @property
    def sampler(self) -> SamplerKind:
        """Where rays are sampled: nothing was auto."""
        return self.config.sampler

    def completed(self, scene: Scene, space: Space) -> TrainingPlan:
        """The plan that it was part of, as far as it still matters.

        Args:
            scene: What is trained on.
            space: That the grid of the checkpoint fills; its first may have filled more.
        """
        n_views, one = len(scene.splits["train"]), self.content_distance
        distances = list(self.content_distances or [one] * n_views)
        return planned(scene, self.config, space, one, distances, self.reach)
