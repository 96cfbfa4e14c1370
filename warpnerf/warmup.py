"""Which kernels a training needs, and having them compiled before anyone waits for them."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import get_args

import warp as wp
from warpnerf_kernels import adam, camera, interp, occupancy, regularize, render

from warpnerf import kernel_cache
from warpnerf.config import PRESETS, Contraction, Jacobian, Scaling
from warpnerf.grid import CONTRACTIONS
from warpnerf.parallel import Workers
from warpnerf.render import JACOBIANS, SCALINGS


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
    contraction: Contraction, scaling: Scaling, jacobian: Jacobian, device: wp.Device
) -> list[wp.Kernel]:
    """The kernels of a training from its first step to its last; at least one for each module.

    Kernels that share a module with one of these are compiled along with it.
    """
    variant = _variant(contraction, scaling, jacobian, device)
    return [
        camera.sample_pixels,
        render.render_train_kernel(variant),
        regularize.total_variation_backward,
        adam.adam_step,
        occupancy.mark_occupied,
        interp.resample,
    ]


def rendering_kernels(contraction: Contraction, device: wp.Device) -> list[wp.Kernel]:
    """The kernels that look at a field; likewise."""
    variant = _variant(contraction, "none", "none", device)
    return [camera.camera_rays, render.render_forward_kernel(variant)]


def warm_up(
    device: str = "cpu", on_kernel: Callable[[Warmed], None] = lambda kernel: None
) -> list[Warmed]:
    """Compile whatever training and rendering with the presets need, in every scaling.

    Args:
        device: Where they are to run: cpu, cuda, cuda:1, ...
        on_kernel: Called with each kernel that is ready.

    Returns:
        All of them.

    Raises:
        InputError: The device does not exist, or kernels can be kept nowhere.
    """
    workers = Workers(device, 1)
    wanted: dict[wp.Module, tuple[str, wp.Kernel]] = {}
    for contraction in _contractions():
        for kernel in rendering_kernels(contraction, workers.device):
            wanted.setdefault(kernel.module, (_words(kernel, contraction), kernel))
        for jacobian in dict.fromkeys(preset.jacobian for preset in PRESETS.values()):
            for scaling in get_args(Scaling):
                for kernel in training_kernels(contraction, scaling, jacobian, workers.device):
                    words = _words(kernel, contraction, scaling)
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


def _variant(
    contraction: Contraction, scaling: Scaling, jacobian: Jacobian, device: wp.Device
) -> render.Variant:
    return render.Variant(
        CONTRACTIONS[contraction],
        SCALINGS[scaling],
        JACOBIANS[jacobian],
        packed=not device.is_cuda,
    )


def _contractions() -> list[Contraction]:
    """Those of the presets; "auto" is none for bounded scenes and linf for others."""
    found: dict[Contraction, None] = {}
    for preset in PRESETS.values():
        chosen = preset.grid.contraction
        found |= dict.fromkeys(("none", "linf") if chosen == "auto" else (chosen,))
    return list(found)


def _words(kernel: wp.Kernel, contraction: Contraction, scaling: Scaling | None = None) -> str:
    """A kernel's name, and what it is compiled for where it has a module to itself."""
    name = str(kernel.key).rpartition("__")[2].replace("_", " ")
    if not name.startswith("render"):
        return name
    space = "" if contraction == "none" else ", space folded in"
    return name + space + (f", scaling {scaling}" if scaling else "")
