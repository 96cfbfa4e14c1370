"""What launches take: the variant of their kernels, and the structs that these read and write."""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import warp as wp
from warpnerf_kernels.volume import gradscale

from warpnerf.config import Jacobian, LossConfig, Scaling
from warpnerf.fields.occupancy import FreeCells
from warpnerf.fields.storage import Storage
from warpnerf.grid_config import Contraction
from warpnerf.model.interface import Model, loader
from warpnerf.model.sampler_kinds import CLIPPED, MARCHED, SamplerKind
from warpnerf.model.spaces import part_of
from warpnerf.model.storage_kinds import DENSE, StorageKind
from warpnerf.rendering.losses import PHOTOMETRIC_ONLY, Objective, loss_struct, parts_with
from warpnerf.rendering.proposal import Intervals
from warpnerf.rendering.steps import ClippedSteps, Steps
from warpnerf.runtime.parallel import Workers

AnySteps = Steps | ClippedSteps | Intervals
"""How rays are marched, or where else their samples lie."""

SCALINGS = {
    "none": gradscale.NONE,
    "quadratic": gradscale.QUADRATIC,
    "clamped": gradscale.CLAMPED,
}
JACOBIANS = {
    "none": gradscale.JACOBIAN_NONE,
    "density": gradscale.JACOBIAN_DENSITY,
    "paper": gradscale.JACOBIAN_PAPER,
}


@dataclass(frozen=True, kw_only=True, eq=False)
class FieldStructs:
    """A field as kernels take it, in their precision and on their device."""

    box: Any
    """A kernel's Box."""
    free: Any
    """A kernel's FreeSpace."""
    values: Any
    """The ``Params`` of the encoding."""
    density: Any
    """A kernel's Density."""
    weights: wp.array
    """[n_weights] of the head."""

    @staticmethod
    def of(
        storage: Storage,
        weights: wp.array,
        free: FreeCells,
        steps: AnySteps,
        workers: Workers,
    ) -> FieldStructs:
        """Those of a storage, in float32.

        Args:
            storage: Which one.
            weights: [n_weights] of the head.
            free: What of it is skipped.
            steps: How it will be marched through.
            workers: Those that will be launched.
        """
        return FieldStructs(
            box=storage.lattice.box_between(steps.near, steps.far),
            free=free.struct,
            values=storage.struct_in(loader("float32"), workers),
            density=storage.density,
            weights=weights,
        )


def variant_of(
    model: Model,
    precision: str,
    contraction: Contraction,
    scaling: Scaling,
    jacobian: Jacobian,
    packed: bool,
    losses: LossConfig = PHOTOMETRIC_ONLY.config,
    stored: StorageKind = DENSE,
    sampler: SamplerKind = MARCHED,
) -> Any:
    """What to compile for a model.

    Args:
        model: Which one.
        precision: float32 or float64.
        contraction: Of the grid.
        scaling: Of gradients.
        jacobian: Its term.
        packed: Sixteen samples at a time, where the space and all parts of the model have such a
            form.
        losses: What a training launch minimises; it is compiled for those of a weight above 0.
        stored: What the field's raw values are stored in.
        sampler: Where samples lie.

    Returns:
        ``warpnerf_kernels.launch.assembly.Variant`` in that precision.
    """
    parts = parts_with(model, precision, losses, stored, sampler)
    space = part_of(contraction, precision)
    return loader(precision)("launch.assembly").Variant(
        parts,
        space,
        SCALINGS[scaling],
        JACOBIANS[jacobian],
        packed=packed and parts.have_packs and space.vectors is not None,
    )


def render_params_struct(
    model: Model,
    precision: str,
    field: FieldStructs,
    steps: AnySteps,
    workers: Workers,
    *,
    objective: Objective = PHOTOMETRIC_ONLY,
    stored: StorageKind = DENSE,
) -> Any:
    """What rays are marched through, as kernels take it.

    Args:
        model: Which one.
        precision: float32 or float64.
        field: What they are marched through, in that precision.
        steps: How to march.
        workers: Those that will be launched.
        objective: By a training launch.
        stored: What the field's raw values are stored in.

    Returns:
        A kernel's Scene.
    """
    load = loader(precision)
    parts = parts_with(model, precision, objective.config, stored, sampler_of(steps))
    scene = load("launch.assembly").render_params_type(parts)()
    scene.box, scene.free = field.box, field.free
    scene.field, scene.density = field.values, field.density
    scene.march = march_struct(model, precision, steps, workers)
    scene.loss = loss_struct(model, precision, objective)
    layout = model.layout(load)
    if layout is not None:
        head = load("networks.mlp").Weights()
        head.values = weights = field.weights
        head.width = layout.width
        row = -(-layout.n_transposed // 16) * 16  # whole cache lines
        head.transposed = wp.zeros((workers.count, row), dtype=weights.dtype, device=workers.device)
        scene.head = head
    return scene


def sampler_of(steps: AnySteps) -> SamplerKind:
    """The kind that places samples: that of intervals, or a march, of whole rays or parts."""
    if isinstance(steps, Intervals):
        return steps.kind
    return CLIPPED if isinstance(steps, ClippedSteps) else MARCHED


def most_samples(model: Model, steps: AnySteps, length: float) -> int:
    """How many samples a ray can have; see ``Model.most_steps``."""
    if isinstance(steps, Intervals):
        return steps.kind.samples
    return model.most_steps(steps.steps if isinstance(steps, ClippedSteps) else steps, length)


def march_struct(model: Model, precision: str, steps: AnySteps, workers: Workers) -> Any:
    """The parameters of a model's sampler, as kernels take them.

    Args:
        model: Which one.
        precision: float32 or float64.
        steps: How to march.
        workers: Those that will be launched.

    Returns:
        A kernel's ``Params`` of the sampler.
    """
    load = loader(precision)
    if isinstance(steps, Intervals):
        return steps.struct(load)
    if isinstance(steps, ClippedSteps):
        params = parts_with(
            model, precision, PHOTOMETRIC_ONLY.config, sampler=CLIPPED
        ).sampler.Params()
        params.steps = model.march(load, steps.steps, workers.device)
        params.ends, params.near, params.far = steps.ends, steps.near, steps.far
        params.transmittance_min = steps.steps.transmittance_min
        return params
    return model.march(load, steps, workers.device)


def scratch_struct(variant: Any, n_packs: int, workers: Workers, assembly: ModuleType) -> Any:
    """Where the workers of a launch keep rays between the passes.

    Args:
        variant: Of the kernel to launch.
        n_packs: What each worker keeps, if in packs, besides those that it does not keep. Scalar
            kernels, which CUDA runs, keep nothing:
            with all rays under way at once, reading a sample again is the cheaper way.
        workers: Where to work.
        assembly: ``warpnerf_kernels.launch.assembly`` in the variant's precision.

    Returns:
        A kernel's Scratch.
    """
    Scratch = assembly.scratch_type(variant)
    scratch = Scratch()
    if variant.packed:
        fields, n = Scratch.vars, workers.count
        scratch.capacity = capacity = n_packs + variant.parts.head.vectors.n_packs
        scratch.packs = wp.empty(n * capacity, dtype=fields["packs"].type.dtype, device="cpu")
        scratch.rows = wp.empty(n * variant.batch, dtype=fields["rows"].type.dtype, device="cpu")
    return scratch


def render_outputs_struct(variant: Any, n_rays: int, workers: Workers, assembly: ModuleType) -> Any:
    """Room for what the rays of a forward launch see.

    Args:
        variant: Of the kernel to launch.
        n_rays: How many.
        workers: Where to work.
        assembly: ``warpnerf_kernels.launch.assembly`` in the variant's precision.

    Returns:
        A kernel's RenderOutputs.
    """
    RenderOutputs = assembly.render_outputs_type(variant.parts.head.n_channels)
    rendered = RenderOutputs()
    for name, variable in RenderOutputs.vars.items():
        room = wp.empty(n_rays, dtype=variable.type.dtype, device=workers.device)
        setattr(rendered, name, room)
    return rendered


def train_outputs(n_rays: int, precision: str, workers: Workers) -> Any:
    """Room for what a training launch tells of rays.

    Args:
        n_rays: How many.
        precision: float32 or float64.
        workers: Where to work.

    Returns:
        A kernel's TrainOutputs, zeros.
    """
    load, device = loader(precision), workers.device
    outputs, real = load("launch.assembly").TrainOutputs(), load("base.types").real
    outputs.rgb = wp.zeros(n_rays, dtype=load("base.types").vec3, device=device)
    outputs.error = wp.zeros(n_rays, dtype=real, device=device)
    outputs.loss = wp.zeros(n_rays, dtype=real, device=device)
    outputs.n_samples = wp.zeros(n_rays, dtype=wp.int32, device=device)
    return outputs
