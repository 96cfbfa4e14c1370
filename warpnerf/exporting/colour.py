"""The colour of a field at points, whatever the model: as cameras saw it, or along the normal."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from warpnerf.exporting.visibility import Visibility
from warpnerf.fields.nodes import nodes_of, voxel_edges
from warpnerf.fields.occupancy import FreeCells
from warpnerf.rendering.field import Field
from warpnerf.rendering.steps import Steps

THIN = 2.0**-7
"""Length of the one step that a ray takes, in voxel edges."""

OPAQUE = 1e6
"""Optical depth of that step, at least."""


def colours(
    field: Field, visibility: Visibility | None, points: np.ndarray, normals: np.ndarray
) -> np.ndarray:
    """The mean colour of the pixels that see points, or else their colour along the normal.

    Args:
        field: Of any model.
        visibility: What its cameras see; None: there are none.
        points: [n, 3] scene units.
        normals: [n, 3] unit vectors, outward.

    Returns:
        [n, 3] float32 in [0, 1].
    """
    if visibility is None:
        return opaque_colours(field, points, -normals)
    rgb, seen = visibility.rgb_at(nodes_of(field.lattice, points))
    if not seen.all():
        rgb[~seen] = opaque_colours(field, points[~seen], -normals[~seen])
    return rgb


def opaque_colours(field: Field, points: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """The colour of an opaque medium that holds, everywhere, what the field holds at a point.

    A ray of one short step, with its sample at the point, goes through the field with its density
    replaced by one that lets nothing pass. So a colour is decoded and shaded as in any rendering,
    without what is before and behind the point.

    Args:
        field: Of any model.
        points: [n, 3] scene units.
        directions: [n, 3] unit vectors, those of the rays that see the points.

    Returns:
        [n, 3] float32 in [0, 1]; the background outside of the grid.
    """
    edges = voxel_edges(field.lattice, points)
    if field.lattice.frustum is not None:
        return _colours_in_frustum(field, points, directions)
    if field.lattice.kind.bounded:  # rounding must not leave points on its faces outside
        margin = THIN * edges[:, None]
        points = np.clip(points, field.lattice.box_min + margin, field.lattice.box_max - margin)
    sizes = np.round(np.log2(edges))  # rays of one launch take steps of one length
    rgb, lift = np.empty((len(points), 3), np.float32), _lift(field)
    for size in np.unique(sizes):
        chosen, step = sizes == size, THIN * float(2.0**size)
        scale = OPAQUE / step  # times softplus(raw + shift) of at least 1, for any raw density
        opaque = replace(
            field,
            storage=replace(field.storage, density_shift=lift, density_scale=scale),
            free=FreeCells.none(field.workers),
            steps=Steps(near=0.0, far=step, step=step),
            proposal=None,
        )
        origins = points[chosen] - 0.5 * step * directions[chosen]
        rgb[chosen] = opaque.render_rays(origins, directions[chosen]).rgb
    return rgb


def _colours_in_frustum(field: Field, points: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """``opaque_colours`` where steps are lengths in a frustum; rays begin at the points."""
    lattice, step = field.lattice, THIN * float(field.lattice.voxel_size.min())
    assert lattice.frustum is not None
    places = np.clip(lattice.frustum.to_ndc(points), lattice.box_min + step, lattice.box_max - step)
    opaque = replace(
        field,
        storage=replace(field.storage, density_shift=_lift(field), density_scale=OPAQUE / step),
        free=FreeCells.none(field.workers),
        steps=Steps(near=0.0, far=1e30, step=step, in_ndc=True),
    )
    return opaque.render_rays(lattice.frustum.to_scene(places), directions).rgb


def _lift(field: Field) -> float:
    """What is added to raw densities so that all are above 1."""
    return 1.0 - float(min(0.0, field.storage.raw_densities(field.workers).min()))
