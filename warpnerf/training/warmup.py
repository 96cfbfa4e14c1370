"""Which kernels a training needs, and having them compiled before anyone waits for them."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection
from dataclasses import dataclass, fields
from itertools import product
from typing import get_args

import warp as wp
from warpnerf_kernels.fields import dense, dense_bound
from warpnerf_kernels.launch import assembly
from warpnerf_kernels.optim import adam, total_variation
from warpnerf_kernels.sampling import coverage, occupancy
from warpnerf_kernels.space import camera

from warpnerf.config import (
    Contraction,
    Jacobian,
    LossConfig,
    Scaling,
    SceneKind,
    TrainConfig,
)
from warpnerf.model.interface import Model
from warpnerf.presets import EVERYDAY, PRESETS
from warpnerf.rendering.losses import PLAIN
from warpnerf.rendering.render import variant_of
from warpnerf.runtime import kernel_cache
from warpnerf.runtime.parallel import Workers


@dataclass(frozen=True, kw_only=True)
class Warmed:
    """A kernel that is ready."""

    name: str
    """What it is, in words."""
    compiled: bool
    """Whether it had to be compiled; else it was in the cache."""
    seconds: float
    """How long that took."""


def training_kernels(
    model: Model,
    contraction: Contraction,
    scaling: Scaling,
    jacobian: Jacobian,
    device: wp.Device,
    losses: LossConfig,
) -> list[wp.Kernel]:
    """The kernels of a training from its first step to its last; at least one for each module.

    Kernels that share a module with one of these are compiled along with it.
    """
    n_floats, packed = model.n_floats, not device.is_cuda
    variant = variant_of(model, "float32", contraction, scaling, jacobian, packed, losses)
    return [
        camera.sample_pixels,
        assembly.render_train_kernel(variant),
        total_variation.total_variation_backward_kernel(n_floats),
        adam.adam_kernel(n_floats),
        adam.adam_weights,
        adam.resample_moments_kernel(n_floats),
        dense_bound.find_highest_kernel(n_floats),
        dense_bound.join_highest,
        occupancy.mark_occupied_kernel(variant.parts.sampler),
        occupancy.spread_distance,
        coverage.cover_blocks,
        dense.resample_kernel(n_floats),
    ]


def rendering_kernels(model: Model, contraction: Contraction, device: wp.Device) -> list[wp.Kernel]:
    """The kernels that render a field; at least one for each module."""
    packed = not device.is_cuda
    variant = variant_of(model, "float32", contraction, "none", "none", packed)
    return [camera.camera_rays, assembly.render_forward_kernel(variant)]


def warm_up(
    device: str = "cpu",
    on_kernel: Callable[[Warmed], None] = lambda kernel: None,
    configs: Collection[TrainConfig] | None = None,
) -> list[Warmed]:
    """Compile whatever trainings and rendering need, in every scaling.

    Args:
        device: Where they are to run: cpu, cuda, cuda:1, ...
        on_kernel: Called with each kernel that is ready.
        configs: For which; None: the presets fast and quality.

    Returns:
        All of them.

    Raises:
        InputError: The device does not exist, or kernels can be kept nowhere.
    """
    workers = Workers(device, 1)
    configs = [PRESETS[name] for name in EVERYDAY] if configs is None else configs
    first = next(iter(configs), None)
    wanted: dict[wp.Module, tuple[str, wp.Kernel]] = {}
    for config in configs:
        model = config.model
        # What is compiled for the first model as well needs no name of its own.
        of_model = "" if first is None or model == first.model else f", {_options_of(model)}"
        for contraction in _contractions(config):
            for kernel in rendering_kernels(model, contraction, workers.device):
                words = _words(kernel, contraction) + of_model
                wanted.setdefault(kernel.module, (words, kernel))
            for scaling, losses in product(get_args(Scaling), _losses(config, contraction)):
                for kernel in training_kernels(
                    model, contraction, scaling, config.jacobian, workers.device, losses
                ):
                    words = _words(kernel, contraction, scaling, losses) + of_model
                    wanted.setdefault(kernel.module, (words, kernel))
    done = []
    for name, kernel in wanted.values():
        compiled = not kernel_cache.is_compiled(kernel, workers.device)
        start = time.perf_counter()
        workers.load(kernel)
        seconds = time.perf_counter() - start
        done.append(Warmed(name=name, compiled=compiled, seconds=seconds))
        on_kernel(done[-1])
    return done


def _contractions(config: TrainConfig) -> tuple[Contraction, ...]:
    """Those of a configuration; "auto" is none for bounded scenes, and linf or ndc for others."""
    chosen = config.grid.contraction
    return ("none", "linf", "ndc") if chosen == "auto" else (chosen,)


def _losses(config: TrainConfig, contraction: Contraction) -> list[LossConfig]:
    """Those of the kinds of scenes that there are in such a space."""
    kinds: list[SceneKind] = ["object", "bounded"] if contraction == "none" else ["unbounded"]
    return list(dict.fromkeys(config.losses_for(kind) for kind in kinds))


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
    scaling: Scaling | None = None,
    losses: LossConfig = PLAIN.config,
) -> str:
    """A kernel's name, and what it is compiled for where it has a module to itself."""
    name = str(kernel.key).rpartition("__")[2].replace("_", " ")
    if not name.startswith("render"):
        return name
    space = {"none": "", "ndc": ", in NDC"}.get(contraction, ", space folded in")
    kinds = "".join(f", {kind}" for kind in losses.kinds)
    return name + space + (f", scaling {scaling}" if scaling else "") + kinds
