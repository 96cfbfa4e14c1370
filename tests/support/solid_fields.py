"""A ball as a field, and cameras around it, for tests of what is exported."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import warp as wp
from warpnerf_kernels.base.types import vector

from warpnerf.fields.dense import DenseGrid
from warpnerf.fields.lattice import Lattice
from warpnerf.fields.nodes import points_of
from warpnerf.fields.occupancy import FreeCells
from warpnerf.grid_config import Contraction
from warpnerf.model.models import Rgb
from warpnerf.rendering.field import Field
from warpnerf.rendering.steps import Steps
from warpnerf.runtime.parallel import Workers
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.extent.frustum import Frustum

SIZE = (41, 45, 49)
BOX_MIN, BOX_MAX = np.array([-1.0, -1.1, -1.2]), np.array([1.0, 1.1, 1.2])
FRUSTUM = Frustum(
    origin=np.array([0.2, -3.0, 0.1]),
    axes=np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    near=1.5,
    depth=1.2,
)
"""Before the ball, looking along y, z up."""
LEVEL = 10.0 * math.log(2.0)
"""Density at the ball's surface, where the raw density is 0."""


def ball_field(
    centre: tuple[float, float, float] = (0.1, -0.05, 0.15),
    radius: float = 0.6,
    contraction: Contraction = "none",
    hidden: float = 0.0,
) -> Field:
    """Red where x is above the centre's, green where not; blue rises with z from 0.2 to 0.8.

    Args:
        centre: Of the ball.
        radius: Of the ball.
        contraction: Of the space around the box.
        hidden: Radius of a hollow in the middle.
    """
    workers = Workers("cpu", 1)
    nodes = np.argwhere(np.ones(SIZE, bool)).astype(np.float64)
    lattice = Lattice(
        size=SIZE,
        box_min=BOX_MIN,
        box_max=BOX_MAX,
        contraction=contraction,
        border=0.2 if contraction in ("linf", "l2") else 0.0,
    )
    if contraction == "ndc":
        lattice = replace(
            lattice,
            frustum=FRUSTUM,
            box_min=np.array([-0.5, -0.6, 0.0]),
            box_max=np.array([0.6, 0.5, 1.0]),
        )
    grid = DenseGrid(
        values=wp.empty(len(nodes), dtype=vector(4), device="cpu"),
        lattice=lattice,
        density_shift=0.0,
        density_scale=20.0 if contraction == "ndc" else 10.0,
    )
    points = points_of(lattice, nodes)
    points = np.where(np.isfinite(points), points, 1e6)
    apart = np.linalg.norm(points - centre, axis=1)
    inward = radius - apart if hidden == 0.0 else np.minimum(radius - apart, apart - hidden)
    values = np.empty((len(nodes), 4), np.float32)
    if contraction == "none":
        values[:, 0] = np.clip(400.0 * inward, -40.0, 40.0)
    else:  # voxels are long out there
        values[:, 0] = np.clip(40.0 * inward, -1e4, 1e4)
    red = points[:, 0] > centre[0]
    values[:, 1], values[:, 2] = np.where(red, 2.0, -2.0), np.where(red, -2.0, 2.0)
    blue = 0.5 + 0.3 * np.clip((points[:, 2] - centre[2]) / radius, -1.0, 1.0)
    values[:, 3] = np.log(blue / (1.0 - blue))
    grid.values.assign(values)
    contracted = lattice.contracted
    steps = Steps(
        near=0.0,
        far=100.0,
        step=0.02,
        n_linear=100 if contracted else 0,
        growth=0.02 if contracted else 0.0,
        transmittance_min=1e-4,
        in_ndc=lattice.frustum is not None,
    )
    return Field(
        model=Rgb(),
        storage=grid,
        weights=wp.zeros(0, dtype=wp.float32, device="cpu"),
        free=FreeCells.of(grid, workers, steps.struct(), 1e-3),
        steps=steps,
        background=(0.3, 0.3, 0.3),
        workers=workers,
    )


def camera_at(position: tuple[float, float, float], width: int = 48, height: int = 40) -> Camera:
    """A camera that looks at the origin, z up."""
    eye = np.array(position)
    back = eye / np.linalg.norm(eye)
    right = np.cross((0.0, 0.0, 1.0), back)
    right /= np.linalg.norm(right)
    c2w = np.stack([right, np.cross(back, right), back, eye], axis=1)
    return Camera(
        width=width, height=height, fx=width, fy=width, cx=width / 2, cy=height / 2, c2w=c2w
    )


def cameras_around() -> list[Camera]:
    """Twelve that see all of the ball, from above and below."""
    angles = 2.0 * np.pi * np.arange(12) / 12
    return [
        camera_at((2.4 * math.cos(a), 2.4 * math.sin(a), 1.6 * (-1) ** k))
        for k, a in enumerate(angles)
    ]


def read_ply(data: bytes) -> tuple[np.ndarray, np.ndarray | None]:
    """A table of vertices, and triangles where there are any, of a binary PLY."""
    header, body = data.split(b"end_header\n", 1)
    counts, fields = {}, []
    for line in header.decode().splitlines():
        word = line.split()
        if word[0] == "element":
            counts[word[1]] = int(word[2])
        elif word[0] == "property" and word[1] != "list":
            fields.append((word[2], {"float": "<f4", "uchar": "u1"}[word[1]]))
    assert b"format binary_little_endian 1.0" in header
    table = np.frombuffer(body, np.dtype(fields), counts["vertex"])
    if "face" not in counts:
        assert len(body) == table.nbytes
        return table, None
    kind = np.dtype([("n", "u1"), ("corners", "<i4", 3)])
    faces = np.frombuffer(body, kind, counts["face"], table.nbytes)
    assert (faces["n"] == 3).all() and len(body) == table.nbytes + faces.nbytes
    return table, faces["corners"]
