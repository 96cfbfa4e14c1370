"""Export of a field as Gaussian splats: one for each node that cameras see, as opaque as it is.

Opacity. Splats of opacity o and standard deviation k voxel edges on a lattice let through what a
density of

    sigma = 2 pi k^2 |J^-1 d| Li2(o),    Li2(o) = sum_n o^n / n^2

lets through along the unit direction d: the columns of J are a cell's edges, so a splat's
covariance is k^2 J J^T, and the integral of -log(1 - o exp(-r^2 / 2)) over the plane is
2 pi Li2(o). Where space is not contracted, |J^-1 d| is 1 / voxel edge for every d.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from warpnerf.checked import checked_arguments
from warpnerf.exporting.colour import colours
from warpnerf.exporting.ply import ply
from warpnerf.exporting.surface import (
    Crop,
    NothingThereError,
    checked_crop,
    density,
    inside,
    normals_at,
    raw_density,
)
from warpnerf.exporting.visibility import Visibility
from warpnerf.fields.nodes import points_of
from warpnerf.renamed import renamed_argument
from warpnerf.rendering.field import Field
from warpnerf.scenes.cameras.quaternions import quaternions

SPREAD = 0.5
"""Standard deviation of a splat, in voxel edges."""

FAINTEST = 0.02
"""Opacity of a cell that gets a splat, at least."""

ALONG_AN_AXIS = 0.9
"""Cosine of the angle to an axis from which on it is the vertical one: 26 degrees."""

LEAST_LIGHT = 0.2
"""Pixels whose light comes from a node that gets a splat, at least."""

DENSEST = 0.99
"""Opacity of a splat, at most: viewers cut off there."""

FIRST_HARMONIC = 0.28209479177387814
"""The constant spherical harmonic."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Splats:
    """Gaussian splats with one colour each."""

    centres: np.ndarray
    """[n, 3] float32, scene units."""
    scales: np.ndarray
    """[n, 3] float32, standard deviations along their axes, scene units."""
    rotations: np.ndarray
    """[n, 4] float32 unit quaternions w, x, y, z: from their axes to the scene's."""
    opacity: np.ndarray
    """[n] float32 in (0, 1)."""
    rgb: np.ndarray
    """[n, 3] float32 in [0, 1], sRGB as in the photographs."""


@renamed_argument("sight", "visibility")
@checked_arguments
def splats_of(
    field: Field,
    visibility: Visibility | None = None,
    *,
    unseen: bool = False,
    crop: Crop | None = None,
) -> Splats:
    """Convert a field to Gaussian splats.

    Args:
        field: A trained field.
        visibility: Of the cameras of its training, as for ``extract_surface``.
        unseen: Keep what no camera sees, too.
        crop: Only splats with their centres inside; None: all, also in contracted space.

    Returns:
        The splats, in the order of the grid.

    Raises:
        InputError: The crop is no box, or nothing is left.
    """
    lattice = field.lattice
    raw = raw_density(field)
    sigma = density(field, raw)
    # How opaque a cell is at most: far out in contracted space they are long.
    kept = -np.expm1(-sigma * float(lattice.voxel_size.max())) > FAINTEST
    if visibility is not None and not unseen:
        kept &= visibility.light > LEAST_LIGHT
    nodes = np.argwhere(kept).astype(np.float64)
    points = points_of(lattice, nodes)
    jacobian = _cells(field, nodes)
    usable = np.isfinite(points).all(axis=1) & np.isfinite(jacobian).all(axis=(1, 2))
    if crop is not None:
        usable &= inside(points, checked_crop(field, crop))
    if not usable.any():
        raise NothingThereError(
            "no splat is left: nothing in the crop is both dense enough to be seen and seen by a "
            "training camera; enlarge the crop, or keep what is unseen."
        )
    points, jacobian, sigma = points[usable], jacobian[usable], sigma[kept][usable]
    # Where space is contracted, cells are long and are looked along, from the box outward.
    middle = 0.5 * (lattice.box_min + lattice.box_max)
    outward = points - (middle if lattice.frustum is None else lattice.frustum.origin)
    length = np.linalg.norm(outward, axis=1, keepdims=True)
    outward = np.where(length > 0.0, outward / np.maximum(length, 1e-30), [1.0, 0.0, 0.0])
    crossed = np.linalg.norm(np.linalg.solve(jacobian, outward[..., None])[..., 0], axis=1)
    if lattice.frustum is not None:  # whose densities are those of its coordinates
        crossed[:] = 1.0 / float(lattice.voxel_size.mean())
    scales, rotations = _axes(jacobian)
    return Splats(
        centres=points.astype(np.float32),
        scales=scales.astype(np.float32),
        rotations=rotations.astype(np.float32),
        opacity=_opacity(sigma / (2.0 * math.pi * SPREAD**2 * crossed)).astype(np.float32),
        rgb=colours(field, visibility, points, normals_at(field, raw, points)),
    )


def splats_ply(
    splats: Splats, up: np.ndarray | None = None, offset: np.ndarray | None = None
) -> list[bytes]:
    """The PLY file that 3DGS writes, with harmonics of degree 0.

    Opacities are logits, scales logarithms, and colours coefficients: rgb = 1/2 + 0.282 f_dc.

    Args:
        splats: To write, in the scene's coordinates.
        up: Direction in which the cameras stand upright, [3] unit vector; None: not known. If it is
            near an axis, the header names that as the vertical axis, as nerfstudio and Brush do.
        offset: [3] what is missing to the coordinates of the scene's file, scene units, which the
            header names; None: nothing.

    Returns:
        The pieces of the file.
    """
    zero = np.zeros((len(splats.centres), 3), np.float32)
    opacity = splats.opacity[:, None]
    named = (
        (("x", "y", "z"), splats.centres),
        (("nx", "ny", "nz"), zero),
        (("f_dc_0", "f_dc_1", "f_dc_2"), (splats.rgb - 0.5) / FIRST_HARMONIC),
        (("opacity",), np.log(opacity) - np.log1p(-opacity)),
        (("scale_0", "scale_1", "scale_2"), np.log(splats.scales)),
        (("rot_0", "rot_1", "rot_2", "rot_3"), splats.rotations),
    )
    columns = {
        name: values[:, k].astype(np.float32)
        for names, values in named
        for k, name in enumerate(names)
    }
    missing = [] if offset is None else ["offset " + " ".join(f"{x:.12g}" for x in offset)]
    return ply(columns, comments=[*_vertical_axis(up), *missing])


def _vertical_axis(up: np.ndarray | None) -> list[str]:
    if up is None or np.abs(up).max() < ALONG_AN_AXIS:
        return []
    k = int(np.abs(up).argmax())
    return [f"Vertical Axis: {'-' if up[k] < 0.0 else ''}{'xyz'[k]}"]


def _cells(field: Field, nodes: np.ndarray) -> np.ndarray:
    """The edges of the cells around nodes as columns, [n, 3, 3] scene units; some not finite."""
    lattice, half_steps = field.lattice, 0.5 * np.eye(3)
    beyond = np.stack([points_of(lattice, nodes + step) for step in half_steps], axis=2)
    before = np.stack([points_of(lattice, nodes - step) for step in half_steps], axis=2)
    with np.errstate(invalid="ignore"):  # both are infinite at the rim of contracted space
        return np.asarray(beyond - before)


def _axes(jacobian: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations and rotations, as quaternions, of k^2 J J^T."""
    axes, stretch, _ = np.linalg.svd(jacobian)
    axes[:, :, 2] *= np.sign(np.linalg.det(axes))[:, None]  # rotations, not reflections
    return SPREAD * stretch, quaternions(axes)


def _opacity(dilogarithm: np.ndarray) -> np.ndarray:
    """The opacity that has a dilogarithm: the inverse of Li2, up to DENSEST."""
    table = np.linspace(0.0, DENSEST, 1000)
    n = np.arange(1, 1000)
    li2 = (table[:, None] ** n / n**2).sum(axis=1)
    return np.interp(dilogarithm, li2, table).clip(1e-4)
