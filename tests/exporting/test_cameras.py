"""A scene's folder for other programs, read back by our loaders and by pycolmap."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.solid_fields import LEVEL, ball_field, cameras_around, read_ply
from warpnerf.checks import InputError
from warpnerf.exporting import cameras as scenes
from warpnerf.exporting.export import export
from warpnerf.scenes.formats.load import load_scene
from warpnerf.scenes.scene import Scene, View

pytestmark = pytest.mark.usefixtures("poses_as_given")


def ball_scene(masked: bool = False, **lens: float) -> Scene:
    """Noise, photographed by the cameras around the ball; the last one has another lens."""
    rng = np.random.default_rng(0)
    cameras = cameras_around()
    bent = lens or {"k1": 0.05, "k2": -0.02, "p1": 0.003, "p2": -0.001}
    cameras[-1] = replace(cameras[-1], **bent)
    masks: list[np.ndarray | None] = [None] * 12
    if masked:
        masks[3] = rng.random((40, 48)) > 0.3
    views = [
        View(
            name=f"a/{k:02}.jpg",
            camera=camera,
            image=rng.integers(0, 256, (40, 48, 3), np.uint8),
            mask=masks[k],
        )
        for k, camera in enumerate(cameras)
    ]
    return Scene(
        name="ball",
        views=views,
        splits={"train": tuple(range(2, 12)), "test": (0, 1)},
        box_min=np.full(3, -1.0),
        box_max=np.full(3, 1.0),
        unbounded=False,
        content_distance=2.4,
    )


def assert_same(read: Scene, scene: Scene) -> None:
    assert len(read.views) == len(scene.views)
    for view, wanted in zip(read.views, scene.views, strict=True):
        np.testing.assert_array_equal(view.image, wanted.image)
        np.testing.assert_allclose(view.camera.c2w, wanted.camera.c2w, atol=1e-12)
        for name in vars(wanted.camera):
            if name != "c2w":
                assert getattr(view.camera, name) == getattr(wanted.camera, name), name
        if wanted.mask is not None:
            np.testing.assert_array_equal(view.mask, wanted.mask)
        assert view.mask is None or wanted.mask is not None or view.mask.all()


@pytest.mark.ci
@pytest.mark.parametrize(
    "lens",
    [
        {"k1": 0.05, "k2": -0.02, "p1": 0.003, "p2": -0.001},
        {"k1": 0.05, "k3": 0.01},
        {"k1": 0.3, "p1": 0.001, "k4": 0.2, "k5": 0.01, "k6": 0.002},
        {"fisheye": True, "k1": 0.02, "k2": 0.01, "k3": -0.005, "k4": 0.002},
        {"masked": True},
    ],
    ids=["bent", "k3", "rational", "fisheye", "masked"],
)
def test_the_folder_is_the_scene(tmp_path: Path, lens: dict[str, Any]) -> None:
    scene = ball_scene(**lens)
    folder = export(ball_field(), tmp_path / "out", scene=scene, level=LEVEL)
    files = {"images", "points.ply", "sparse", "transforms.json"}
    assert {path.name for path in folder.iterdir()} - {"masks"} == files
    read = load_scene(folder)
    assert_same(read, scene)
    assert read.splits["test"] == read.splits["val"] == (0, 1)  # nerfstudio reads all three
    (folder / "transforms.json").unlink()
    assert_same(load_scene(folder), scene)  # by the COLMAP model
    points, _ = read_ply((folder / "points.ply").read_bytes())
    away = np.stack([points[c] for c in "xyz"], axis=1) - (0.1, -0.05, 0.15)
    np.testing.assert_allclose(np.linalg.norm(away, axis=1), 0.6, atol=0.01)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_pycolmap_sees_the_same(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    scene = ball_scene()
    export(ball_field(), tmp_path / "out", scene=scene, level=LEVEL)
    model = pycolmap.Reconstruction(tmp_path / "out" / "sparse" / "0")
    assert {camera.model.name for camera in model.cameras.values()} == {"PINHOLE", "OPENCV"}
    assert len(model.images) == 12
    point = np.array([0.2, -0.1, 0.3])
    for image in model.images.values():
        camera = scene.views[image.image_id - 1].camera
        local = (point - camera.position) @ camera.c2w[:, :3] * (1.0, -1.0, -1.0)
        (x, y), _ = (part[0] for part in camera.distort(local[None, :2] / local[2]))
        wanted = (camera.fx * x + camera.cx, camera.fy * y + camera.cy)
        np.testing.assert_allclose(image.project_point(point), wanted, atol=1e-6)
    positions = np.array([p.xyz for p in model.points3D.values()])
    np.testing.assert_allclose(
        np.linalg.norm(positions - (0.1, -0.05, 0.15), axis=1), 0.6, atol=0.01
    )


def test_transforms_say_what_nerfstudio_reads(tmp_path: Path) -> None:
    export(ball_field(), tmp_path / "out", scene=ball_scene(), level=LEVEL)
    tree = json.loads((tmp_path / "out" / "transforms.json").read_text())
    assert tree["camera_model"] == "OPENCV"
    assert (tmp_path / "out" / tree["ply_file_path"]).exists()
    assert tree["test_filenames"] == ["images/a_00.png", "images/a_01.png"]
    frame = tree["frames"][-1]
    assert (frame["w"], frame["h"], frame["k1"]) == (48, 40, 0.05)
    assert frame["transform_matrix"][3] == [0.0, 0.0, 0.0, 1.0]


def test_points_are_thinned_the_same_way_each_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scenes, "MAX_POINTS", 100)
    for name in ("a", "b"):
        export(ball_field(), tmp_path / name, scene=ball_scene(), level=LEVEL)
    points = [(tmp_path / name / "points.ply").read_bytes() for name in ("a", "b")]
    assert points[0] == points[1] and len(read_ply(points[0])[0]) == 100


def test_a_folder_that_holds_something_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    export(ball_field(), tmp_path / "out", scene=ball_scene(), level=LEVEL)
    with pytest.raises(InputError, match="exists already; name a new folder"):
        export(ball_field(), tmp_path / "out", scene=ball_scene(), level=LEVEL)
    with pytest.raises(InputError, match="needs the scene"):
        export(ball_field(), tmp_path / "other", level=LEVEL)
    assert not (tmp_path / "other").exists()
    (tmp_path / "mesh").touch()
    for path in (tmp_path / "mesh", "/dev/stdout"):
        with pytest.raises(InputError, match="its name has no ending, which says what to write"):
            export(ball_field(), path, scene=ball_scene(), level=LEVEL)


def test_what_fails_half_way_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(scenes, "transforms_json", full)
    with pytest.raises(OSError, match="No space"):
        export(ball_field(), tmp_path / "out", scene=ball_scene(), level=LEVEL)
    assert list(tmp_path.iterdir()) == []
