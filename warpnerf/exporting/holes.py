"""Hole filling: small open borders of a mesh are closed by fans, larger ones are counted."""

from __future__ import annotations

import numpy as np


def filled(
    points: np.ndarray, faces: np.ndarray, width: float
) -> tuple[np.ndarray, np.ndarray, list[float]]:
    """Close the holes of a triangle mesh that are narrow enough.

    A hole gets a vertex in its middle, and a face for each of its edges. Borders that meet
    themselves in a vertex stay open.

    Args:
        points: [n_vertices, 3].
        faces: [n_faces, 3] of vertices.
        width: Diagonal of the box around a hole that is closed, at most.

    Returns:
        The points and faces with the new ones behind the others, and the diagonals of the borders
        that are open still, the widest first.
    """
    widths: list[float] = []
    middles: list[np.ndarray] = []
    fans: list[np.ndarray] = []
    for border in _borders(faces):
        around = points[border]
        across = float(np.linalg.norm(np.ptp(around, axis=0)))
        if across > width or len(set(border)) < len(border):
            widths.append(across)
            continue
        middle = np.full(len(border), len(points) + len(middles))
        middles.append(around.mean(axis=0))
        fans.append(np.stack([np.roll(border, -1), border, middle], axis=1))
    if middles:
        points = np.concatenate([points, np.array(middles)])
        faces = np.concatenate([faces, *fans])
    return points, faces, sorted(widths, reverse=True)


def _borders(faces: np.ndarray) -> list[list[int]]:
    """Vertices along each open border, in the direction of the faces beside it."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    n = int(edges.max(initial=0)) + 1
    there, back = edges[:, 0] * n + edges[:, 1], edges[:, 1] * n + edges[:, 0]
    following: dict[int, list[int]] = {}
    for begin, end in edges[~np.isin(there, back)].tolist():
        following.setdefault(begin, []).append(end)
    borders = []
    for first in list(following):
        while following[first]:
            border, vertex = [first], following[first].pop()
            while vertex != first and following.get(vertex):
                border.append(vertex)
                vertex = following[vertex].pop()
            borders.append(border)
    return borders
