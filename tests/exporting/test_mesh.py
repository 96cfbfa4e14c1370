"""Surfaces: where they lie, which way they face, their colours, and files that others read."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.support.solid_fields import LEVEL, ball_field, camera_at, cameras_around, read_ply
from warpnerf.checks import InputError
from warpnerf.exporting.export import export
from warpnerf.exporting.mesh import linear_light, mesh_glb, mesh_obj, mesh_ply, points_ply
from warpnerf.exporting.surface import Surface, density, extract_surface, raw_density
from warpnerf.exporting.visibility import visibility

CENTRE, RADIUS = np.array([0.1, -0.05, 0.15]), 0.6


def signed_volume(points: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = points.astype(np.float64)[faces].transpose(1, 0, 2)
    return float(np.einsum("ni,ni->", a, np.cross(b, c)) / 6.0)


@pytest.fixture(scope="module")
def ball() -> Surface:
    return extract_surface(ball_field(), level=LEVEL)


def test_a_ball_is_closed_and_has_its_volume(ball: Surface) -> None:
    true = 4.0 / 3.0 * np.pi * RADIUS**3
    assert signed_volume(ball.points, ball.faces) == pytest.approx(true, rel=0.01)
    edges = np.concatenate([ball.faces[:, pair] for pair in ([0, 1], [1, 2], [2, 0])])
    there = {tuple(edge) for edge in edges.tolist()}
    assert len(there) == len(edges)  # each edge belongs to two faces that run along it
    assert there == {(b, a) for a, b in there}  # in opposite directions


def test_vertices_lie_on_the_ball_and_normals_point_outward(ball: Surface) -> None:
    outward = ball.points - CENTRE
    radii = np.linalg.norm(outward, axis=1)
    assert np.abs(radii - RADIUS).max() < 0.1 * 0.05  # of a voxel edge
    assert ((outward / radii[:, None]) * ball.normals).sum(axis=1).min() > 0.99


def test_colours_are_those_of_the_field(ball: Surface) -> None:
    x, _, z = (ball.points - CENTRE).T
    bright, dark = 1.0 / (1.0 + np.exp(-2.0)), 1.0 / (1.0 + np.exp(2.0))
    right, left = x > 0.06, x < -0.06
    np.testing.assert_allclose(ball.rgb[right, 0], bright, atol=0.01)
    np.testing.assert_allclose(ball.rgb[left, 0], dark, atol=0.01)
    np.testing.assert_allclose(ball.rgb[left, 1], bright, atol=0.01)
    assert np.abs(ball.rgb[:, 2] - (0.5 + 0.3 * z / RADIUS)).max() < 0.02


def test_what_is_added_to_raw_densities_counts() -> None:
    """Of raw densities that are as much lower it is the same ball."""
    field = ball_field()
    values = field.storage.values.numpy()
    values[:, 0] -= 15.0
    field.storage.values.assign(values)
    shifted = replace(field, storage=replace(field.storage, density_shift=15.0))
    same = extract_surface(shifted, level=LEVEL)
    radii = np.linalg.norm(same.points - CENTRE, axis=1)
    assert np.abs(radii - RADIUS).max() < 0.1 * 0.05  # of a voxel edge
    np.testing.assert_allclose(
        density(shifted, raw_density(shifted)),
        density(ball_field(), raw_density(ball_field())),
        atol=1e-4,
    )


@pytest.mark.parametrize("contraction", ["linf", "l2"])
def test_folded_space_comes_out_in_scene_units(contraction: str) -> None:
    """A ball that reaches far out of the box, where a voxel is several times as long."""
    field = ball_field((0.3, 0.0, 0.0), 1.4, contraction)
    far = extract_surface(field, level=LEVEL, crop=((-9, -9, -9), (9, 9, 9)))
    radii = np.linalg.norm(far.points - (0.3, 0.0, 0.0), axis=1)
    assert np.abs(radii - 1.4).max() < 0.2  # a voxel edge is as long there
    assert np.abs(radii - 1.4).mean() < 0.05
    assert signed_volume(far.points, far.faces) == pytest.approx(4 / 3 * np.pi * 1.4**3, rel=0.06)
    outward = (far.points - (0.3, 0.0, 0.0)) / radii[:, None]
    assert np.mean((outward * far.normals).sum(axis=1)) > 0.94
    inner = extract_surface(field, level=LEVEL)  # by default, that of the inner box
    assert (np.abs(inner.points) < np.array([1.0, 1.1, 1.2]) + 1e-6).all()
    assert len(inner.points) < len(far.points)


def test_only_what_cameras_see_is_kept() -> None:
    field = ball_field(hidden=0.35)
    all_of_it = extract_surface(field, level=LEVEL)
    radii = np.linalg.norm(all_of_it.points - CENTRE, axis=1)
    assert (radii < 0.4).any()
    seen = extract_surface(field, visibility(field, cameras_around()), level=LEVEL)
    radii = np.linalg.norm(seen.points - CENTRE, axis=1)
    assert radii.min() > 0.55  # the hollow is gone, the outside is whole
    assert signed_volume(seen.points, seen.faces) == pytest.approx(0.905, rel=0.01)
    in_front = extract_surface(field, visibility(field, [camera_at((2.5, 0.0, 0.1))]), level=LEVEL)
    assert 0.2 < len(in_front.faces) / len(seen.faces) < 0.6
    assert in_front.points[:, 0].min() > CENTRE[0] - 0.2


def test_crop_and_size_drop_what_they_say() -> None:
    field = ball_field()
    cut = extract_surface(field, level=LEVEL, crop=((-1, -1, -1), (0.2, 1, 1)))
    assert 0.15 < cut.points[:, 0].max() <= 0.2
    assert cut.faces.max() == len(cut.points) - 1
    with pytest.raises(InputError, match="scene units across"):
        extract_surface(field, level=LEVEL, min_size=2.5)
    hollow = ball_field(hidden=0.2)
    both = extract_surface(hollow, level=LEVEL, min_size=0.1)
    outer = extract_surface(hollow, level=LEVEL, min_size=1.0)
    assert len(both.faces) > len(outer.faces)
    assert np.linalg.norm(outer.points - CENTRE, axis=1).min() > 0.5


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"level": 1e9}, "no surface of this density in its box, where it is .* to 400 per"),
        ({"level": 1e300}, "no surface of this density in its box, where it is .* to 400 per"),
        ({"level": 1e-310}, "no surface of this density in its box, where it is .* to 400 per"),
        ({"level": 0.0}, "level must be a finite number above 0"),
        ({"level": float("nan")}, "level must be a finite number above 0"),
        ({"min_size": -1.0}, "min_size must be"),
        ({"crop": ((0, 0, 0), (1, 1, 0))}, "the first below the second"),
        ({"crop": ((0, 0, 0), (1, 1, float("inf")))}, "the first below the second"),
        ({"crop": ((2, 2, 2), (3, 3, 3))}, "lies outside of the field, which reaches from -1"),
        ({"crop": ((0.11, 0, 0), (0.12, 0.1, 0.1))}, "lies between two nodes of the grid"),
        (
            {"crop": ((-1, -1, -1), (-0.8, -0.8, -0.8))},
            "no surface of this density inside the crop, where it is .*e-17",
        ),
    ],
)
def test_what_cannot_be_is_refused(options: dict, says: str) -> None:
    with pytest.raises(InputError, match=says):
        extract_surface(ball_field(), **options)


def test_ply_holds_the_mesh(ball: Surface) -> None:
    table, faces = read_ply(b"".join(mesh_ply(ball)))
    assert table.dtype.names == ("x", "y", "z", "nx", "ny", "nz", "red", "green", "blue")
    np.testing.assert_array_equal(faces, ball.faces)
    np.testing.assert_array_equal(np.stack([table[c] for c in "xyz"], axis=1), ball.points)
    colour = np.stack([table[c] for c in ("red", "green", "blue")], axis=1)
    assert np.abs(colour / 255.0 - ball.rgb).max() < 0.51 / 255.0
    points, nothing = read_ply(b"".join(points_ply(ball)))
    np.testing.assert_array_equal(points, table)
    assert nothing is None


def test_obj_holds_the_mesh(ball: Surface) -> None:
    rows: dict[str, list] = {"v": [], "vn": [], "f": []}
    for line in b"".join(mesh_obj(ball)).decode().splitlines()[1:]:
        kind, *words = line.split()
        rows[kind].append([float(word.split("//")[0]) for word in words])
    vertices = np.array(rows["v"])
    np.testing.assert_allclose(vertices[:, :3], ball.points, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(vertices[:, 3:], ball.rgb, atol=1e-4)
    np.testing.assert_allclose(rows["vn"], ball.normals, atol=1e-4)
    np.testing.assert_array_equal(np.array(rows["f"], int) - 1, ball.faces)


def test_glb_holds_the_mesh_with_up_turned_to_y(ball: Surface) -> None:
    data = b"".join(mesh_glb(ball, np.array([0.0, 0.0, 1.0])))
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    tree, begin = json.loads(data[20 : 20 + size]), 20 + size
    assert kind == b"JSON" and begin % 4 == 0
    size, kind = struct.unpack_from("<I4s", data, begin)
    assert kind == b"BIN\0" and begin + 8 + size == len(data)
    assert tree["buffers"] == [{"byteLength": size}]

    def values(accessor: int) -> np.ndarray:
        entry = tree["accessors"][accessor]
        view = tree["bufferViews"][entry["bufferView"]]
        dtype = {5126: "<f4", 5125: "<u4"}[entry["componentType"]]
        n = {"SCALAR": 1, "VEC3": 3}[entry["type"]]
        flat = np.frombuffer(data, dtype, n * entry["count"], begin + 8 + view["byteOffset"])
        return flat.reshape(-1, n)

    primitive = tree["meshes"][0]["primitives"][0]
    at = primitive["attributes"]
    np.testing.assert_array_equal(values(at["POSITION"]), ball.points)
    np.testing.assert_array_equal(values(primitive["indices"]).reshape(-1, 3), ball.faces)
    np.testing.assert_allclose(values(at["COLOR_0"]), linear_light(ball.rgb), atol=1e-6)
    bounds = tree["accessors"][at["POSITION"]]
    np.testing.assert_array_equal(bounds["min"], ball.points.min(axis=0))
    np.testing.assert_array_equal(bounds["max"], ball.points.max(axis=0))
    np.testing.assert_allclose(turned(tree, (0.0, 0.0, 1.0)), (0, 1, 0), atol=1e-6)


def turned(tree: dict, v: tuple[float, float, float]) -> np.ndarray:
    """A vector after the rotation of the mesh's node."""
    *axis, w = tree["nodes"][0]["rotation"]
    return np.array(v) + 2.0 * np.cross(axis, np.cross(axis, v) + np.multiply(w, v))


@pytest.mark.parametrize("up", [(0, 1, 0), (0, -1, 0), (0.6, 0, 0.8), (0, -0.6, 0.8)])
def test_any_up_is_turned_to_y(ball: Surface, up: tuple[float, float, float]) -> None:
    data = b"".join(mesh_glb(ball, np.array(up)))
    (size,) = struct.unpack_from("<I", data, 12)
    np.testing.assert_allclose(turned(json.loads(data[20 : 20 + size]), up), (0, 1, 0), atol=1e-6)


def test_linear_light_is_that_of_the_standard() -> None:
    linear = linear_light(np.array([0.0, 0.02, 0.5, 1.0]))
    np.testing.assert_allclose(linear, [0.0, 0.0015480, 0.2140411, 1.0], atol=1e-7)


@pytest.mark.parametrize("ending", ["ply", "obj", "glb", "points.ply"])
def test_trimesh_reads_it(tmp_path: Path, ending: str) -> None:
    trimesh = pytest.importorskip("trimesh")
    path = export(ball_field(), tmp_path / f"ball.{ending}", level=LEVEL)
    options = {"skip_materials": True} if ending == "glb" else {}
    loaded = trimesh.load(path, process=False, **options)
    geometry = next(iter(loaded.geometry.values())) if ending == "glb" else loaded
    if ending == "points.ply":
        colours = geometry.colors
    else:
        assert geometry.is_watertight and geometry.is_winding_consistent
        assert geometry.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.01)
        colours = geometry.visual.vertex_colors
    right = geometry.vertices[:, 0] > CENTRE[0] + 0.06
    bright = 0.8808 if ending != "glb" else float(linear_light(np.array(0.8808)))
    np.testing.assert_allclose(colours[right, 0] / 255.0, bright, atol=0.02)
