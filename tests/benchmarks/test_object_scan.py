"""The generated object: a scene that the readers take, with alpha and highlights."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

import warpnerf as wn
from warpnerf.scenes.builtin.solids import Ball, Cylinder

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import object_scan


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> wn.Scene:
    folder = tmp_path_factory.mktemp("object") / "scan"
    object_scan.write_scan(folder, {"train": 3, "val": 1, "test": 2}, size=48, workers=1)
    return wn.load_scene(folder)


def test_it_is_an_object_with_alpha(scene: wn.Scene) -> None:
    assert {split: len(views) for split, views in scene.splits.items()} == {
        "train": 3,
        "val": 1,
        "test": 2,
    }
    assert scene.has_alpha and not scene.unbounded
    for view in scene.views:
        alpha = view.image[..., 3]
        assert 0.1 < (alpha == 255).mean() < 0.6
        assert ((alpha > 0) & (alpha < 255)).any()
        assert (alpha[:, [0, -1]] == 0).all() and (alpha[[0, -1]] == 0).all()  # wholly in sight
        assert view.image[alpha == 255, :3].std() > 20


def test_pixels_show_the_solids_of_their_rays(scene: wn.Scene) -> None:
    """Cameras of the files, turned back to where the solids lie along the axes."""
    cosine, sine = np.cos(object_scan.TURN), np.sin(object_scan.TURN)
    back = np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    for index in scene.splits["test"]:
        view = scene.views[index]
        camera = view.camera
        v, u = np.mgrid[: camera.height, : camera.width]
        local = np.stack(
            [
                (u + 0.5 - camera.cx) / camera.fx,
                (camera.cy - v - 0.5) / camera.fy,
                np.full(u.shape, -1.0),
            ],
            axis=-1,
        )
        directions = (local @ (back @ camera.c2w[:, :3]).T).reshape(-1, 3)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        origins = np.broadcast_to(back @ camera.position, directions.shape)
        hit = object_scan.tracer().first_hit(origins, directions) < 6.0
        alpha = view.image[..., 3].ravel()
        assert hit[alpha == 255].mean() > 0.97 and hit[alpha == 0].mean() < 0.02


def test_highlights_depend_on_the_eye() -> None:
    points = np.array([[0.0], [0.0], [1.0]])
    top = object_scan.box((-1.0, -1.0, 0.0), (1.0, 1.0, 1.0), lambda at: 0.0 * at.points, 0.5)
    mirrored = object_scan.SUN * [-1.0, -1.0, 1.0]
    shine = []
    for eye in (mirrored, object_scan.SUN * [1.0, 1.0, 0.1]):
        object_scan.Lacquer.eye = points[:, 0] + 4.0 * eye
        shine.append(top.texture(top.locate(points)).max())
    assert shine[0] == pytest.approx(0.5, rel=1e-4) and shine[1] < 0.1


def test_a_mesh_of_the_solids_is_where_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And one that is moved, or lacks the bars, is not."""
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("scipy")
    import object_mesh

    for name, value in {"POINTS": 200_000, "CHECKED": 2000, "SEEN_SIZE": 24, "CAMERAS": 4}.items():
        monkeypatch.setattr(object_mesh, name, value)
    parts = []
    for solid in list(object_scan.solids())[1:]:
        low, high = np.array(solid.lo), np.array(solid.hi)
        if isinstance(solid, Ball):
            part = trimesh.creation.icosphere(radius=0.5 * (high - low)[0])
        elif isinstance(solid, Cylinder):
            part = trimesh.creation.cylinder(0.5 * (high - low)[0], (high - low)[2])
        else:
            part = trimesh.creation.box(high - low)
        parts.append(part.apply_translation(0.5 * (low + high)))
    turn = np.eye(4)
    turn[:3, :3] = object_scan.turning()
    thick = [part for part in parts if np.sort(part.extents)[1] > object_mesh.THIN]
    paths = []
    for name, solids, away in (("right", parts, 0.0), ("moved", parts, 0.1), ("thick", thick, 0.0)):
        mesh = trimesh.util.concatenate(solids).apply_translation([0.0, 0.0, away])
        paths.append(tmp_path / f"{name}.ply")
        mesh.apply_transform(turn).export(paths[-1])
    output = tmp_path / "record.json"
    monkeypatch.setattr(sys, "argv", ["object_mesh.py", *map(str, paths), "--output", str(output)])
    object_mesh.main()
    right, moved, thick = json.loads(output.read_text())["rows"]
    assert right["mesh_to_truth"] < 1e-3  # balls and cylinders have flat faces
    assert right["truth_to_mesh"] < 2.0 * right["apart"] and right["thin_most"] < 0.01
    assert moved["chamfer"] > 0.01
    assert thick["thin_mean"] > 3.0 * right["thin_mean"]
