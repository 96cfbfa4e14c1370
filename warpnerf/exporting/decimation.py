"""Mesh decimation by edge collapse with quadric error metrics, many independent edges at a time.

Source: Garland and Heckbert 1997, "Surface simplification using quadric error metrics". A vertex
has the sum of squared distances to the planes of the faces around it, as a quadratic form.
Contracting an edge costs what the sum of both forms is at its minimum.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

BORDER = 10.0
"""Weight of the planes that stand on open edges, which keep a border where it is."""

TOWARDS_MIDDLE = 1e-3
"""Share of a form's trace that draws a new vertex to the middle of its edge: on plane parts the
form alone does not say where it goes."""

LEAST_COSINE = 0.3
"""Between the normals of a face before and after a collapse, at least; else it would fold."""

SLIVER = 0.02
"""Height of a face by its longest side, up to which its normal says nothing: marching cubes leave
such faces where the surface passes close by a node."""

CHEAPEST = 0.5
"""Share of the edges that are tried in a round."""


@dataclass(frozen=True, eq=False)
class _Edges:
    ends: np.ndarray
    """[n, 2], the smaller first."""
    n_faces: np.ndarray
    """[n], how many meet there."""
    opposite: np.ndarray
    """[n], a face of it."""


def decimated(points: np.ndarray, faces: np.ndarray, n_faces: int) -> tuple[np.ndarray, np.ndarray]:
    """Decimate a triangle mesh by edge collapse.

    Each round contracts edges that are cheaper than all others around them, so that no collapse
    changes the faces of another one. The topology stays: edges whose collapse would pinch the
    surface, or turn a face over, are left.

    Args:
        points: [n_vertices, 3].
        faces: [n_faces, 3] of vertices.
        n_faces: How many may be left, about; where nothing more can be contracted, more are.

    Returns:
        Points [m, 3] float64 and faces [k, 3] int64, without vertices that no face has.
    """
    points, faces = np.array(points, np.float64), np.array(faces, np.int64)
    forms, blocked = _forms(points, faces), np.zeros(0, np.int64)
    n_before = len(faces) + 1  # when all edges were last tried
    while len(faces) > n_faces:
        edges = _edges(faces)
        chosen, places = _independent(points, forms, edges, blocked, len(points))
        n_wanted = (len(faces) - n_faces + 1) // 2  # a collapse takes two faces
        chosen, places = chosen[:n_wanted], places[:n_wanted]
        fine = _keeps_topology(edges, chosen, len(points))
        fine &= _keeps_sides(points, faces, edges.ends[chosen], places)
        if not len(chosen):
            if len(faces) == n_before or not len(blocked):
                break
            blocked, n_before = np.zeros(0, np.int64), len(faces)  # around them much has changed
            continue
        refused = edges.ends[chosen[~fine]]
        blocked = np.union1d(blocked, refused[:, 0] * len(points) + refused[:, 1])
        kept, gone = edges.ends[chosen[fine]].T
        points[kept] = places[fine]
        forms[kept] += forms[gone]
        heir = np.arange(len(points))
        heir[gone] = kept
        faces = heir[faces]
        a, b, c = faces.T
        faces = faces[(a != b) & (b != c) & (c != a)]
    used, faces = np.unique(faces, return_inverse=True)
    return points[used], faces.reshape(-1, 3)


def _forms(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The quadratic forms of vertices, [n, 4, 4]: x^T Q x with x = (point, 1)."""
    corners = points[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(across, axis=1)
    normals = across / np.maximum(area, 1e-300)[:, None]
    forms = np.zeros((len(points), 4, 4))
    _add_planes(forms, faces, normals, corners[:, 0], area)
    edges = _edges(faces)
    open_ = edges.n_faces == 1
    ends = edges.ends[open_]
    along = points[ends[:, 1]] - points[ends[:, 0]]
    standing = np.cross(along, normals[edges.opposite[open_]])
    length = np.linalg.norm(standing, axis=1)
    standing /= np.maximum(length, 1e-300)[:, None]
    _add_planes(forms, ends, standing, points[ends[:, 0]], BORDER * length**2)
    return forms


def _add_planes(
    forms: np.ndarray,
    corners: np.ndarray,
    normals: np.ndarray,
    through: np.ndarray,
    weight: np.ndarray,
) -> None:
    """Add the planes [n] to the forms of the vertices [n, k] that lie on them."""
    plane = np.concatenate([normals, -(normals * through).sum(axis=1, keepdims=True)], axis=1)
    form = weight[:, None, None] * plane[:, :, None] * plane[:, None, :]
    for corner in corners.T:
        np.add.at(forms, corner, form)


def _edges(faces: np.ndarray) -> _Edges:
    """The edges of faces."""
    pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    keys = pairs[:, 0] * (faces.max(initial=0) + 1) + pairs[:, 1]
    _, first, counts = np.unique(keys, return_index=True, return_counts=True)
    return _Edges(pairs[first], counts, first % len(faces))


def _independent(
    points: np.ndarray, forms: np.ndarray, edges: _Edges, blocked: np.ndarray, n: int
) -> tuple[np.ndarray, np.ndarray]:
    """Edges whose ends have no edge in common with those of another one, the cheapest first.

    Returns:
        Their numbers [k], and where their ends are put, [k, 3].
    """
    a, b = edges.ends.T
    form = forms[a] + forms[b]
    middle = 0.5 * (points[a] + points[b])
    matrix, pull = form[:, :3, :3], TOWARDS_MIDDLE * np.trace(form[:, :3, :3], axis1=1, axis2=2)
    pull = np.maximum(pull, 1e-300)
    slope = -form[:, :3, 3] + pull[:, None] * middle
    places = _solved(matrix + pull[:, None, None] * np.eye(3), slope)
    whole = np.concatenate([places, np.ones((len(places), 1))], axis=1)
    cost = np.maximum(np.einsum("ni,nij,nj->n", whole, form, whole), 0.0)
    # Short edges first where the surface is plane, so that faces stay well shaped.
    cost += 1e-3 * pull * ((points[a] - points[b]) ** 2).sum(axis=1)
    border = np.zeros(n, bool)
    border[edges.ends[edges.n_faces != 2]] = True
    usable = (edges.n_faces == 1) | ((edges.n_faces == 2) & ~(border[a] & border[b]))
    usable &= ~np.isin(a * n + b, blocked)
    order = np.argsort(np.where(usable, cost, np.inf), kind="stable")
    order = order[: max(1, int(CHEAPEST * usable.sum()))]
    order = order[usable[order]]
    rank = np.full(len(a), len(a))
    rank[order] = np.arange(len(order))
    best = np.full(n, len(a))
    for end in (a, b):
        np.minimum.at(best, end, rank)
    around = best.copy()
    np.minimum.at(around, a, best[b])
    np.minimum.at(around, b, best[a])
    chosen = order[(rank[order] == around[a[order]]) & (rank[order] == around[b[order]])]
    return chosen, places[chosen]


def _solved(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solutions [n, 3] of symmetric systems [n, 3, 3], by Cramer's rule."""
    x, y, z = matrix[:, 0], matrix[:, 1], matrix[:, 2]
    yz, zx, xy = np.cross(y, z), np.cross(z, x), np.cross(x, y)
    determinant = (x * yz).sum(axis=1)
    solution = right[:, :1] * yz + right[:, 1:2] * zx + right[:, 2:] * xy
    return np.asarray(solution / np.where(determinant == 0.0, 1.0, determinant)[:, None])


def _keeps_topology(edges: _Edges, chosen: np.ndarray, n: int) -> np.ndarray:
    """Which edges' ends have no neighbour in common but those of the faces at the edge, and enough
    others that the faces around the new vertex do not lie on one another, [k]."""
    both = np.concatenate([edges.ends, edges.ends[:, ::-1]])
    both = both[np.lexsort((both[:, 1], both[:, 0]))]
    starts = np.searchsorted(both[:, 0], np.arange(n + 1))
    a, b = edges.ends[chosen].T
    counts = starts[a + 1] - starts[a]
    owner = np.repeat(np.arange(len(chosen)), counts)
    within = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    neighbours = both[starts[a][owner] + within, 1]
    keys = both[:, 0] * n + both[:, 1]
    wanted = neighbours * n + b[owner]
    at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    shared = np.bincount(owner, keys[at] == wanted, minlength=len(chosen))
    n_around = counts + starts[b + 1] - starts[b] - 2 - shared
    return np.asarray((shared == edges.n_faces[chosen]) & (n_around > edges.n_faces[chosen]))


def _keeps_sides(
    points: np.ndarray, faces: np.ndarray, ends: np.ndarray, places: np.ndarray
) -> np.ndarray:
    """Which collapses turn no face over, [k]; ends [k, 2] and places [k, 3]."""
    collapse = np.full(len(points), -1)
    collapse[ends] = np.arange(len(ends))[:, None]
    of_corner = collapse[faces]
    touched = (of_corner >= 0).sum(axis=1) == 1
    before = points[faces[touched]]
    at = of_corner[touched]
    after = np.where((at >= 0)[..., None], places[np.maximum(at, 0)], before)
    old, new = (np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]) for t in (before, after))
    lengths = np.linalg.norm(old, axis=1) * np.linalg.norm(new, axis=1)
    turned = (old * new).sum(axis=1) <= LEAST_COSINE * lengths
    sides = np.linalg.norm(before - np.roll(before, 1, axis=1), axis=2).max(axis=1)
    turned &= np.linalg.norm(old, axis=1) > SLIVER * sides**2
    fine = np.ones(len(ends), bool)
    fine[at[turned].max(axis=1)] = False
    return fine
