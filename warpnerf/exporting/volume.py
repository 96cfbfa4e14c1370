"""Export of density and colour as a voxel volume: numpy's .npz and NanoVDB's .nvdb."""

from __future__ import annotations

import io
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import warp as wp

from warpnerf.checks import InputError
from warpnerf.exporting.colour import colours
from warpnerf.exporting.surface import Crop, checked_crop, density, normals_at, raw_density
from warpnerf.exporting.visibility import SEEN, Visibility
from warpnerf.fields.nodes import nodes_of, points_of
from warpnerf.rendering.field import Field


@dataclass(frozen=True, kw_only=True, eq=False)
class Volume:
    """A voxel volume: a block of a field's nodes, at equal distances."""

    density: np.ndarray
    """[X, Y, Z] float32, 1 / scene unit; 0 in what is left out."""
    rgb: np.ndarray
    """[X, Y, Z, 3] uint8, sRGB as in the photographs; 0 in what is left out."""
    seen: np.ndarray
    """[X, Y, Z] bool, whether a training camera sees it; true where it is not known."""
    box_min: np.ndarray
    """[3] float64, the first node, scene units."""
    box_max: np.ndarray
    """[3] float64, the last node."""

    def moved(self, by: np.ndarray) -> Volume:
        """The volume elsewhere, by [3] scene units."""
        return replace(self, box_min=self.box_min + by, box_max=self.box_max + by)


def volume_of(
    field: Field,
    visibility: Visibility | None = None,
    *,
    unseen: bool = False,
    crop: Crop | None = None,
) -> Volume:
    """The nodes of a field in a box, without what lies outside of the field's own.

    Args:
        field: A trained field.
        visibility: From the cameras of its training, as for ``extract_surface``: what none sees is
            empty.
        unseen: Keep what no camera sees, too.
        crop: The box; None: the field's.

    Returns:
        The volume.

    Raises:
        InputError: The crop is no box, or holds no two nodes along an axis; or the field is one in
            normalised device coordinates.
    """
    lattice = field.lattice
    first, last = checked_block(field, crop)
    block = tuple(slice(a, b + 1) for a, b in zip(first, last, strict=True))
    corners = points_of(lattice, np.stack([first, last]))
    raw = raw_density(field)
    seen = np.ones(lattice.size, bool) if visibility is None else visibility.light > SEEN
    sigma, seen = density(field, raw[block]), seen[block]
    there = np.ones_like(seen) if unseen else seen
    points = points_of(lattice, np.argwhere(there) + first)
    rgb = np.zeros((*seen.shape, 3), np.uint8)
    rgb[there] = np.round(
        255.0 * colours(field, visibility, points, normals_at(field, raw, points))
    )
    return Volume(
        density=np.where(there, sigma, np.float32(0.0)),
        rgb=rgb,
        seen=seen,
        box_min=corners[0],
        box_max=corners[1],
    )


def checked_block(field: Field, crop: Crop | None) -> tuple[np.ndarray, np.ndarray]:
    """The first and the last node of a volume along each axis, [3] int.

    Raises:
        InputError: As ``volume_of``.
    """
    lattice = field.lattice
    if lattice.frustum is not None:
        raise InputError(
            "a volume has voxels of one size, but this field's are those of normalised device "
            "coordinates, which grow with the distance; export a mesh, points or splats."
        )
    box = np.clip(checked_crop(field, crop), lattice.box_min, lattice.box_max)
    low, high = nodes_of(lattice, box)
    first, last = np.ceil(low - 1e-6).astype(int), np.floor(high + 1e-6).astype(int)
    if (first >= last).any():
        raise InputError(
            "crop holds fewer than two nodes of the grid along an axis, whose voxels have edges of "
            f"{lattice.voxel_size.max():.3g} scene units; choose a larger box inside the field's."
        )
    return first, last


def volume_npz(volume: Volume) -> list[bytes]:
    """An .npz file, whose keys are the names of the volume's fields."""
    file = io.BytesIO()
    np.savez_compressed(file, **vars(volume))
    return [file.getvalue()]


def volume_nvdb(volume: Volume) -> list[bytes]:
    """A NanoVDB file of a volume's density; index space counts nodes, world space scene units."""
    step = (volume.box_max - volume.box_min) / (np.array(volume.density.shape) - 1)
    stored = wp.Volume.load_from_numpy(
        volume.density,
        min_world=tuple(map(float, volume.box_min)),
        voxel_size=tuple(map(float, step)),
        bg_value=0.0,
        device="cpu",
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "volume.nvdb"
        stored.save_to_nvdb(path)
        return [path.read_bytes()]
