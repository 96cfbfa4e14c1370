"""Surface normals of a field: against the gradient of its density, at points or in a picture."""

from __future__ import annotations

import numpy as np

from warpnerf.fields.nodes import nodes_of, values_at, voxel_edges
from warpnerf.rendering.field import Field, Rendering
from warpnerf.rendering.rays import camera_rays
from warpnerf.scenes.cameras.camera import Camera

SEEN = 1e-3
"""Opacity of a pixel that has a normal, at least."""


def normals_at(field: Field, raw: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Unit vectors against the gradient of the density, by differences over a voxel edge.

    Args:
        field: The field.
        raw: Its raw density, [X, Y, Z].
        points: [n, 3] scene units.

    Returns:
        [n, 3] float64; upward where the gradient is 0.
    """
    half = 0.5 * voxel_edges(field.lattice, points)
    falling = np.empty((len(points), 3))
    for axis, direction in enumerate(np.eye(3)):
        before, after = (
            values_at(raw, nodes_of(field.lattice, points + (sign * half)[:, None] * direction))
            for sign in (-1.0, 1.0)
        )
        falling[:, axis] = before - after
    length = np.linalg.norm(falling, axis=1, keepdims=True)
    return np.where(length > 0.0, falling / np.maximum(length, 1e-30), [0.0, 0.0, 1.0])


def normal_map(field: Field, raw: np.ndarray, camera: Camera, rendering: Rendering) -> np.ndarray:
    """Surface normals in a camera's picture, where its rays end on average.

    Args:
        field: The field.
        raw: Its raw density, [X, Y, Z].
        camera: From where.
        rendering: What it sees, [H, W].

    Returns:
        [H, W, 3] float64 unit vectors in the camera's axes: x right, y up, z towards the camera;
        0 where nothing is seen.
    """
    origins, directions = (rays.numpy() for rays in camera_rays(camera, field.workers))
    opacity = rendering.opacity.ravel()
    seen = opacity > SEEN
    depth = rendering.depth.ravel()[seen] / opacity[seen]
    points = np.broadcast_to(origins, directions.shape)[seen] + depth[:, None] * directions[seen]
    normals = np.zeros((len(opacity), 3))
    normals[seen] = normals_at(field, raw, points.astype(np.float64)) @ camera.c2w[:, :3]
    return normals.reshape(*rendering.opacity.shape, 3)
