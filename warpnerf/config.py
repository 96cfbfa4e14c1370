"""How to train: small frozen values, each field with its unit, refused when wrong."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal, get_args

from warpnerf.checks import (
    InputError,
    require_at_least,
    require_kind,
    require_one_of,
    require_positive,
    require_shares,
    require_whole,
)
from warpnerf.model.interface import Model
from warpnerf.model.models import Deferred, model_of, to_json

Scaling = Literal["none", "quadratic", "clamped"]
Jacobian = Literal["none", "density", "paper"]
Contraction = Literal["none", "linf", "l2", "ndc"]
Background = Literal["auto", "white", "black", "random"]
SceneKind = Literal["object", "bounded", "unbounded"]
"""Bounded with photographs that have alpha, other bounded ones, and those that are not."""

ACCUMULATE_AT: dict[SceneKind, tuple[float, ...]] = {
    "object": (0.3, 0.4, 0.4, 0.5),
    "bounded": (0.4, 0.5, 0.5, 0.7),
    "unbounded": (0.5, 0.7),
}
"""What ``OptimConfig.accumulate_at`` is by default. Where rays meet fewer samples, as they should
where photographs have alpha, updates take more steps, and earlier."""

GROW_AT: dict[SceneKind, tuple[float, ...]] = {
    "object": (0.1, 0.2, 0.3, 0.4),
    "bounded": (0.3, 0.4, 0.5, 0.6),
    "unbounded": (0.3, 0.4, 0.5, 0.6),
}
"""What ``GridConfig.grow_at`` is by default. Around an object most of the first box is empty, and a
growth leaves that out; elsewhere coarse grids do more in the same time."""

MAX_VOXELS = 2**31
"""Nodes are counted in 32 bits."""

MIN_COARSE_STEPS = 50
"""Of a short training that looks for the content distance: after fewer nothing has settled, and
distances come out several times too large."""

TRAINING_BYTES = 12
"""Memory that a number of a node takes: value, two moments together, and gradient, 4 each."""


@dataclass(frozen=True, kw_only=True)
class GridConfig:
    """The voxel grid over the scene's box."""

    voxels: int = 160**3
    """Nodes of the final grid, in all. It grows from step 200 on: a shorter training keeps the grid
    that it begins with, of 1/16 as many after four growths."""
    grow_at: Literal["auto"] | tuple[float, ...] = "auto"
    """Shares of the training at which the number of nodes doubles. auto: those of ``GROW_AT``."""
    shift_at_growth: float = 0.0
    """Taken from all raw densities at each growth, before their activation; DVGO takes 1."""
    alpha_init: float = 1e-3
    """Opacity of one voxel's length before training."""
    contraction: Literal["auto", "none", "linf", "l2", "ndc"] = "auto"
    """How space outside the box is folded in. ndc: the grid lies in normalised device coordinates
    instead, for cameras that look the same way. auto: ndc for captures of LLFF that do, linf for
    other unbounded scenes, else none."""
    planes: int = 64
    """Nodes of the final grid along the depth of normalised device coordinates; with ndc only."""
    border: float = 0.2
    """Width of the shell that holds space outside the box, in half edges of the box; (0, 1]."""

    def __post_init__(self) -> None:
        """Refuse what makes no grid."""
        require_whole("grid.voxels", self.voxels, 8)
        if self.voxels >= MAX_VOXELS:
            raise InputError(
                "grid.voxels must be below 2^31 (1290 x 1290 x 1290), which kernels can count; use "
                "fewer --voxels."
            )
        require_one_of("grid.contraction", self.contraction, ("auto", *get_args(Contraction)))
        require_whole("grid.planes", self.planes, 2)
        if not 0 < self.alpha_init < 1:
            raise InputError(f"grid.alpha_init must lie between 0 and 1, not {self.alpha_init}.")
        if not 0 < self.border <= 1:
            raise InputError(f"grid.border must be above 0 and at most 1, not {self.border}.")
        if not isinstance(self.grow_at, str):
            require_shares("grid.grow_at", self.grow_at)
        elif self.grow_at != "auto":
            raise InputError(
                f"grid.grow_at must be auto or shares between 0 and 1, not {self.grow_at!r}."
            )
        require_at_least("grid.shift_at_growth", self.shift_at_growth, 0.0)

    def grows_at(self, kind: SceneKind) -> tuple[float, ...]:
        """``grow_at``, decided for a kind of scene.

        Args:
            kind: object, bounded or unbounded.

        Returns:
            Shares of the training.
        """
        return GROW_AT[kind] if isinstance(self.grow_at, str) else self.grow_at

    def nodes_after(self, grown: int, kind: SceneKind) -> int:
        """How many nodes a grid has, about, that has grown so often.

        Args:
            grown: At most as often as ``grows_at`` has shares.
            kind: object, bounded or unbounded.

        Returns:
            Nodes in all; 8 at least.
        """
        return max(8, self.voxels >> len(self.grows_at(kind)) - grown)


@dataclass(frozen=True, kw_only=True)
class MarchConfig:
    """How rays are stepped."""

    step_voxels: float = 1.0
    """Step length, in voxel edges."""
    near: float = 0.0
    """Nothing is sampled nearer to the camera than this, scene units."""
    far: float | None = None
    """Nothing is sampled at or beyond this, scene units; None: where the box or the world ends."""
    growth: float = 0.1
    """Beyond the box of an unbounded scene, each step is this share longer than the one before."""
    transmittance_min: float = 1e-3
    """A ray ends where less light than this would pass."""
    jitter: bool = True
    """Shift each training ray's samples by a random part of a step."""

    def __post_init__(self) -> None:
        """Refuse what cannot be marched."""
        require_positive("march.step_voxels", self.step_voxels)
        require_at_least("march.near", self.near, 0.0)
        require_at_least("march.growth", self.growth, 0.0)
        if 0 < self.growth < 1e-4:
            raise InputError(
                f"march.growth must be 0 or at least 0.0001, not {self.growth}: a smaller one is "
                "lost in float32."
            )
        if self.far is not None and not self.near < self.far < math.inf:
            raise InputError(
                f"march.far must be finite and beyond march.near, not {self.far}; leave it out for "
                "no limit."
            )
        if not 0 <= self.transmittance_min < 1:
            raise InputError(
                f"march.transmittance_min must lie in [0, 1), not {self.transmittance_min}."
            )


@dataclass(frozen=True, kw_only=True)
class OptimConfig:
    """Adam, its schedule, and regularisation."""

    learning_rate_density: float = 0.5
    """How far an update of one step moves raw densities, about, at the start; one of n steps moves
    them n^(1/4) times as far."""
    learning_rate_rgb: float = 0.2
    """The same of raw colours. Models with other features have rates of their own for them."""
    decay: float = 0.07
    """What is left of the learning rates at the end of training."""
    restart_at_growth: bool = False
    """Whether the optimiser begins anew where the grid grows, as DVGO's does: without moments, and
    with the learning rates of the start, whose decay goes on from there at the same pace."""
    beta1: float = 0.9
    """Decay of the first moment."""
    beta2: float = 0.99
    """Decay of the second moment."""
    epsilon: float = 1e-8
    """Added to the root of the second moment; gradients are of the mean over a step's rays,
    added up over an update's steps."""
    tv_density: float = 3e-9
    """Weight of the total variation of raw densities, per pair of neighbouring nodes of the final
    grid; of coarser ones as much more as the face between two nodes is larger."""
    tv_rgb: float = 3e-10
    """The same of raw colours and of all other features."""
    tv_until: float = 1.0
    """Share of the training after which there is no total variation."""
    tv_every: int = 8
    """Updates from one total-variation gradient to the next, which counts that many times."""
    accumulate_at: Literal["auto"] | tuple[float, ...] = "auto"
    """Shares of the training. Before the first, an update of the grid follows each step; from each
    on, twice as many steps, whose rays are put through together and whose losses are added up.
    auto: those of ``ACCUMULATE_AT``. At most six, as the rays of an update are in memory at a
    time."""

    def __post_init__(self) -> None:
        """Refuse what cannot be optimised with."""
        require_positive("optim.learning_rate_density", self.learning_rate_density)
        require_positive("optim.learning_rate_rgb", self.learning_rate_rgb)
        require_positive("optim.decay", self.decay)
        require_positive("optim.epsilon", self.epsilon)
        require_at_least("optim.tv_density", self.tv_density, 0.0)
        require_at_least("optim.tv_rgb", self.tv_rgb, 0.0)
        require_whole("optim.tv_every", self.tv_every, 1)
        if not 0 <= self.tv_until <= 1:
            raise InputError(f"optim.tv_until must lie in [0, 1], not {self.tv_until}.")
        if isinstance(self.accumulate_at, str):
            if self.accumulate_at != "auto":
                raise InputError(
                    "optim.accumulate_at must be auto or shares between 0 and 1, not "
                    f"{self.accumulate_at!r}."
                )
        else:
            require_shares("optim.accumulate_at", self.accumulate_at)
            if (n := len(self.accumulate_at)) > 6:
                raise InputError(
                    f"optim.accumulate_at must hold at most 6 shares, not {n}: with 6, an update "
                    "takes 64 steps."
                )
        for name in ("beta1", "beta2"):
            if not 0 <= getattr(self, name) < 1:
                raise InputError(f"optim.{name} must lie in [0, 1), not {getattr(self, name)}.")

    def accumulates_at(self, kind: SceneKind) -> tuple[float, ...]:
        """``accumulate_at``, decided for a kind of scene.

        Args:
            kind: object, bounded or unbounded.

        Returns:
            Shares of the training.
        """
        return ACCUMULATE_AT[kind] if isinstance(self.accumulate_at, str) else self.accumulate_at


HUBER_DELTA = 0.1


WEIGHTS_OF_LOSSES = ("distortion", "entropy", "opacity", "sample_colour", "near_clip")
"""Fields of LossConfig that weigh a loss."""

OPACITY = 1e-3
"""What ``LossConfig.opacity`` is by auto."""


@dataclass(frozen=True, kw_only=True)
class LossConfig:
    """What training minimises: the mean over rays of the photometric loss, which is a sum over the
    three channels, and of the others, each times its weight. A weight of 0 leaves a loss out.

    Systems that take the mean over the channels give a third of these weights, but for near_clip.
    """

    photometric: Literal["squared", "huber"] = "squared"
    """How a ray's colour is held against its pixel. huber: as squared up to huber_delta in a
    channel, from there on a line."""
    huber_delta: float = HUBER_DELTA
    """Where that line begins, of colours in [0, 1]."""
    distortion: float = 0.0
    """Weight of the distortion loss: matter of a ray comes together. Distances count as
    t / (D + t), with D the content distance in use; with auto and per-camera, the scene's."""
    entropy: float = 0.0
    """Weight of the entropy of the remaining light: a ray ends in matter, or meets none."""
    opacity: float | Literal["auto"] = 0.0
    """Weight of -log of the opacity of rays: each ends in matter. For photographs without alpha,
    whose pixels all show something; auto: 0.001, but 0 for objects with alpha, and where a
    background is given (``TrainConfig.losses_for``)."""
    sample_colour: float = 0.0
    """Weight of the squared errors of the colours of single samples. For models that have such:
    all but deferred."""
    near_clip: float = 0.0
    """Weight of the sum of raw densities nearer to the camera than near_clip_distance, as DVGO
    pushes them down; for comparison. DVGO does not divide by the rays of a step: its weight 1 is
    3 rays_per_step here."""
    near_clip_distance: float = 0.0
    """How near that is, scene units."""

    def __post_init__(self) -> None:
        """Refuse what cannot be minimised."""
        require_one_of("loss.photometric", self.photometric, ("squared", "huber"))
        require_positive("loss.huber_delta", self.huber_delta)
        if isinstance(self.opacity, str) and self.opacity != "auto":
            raise InputError(f"loss.opacity must be auto or a number, not {self.opacity!r}.")
        for name in (*WEIGHTS_OF_LOSSES, "near_clip_distance"):
            if name != "opacity" or self.opacity != "auto":
                require_at_least(f"loss.{name}", getattr(self, name), 0.0)
        if self.photometric != "huber" and self.huber_delta != HUBER_DELTA:
            raise InputError(
                f"loss.huber_delta is {self.huber_delta:g}, but loss.photometric is squared; set "
                "that to huber, or leave huber_delta out."
            )
        if self.near_clip == 0.0 and self.near_clip_distance > 0.0:
            raise InputError(
                "loss.near_clip_distance does nothing while loss.near_clip is 0; give both, or "
                "leave near_clip_distance out."
            )
        if self.near_clip > 0.0 and self.near_clip_distance == 0.0:
            raise InputError(
                "loss.near_clip needs loss.near_clip_distance, the distance up to which raw "
                "densities are pushed down; give both, or leave near_clip at 0."
            )

    @property
    def kinds(self) -> tuple[str, ...]:
        """Which losses there are besides the squared error; kernels are compiled for them."""
        huber = ("huber",) if self.photometric == "huber" else ()
        return huber + tuple(name for name in WEIGHTS_OF_LOSSES if getattr(self, name) != 0.0)


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """One training run."""

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
    distance of what it sees, as points or short trainings tell; auto: where that is known, the
    geometric mean of it and of the scene's estimate, or down to half of that where cameras look
    around and many see the same (``training.extent.content_distances``), else the scene's."""
    coarse_steps: int = 200
    """Steps, at most, of a short training on a small grid, with clamped scaling, that finds the
    content distance of captures without points, but for objects with alpha; two of them find the
    box as well where cameras look at no common point. 0: none, and the extent stays what the
    scene says."""
    jacobian: Jacobian = "none"
    """Whether the scaling takes into account how folding changes volumes; in folded space only."""
    rays_per_step: int = 4096
    """Rays in a batch: what one step draws, those counted that ``skip_empty_rays`` leaves out."""
    background: Background | tuple[float, float, float] = "auto"
    """What is seen behind the scene: a colour, rgb in [0, 1], or random colours while training
    (white when rendering); auto: white where photographs have alpha, else black."""
    occupancy_every: int = 100
    """Updates of the grid between two looks for free space, each of one or several steps."""
    skip_empty_rays: bool = True
    """Whether rays that meet free space only are left out of the batches of bounded scenes. They
    see the background, whatever is trained: gradients are the same on average, for less work."""
    alpha_min: float = 0.05
    """A cell is free where the longest step that there can be would be less opaque than this: what
    light crosses twenty voxels of is fog in most scenes. Smoke needs less."""
    seed: int = 0
    """Same seed, same number of threads: same bits on the CPU."""
    threads: int | None = None
    """CPU threads; None: one per core that the process or its container may use."""
    device: str = "cpu"
    """Where to train: cpu, cuda, cuda:1, ..."""
    checkpoint_every: float = 300.0
    """Seconds from one checkpoint to the next, at least; there is one at the end besides."""
    model: Model = field(default_factory=Deferred)
    """What the grid holds, and how that becomes colour. A name (rgb, sh, deferred, features) stands
    for the model of that name as it is configured by default."""
    grid: GridConfig = field(default_factory=GridConfig)
    """The voxel grid."""
    march: MarchConfig = field(default_factory=MarchConfig)
    """How rays are stepped."""
    optim: OptimConfig = field(default_factory=OptimConfig)
    """Adam, its schedule, and regularisation."""
    loss: LossConfig = field(default_factory=LossConfig)
    """What is minimised."""

    def losses_for(self, kind: SceneKind) -> LossConfig:
        """``loss``, decided for a kind of scene.

        Args:
            kind: object, bounded or unbounded.

        Returns:
            The same, with a number for what is auto.
        """
        if self.loss.opacity != "auto":
            return self.loss
        all_show_something = kind != "object" and self.background == "auto"
        return replace(self.loss, opacity=OPACITY if all_show_something else 0.0)

    def __post_init__(self) -> None:
        """Refuse what cannot be trained with."""
        if isinstance(self.model, str):
            object.__setattr__(self, "model", model_of(self.model))
        if not isinstance(self.model, Model):
            raise InputError(f"model must be a name or a model, not {self.model!r}.")
        parts = {"grid": GridConfig, "march": MarchConfig, "optim": OptimConfig, "loss": LossConfig}
        for name, kind in parts.items():
            what = f"{name} must be a {kind.__name__}"
            require_kind(getattr(self, name), kind, what, "make one, or leave it out")
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
        require_whole("seed", self.seed, 0)
        if self.seed >= 2**63:
            raise InputError(f"seed must be at least 0 and below 2^63, not {self.seed}.")
        require_one_of("scaling", self.scaling, get_args(Scaling))
        require_one_of("jacobian", self.jacobian, get_args(Jacobian))
        if self.grid.contraction == "ndc" and self.jacobian != "none":
            raise InputError(
                f"jacobian must be none with grid.contraction ndc, not {self.jacobian}: it is for "
                "contractions that leave a box around the cameras as it is."
            )
        require_positive("checkpoint_every", self.checkpoint_every)
        if self.time_limit is not None:
            require_positive("time_limit", self.time_limit)
        if self.threads is not None:
            require_whole("threads", self.threads, 1)
        if isinstance(self.content_distance, str):
            require_one_of("content_distance", self.content_distance, ("auto", "per-camera"))
        else:
            require_positive("content_distance", self.content_distance)
        if isinstance(self.background, str):
            require_one_of("background", self.background, get_args(Background))
        elif len(self.background) != 3 or not all(
            math.isfinite(c) and 0 <= c <= 1 for c in self.background
        ):
            raise InputError(f"background must be rgb in [0, 1], not {self.background}.")


def config_to_json(config: TrainConfig) -> dict[str, Any]:
    """All fields, the model's with its name."""
    return asdict(config) | {"model": to_json(config.model)}


def config_from_json(tree: dict[str, Any]) -> dict[str, Any]:
    """What to decode as a TrainConfig: fields of later versions are as what was there before them.

    Where no model is named, there was only one, rgb, and all rays were drawn.
    """
    return {"model": {"name": "rgb"}, "skip_empty_rays": False} | tree
