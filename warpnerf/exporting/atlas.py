"""Texture atlas of a mesh: charts seen along axes (UV unwrapping by box mapping), packed, baked.

A chart is a connected part whose faces look along the same axis, projected along it, so that texels
have one size on it and at most 3^(1/2) times that. Charts are placed in rows, the highest first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from warpnerf.exporting.surface import Surface

MARGIN = 2
"""Texels around a chart that repeat its border, so that filtering mixes in no other chart."""

SMOOTHINGS = 4
"""Rounds in which a face takes the axis of most of its neighbours."""

STEEPEST = 0.35
"""Cosine between a face's normal and the axis it takes from its neighbours, at least."""

CHUNK = 1 << 20
"""Texels that are baked at a time."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Textured:
    """A triangle mesh with texture coordinates and a texture."""

    surface: Surface
    """Vertices at borders of charts are there once for each chart."""
    uv: np.ndarray
    """[n_vertices, 2] float32 in [0, 1], the origin in the upper left corner, as in glTF."""
    texture: np.ndarray
    """[H, W, 3] uint8, sRGB."""


Bake = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""From points [n, 3] and normals [n, 3] to colours [n, 3] in [0, 1]."""


def textured(surface: Surface, texel: float, largest: int, bake: Bake) -> Textured:
    """Unwrap a mesh, and bake a texture for it.

    Args:
        surface: The mesh.
        texel: Edge of a texel, scene units; larger where the texture would not hold them all.
        largest: Width and height of the texture, at most, texels.
        bake: The colours of points.

    Returns:
        The mesh with its texture.
    """
    axes = _axes(surface)
    charts = _charts(surface.faces, axes)
    corners = surface.points[surface.faces].astype(np.float64)
    u, v = (axes // 2 + 1) % 3, (axes // 2 + 2) % 3
    rows = np.arange(len(corners))[:, None]
    flat = np.stack(
        [corners[rows, np.arange(3), u[:, None]], corners[rows, np.arange(3), v[:, None]]], axis=-1
    )
    n_charts = int(charts.max()) + 1
    low, high = np.full((n_charts, 2), np.inf), np.full((n_charts, 2), -np.inf)
    np.minimum.at(low, charts, flat.min(axis=1))
    np.maximum.at(high, charts, flat.max(axis=1))
    texel, places, size = _packed(high - low, texel, largest)
    at = (flat - low[charts][:, None]) / texel + places[charts][:, None] + MARGIN
    vertices, firsts, faces = np.unique(
        charts[:, None].repeat(3, axis=1).astype(np.int64) * len(surface.points) + surface.faces,
        return_index=True,
        return_inverse=True,
    )
    old = vertices % len(surface.points)
    split = replace(
        surface,
        points=surface.points[old],
        normals=surface.normals[old],
        rgb=surface.rgb[old],
        faces=faces.reshape(-1, 3).astype(np.int32),
    )
    uv = at.reshape(-1, 2)[firsts] / size[::-1]
    texture = _baked(split, at, size, bake)
    return Textured(surface=split, uv=uv.astype(np.float32), texture=texture)


def _axes(surface: Surface) -> np.ndarray:
    """The axis that each face looks along, [n_faces]: 0 to 5 for x, -x, y, -y, z, -z."""
    a, b, c = surface.points[surface.faces].astype(np.float64).transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    along = np.stack([normals, -normals], axis=2).reshape(-1, 6)
    axes = along.argmax(axis=1)
    pairs = _neighbours(surface.faces)
    for _ in range(SMOOTHINGS):
        votes = np.zeros((len(axes), 6), np.int64)
        for one, other in (pairs, pairs[::-1]):
            np.add.at(votes, (one, axes[other]), 1)
        most = votes.argmax(axis=1)
        rows = np.arange(len(axes))
        better = (votes[rows, most] >= 2) & (along[rows, most] > STEEPEST)
        axes = np.where(better, most, axes)
    return axes


def _neighbours(faces: np.ndarray) -> np.ndarray:
    """Pairs of faces that share an edge, [2, n]."""
    ends = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    keys = ends[:, 0].astype(np.int64) * (int(faces.max()) + 1) + ends[:, 1]
    order = np.argsort(keys, kind="stable")
    same = keys[order[1:]] == keys[order[:-1]]
    return np.stack([order[:-1][same], order[1:][same]]) % len(faces)


def _charts(faces: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """The chart of each face, [n_faces]: connected components of one axis, by label propagation."""
    one, other = _neighbours(faces)
    same = axes[one] == axes[other]
    one, other = one[same], other[same]
    labels = np.arange(len(faces))
    while True:
        new = labels.copy()
        smallest = np.minimum(labels[one], labels[other])
        for root in (labels[one], labels[other], one, other):
            np.minimum.at(new, root, smallest)
        new = new[new]
        if (new == labels).all():
            return np.unique(labels, return_inverse=True)[1].reshape(-1)
        labels = new


def _packed(
    extents: np.ndarray, texel: float, largest: int
) -> tuple[float, np.ndarray, np.ndarray]:
    """Place charts in rows of a texture.

    Args:
        extents: [n, 2] of charts, scene units.
        texel: Edge of a texel, scene units.
        largest: Of the texture, texels.

    Returns:
        The edge of a texel that fits, corners of charts [n, 2] in texels, height and width [2].
    """
    while True:
        sizes = np.ceil(extents / texel).astype(np.int64) + 1 + 2 * MARGIN
        width = int(max(sizes[:, 0].max(), np.ceil(np.sqrt(1.15 * sizes.prod(axis=1).sum()))))
        width += -width % 4
        places, height = _rows(sizes, width)
        height += -height % 4
        if max(width, height) <= largest or texel > extents.max():
            return texel, places, np.array([height, width])
        texel *= max(1.02, 0.9 * max(width, height) / largest)


def _rows(sizes: np.ndarray, width: int) -> tuple[np.ndarray, int]:
    """Corners of rectangles [n, 2] in rows of a width, and the height of all."""
    places = np.zeros((len(sizes), 2))
    x = y = height = 0
    for chart in np.argsort(-sizes[:, 1], kind="stable").tolist():
        w, h = sizes[chart].tolist()
        if x + w > width:
            x, y, height = 0, y + height, 0
        places[chart] = x, y
        x, height = x + w, max(height, h)
    return places, y + height


def _baked(surface: Surface, at: np.ndarray, size: np.ndarray, bake: Bake) -> np.ndarray:
    """The texture, uint8 of a size, of a mesh whose faces' corners are at texels [n, 3, 2]."""
    texture = np.zeros((*size, 3), np.uint8)
    filled = np.zeros(tuple(size), bool)
    boxes = np.floor(at.max(axis=1)) - np.floor(at.min(axis=1)) + 1
    ends = np.cumsum(boxes.prod(axis=1))

    def fill(texels: np.ndarray, faces: np.ndarray, shares: np.ndarray) -> None:
        """Bake texels [n, 2] that show faces [n, 3], at the shares [n, 3] of their corners."""
        points = np.einsum("nk,nkc->nc", shares, surface.points[faces].astype(np.float64))
        normals = np.einsum("nk,nkc->nc", shares, surface.normals[faces].astype(np.float64))
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        if len(points):
            x, y = texels.T
            texture[y, x] = np.round(255.0 * bake(points, normals))
            filled[y, x] = True

    begin = 0
    while begin < len(at):
        before = ends[begin - 1] if begin else 0.0
        end = max(begin + 1, int(np.searchsorted(ends, before + CHUNK, side="right")))
        texels, owner, shares = _covered(at[begin:end])
        fill(texels, surface.faces[begin:end][owner], shares)
        begin = end
    for shares in (np.full(3, 1.0 / 3.0), *np.eye(3)):  # faces between the middles of texels
        texels = np.floor((shares[:, None] * at).sum(axis=1)).astype(np.int64)
        missing = ~filled[texels[:, 1], texels[:, 0]]
        fill(texels[missing], surface.faces[missing], np.tile(shares, (int(missing.sum()), 1)))
    for _ in range(MARGIN + 1):
        _spread(texture, filled)
    return texture


def _covered(at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The texels whose middles lie in faces: x and y [n, 2], the face [n], its corners' shares."""
    low = np.floor(at.min(axis=1)).astype(np.int64)
    across = np.floor(at.max(axis=1)).astype(np.int64) - low + 1
    counts = across.prod(axis=1)
    owner = np.repeat(np.arange(len(at)), counts)
    within = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    texels = low[owner] + np.stack([within % across[owner, 0], within // across[owner, 0]], axis=1)
    a, b, c = at[:, 0], at[:, 1] - at[:, 0], at[:, 2] - at[:, 0]
    area = b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0]
    area = np.where(np.abs(area) < 1e-12, np.inf, area)
    p = texels + 0.5 - a[owner]
    second = (p[:, 0] * c[owner, 1] - p[:, 1] * c[owner, 0]) / area[owner]
    third = (b[owner, 0] * p[:, 1] - b[owner, 1] * p[:, 0]) / area[owner]
    shares = np.stack([1.0 - second - third, second, third], axis=1)
    inside = (shares >= -1e-9).all(axis=1) & np.isfinite(area[owner])
    return texels[inside], owner[inside], shares[inside]


def _spread(texture: np.ndarray, filled: np.ndarray) -> None:
    """Fill the texels beside filled ones with the mean of these, in place."""
    total, count = np.zeros(texture.shape, np.float32), np.zeros(filled.shape, np.float32)
    height, width = filled.shape
    for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)):
        to = slice(max(dy, 0), height + min(dy, 0)), slice(max(dx, 0), width + min(dx, 0))
        of = slice(max(-dy, 0), height + min(-dy, 0)), slice(max(-dx, 0), width + min(-dx, 0))
        total[to] += np.where(filled[of][..., None], texture[of], 0)
        count[to] += filled[of]
    new = ~filled & (count > 0)
    texture[new] = np.round(total[new] / count[new][:, None])
    filled |= new
