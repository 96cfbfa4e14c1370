"""A batch of rays through a field with a decoder, and where its samples lie.

The field is one late in a training, or made of random numbers.
"""

from __future__ import annotations

import argparse
import itertools
import math
from dataclasses import dataclass, fields, replace

import numpy as np
import warp as wp
from candidates.warpnerf_step import WarpStep
from measuring import named
from models import train_until_late
from workload import MODELS, ModelName, Workload, split_network

import warpnerf as wn
from warpnerf.fields.decoded import Decoded
from warpnerf.fields.hashed import level_shapes
from warpnerf.fields.lattice import Lattice
from warpnerf.fields.occupancy import FreeCells
from warpnerf.fields.storages import class_of
from warpnerf.model.storage_kinds import Hash, storage_of
from warpnerf.rendering.steps import Steps
from warpnerf.runtime.parallel import Workers
from warpnerf.training.trainer import Trainer

FIELDS = ("vm", "hash")
"""What fields are stored in besides dense grids."""
OF_FIELDS: tuple[ModelName, ...] = ("deferred", "sh", "rgb")
"""Models whose samples are all read alike, which torch has with these."""


def add_fields(parser: argparse.ArgumentParser) -> None:
    """The option --fields, beside --models."""
    parser.add_argument(
        "--fields",
        nargs="+",
        default=["dense"],
        choices=["dense", *FIELDS],
        help=f"what raw values are stored in; other than dense: of {', '.join(OF_FIELDS)}",
    )


def models_of(
    parser: argparse.ArgumentParser, args: argparse.Namespace
) -> list[tuple[str, ModelName]]:
    """Fields and models that --fields and --models request; there is one, or the parser exits."""
    found = [
        (field, model)
        for field in args.fields
        for model in args.models
        if field == "dense" or model in OF_FIELDS
    ]
    if not found:
        parser.error(f"--fields {' '.join(args.fields)} goes with {', '.join(OF_FIELDS)}")
    return found


@dataclass(frozen=True, kw_only=True, eq=False)
class FieldWorkload(Workload):
    """Rays through a field that is no dense grid, in space that may be contracted."""

    trained: Decoded
    """The field; ``values`` have but the shape of its lattice."""
    march: Steps
    """How rays are marched."""
    positions_in_field: np.ndarray
    """[n_samples, 3] float32, contracted coordinates, ray by ray."""
    distances: np.ndarray
    """[n_samples] float32, scene units."""
    lengths: np.ndarray
    """[n_samples] float32 of steps, scene units."""
    ray_of_sample: np.ndarray
    """[n_samples] int64, in rising order."""

    def voxel_grid(self, workers: Workers) -> Decoded:
        """A copy of the field."""
        return self.trained.copied_to(workers.device)

    def free_cells(self, workers: Workers) -> FreeCells:
        """The free cells as warpnerf takes them."""
        return replace(super().free_cells(workers), border=self.trained.lattice.border)

    def steps(self) -> Steps:
        """The steps as warpnerf takes them."""
        return self.march


def late_field(
    scene: wn.Scene, model: ModelName, field: str, steps: int, voxels: int
) -> FieldWorkload:
    """Where a training stands at nine tenths of its schedule, and a batch of its rays.

    Args:
        scene: What is trained on.
        model: By name.
        field: The kind of storage, by name.
        steps: That the schedule is made for.
        voxels: Of the last lattice.
    """
    config = replace(wn.PRESETS["fast"], model=named(model), field=storage_of(field), steps=steps)
    config = replace(config, grid=replace(config.grid, voxels=voxels))
    state = train_until_late(scene, config)
    trainer = Trainer(scene, state.config, state)
    storage, march, batch = trainer.storage, trainer.march_steps(), trainer._sampler.draw(steps)
    assert isinstance(storage, Decoded)
    free = trainer.free.distance.numpy().reshape(trainer.free.size)
    origins, directions = batch.origins.numpy(), batch.directions.numpy()
    n_steps = steps_of(storage.lattice, march, origins)
    position, t, dt, ray = samples_of(storage.lattice, free, march, n_steps, origins, directions)
    work = FieldWorkload(
        values=np.empty((*storage.lattice.size, 0), np.float32),
        free=free,
        origins=origins,
        directions=directions,
        target_rgb=batch.target_rgb.numpy(),
        n_steps=n_steps,
        step=march.step,
        background=tuple(batch.background.numpy()[0].tolist()),
        content_distance=trainer.plan.content_distance,
        box=(storage.lattice.box_min, storage.lattice.box_max),
        density_shift=storage.density_shift,
        density_scale=storage.density_scale,
        transmittance_min=march.transmittance_min,
        model=model,
        network=split_network(MODELS[model], trainer.weights.numpy()),
        trained=storage,
        march=march,
        positions_in_field=position,
        distances=t,
        lengths=dt,
        ray_of_sample=ray,
    )
    # Where rays end, warpnerf says: after as many of these as it visits.
    ours = WarpStep(work, 1, "cpu")
    ours.step()
    counts = np.bincount(ray, minlength=len(origins))
    nth = np.arange(len(ray)) - np.repeat(np.cumsum(counts) - counts, counts)
    seen = nth < ours.samples_of_rays()[ray]
    return replace(
        work,
        positions_in_field=position[seen],
        distances=t[seen],
        lengths=dt[seen],
        ray_of_sample=ray[seen],
    )


def made_field(field: str, work: Workload, seed: int = 0) -> FieldWorkload:
    """The rays of a workload through a field of random numbers, in all of the box.

    Entries are standard normal, and what decodes them keeps about that size. Finer levels of a hash
    have smaller entries, as trained ones have.

    Args:
        field: The kind of storage, by name.
        work: Of a dense grid, of which nodes along each axis, rays and steps are taken.
        seed: Of the numbers.
    """
    kind, device = storage_of(field), wp.get_device("cpu")
    size = work.values.shape[:3]
    lattice = Lattice(size=(size[0], size[1], size[2]), box_min=work.box[0], box_max=work.box[1])
    model, rng = work.warp_model(), np.random.default_rng(seed)
    made = class_of(kind).first(kind, model, lattice, seed, device)
    assert isinstance(made, Decoded)
    tensors = {
        name: rng.normal(size=values.shape).astype(np.float32)
        for name, values in made.tensors().items()
    }
    tensors["decoder"] /= math.sqrt(len(tensors["decoder"]))
    tensors["decoder"][:, made.n_decoded :] = 0.0  # padding
    if isinstance(kind, Hash):
        for level, cells in zip(level_shapes(kind, lattice), kind.resolutions, strict=True):
            tensors["values"][level.begin : level.end] *= kind.coarsest / cells
    made = type(made).from_tensors(kind, model, lattice, tensors, device)
    made = replace(made, density_shift=work.density_shift, density_scale=work.density_scale)
    position, t, dt, ray = samples_of(
        lattice, work.free, work.steps(), work.n_steps, work.origins, work.directions
    )
    plain = {one.name: getattr(work, one.name) for one in fields(work)}
    return FieldWorkload(
        **plain | {"values": np.empty((*size, 0), np.float32)},
        trained=made,
        march=work.steps(),
        positions_in_field=position,
        distances=t,
        lengths=dt,
        ray_of_sample=ray,
    )


def steps_of(lattice: Lattice, march: Steps, origins: np.ndarray) -> int:
    """So many reach the end of what is sampled: far, or the farthest corner of the box."""
    if lattice.contracted:
        return march.most(np.inf)
    corners = itertools.product(*zip(lattice.box_min, lattice.box_max, strict=True))
    reach = np.linalg.norm(origins[:, None] - np.array(list(corners)), axis=2).max()
    return math.ceil((reach - march.near) / march.step)


def samples_of(
    lattice: Lattice,
    free: np.ndarray,
    march: Steps,
    n_steps: int,
    origins: np.ndarray,
    directions: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Samples of rays that no light ends, those in free cells left out.

    Args:
        lattice: Of the field.
        free: [MX, MY, MZ] cells to the nearest one that is not free.
        march: Samples lie in the middle of steps.
        n_steps: Of each ray, at most.
        origins: [n_rays, 3] scene units.
        directions: [n_rays, 3] of unit length.

    Returns:
        Contracted coordinates [n_samples, 3], distances, lengths of steps, and rays.
    """
    k = np.arange(n_steps)
    begin, dt = march.near + k * march.step, np.full(len(k), march.step)
    if march.growth:
        linear = march.near + march.n_linear * march.step
        grown = linear * (1.0 + march.growth) ** np.maximum(k - march.n_linear, 0)
        begin = np.where(k < march.n_linear, begin, grown)
        dt = np.where(k < march.n_linear, dt, grown * march.growth)
    t = begin + 0.5 * dt
    t, dt = t[t < march.far], dt[t < march.far]
    half = 0.5 * np.array(free.shape) / (1.0 + lattice.border)
    found = []
    for ray, (origin, direction) in enumerate(zip(origins, directions, strict=True)):
        points = origin.astype(float) + t[:, None] * direction
        c = lattice.kind.contracted(lattice, points)
        cell = np.clip(((c + 1.0 + lattice.border) * half).astype(int), 0, np.array(free.shape) - 1)
        met = (np.abs(c) <= 1.0 + lattice.border).all(axis=1) & (free[tuple(cell.T)] == 0)
        found.append((c[met], t[met], dt[met], np.full(met.sum(), ray)))
    c, t, dt, rays = (np.concatenate(arrays) for arrays in zip(*found, strict=True))
    return c.astype(np.float32), t.astype(np.float32), dt.astype(np.float32), rays
