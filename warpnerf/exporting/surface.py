"""Isosurface of a field (marching cubes), as far as cameras see it, at a level of its density."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from warpnerf.checked import checked_arguments
from warpnerf.checks import InputError, require_at_least, require_positive, require_whole
from warpnerf.exporting.colour import colours
from warpnerf.exporting.decimation import decimated
from warpnerf.exporting.holes import filled
from warpnerf.exporting.visibility import SEEN, Visibility
from warpnerf.fields.nodes import nodes_of, points_of, values_at, voxel_edges
from warpnerf.renamed import renamed_argument
from warpnerf.rendering.field import Field
from warpnerf.rendering.normals import normals_at

log = logging.getLogger(__name__)

LEVEL_OPACITY = 0.2
"""Of a voxel edge at the level that is the default; benchmarks/mesh.py tries others."""

MIN_SIZE = 8.0
"""Smallest component that is kept by default, in voxel edges."""

LEAST_FACES = 4
"""Of a closed mesh."""

Crop = tuple[Sequence[float], Sequence[float]]
"""Lower and upper corner, scene units."""


class NothingThereError(InputError):
    """A field holds nothing of what is to be written."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Surface:
    """A triangle mesh with normals and colours at its vertices."""

    points: np.ndarray
    """[n_vertices, 3] float32, scene units; float64 in the coordinates of a georeferenced file."""
    faces: np.ndarray
    """[n_faces, 3] int32, counter-clockwise as seen from outside."""
    normals: np.ndarray
    """[n_vertices, 3] float32 unit vectors, outward: against the density's gradient."""
    rgb: np.ndarray
    """[n_vertices, 3] float32 in [0, 1], sRGB as in the photographs."""
    borders: tuple[float, ...] = ()
    """Diagonals of the boxes around its open borders, scene units, the widest first."""


@renamed_argument("sight", "visibility")
@checked_arguments
def extract_surface(
    field: Field,
    visibility: Visibility | None = None,
    *,
    unseen: bool = False,
    level: float | None = None,
    crop: Crop | None = None,
    min_size: float | None = None,
    fill: float | None = None,
    n_faces: int | None = None,
) -> Surface:
    """Extract the isosurface of the density as a triangle mesh, by marching cubes.

    They run over the raw density, whose trilinear interpolation is what rendering reads, so that
    vertices lie exactly where the density has the level.

    Args:
        field: A trained field.
        visibility: From ``visibility`` with the cameras of its training: what none of them sees is
            dropped, and colours are those that they see. None: all is kept, and colours are those
            seen along the normals.
        unseen: Keep what no camera sees, too.
        level: Density of the surface, 1 / scene unit, in a frustum 1 / unit of its coordinates;
            None: that of which a voxel edge is 20 % opaque.
        crop: Only triangles inside this box; None: what cameras see.
        min_size: Components whose box has a shorter diagonal are dropped, scene units; None: eight
            voxel edges.
        fill: Holes whose box has a diagonal of at most this are closed, scene units; None: eight
            voxel edges.
        n_faces: Decimate to about so many triangles; None: about two for each voxel that the
            surface crosses.

    Returns:
        The surface. It is open where the crop cuts through something, and where cameras see no
        further.

    Raises:
        InputError: A value is wrong, or there is no such surface.
    """
    lattice = field.lattice
    edge = float(lattice.voxel_size.mean())
    check_options(field, level, crop, min_size, fill, n_faces)
    require_crossed(field, level, crop)
    level = default_level(field) if level is None else level
    box = checked_crop(field, crop)
    raw = raw_density(field)
    nodes, faces = _marching_cubes(raw, _raw_of(field, level), field)
    points = points_of(lattice, nodes)
    kept = inside(points, box)
    if not kept.any():
        raise NothingThereError(
            f"level {level:g}: the surface of this density does not reach into the crop; enlarge "
            "the crop, or choose another level."
        )
    if visibility is not None and not unseen:
        kept &= values_at(visibility.light, nodes) > SEEN
    if lattice.frustum is not None and kept.any():
        edge = float(np.median(voxel_edges(lattice, points[kept])))
    min_size = MIN_SIZE * edge if min_size is None else min_size
    faces = faces[kept[faces].all(axis=1)]
    faces = faces[_large_components(points, faces, min_size)]
    if not len(faces):
        raise NothingThereError(
            f"level {level:g}: no part of the surface of this density is both seen by a training "
            f"camera and {min_size:g} scene units across; choose a lower level, a smaller minimum "
            "size, or keep what is unseen."
        )
    used, faces = np.unique(faces, return_inverse=True)
    points, faces = points[used], faces.reshape(-1, 3)
    points, faces, borders = filled(points, faces, MIN_SIZE * edge if fill is None else fill)
    if n_faces is not None and n_faces >= len(faces):
        n = len(faces)
        log.info(f"the mesh has {n} triangles, not {n_faces}, and stays as it is")
    elif n_faces is not None:
        points, faces = decimated(points, faces, n_faces)
    normals = normals_at(field, raw, points)
    return Surface(
        points=points.astype(np.float32),
        faces=faces.astype(np.int32),
        normals=normals.astype(np.float32),
        rgb=colours(field, visibility, points, normals),
        borders=tuple(borders),
    )


def check_options(
    field: Field,
    level: float | None,
    crop: Crop | None,
    min_size: float | None,
    fill: float | None = None,
    n_faces: int | None = None,
) -> None:
    """Raise InputError if a value that was given is of no use."""
    if level is not None:
        require_positive("level", level)
    if min_size is not None:
        require_at_least("min_size", min_size, 0.0)
    if fill is not None:
        require_at_least("fill", fill, 0.0)
    if n_faces is not None:
        require_whole("the number of faces", n_faces, LEAST_FACES)
    checked_crop(field, crop)


def default_level(field: Field) -> float:
    """The density of which a voxel edge is 20 % opaque, 1 / scene unit."""
    return -math.log1p(-LEVEL_OPACITY) / float(field.lattice.voxel_size.mean())


def require_crossed(field: Field, level: float | None, crop: Crop | None) -> None:
    """Raise NothingThereError where no node has at least the level, or all have.

    Only the crop is looked at; all nodes of fields in which a box holds no block of them.
    """
    lattice = field.lattice
    level = default_level(field) if level is None else level
    box = checked_crop(field, crop)
    raw = raw_density(field)
    where = " inside the crop" if crop is not None else " in its box"
    inside = (box >= lattice.box_min).all() and (box <= lattice.box_max).all()
    if lattice.frustum is None and inside:
        low, high = nodes_of(lattice, box)
        first, last = np.floor(low).astype(int), np.ceil(high).astype(int)
        raw = raw[tuple(slice(max(a, 0), b + 1) for a, b in zip(first, last, strict=True))]
    if not raw.min() < _raw_of(field, level) <= raw.max():
        low_sigma, high_sigma = density(field, np.array([raw.min(), raw.max()]))
        raise NothingThereError(
            f"level {level:g}: the field has no surface of this density{where}, where it is "
            f"{low_sigma:.3g} to {high_sigma:.3g} per scene unit; choose a level in between."
        )


def checked_crop(field: Field, crop: Crop | None) -> np.ndarray:
    """The box of what is exported, [2, 3]: lower and upper corner, scene units.

    Raises:
        InputError: It is no box, holds no node, or is outside of a field that ends at its own.
    """
    own = np.stack([field.lattice.box_min, field.lattice.box_max])
    if field.lattice.frustum is not None:  # which is no box in the scene
        own = np.array([[-np.inf] * 3, [np.inf] * 3])
    if crop is None:
        return own if field.lattice.content is None else field.lattice.content
    box = np.asarray(crop, np.float64)
    if box.shape != (2, 3) or not np.isfinite(box).all() or not (box[0] < box[1]).all():
        raise InputError(
            "crop must be a lower and an upper corner, x y z each, the first below the second, not "
            f"{_corner(box.ravel())}."
        )
    if field.lattice.kind.bounded and ((box[1] <= own[0]) | (box[0] >= own[1])).any():
        raise InputError(
            f"crop from {_corner(box[0])} to {_corner(box[1])} lies outside of the field, which "
            f"reaches from {_corner(own[0])} to {_corner(own[1])}; choose a box that meets it."
        )
    with np.errstate(invalid="ignore"):  # behind the cameras of a frustum
        low, high = np.sort(nodes_of(field.lattice, box), axis=0)
    if (np.floor(high + 1e-6) < np.ceil(low - 1e-6)).any():
        edge, outside = f"{field.lattice.voxel_size.max():.3g} scene units", ""
        if field.lattice.contracted:
            outside = f" in the box from {_corner(own[0])} to {_corner(own[1])} and longer outside"
        raise InputError(
            f"crop from {_corner(box[0])} to {_corner(box[1])} lies between two nodes of the grid, "
            f"whose voxels have edges of {edge}{outside}; choose a larger box."
        )
    return box


def inside(points: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Which of points [n, 3] lie in a box [2, 3]; what is infinite does not."""
    return ((points >= box[0]) & (points <= box[1])).all(axis=1)


def raw_density(field: Field) -> np.ndarray:
    """What the grid holds of density, [X, Y, Z] float32."""
    return field.storage.raw_densities(field.workers)


def density(field: Field, raw: np.ndarray) -> np.ndarray:
    """Density of raw densities, in 1 / scene unit; the same shape."""
    stored = field.storage
    return (stored.density_scale * np.logaddexp(0.0, raw + stored.density_shift)).astype(np.float32)


def _raw_of(field: Field, level: float) -> float:
    """The raw density of a density: the inverse of ``density``."""
    x = max(level / field.storage.density_scale, 1e-300)
    raw = x + math.log(-math.expm1(-x)) - field.storage.density_shift
    return min(max(raw, -1e30), 1e30)  # as far as single precision goes


def _marching_cubes(raw: np.ndarray, level: float, field: Field) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [n, 3] in node coordinates, and faces [m, 3] with the lower values outside."""
    import warp.geometry  # is no part of `import warp`

    values = wp.array(raw, dtype=wp.float32, device=field.workers.device)
    vertices, indices = warp.geometry.IsoSurfaceMarchingCubes.extract(values, level)
    # Its faces look towards the higher values.
    return vertices.numpy().astype(np.float64), indices.numpy().reshape(-1, 3)[:, ::-1]


def _large_components(points: np.ndarray, faces: np.ndarray, min_size: float) -> np.ndarray:
    """Which faces belong to a component whose box has at least a diagonal of min_size, [n_faces].

    Every vertex takes the smallest label of its faces', and the label that this label's vertex has,
    until nothing changes.
    """
    labels = np.arange(len(points))
    while len(faces):
        smallest = labels[faces].min(axis=1)
        new = labels.copy()
        for corner in range(3):
            np.minimum.at(new, labels[faces[:, corner]], smallest)
            np.minimum.at(new, faces[:, corner], smallest)
        new = new[new]
        if (new == labels).all():
            break
        labels = new
    low, high = np.full((len(points), 3), np.inf), np.full((len(points), 3), -np.inf)
    used = np.unique(faces)
    np.minimum.at(low, labels[used], points[used])
    np.maximum.at(high, labels[used], points[used])
    roots = labels[faces[:, 0]]
    return np.linalg.norm(high[roots] - low[roots], axis=1) >= min_size


def _corner(corner: np.ndarray) -> str:
    return " ".join(f"{x:g}" for x in corner)
