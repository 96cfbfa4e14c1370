"""Whether a field that is to be trained fits the memory of its device."""

from __future__ import annotations

import math

import warp as wp

from warpnerf.checks import InputError
from warpnerf.grid_config import MAX_VOXELS
from warpnerf.model.interface import Model
from warpnerf.model.storage_kinds import StorageKind
from warpnerf.runtime.memory import processes_here, usable_memory


def require_memory(
    kind: StorageKind, model: Model, size: tuple[int, int, int], device: wp.Device, besides: int = 0
) -> None:
    """Raise InputError if training a field of this size does not fit the memory of the device.

    Args:
        kind: Of its storage.
        model: What is stored.
        size: Nodes of the lattice along each axis.
        device: Where it is to be trained.
        besides: Bytes that rays and sampler take besides the field.

    Raises:
        InputError: It does not, or kernels cannot count so many nodes.
    """
    if math.prod(size) >= MAX_VOXELS:
        raise InputError(
            f"grid.voxels must give fewer than {MAX_VOXELS} nodes, not {math.prod(size)}; use "
            "fewer voxels."
        )
    own = kind.training_bytes(model, size)
    total = device.total_memory if device.is_cuda else usable_memory()
    where = str(device) if device.is_cuda else "this machine"
    if not device.is_cuda and processes_here() > 1:
        where = f"each of {processes_here()} processes on this machine"
    if total is None or own + besides <= total:
        return
    both = f"of the {(own + besides) / 2**30:.1f} GiB that training needs"
    there_is = f"but {where} has {total / 2**30:.1f} GiB"
    if besides > own:
        raise InputError(
            f"rays_per_step: {both}, the rays of an update, and what the sampler keeps, are "
            f"{besides / 2**30:.1f} GiB, {there_is}; use fewer, fewer steps an update "
            "(optim.accumulate_at), or fewer voxels of the sampler."
        )
    raise InputError(
        f"grid.voxels: {both}, {kind.in_words(model, size)} is {own / 2**30:.1f} GiB, "
        f"{there_is}; use fewer voxels, or a model with fewer features."
    )
