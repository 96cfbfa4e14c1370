"""Progressive growing: the first grid of a training, and its upsampling to more voxels."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import warp as wp

from warpnerf.config import TrainConfig
from warpnerf.fields.lattice import Lattice
from warpnerf.fields.parameters import Parameter
from warpnerf.fields.storage import Storage, TrainedOn
from warpnerf.fields.storages import class_of
from warpnerf.fields.training_memory import require_memory
from warpnerf.model.interface import Model
from warpnerf.runtime.parallel import Workers
from warpnerf.scenes.extent.space import grid_size
from warpnerf.scenes.scene import Scene
from warpnerf.training.optim import OPTIMISERS
from warpnerf.training.plan import TrainingPlan, bytes_of_rays


def require_room(plan: TrainingPlan, device: wp.Device) -> None:
    """Raise InputError if training the final field of a plan does not fit the device's memory."""
    config = plan.config
    of_rays = bytes_of_rays(config, plan.schedule, plan.sampler)
    require_memory(config.field, _model(config), plan.stages[-1].size, device, of_rays)


MOST_AVERAGED = 4.0
"""Edge of the largest square that pixels are averaged over."""


def averaged_over(plan: TrainingPlan, grown: int) -> float:
    """The edge of the square that pixels are averaged over, 1 to MOST_AVERAGED pixels.

    What is finer than a grid's voxels is noise to it. Voxels count as wide as numbers of nodes say,
    and those of the final grid as a pixel. Bounded scenes without alpha are trained on single
    pixels: the built-in room loses by averages (docs/decisions/average-pixels.md).

    Args:
        plan: Of the training.
        grown: How often the grid has grown.
    """
    if not plan.config.average_pixels or plan.kind == "bounded":
        return 1.0
    edge = (plan.stages[-1].nodes / plan.stages[grown].nodes) ** (1.0 / 3.0)
    return min(edge, MOST_AVERAGED)


def trained_on(scene: Scene, plan: TrainingPlan) -> TrainedOn:
    """What the regularisation of each grid may know of a training.

    Args:
        scene: Its training cameras are those of the plan.
        plan: Of the training.
    """
    config = plan.config
    return TrainedOn(
        model=_model(config),
        optim=config.optim,
        voxels=config.grid.n_nodes,
        cameras=scene.training_cameras,
        distances=plan.content_distances,
        near=config.march.near,
        scaling=config.scaling,
    )


def first_storage(plan: TrainingPlan, device: wp.Device) -> Storage:
    """What the field is stored in before the first update.

    Args:
        plan: Of the training.
        device: Where it lies.

    Raises:
        ValueError: Its parameters are others than its kind's ``rules`` say.
    """
    config, space = plan.config, plan.space
    voxel = float(space.voxel_edges(plan.stages[-1].size).min())
    lattice = Lattice.over(space, plan.stages[0].size)
    storage = class_of(config.field).first(
        config.field, _model(config), lattice, config.seed, device
    )
    found = {p.name: p.rule for p in storage.parameters(_model(config), config.optim)}
    if list(found.items()) != list(config.field.rules.items()):
        raise ValueError(
            f"field {config.field.name!r}: its storage has the parameters {found}, by name and "
            f"rule, but its kind's rules are {dict(config.field.rules)}"
        )
    return replace(
        storage,
        # softplus(shift) is the optical depth of a voxel of the final lattice.
        density_shift=math.log(math.expm1(-math.log1p(-config.grid.alpha_init))),
        density_scale=1.0 / voxel,
    )


def grown_storage(
    storage: Storage,
    box: tuple[np.ndarray, np.ndarray],
    nodes: int,
    shift: float,
    workers: Workers,
) -> Storage:
    """The same field upsampled to more nodes.

    Args:
        storage: As it stands.
        box: Corners of the new lattice's box, within this one's.
        nodes: How many it has, about.
        shift: Taken from all raw densities, before their activation.
        workers: Where to work.
    """
    tight = replace(storage.lattice, box_min=box[0], box_max=box[1])
    grown = storage.resized(workers, Lattice.over(tight, grid_size(tight.extent, nodes)))
    return replace(grown, density_shift=grown.density_shift - shift)


def grown_states(
    states: dict[str, dict[str, wp.array]],
    parameters: tuple[Parameter, ...],
    storage: Storage,
    grown: Storage,
    workers: Workers,
) -> dict[str, dict[str, wp.array]]:
    """Optimiser state, carried over to a grown lattice.

    Args:
        states: Of each parameter, by its name.
        parameters: Those before.
        storage: Before.
        grown: Afterwards.
        workers: Where to work.
    """
    return {
        p.name: OPTIMISERS[p.rule].resized(p.name, states[p.name], storage, grown, workers)
        for p in parameters
    }


def _model(config: TrainConfig) -> Model:
    assert isinstance(config.model, Model)
    return config.model
