"""Textures: texels show what the field shows at the places that they are mapped to."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest

from tests.exporting.test_decimation import plane
from tests.exporting.test_mesh import CENTRE
from tests.support.solid_fields import LEVEL, ball_field
from warpnerf.checks import InputError
from warpnerf.exporting.atlas import Textured, textured
from warpnerf.exporting.export import ExportOptions, export
from warpnerf.exporting.surface import Surface, extract_surface


def position_colours(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    return np.asarray(0.5 + 0.4 * np.sin(3.0 * points))


def texture_at(made: Textured, shares: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Bilinear values [n_faces, 3] in faces, and the points there."""
    weights = np.array(shares)[:, None]
    uv = (weights * made.uv[made.surface.faces]).sum(axis=1)
    points = (weights * made.surface.points[made.surface.faces]).sum(axis=1)
    height, width = made.texture.shape[:2]
    at = uv * (width, height) - 0.5
    low = np.clip(np.floor(at).astype(int), 0, (width - 2, height - 2))
    (fx, fy), (x, y) = (at - low).T[..., None], low.T
    pixels = made.texture / 255.0
    upper = (1 - fx) * pixels[y, x] + fx * pixels[y, x + 1]
    lower = (1 - fx) * pixels[y + 1, x] + fx * pixels[y + 1, x + 1]
    return (1 - fy) * upper + fy * lower, points


@pytest.mark.parametrize("shares", [(1 / 3, 1 / 3, 1 / 3), (1.0, 0.0, 0.0), (0.0, 0.5, 0.5)])
@pytest.mark.parametrize("n_faces", [None, 800])
def test_texels_show_their_places(shares: tuple[float, float, float], n_faces: int | None) -> None:
    """Also on borders of charts: there filtering reads the margin."""
    ball = extract_surface(ball_field(), level=LEVEL, n_faces=n_faces)
    made = textured(ball, 0.01, 2048, position_colours)
    shown, points = texture_at(made, shares)
    away = np.abs(shown - position_colours(points, points)).max(axis=1)
    assert np.quantile(away, 0.99) < 0.04 and away.max() < 0.1
    assert made.uv.min() >= 0.0 and made.uv.max() <= 1.0
    corners = ball.points[ball.faces]
    np.testing.assert_array_equal(made.surface.points[made.surface.faces], corners)


def test_charts_do_not_lie_on_each_other() -> None:
    """Each texel shows the point of the one face that covers it."""
    ball = extract_surface(ball_field(), level=LEVEL, n_faces=800)
    made = textured(ball, 0.02, 2048, position_colours)
    size = made.texture.shape[1::-1]
    middles = np.floor(made.uv[made.surface.faces].mean(axis=1) * size).astype(int)
    of_face = {}
    for face, texel in enumerate(map(tuple, middles.tolist())):
        of_face.setdefault(texel, []).append(made.surface.points[made.surface.faces[face]].mean(0))
    apart = [np.ptp(np.array(points), axis=0).max() for points in of_face.values()]
    assert max(apart) < 0.06


def test_a_texture_stays_within_the_largest() -> None:
    points, faces = plane(20)
    flat = Surface(
        points=points.astype(np.float32),
        faces=faces.astype(np.int32),
        normals=np.tile(np.float32([0, 0, 1]), (len(points), 1)),
        rgb=np.full((len(points), 3), 0.5, np.float32),
    )
    fine = textured(flat, 0.05, 4096, lambda p, n: np.full_like(p, 0.25))
    assert 400 <= fine.texture.shape[0] <= 410 and fine.texture.shape[1] < 450
    small = textured(flat, 0.05, 64, lambda p, n: np.full_like(p, 0.25))
    assert max(small.texture.shape) <= 64
    shown, _ = texture_at(small, (1 / 3, 1 / 3, 1 / 3))
    np.testing.assert_allclose(shown, 0.25, atol=0.01)


def test_trimesh_reads_the_texture(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    path = export(
        ball_field(),
        tmp_path / "ball.glb",
        level=LEVEL,
        options=ExportOptions(n_faces=1000, texture=True),
    )
    (mesh,) = trimesh.load(path, process=False).geometry.values()
    image = mesh.visual.material.baseColorTexture
    pixels = np.asarray(image.convert("RGB")) / 255.0
    uv = mesh.visual.uv[mesh.faces].mean(axis=1)  # v goes up in trimesh
    x, y = (uv * (image.width, image.height)).astype(int).T
    shown = pixels[image.height - 1 - y, x]
    middle = mesh.vertices[mesh.faces].mean(axis=1)
    right = middle[:, 0] > CENTRE[0] + 0.1
    np.testing.assert_allclose(shown[right, 0], 0.8808, atol=0.05)
    np.testing.assert_allclose(shown[middle[:, 0] < CENTRE[0] - 0.1, 1], 0.8808, atol=0.05)
    assert mesh.vertex_attributes["_COLOR_0"].shape == (len(mesh.vertices), 3)
    assert io.BytesIO(path.read_bytes()).read(4) == b"glTF"


def test_a_texture_of_what_is_no_glb_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a texture is of \.glb files, and there is none"):
        export(
            ball_field(), tmp_path / "ball.ply", level=LEVEL, options=ExportOptions(texture=True)
        )
