"""Exports of scenes in blocks: surfaces and splats of all cores, joined."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from warpnerf.blocks.folder import BlockFolder
from warpnerf.checks import InputError
from warpnerf.exporting import mesh, splats, spz, surface
from warpnerf.exporting.export import MESHES, SPLATS, SURFACES, checked_ending
from warpnerf.exporting.splats import Splats
from warpnerf.exporting.surface import NothingThereError, Surface
from warpnerf.exporting.visibility_file import cached_visibility
from warpnerf.runs.scene import load_run_scene
from warpnerf.scenes.cameras.focus import up_direction
from warpnerf.writing import StagedWrites

JOINED = tuple(ending for ending in (*MESHES, ".points.ply", *SPLATS) if ending != ".html")
"""Endings of files that can be written of blocks."""


@dataclass(frozen=True, kw_only=True)
class OfCores:
    """How surfaces and splats of cores are made; see ``export``."""

    unseen: bool = False
    """Write what no training camera sees, too."""
    level: float | None = None
    """Of surfaces."""
    min_size: float | None = None
    """Of surfaces."""
    fill: float | None = None
    """Of surfaces."""


def export_blocks(
    blocks: BlockFolder,
    paths: Sequence[Path],
    how: OfCores,
    device: str,
    threads: int | None,
    on_block: Callable[[int], None],
) -> list[str]:
    """Export a scene in blocks: what each block has in its core, one after the other, joined.

    What the training cameras of a block see of its field is written; around the box of the scene
    nothing is. Surfaces of two blocks meet at a face to about a voxel.

    Args:
        blocks: Trained.
        paths: Of the files, which are replaced: meshes, points and splats.
        how: See there.
        device: Where fields live, one at a time.
        threads: CPU threads; None: one per usable core.
        on_block: Called with the number of blocks that are done.

    Returns:
        What blocks have nothing of, a sentence each.

    Raises:
        InputError: A block is missing, a value is wrong, a format cannot be joined, or no block has
            what it holds.
        OSError: A file cannot be written; what was there before is left as it was.
    """
    endings = [checked_ending(path) for path in paths]
    for path, ending in zip(paths, endings, strict=True):
        if ending not in JOINED:
            raise InputError(
                f"{path}: is made of one field, and {blocks.folder} has {len(blocks)}; write "
                f"{', '.join(JOINED)} of it, or export one of them, such as {blocks.run(0).folder}."
            )
    configs = [blocks.run_config(number) for number in range(len(blocks))]
    surfaces: list[Surface] = []
    clouds: list[Splats] = []
    empty: list[str] = []
    ups = []
    for number, config in enumerate(configs):
        run, entry = blocks.run(number), blocks.config.blocks[number]
        field, _ = run.load_field(device, threads)
        surface.check_options(field, how.level, None, how.min_size, how.fill)
        part = load_run_scene(config, str(blocks.part(number)), threads)
        views = [part.views[index] for index in part.splits["train"]]
        seen = cached_visibility(field, views, run.visibility_file, None)
        ups.append(up_direction(part.training_cameras))
        crop = entry.core_min, entry.core_max
        try:
            if {*endings} & {*SURFACES}:
                made = surface.extract_surface(
                    field,
                    seen,
                    unseen=how.unseen,
                    level=how.level,
                    crop=crop,
                    min_size=how.min_size,
                    fill=how.fill,
                )
                surfaces.append(made)
        except NothingThereError as error:  # sky, or the inside of a hill
            empty.append(f"{blocks.name(number)} has no surface: {error}")
        try:
            if {*endings} & {*SPLATS}:
                clouds.append(splats.splats_of(field, seen, unseen=how.unseen, crop=crop))
        except NothingThereError as error:
            empty.append(f"{blocks.name(number)} has no splats: {error}")
        on_block(number + 1)
    up, offset = _unit(np.mean(ups, axis=0)), blocks.config.offset
    away = None if offset is None else np.array(offset)
    with StagedWrites() as staged:
        for path, ending in zip(paths, endings, strict=True):
            staged.add(path, *_pieces(ending, surfaces, clouds, up, away))
    return empty


def _pieces(
    ending: str,
    surfaces: Sequence[Surface],
    clouds: Sequence[Splats],
    up: np.ndarray,
    offset: np.ndarray | None,
) -> list[bytes]:
    """The pieces of the file of a format."""
    if ending == ".splat.ply":
        return splats.splats_ply(_joined_splats(clouds), up, offset)
    if ending == ".spz":
        return spz.splats_spz(_joined_splats(clouds), up)
    if ending == ".glb":
        return mesh.mesh_glb(_joined_surfaces(surfaces, None), up, offset)
    write = {".points.ply": mesh.points_ply, ".obj": mesh.mesh_obj, ".ply": mesh.mesh_ply}[ending]
    return write(_joined_surfaces(surfaces, offset))


def _joined_surfaces(surfaces: Sequence[Surface], offset: np.ndarray | None) -> Surface:
    """All triangles as one mesh, moved by an offset."""
    if not surfaces:
        raise InputError("no block has a surface; use a lower --level.")
    first = np.cumsum([0, *(len(one.points) for one in surfaces[:-1])])
    points = np.concatenate([one.points for one in surfaces])
    return Surface(
        points=points if offset is None else points + offset,
        faces=np.concatenate(
            [one.faces + np.int32(n) for one, n in zip(surfaces, first, strict=True)]
        ),
        normals=np.concatenate([one.normals for one in surfaces]),
        rgb=np.concatenate([one.rgb for one in surfaces]),
    )


def _joined_splats(clouds: Sequence[Splats]) -> Splats:
    """All splats."""
    if not clouds:
        raise InputError("no block has splats; train the blocks for longer.")
    return Splats(
        **{name: np.concatenate([vars(c)[name] for c in clouds]) for name in vars(clouds[0])}
    )


def _unit(vector: np.ndarray) -> np.ndarray:
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-9))
