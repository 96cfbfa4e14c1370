"""Decimation: how many faces are left, where they lie, and that the topology stays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.exporting.test_mesh import CENTRE, RADIUS, signed_volume
from tests.support.solid_fields import LEVEL, ball_field
from warpnerf.checks import InputError
from warpnerf.exporting.decimation import decimated
from warpnerf.exporting.export import ExportOptions, export
from warpnerf.exporting.surface import extract_surface


def plane(n: int, height: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """n x n squares with edges of 1, two triangles each."""
    x, y = np.mgrid[: n + 1, : n + 1].astype(float)
    points = np.stack([x.ravel(), y.ravel(), np.where(x > n / 2, height, 0.0).ravel()], axis=1)
    at = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    a, b, c, d = at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]
    triangles = [np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))]
    return points, np.concatenate(triangles)


@pytest.mark.parametrize("n_faces", [2000, 300])
def test_a_ball_of_fewer_faces_stays_a_closed_ball(n_faces: int) -> None:
    ball = extract_surface(ball_field(), level=LEVEL, n_faces=n_faces)
    assert n_faces - 2 < len(ball.faces) <= n_faces
    true = 4.0 / 3.0 * np.pi * RADIUS**3
    assert signed_volume(ball.points, ball.faces) == pytest.approx(true, rel=6.0 / n_faces + 0.01)
    radii = np.linalg.norm(ball.points - CENTRE, axis=1)
    assert np.abs(radii - RADIUS).max() < 0.01  # a fifth of a voxel edge
    edges = np.concatenate([ball.faces[:, pair] for pair in ([0, 1], [1, 2], [2, 0])])
    there = {tuple(edge) for edge in edges.tolist()}
    assert len(there) == len(edges) and there == {(b, a) for a, b in there}
    assert ((ball.points - CENTRE) / radii[:, None] * ball.normals).sum(axis=1).min() > 0.99
    red = ball.points[:, 0] > CENTRE[0] + 0.06
    assert ball.rgb[red, 0].min() > 0.8


def test_a_plane_keeps_its_border_and_a_crease() -> None:
    points, faces = decimated(*plane(24), 8)
    assert len(faces) <= 16
    corners = points[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (across[:, 2] > 0.0).all()  # none is turned over
    assert 0.5 * across[:, 2].sum() == pytest.approx(24.0**2, rel=0.01)
    bent, faces = decimated(*plane(24, height=5.0), 40)
    np.testing.assert_allclose(np.minimum(bent[:, 2], 5.0 - bent[:, 2]), 0.0, atol=0.05)
    assert len(faces) == 40


def test_what_cannot_be_contracted_is_left() -> None:
    """A tetrahedron, and two faces that meet in a vertex only."""
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    points, left = decimated(corners, faces, 2)
    assert len(points) == 4 and len(left) == 4


def test_the_same_mesh_comes_out_each_time() -> None:
    field = ball_field()
    made = [extract_surface(field, level=LEVEL, n_faces=500) for _ in range(2)]
    np.testing.assert_array_equal(made[0].points, made[1].points)
    np.testing.assert_array_equal(made[0].faces, made[1].faces)


@pytest.mark.parametrize(
    ("file", "n_faces", "says"),
    [
        ("a.glb", 3, "the number of faces must be"),
        ("a.points.ply", 500, "the number of faces is of meshes"),
    ],
)
def test_a_number_of_faces_that_cannot_be_is_refused(
    tmp_path: Path, file: str, n_faces: int, says: str
) -> None:
    with pytest.raises(InputError, match=says):
        export(ball_field(), tmp_path / file, level=LEVEL, options=ExportOptions(n_faces=n_faces))
