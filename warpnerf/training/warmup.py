"""Kernel warm-up: compiling what a training needs before anyone waits for it."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, fields
from itertools import product
from typing import get_args

import warp as wp
from warpnerf_kernels.fields import dense_bound
from warpnerf_kernels.launch import assembly
from warpnerf_kernels.optim import adam, exposure, near_decay
from warpnerf_kernels.sampling import coverage, occupancy
from warpnerf_kernels.space import camera

from warpnerf.config import Jacobian, LossConfig, Scaling, TrainConfig
from warpnerf.fields.storages import class_of
from warpnerf.grid_config import Contraction
from warpnerf.model.interface import Model
from warpnerf.model.sampler_kinds import MARCHED, ProposedDensity, SamplerKind
from warpnerf.model.spaces import SPACES
from warpnerf.model.storage_kinds import DENSE, StorageKind
from warpnerf.optim_config import SceneKind
from warpnerf.presets import DEFAULT_PRESETS, PRESETS
from warpnerf.rendering.losses import PHOTOMETRIC_ONLY, parts_with
from warpnerf.rendering.proposal import proposing_kernels
from warpnerf.rendering.structs import variant_of
from warpnerf.runtime import kernel_cache
from warpnerf.runtime.parallel import Workers
from warpnerf.training.plan import TrainingPlan


@dataclass(frozen=True, kw_only=True)
class CompiledKernel:
    """A compiled kernel, ready to launch."""

    name: str
    """What it is, in words."""
    compiled: bool
    """Whether it had to be compiled; else it was in the cache."""
    seconds: float
    """How long that took, beside others that were compiled at the same time."""


def training_kernels(
    model: Model,
    contraction: Contraction,
    scaling: Scaling,
    jacobian: Jacobian,
    device: wp.Device,
    losses: LossConfig,
    stored: StorageKind = DENSE,
    sampler: SamplerKind = MARCHED,
    decays: bool = False,
    exposes: bool = False,
) -> list[wp.Kernel]:
    """The kernels of a training from its first step to its last; at least one for each module.

    Kernels that share a module with one of these are compiled along with it.
    """
    packed = not device.is_cuda
    variant = variant_of(
        model, "float32", contraction, scaling, jacobian, packed, losses, stored, sampler
    )
    decaying = [adam.adam_kernel(model.n_floats, decays=True), near_decay.find_near_decay]
    return [
        assembly.render_train_kernel(variant),  # takes longest, so it is compiled first
        camera.pick_pixels,
        camera.sample_pixels,
        *class_of(stored).kernels(stored, model),
        *(decaying if decays else []),
        *([exposure.add_moments] if exposes else []),
        adam.adam_weights,
        dense_bound.join_highest,
        occupancy.mark_occupied_kernel(
            parts_with(model, "float32", losses, stored).sampler, variant.space
        ),
        occupancy.spread_distance,
        coverage.cover_blocks,
        *proposal_kernels(sampler, contraction, device, learns=True),
    ]


def kernels_of(plan: TrainingPlan, contraction: Contraction, device: wp.Device) -> list[wp.Kernel]:
    """The kernels of a training, by its plan, on the grid that it has."""
    config = plan.config
    assert isinstance(config.model, Model)
    return training_kernels(
        config.model,
        contraction,
        config.scaling,
        config.jacobian,
        device,
        plan.losses,
        config.field,
        plan.sampler,
        config.optim.near_decay > 0.0,
        config.appearance != "none",
    )


def rendering_kernels(
    model: Model,
    contraction: Contraction,
    device: wp.Device,
    stored: StorageKind = DENSE,
    sampler: SamplerKind = MARCHED,
) -> list[wp.Kernel]:
    """The kernels that render a field; at least one for each module."""
    packed = not device.is_cuda
    variant = variant_of(
        model, "float32", contraction, "none", "none", packed, stored=stored, sampler=sampler
    )
    return [
        camera.camera_rays,
        assembly.render_forward_kernel(variant),
        *proposal_kernels(sampler, contraction, device),
    ]


def proposal_kernels(
    sampler: SamplerKind, contraction: Contraction, device: wp.Device, learns: bool = False
) -> list[wp.Kernel]:
    """Those that draw intervals where a sampler has a proposal.

    Args:
        sampler: Which one.
        contraction: The space.
        device: Where they run.
        learns: Whether the proposal does, and grows.
    """
    if sampler == MARCHED or SPACES[contraction].has_frustum:
        return []
    made = proposing_kernels(contraction, device)
    if not learns:
        return [made.propose_forward]
    own = class_of(DENSE).kernels(DENSE, ProposedDensity())
    return [made.propose_forward, made.propose_backward, made.add_bins, *own]


def warm_up(
    device: str = "cpu",
    on_kernel: Callable[[CompiledKernel], None] = lambda kernel: None,
    configs: Collection[TrainConfig] | None = None,
) -> list[CompiledKernel]:
    """Warm up the kernel cache: compile all that training and rendering need, in every scaling.

    Args:
        device: Where they are to run: cpu, cuda, cuda:1, ...
        on_kernel: Called with each kernel that is ready, one at a time, from any thread.
        configs: For which; None: the presets fast and quality.

    Returns:
        All of them.

    Raises:
        InputError: The device does not exist, or kernels can be kept nowhere.
    """
    workers = Workers(device)
    configs = [PRESETS[name] for name in DEFAULT_PRESETS] if configs is None else configs
    first = next(iter(configs), None)
    wanted: dict[wp.Module, tuple[str, wp.Kernel]] = {}
    for config in configs:
        model = config.model
        # What is compiled for the first model as well needs no name of its own.
        of_model = "" if first is None or model == first.model else f", {_options_of(model)}"
        for contraction in _contractions(config):
            sampler = config.sampler_in(SPACES[contraction])
            proposals = proposal_kernels(sampler, contraction, workers.device, learns=True)
            decided = _decided(config, contraction)
            for stored in dict.fromkeys(stored for stored, _ in decided):
                for kernel in rendering_kernels(
                    model, contraction, workers.device, stored, sampler
                ):
                    words = _words(kernel, contraction, stored) + of_model
                    wanted.setdefault(kernel.module, (words, kernel))
            for scaling, (stored, losses) in product(get_args(Scaling), decided):
                for kernel in training_kernels(
                    model,
                    contraction,
                    scaling,
                    config.jacobian,
                    workers.device,
                    losses,
                    stored,
                    sampler,
                    config.optim.near_decay > 0.0,
                    config.appearance != "none",
                ):
                    words = _words(kernel, contraction, stored, scaling, losses) + of_model
                    words += ", proposal" * (kernel in proposals)
                    wanted.setdefault(kernel.module, (words, kernel))
    names = {kernel: name for name, kernel in wanted.values()}
    missing = {kernel for kernel in names if not kernel_cache.is_compiled(kernel, workers.device)}
    ready: dict[wp.Kernel, CompiledKernel] = {}

    def note(kernel: wp.Kernel, seconds: float) -> None:
        compiled = kernel in missing
        ready[kernel] = CompiledKernel(name=names[kernel], compiled=compiled, seconds=seconds)
        on_kernel(ready[kernel])

    workers.load(*names, on_loaded=note)
    return [ready[kernel] for kernel in names]


def _contractions(config: TrainConfig) -> tuple[Contraction, ...]:
    """Those of a configuration; "auto" is none for bounded scenes, and linf or ndc for others.

    In ndc rays are marched only.
    """
    chosen = config.grid.contraction
    if chosen != "auto":
        return (chosen,)
    marches = config.sampler_in(SPACES["ndc"]) == MARCHED
    return ("none", "linf", "ndc") if marches else ("none", "linf")


def _decided(config: TrainConfig, contraction: Contraction) -> list[tuple[StorageKind, LossConfig]]:
    """Field and losses of the kinds of scenes that there are in such a space."""
    bounded = SPACES[contraction].bounded
    kinds: list[SceneKind] = ["object", "bounded"] if bounded else ["unbounded"]
    return list(
        dict.fromkeys((config.for_kind(kind).field, config.losses_for(kind)) for kind in kinds)
    )


def _options_of(model: Model) -> str:
    """A model's name, and what of it is not as by default."""
    chosen = [
        f"{field.name}={value}"
        for field in fields(model)  # type: ignore[arg-type]
        if (value := getattr(model, field.name)) != field.default
    ]
    return " ".join([model.name, *chosen])


def _words(
    kernel: wp.Kernel,
    contraction: Contraction,
    stored: StorageKind,
    scaling: Scaling | None = None,
    losses: LossConfig = PHOTOMETRIC_ONLY.config,
) -> str:
    """A kernel's name, and what it is compiled for where it has a module to itself."""
    name = str(kernel.key).rpartition("__")[2].replace("_", " ")
    kind = SPACES[contraction]
    space = "" if kind.bounded else ", contracted space" if kind.contracts else ", in NDC"
    if not name.startswith("render"):
        return name + space if name == "mark occupied" else name
    kinds = "".join(f", {kind}" for kind in losses.kinds)
    of_field = "" if stored == DENSE else f", field {stored.name}"
    return name + space + of_field + (f", scaling {scaling}" if scaling else "") + kinds
