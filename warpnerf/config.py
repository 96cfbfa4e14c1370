"""Training configuration: small frozen values, each field with its unit, refused when wrong."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

from warpnerf.checked import checked
from warpnerf.checks import (
    InputError,
    require_at_least,
    require_kind,
    require_length,
    require_one_of,
    require_positive,
    require_whole,
    said,
)
from warpnerf.grid_config import GridConfig, is_number
from warpnerf.loss_config import OPACITY, USUAL_LOSSES, LossConfig
from warpnerf.model.interface import Model
from warpnerf.model.models import Deferred, model_of
from warpnerf.model.sampler_kinds import (
    AUTO_SAMPLER,
    MARCHED,
    Resampled,
    SamplerKind,
    checked_sampler,
)
from warpnerf.model.spaces import SPACES, SpaceKind
from warpnerf.model.storage_kinds import AUTO_FIELD, DENSE, StorageKind, Vm, storage_of
from warpnerf.optim_config import OPTIM_RATES, OPTIM_VARIATION, OptimConfig, SceneKind, model_rates

Scaling = Literal["none", "quadratic", "clamped"]
Jacobian = Literal["none", "density", "paper"]
Appearance = Literal["auto", "none", "affine"]
Background = Literal["auto", "white", "black", "random"]

OBJECT_FIELD = Vm(density=8, appearance=24, learning_rate=0.05, sparsity=1e-4)
"""What ``TrainConfig.field`` is around an object where it is auto: TensoRF's VM-96, and its L1
loss."""

MIN_COARSE_STEPS = 50
"""Of a short training that looks for the content distance: after fewer nothing has settled, and
distances come out several times too large."""


@checked("march")
@dataclass(frozen=True, kw_only=True)
class MarchConfig:
    """Ray marching: step length, its growth with the distance, near and far."""

    step_voxels: float = 1.0
    """Step length, in voxel edges."""
    near: float = 0.0
    """Nothing is sampled nearer to the camera than this, scene units."""
    far: float | None = None
    """Nothing is sampled at or beyond this, scene units; None: where the box or the world ends."""
    growth: float | Literal["auto"] = "auto"
    """Beyond the box of an unbounded scene, each step is this share longer than the one before.
    auto: 0.02 / grid.border, so that as many fall into a voxel of a wide shell as of a thin one, at
    most 0.1."""
    transmittance_min: float = 1e-3
    """Early ray termination: a ray ends where less light than this would pass; where it is as by
    default, 0.01 once the training has settled (``TrainConfig.settle_at``)."""
    jitter: bool = True
    """Shift each training ray's samples by a random part of a step."""

    def __post_init__(self) -> None:
        """Refuse what cannot be marched."""
        require_positive("march.step_voxels", self.step_voxels)
        require_at_least("march.near", self.near, 0.0)
        if self.growth != "auto":
            self._require_growth(self.growth)
        if self.far is not None and not self.near < self.far < math.inf:
            raise InputError(
                f"march.far must be finite and beyond march.near, not {said(self.far)}; leave it "
                "out for no limit."
            )
        if not 0 <= self.transmittance_min < 1:
            raise InputError(
                f"march.transmittance_min must lie in [0, 1), not {said(self.transmittance_min)}."
            )

    def _require_growth(self, growth: object) -> None:
        """Refuse what steps cannot grow by."""
        if not (is_number(growth) and 0.0 <= growth < math.inf):  # type: ignore[operator]
            raise InputError(
                f"march.growth must be auto, or a number from 0 on, not {said(growth)}."
            )
        if 0 < growth < 1e-4:  # type: ignore[operator]
            raise InputError(
                f"march.growth must be 0 or at least 0.0001, not {said(growth)}: a smaller one is "
                "lost in float32."
            )


@checked("")
@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """The configuration of a training run: by default the preset fast."""

    steps: int = 4000
    """Batches of rays to draw. Each adds to the gradient by which the grid is updated, see
    ``OptimConfig.accumulate_at``."""
    time_limit: float | None = None
    """Seconds after which training ends, its schedule squeezed to fit; compiling does not count.
    None: no limit. What fits depends on the machine, so the result does too."""
    scaling: Scaling = "clamped"
    """How a sample's gradient depends on its distance t from the camera: none, quadratic
    (t / D)^2, or clamped min(1, (t / D)^2), the method of "Floaters No More"."""
    content_distance: float | Literal["auto", "per-camera"] = "auto"
    """D: where gradients reach full strength, scene units; per-camera: for each camera's rays the
    distance of what it sees, as points, photographs or short trainings tell; auto: where that is
    known, the geometric mean of it and of the scene's estimate, or less where many cameras see the
    same (``training.extent.content_distances``), else the scene's."""
    coarse_steps: int = 200
    """Steps, at most, of a short training on a small grid, with clamped scaling, that finds the
    content distance of captures without points whose photographs do not tell it, but for objects
    with alpha; two of them find the box as well where cameras look at no common point. 0: neither
    is asked, and the extent stays what the scene says."""
    jacobian: Jacobian = "none"
    """Whether the scaling accounts for how contraction changes volumes; contracted space only."""
    rays_per_step: int = 4096
    """Rays in a batch: what one step draws, those counted that ``skip_empty_rays`` leaves out."""
    background: Background | tuple[float, float, float] = "auto"
    """What is seen behind the scene: a colour, rgb in [0, 1], or random colours while training
    (white when rendering); auto: white where photographs have alpha, else black."""
    appearance: Appearance = "auto"
    """What each photograph does to the scene's colours: none, affine, a gain and an offset of each
    channel, fitted while training, for photographs whose exposure or white balance differ; or auto:
    affine where the brightness of photographs differs, else none. What is rendered has the mean of
    all exposures."""
    average_pixels: bool = True
    """Whether pixels are averaged as long as the grid is coarse: over a square as many pixels wide
    as its voxels are of the final grid's, by numbers of nodes (``training.growth.averaged_over``).
    Photographs that have masks are taken as they are, and those of bounded scenes without
    alpha."""
    occupancy_every: int = 100
    """Updates of the grid between two looks for free space, each of one or several steps."""
    skip_empty_rays: bool = True
    """Whether rays that meet free space only are left out of the batches of bounded scenes. They
    see the background, whatever is trained: gradients are the same, for less work."""
    alpha_min: float = 0.05
    """A cell is free where the longest step that there can be would be less opaque than this: what
    light crosses twenty voxels of is fog in most scenes. Smoke needs less."""
    settle_at: float | None = 0.5
    """Share of the training after which it settles, once the grid has its final size and 1000 steps
    are done: surfaces then stand where they will stay. Free cells are from then on those whose own
    nodes hold nothing, not their neighbours' as well (but for a hash), and rays end at 1 % of the
    light, where ``march.transmittance_min`` is not configured. None: never."""
    seed: int = 0
    """Same seed, same number of threads: same bits on the CPU."""
    threads: int | None = None
    """CPU threads; None: one per core that the process or its container may use."""
    device: str = "cpu"
    """Where to train: cpu, cuda, cuda:1, ..."""
    checkpoint_every: float = 300.0
    """Seconds from one checkpoint to the next, at least; there is one at the end besides."""
    model: Model = field(default_factory=Deferred)
    """What the grid holds, and how that becomes colour: deferred (features and a small MLP for each
    ray), per_sample (DVGO's: an MLP for each sample), sh (spherical harmonics), or rgb (colour that
    is the same from all sides). A name stands for the model as it is by default."""
    grid: GridConfig = field(default_factory=GridConfig)
    """The voxel grid."""
    march: MarchConfig = field(default_factory=MarchConfig)
    """Ray marching."""
    optim: OptimConfig = field(default_factory=OptimConfig)
    """Adam, its schedule, and regularisation."""
    loss: LossConfig = USUAL_LOSSES
    """What is minimised; ``LossConfig()`` is the squared error alone."""
    field: StorageKind = DENSE
    """What the model's raw values are stored in: dense (at each node of the grid), vm (TensoRF's
    planes and lines of vectors, and a matrix that decodes their products), hash (Instant-NGP's
    tables of entries, by level), or auto: vm with more components (``OBJECT_FIELD``) for objects
    with alpha, unless rates or a decay of a dense grid are configured, else dense. A name stands
    for what it is by default."""
    sampler: SamplerKind = AUTO_SAMPLER
    """Where rays are sampled: march (regular steps), resampled (intervals drawn for each ray from a
    small grid of densities that is trained along), or auto: resampled where space is contracted and
    steps are not configured, else march. A name stands for the sampler with its defaults."""

    def for_kind(self, kind: SceneKind) -> TrainConfig:
        """The configuration with ``field`` and ``grid.voxels`` decided for a kind of scene.

        Args:
            kind: object, bounded or unbounded.

        Returns:
            The same, or with what auto stands for.
        """
        field = self._field_for(kind)
        grid = self.grid
        if grid.voxels == "auto":
            grid = replace(grid, voxels=field.auto_voxels)
        return replace(self, field=field, grid=grid)

    def _field_for(self, kind: SceneKind) -> StorageKind:
        if self.field != AUTO_FIELD:
            return self.field
        parts = (self.optim, (*OPTIM_RATES, "near_decay")), (self.model, model_rates(self.model))
        configured = any(
            getattr(part, name) != getattr(type(part), name)
            for part, names in parts
            for name in names
        )
        return OBJECT_FIELD if kind == "object" and not configured else DENSE

    def losses_for(self, kind: SceneKind) -> LossConfig:
        """The loss weights: ``loss``, decided for a kind of scene.

        Args:
            kind: object, bounded or unbounded.

        Returns:
            The same, with a number for what is auto.
        """
        if self.loss.opacity != "auto":
            return self.loss
        all_show_something = kind != "object" and self.background == "auto"
        return replace(self.loss, opacity=OPACITY if all_show_something else 0.0)

    def sampler_in(self, space: SpaceKind) -> SamplerKind:
        """The sampler: ``sampler``, decided for a kind of space.

        Proposals are resampled where space is contracted, unless the model brings a sampler of its
        own, or steps are configured.

        Args:
            space: That the grid fills.

        Returns:
            The same, or what auto stands for.
        """
        if self.sampler != AUTO_SAMPLER:
            return self.sampler
        march, usual = self.march, MarchConfig()
        configured = (march.step_voxels, march.growth) != (usual.step_voxels, usual.growth)
        own = type(self.model).march is not Model.march
        return Resampled() if space.contracts and not configured and not own else MARCHED

    def _require_used(self) -> None:
        """Refuse what of the optimiser does nothing to what the field stores."""
        unused: list[tuple[str, OptimConfig | Model, tuple[str, ...], str]] = []
        if self.field.own_rates:
            why = "has rates of its own; set field.learning_rate, and"
            unused.append(("optim", self.optim, OPTIM_RATES, why))
            unused.append(("model", self.model, model_rates(self.model), why))
        alone = self.model.learning_rate_mlp == 0.0 and self.sampler == MARCHED
        if self.field.own_epsilon and alone:
            why = "has one of its own, and nothing else is trained; set field.epsilon, and"
            unused.append(("optim", self.optim, ("epsilon",), why))
        if not self.field.owns_densities:
            why = "has no density of its own at each node;"
            unused.append(("optim", self.optim, ("near_decay",), why))
        if not self.field.smoothed:
            unused.append(("optim", self.optim, OPTIM_VARIATION, "has no total variation;"))
        elif self.optim.tv_density == self.optim.tv_rgb == 0.0 and not self.field.has_sparsity:
            for name in ("tv_until", "tv_every"):
                if getattr(self.optim, name) != getattr(OptimConfig, name):
                    weights = ["optim.tv_density", "optim.tv_rgb"]
                    weights += ["field.sparsity"] * hasattr(self.field, "sparsity")
                    raise InputError(
                        f"optim.{name} is {getattr(self.optim, name):g}, but "
                        f"{' and '.join(weights)} are 0; set one of them, or leave {name} out."
                    )
        for part, value, names, why in unused:
            for name in names:
                if getattr(value, name) != getattr(type(value), name):
                    raise InputError(
                        f"{part}.{name} is {getattr(value, name):g}, but a {self.field.name} field "
                        f"{why} leave {name} out."
                    )

    def __post_init__(self) -> None:
        """Refuse what cannot be trained with."""
        if isinstance(self.model, str):
            object.__setattr__(self, "model", model_of(self.model))
        if not isinstance(self.model, Model):
            raise InputError(f"model must be a name or a model, not {said(self.model)}.")
        if isinstance(self.field, str):
            object.__setattr__(self, "field", storage_of(self.field))
        if not isinstance(self.field, StorageKind):
            raise InputError(f"field must be a name or a storage, not {said(self.field)}.")
        object.__setattr__(self, "sampler", checked_sampler(self.sampler))
        parts = {"grid": GridConfig, "march": MarchConfig, "optim": OptimConfig, "loss": LossConfig}
        for name, kind in parts.items():
            what = f"{name} must be a {kind.__name__}"
            require_kind(getattr(self, name), kind, what, "make one, or leave it out")
        self._require_used()
        require_whole("steps", self.steps, 1)
        require_whole("coarse_steps", self.coarse_steps, 0)
        if 0 < self.coarse_steps < MIN_COARSE_STEPS:
            raise InputError(
                f"coarse_steps must be 0, for none, or at least {MIN_COARSE_STEPS}, not "
                f"{self.coarse_steps}: fewer find nothing."
            )
        require_whole("rays_per_step", self.rays_per_step, 1)
        require_whole("occupancy_every", self.occupancy_every, 1)
        require_at_least("alpha_min", self.alpha_min, 0.0)
        if self.alpha_min >= 1.0:
            raise InputError(
                f"alpha_min must be an opacity in [0, 1), not {self.alpha_min}: from 1 on all "
                "space is free, and nothing is seen."
            )
        if self.settle_at is not None and not 0.0 < self.settle_at < 1.0:
            raise InputError(
                f"settle_at must be a share of the training in (0, 1), not {said(self.settle_at)}; "
                "none leaves it out."
            )
        require_whole("seed", self.seed, 0)
        require_one_of("scaling", self.scaling, get_args(Scaling))
        require_one_of("jacobian", self.jacobian, get_args(Jacobian))
        require_one_of("appearance", self.appearance, get_args(Appearance))
        space = SPACES.get(self.grid.contraction)
        if space is not None and space.has_frustum and self.jacobian != "none":
            raise InputError(
                f"jacobian must be none with grid.contraction {space.name}, not {self.jacobian}: "
                "it is for contractions that leave a box around the cameras as it is."
            )
        if self.optim.restart_at_growth and not self.grid.grow_at:
            raise InputError(
                "optim.restart_at_growth is true, but grid.grow_at is empty; give shares at which "
                "the grid grows, or leave restart_at_growth out."
            )
        require_positive("checkpoint_every", self.checkpoint_every)
        if self.time_limit is not None:
            require_positive("time_limit", self.time_limit)
        if self.threads is not None:
            require_whole("threads", self.threads, 1)
        if isinstance(self.content_distance, str):
            require_one_of("content_distance", self.content_distance, ("auto", "per-camera"))
        else:
            require_length("content_distance", self.content_distance)
        if isinstance(self.background, str):
            require_one_of("background", self.background, get_args(Background))
        elif len(self.background) != 3 or not all(
            math.isfinite(c) and 0 <= c <= 1 for c in self.background
        ):
            raise InputError(f"background must be rgb in [0, 1], not {said(self.background)}.")
