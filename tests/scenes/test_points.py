"""Points of a scene's surfaces: what cameras see of them, and the extent that follows."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.scenes.test_colmap import scene_with_model, write_model
from tests.support.small_model import SQUARED
from tests.support.tiny_scenes import (
    camera_at,
    look_at,
    ring,
    transforms_content,
    write_blender,
    write_transforms,
)
from warpnerf.checks import InputError
from warpnerf.config import GridConfig, TrainConfig
from warpnerf.inspection.inspection import inspect
from warpnerf.media.scene_plan import plan_picture
from warpnerf.model.sampler_kinds import MARCHED
from warpnerf.optim_config import OptimConfig
from warpnerf.runs.checkpoint import load_checkpoint, save_checkpoint
from warpnerf.scenes.extent.points import Points, observed_extent
from warpnerf.scenes.formats.load import load_scene
from warpnerf.scenes.scene import Scene
from warpnerf.training.plan import OlderPlan
from warpnerf.training.train import train
from warpnerf.training.trainer import Trainer


def ball(n: int = 400, radius: float = 0.5, seed: int = 0) -> np.ndarray:
    """Points on a ball about the origin."""
    points = np.random.default_rng(seed).normal(size=(n, 3))
    return radius * points / np.linalg.norm(points, axis=1, keepdims=True)


def write_points(model: Path, points: np.ndarray, views: int = 4) -> None:
    """points3D.txt, all of whose points are seen in all views."""
    track = " ".join(f"{view + 1} 0" for view in range(views))
    lines = [f"{i} {x} {y} {z} 1 2 3 0.5 {track}" for i, (x, y, z) in enumerate(points)]
    (model / "points3D.txt").write_text("# points\n" + "\n".join(lines) + "\n")


def write_ply(file: Path, points: np.ndarray) -> None:
    head = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    file.write_text(head + "".join(f"{x} {y} {z}\n" for x, y, z in points))


def test_a_track_tells_what_is_seen_and_else_the_picture() -> None:
    camera = camera_at(look_at((0.0, -3.0, 0.0), (0.0, 0.0, 0.0)))
    places = np.array(
        [
            [0.0, 0.0, 0.0],  # in the middle
            [0.0, -4.0, 0.0],  # behind
            [1.1, 0.0, 0.0],  # 0.37 to the side, and half the picture is 0.4
            [1.3, 0.0, 0.0],  # too far
            [0.0, 0.0, 0.8],
            [0.0, 0.0, -1.0],  # half the picture's height is 0.3
            [0.0, -3.0, 0.0],  # the camera
        ]
    )
    by_picture = Points(positions=places, tracks=None, source="")
    np.testing.assert_array_equal(by_picture.seen_by("a", camera), places[[0, 2, 4]])
    tracks = {"a": np.array([0, 1, 3])}
    by_track = Points(positions=places, tracks=tracks, source="")
    np.testing.assert_array_equal(by_track.seen_by("a", camera), places[[0, 3]])
    assert len(by_track.seen_by("b", camera)) == 0


def test_an_off_centre_principal_point_counts() -> None:
    pose = look_at((0.0, -3.0, 0.0), (0.0, 0.0, 0.0))
    aside = Points(positions=np.array([[1.3, 0.0, 0.0], [-1.3, 0.0, 0.0]]), tracks=None, source="")
    for cx, seen in ((3.0, [1.3]), (5.0, [-1.3])):
        assert aside.seen_by("a", camera_at(pose, cx=cx))[:, 0] == pytest.approx(seen)
    above = Points(positions=np.array([[0.0, 0.0, 1.1], [0.0, 0.0, -1.1]]), tracks=None, source="")
    for cy, seen in ((2.0, [-1.1]), (4.0, [1.1])):
        assert above.seen_by("a", camera_at(pose, cy=cy))[:, 2] == pytest.approx(seen)


def test_a_fisheye_lens_sees_by_the_angle() -> None:
    pose = look_at((0.0, -3.0, 0.0), (0.0, 0.0, 0.0))
    angles = np.radians([0.0, 20.0, 40.0, 70.0, 80.0])
    around = np.stack([np.sin(angles), np.cos(angles) - 3.0, 0.0 * angles], axis=1)
    wide = camera_at(pose, fx=3.0, fy=3.0, fisheye=True)  # half the picture is 76 degrees
    points = Points(positions=around, tracks=None, source="")
    np.testing.assert_array_equal(points.seen_by("a", wide), around[:4])


def test_distances_are_each_camera_s_own() -> None:
    cameras = [camera_at(pose) for r in (2.0, 4.0, 8.0) for pose in ring(3, radius=r, height=0.0)]
    seen = [ball() for _ in cameras]
    seen[4] = ball(5)
    observed = observed_extent(cameras, seen, range(6))
    assert observed is not None
    expected = [2.0, 2.0, 2.0, 4.0, 4.0, 4.0, 8.0, 8.0, 8.0]
    expected[4] = observed.content_distance  # sees too few
    np.testing.assert_allclose(observed.distances, expected, rtol=0.07)
    assert observed.content_distance == pytest.approx(2.0, rel=0.07)  # of five training cameras
    assert observed.near_content == pytest.approx(1.5, rel=0.03)
    np.testing.assert_allclose(observed.box_max, 0.53, rtol=0.05)
    np.testing.assert_allclose(observed.box_min, -observed.box_max, rtol=0.05)


def test_wrong_points_change_little() -> None:
    cameras = [camera_at(pose) for pose in ring(8)]
    rng = np.random.default_rng(3)
    clean = observed_extent(cameras, [ball() for _ in cameras], range(8))
    seen = []
    for camera in cameras:
        close = camera.position + 0.02 * rng.normal(size=(6, 3))
        far = camera.position + camera.forward * rng.uniform(20.0, 2000.0, (40, 1))
        seen.append(np.concatenate([ball(), close, far]))
    noisy = observed_extent(cameras, seen, range(8))
    assert clean is not None and noisy is not None
    assert noisy.content_distance == pytest.approx(clean.content_distance, rel=0.02)
    np.testing.assert_allclose(noisy.box_max, clean.box_max, rtol=0.1)
    np.testing.assert_allclose(noisy.box_min, clean.box_min, rtol=0.1)


def test_a_camera_counts_as_much_as_another() -> None:
    cameras = [camera_at(pose) for pose in ring(4)]
    aside = np.array([5.0, 0.0, 0.0])
    seen = [ball(90_000, seed=1), *(ball(100, seed=s) + aside for s in (2, 3, 4))]
    observed = observed_extent(cameras, seen, range(4))
    assert observed is not None and observed.box_max[0] > 5.0  # 1 in 300 points is there
    assert observed.middle[0] > 4.0
    alone = observed_extent(cameras, [ball(100), *seen[:1] * 3], range(4))
    assert alone is not None and alone.box_max[0] < 1.0


def test_a_flat_scene_has_a_box_with_depth() -> None:
    cameras = [camera_at(pose) for pose in ring(4)]
    wall = np.random.default_rng(0).uniform(-1.0, 1.0, (500, 3)) * [1.0, 1.0, 0.0]
    observed = observed_extent(cameras, [wall] * 4, range(4))
    assert observed is not None
    edges = observed.box_max - observed.box_min
    assert edges[:2] == pytest.approx(2.1, rel=0.1) and 0.3 < edges[2] < 0.5


def test_too_few_points_tell_nothing() -> None:
    cameras = [camera_at(pose) for pose in ring(4)]
    assert observed_extent(cameras, [ball(9)] * 4, range(4)) is None
    assert observed_extent(cameras, [ball(9)] * 2 + [ball(10)] * 2, range(3)) is None
    assert observed_extent(cameras, [ball(9)] * 2 + [ball(10)] * 2, range(4)) is not None
    assert observed_extent(cameras, [np.zeros((20, 3))] * 4, range(4)) is None  # all in one place
    at_cameras = [np.tile(camera.position, (20, 1)) for camera in cameras]
    assert observed_extent(cameras, at_cameras, range(4)) is None
    observed = observed_extent(cameras, [*at_cameras[:2], ball(), ball()], range(4))
    assert observed is not None and (observed.distances > 1.0).all()


def by_points(scene: Scene) -> bool:
    return scene.content_distances is not None


def test_a_model_s_points_give_the_extent(tmp_path: Path) -> None:
    model = scene_with_model(tmp_path, text=True)
    without = load_scene(tmp_path)
    assert not by_points(without) and without.points is None
    write_points(model, ball(radius=0.3) + np.array([0.0, 0.0, 0.1]))
    scene = load_scene(tmp_path)
    assert by_points(scene) and scene.points is not None and scene.points.shape == (400, 3)
    assert (
        scene.tracks is not None and (scene.tracks.counts(v.name for v in scene.views) == 4).all()
    )
    assert scene.content_distance == pytest.approx(np.sqrt(10.0), rel=0.1)
    np.testing.assert_allclose(scene.box_min, [-0.32, -0.32, -0.22], atol=0.02)
    np.testing.assert_allclose(scene.box_max, [0.32, 0.32, 0.42], atol=0.02)
    assert any("median distance of the points of sparse/0/points3D.txt" in n for n in scene.notes)
    found = inspect(tmp_path)
    assert "seen from" in str(found) and found.facts()["near_content"] == scene.near_content
    assert (plan_picture(found) != plan_picture(replace(found, scene=without))).any()
    write_points(model, ball(5))
    few = load_scene(tmp_path)
    assert not by_points(few) and few.content_distance == without.content_distance
    assert any("are not used: too few tell" in note for note in few.notes)


def test_an_object_keeps_the_box_that_the_cameras_see(tmp_path: Path) -> None:
    write_blender(tmp_path, "train", ring(5))
    content = json.loads((tmp_path / "transforms_train.json").read_text())
    (tmp_path / "transforms_train.json").rename(tmp_path / "transforms.json")
    without = load_scene(tmp_path)
    write_ply(tmp_path / "points.ply", ball())
    (tmp_path / "transforms.json").write_text(json.dumps(content | {"ply_file_path": "points.ply"}))
    scene = load_scene(tmp_path)
    assert not scene.unbounded and by_points(scene)
    np.testing.assert_array_equal(scene.box_min, without.box_min)


def test_outward_cameras_get_the_room_that_they_see(tmp_path: Path) -> None:
    turned = [pose @ np.diag([-1.0, 1.0, -1.0, 1.0]) for pose in ring(12, radius=0.3, height=0.0)]
    content = transforms_content(12)
    for frame, pose in zip(content["frames"], turned, strict=True):
        frame["transform_matrix"] = pose.tolist()
    write_transforms(tmp_path, 12)
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    angles = np.random.default_rng(0).uniform(0.0, 2.0 * np.pi, 3000)
    heights = np.random.default_rng(1).uniform(-1.0, 1.0, 3000)
    guessed = load_scene(tmp_path)
    write_ply(
        tmp_path / "sparse.ply", np.stack([3 * np.cos(angles), 3 * np.sin(angles), heights], 1)
    )
    content["ply_file_path"] = "sparse.ply"
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    scene = load_scene(tmp_path)
    assert (guessed.box_max - guessed.box_min).max() < 1.0
    np.testing.assert_allclose(scene.box_max[:2], 3.2, atol=0.3)
    assert scene.content_distance == pytest.approx(2.8, abs=0.1)
    assert not any("no common focus" in odd for odd in inspect(tmp_path).diagnostics)


@pytest.mark.parametrize("what", ["same", "moved", "turned", "damaged", "others"])
def test_points_beside_a_transforms_json_need_its_cameras(tmp_path: Path, what: str) -> None:
    write_transforms(tmp_path)
    expected = load_scene(tmp_path)
    model = write_model(tmp_path, text=True)
    write_points(model, ball())
    content = transforms_content(4)
    for frame in content["frames"]:
        pose = np.array(frame["transform_matrix"])
        if what == "moved":
            pose[:3, 3] += 0.5
        if what == "turned":
            pose = np.array([[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]]) @ pose
        frame["transform_matrix"] = pose.tolist()
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    if what == "damaged":
        (model / "points3D.txt").write_text("1 2 3\n")
    if what == "others":
        (model / "images.txt").write_text("\n".join(f"{i} 1 0 0 0 0 0 0 7 {i}.png\n" for i in "ab"))
    scene = load_scene(tmp_path)
    assert by_points(scene) == (what == "same")
    if what == "same":
        assert not scene.warnings
    elif what in ("damaged", "others"):
        assert scene.content_distance == expected.content_distance
        assert "the points of sparse/0 are not used: " in scene.warnings[0]
    else:
        assert scene.warnings == ("the points of sparse/0 are not used: its cameras are others",)


TURN = np.array([[0.0, 0.0, 1.0, 0.5], [1.0, 0.0, 0.0, -2.0], [0.0, 1.0, 0.0, 0.0]])


@pytest.mark.parametrize("applied", [TURN, None, TURN * 2.0, "TURN", [[1.0], "a"]])
def test_points_are_turned_as_the_cameras_of_their_model_were(tmp_path: Path, applied: Any) -> None:
    """As of ns-process-data: a turn, written as applied_transform, but not of the model."""
    write_transforms(tmp_path)
    write_points(write_model(tmp_path, text=True), ball())
    straight = load_scene(tmp_path)
    content = transforms_content(4)
    for frame in content["frames"]:
        pose = TURN[:, :3] @ np.array(frame["transform_matrix"])[:3]
        pose[:, 3] += TURN[:, 3]
        frame["transform_matrix"] = pose.tolist()
    content["applied_transform"] = applied.tolist() if hasattr(applied, "tolist") else applied
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    scene = load_scene(tmp_path)
    assert by_points(scene) == (applied is TURN)
    if applied is TURN:
        assert not scene.warnings
        assert scene.content_distance == pytest.approx(straight.content_distance)
        low, high = (TURN[:, :3] @ c + TURN[:, 3] for c in (straight.box_min, straight.box_max))
        np.testing.assert_allclose([scene.box_min, scene.box_max], [low, high], atol=1e-6)


def test_a_missing_ply_is_a_warning_and_a_wrong_one_an_error(tmp_path: Path) -> None:
    content = write_transforms(tmp_path)
    for name, error in (
        ("no.ply", ""),
        ("../no.ply", "leaves the scene's folder"),
        (7, "expected"),
    ):
        (tmp_path / "transforms.json").write_text(json.dumps(content | {"ply_file_path": name}))
        if error:
            with pytest.raises(InputError, match=rf"ply_file_path.*{error}|{error}.*ply_file_path"):
                load_scene(tmp_path)
        else:
            assert load_scene(tmp_path).warnings[0].endswith("ply_file_path no.ply is not there")


def scene_of_two_distances() -> Scene:
    from tests.support.tiny_scenes import tiny_scene

    poses = [*ring(3, radius=2.0), *ring(3, radius=6.0)]
    scene = tiny_scene(poses)
    return replace(scene, content_distances=np.array([2.0] * 3 + [6.0] * 3))


PER_CAMERA = TrainConfig(
    steps=20,
    rays_per_step=64,
    threads=1,
    model="rgb",
    loss=SQUARED,
    grid=GridConfig(voxels=8**3),
    optim=OptimConfig(tv_density=0.0, tv_rgb=0.0),  # takes the same distances
    content_distance="per-camera",
)


def test_training_takes_each_camera_s_distance() -> None:
    scene = scene_of_two_distances()
    values = [
        train(scene, replace(PER_CAMERA, content_distance=d)).field.storage.values.numpy()
        for d in ("per-camera", "auto", 2.0, 6.0)
    ]
    for other in values[1:]:
        assert not np.array_equal(values[0], other)
    alike = replace(scene, content_distances=np.full(6, scene.content_distance))
    one = train(alike, PER_CAMERA).field.storage.values.numpy()
    as_number = replace(PER_CAMERA, content_distance=scene.content_distance)
    np.testing.assert_array_equal(one, train(alike, as_number).field.storage.values.numpy())


def test_by_default_they_lie_between_each_camera_s_and_the_scene_s() -> None:
    scene = replace(scene_of_two_distances(), content_distance=3.0)
    auto = replace(PER_CAMERA, content_distance="auto")
    trainer = Trainer(scene, auto)
    assert trainer.plan.content_distance == 3.0
    expected = [math.sqrt(6.0)] * 3 + [math.sqrt(18.0)] * 2  # the sixth is for testing
    assert trainer.plan.content_distances == pytest.approx(expected, rel=1e-12)
    trainer.run()
    between = replace(scene, content_distances=np.sqrt(3.0 * scene.content_distances))
    own = train(between, PER_CAMERA).field.storage.values.numpy()
    np.testing.assert_array_equal(trainer.storage.values.numpy(), own)
    unknown = Trainer(replace(scene, content_distances=None), auto)
    assert unknown.plan.content_distances == (3.0,) * 5


def test_a_checkpoint_of_one_distance_for_all_goes_on_so(tmp_path: Path) -> None:
    """As they were written when auto was the scene's for each camera."""
    scene = scene_of_two_distances()
    auto = replace(PER_CAMERA, content_distance="auto", sampler=MARCHED)
    one = {"content_distance": scene.content_distance, "sampler": MARCHED}
    half = Trainer(scene, replace(PER_CAMERA, **one))
    half.run(stop=lambda: half.steps_done >= 10)
    state, file = half.state(), tmp_path / "state.safetensors"
    older = OlderPlan(
        config=replace(state.config, content_distance="auto"),
        content_distance=scene.content_distance,
        reach=state.plan.reach,
    )
    save_checkpoint(file, replace(state, plan=older))
    resumed = Trainer(scene, auto, load_checkpoint(file))
    assert resumed.plan.content_distances == (scene.content_distance,) * 5
    own = replace(older, content_distances=(2.0, 2.0, 2.0, 6.0, 6.0))
    save_checkpoint(file, replace(state, plan=own))
    resumed = Trainer(scene, auto, load_checkpoint(file))
    assert resumed.plan.content_distances == own.content_distances
    for content_distance, each in ((2.0, (1.0,) * 5), ("per-camera", None)):
        config = replace(state.config, content_distance=content_distance)
        wrong = replace(older, config=config, content_distances=each)
        save_checkpoint(file, replace(state, plan=wrong))
        with pytest.raises(InputError, match="content distances of cameras are not as its config"):
            load_checkpoint(file)


def test_a_resumed_training_keeps_them(tmp_path: Path) -> None:
    scene = scene_of_two_distances()
    whole = Trainer(scene, PER_CAMERA)
    whole.run()
    half = Trainer(scene, PER_CAMERA)
    half.run(stop=lambda: half.steps_done >= 10)
    state = half.state()
    assert state.plan.content_distances == (2.0, 2.0, 2.0, 6.0, 6.0)
    file = tmp_path / "state.safetensors"
    save_checkpoint(file, state)
    state = load_checkpoint(file)
    fewer = replace(state, plan=replace(state.plan, content_distances=(2.0,)))
    with pytest.raises(InputError, match="has 1 content distances, but tiny 5 training views"):
        Trainer(scene, PER_CAMERA, fewer)
    anew = replace(scene, content_distances=scene.content_distances * 1.001)
    resumed = Trainer(anew, PER_CAMERA, state)
    resumed.run()
    np.testing.assert_array_equal(resumed.storage.values.numpy(), whole.storage.values.numpy())


def test_they_are_asked_for_where_there_are_none() -> None:
    scene = replace(scene_of_two_distances(), content_distances=None)
    with pytest.raises(InputError, match=r"tiny brings no points, .* use auto, or a"):
        Trainer(scene, PER_CAMERA)
    for wrong in (np.ones(5), np.array([1.0, 2.0, 3.0, 0.0, 1.0, 1.0])):
        with pytest.raises(InputError, match="content_distances must be one above 0 for each of 6"):
            replace(scene, content_distances=wrong)
