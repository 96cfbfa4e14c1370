"""The short trainings that find out how far cameras see, where the cameras do not tell."""

from __future__ import annotations

import json
import math
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from PIL import Image
from tiny_fields import tiny_field
from tiny_scenes import camera_at, look_at, ring, tiny_scene
from watched_command import command, make_scene

import warpnerf as wn
from warpnerf.model.nodes import points_of
from warpnerf.scenes.builtin.room import first_hit, photograph
from warpnerf.scenes.focus import estimate_extent, find_focus
from warpnerf.scenes.scene import Scene, View
from warpnerf.training import coarse
from warpnerf.training.coarse import begin, find_sight, is_needed, median_distances
from warpnerf.training.run import Run
from warpnerf.training.state import scene_digest
from warpnerf.training.trainer import Trainer


def of_room(poses: Sequence[np.ndarray]) -> tuple[Scene, float]:
    """The built-in room as cameras see it that bring no points, and the median true distance."""
    views, depths = [], []
    for pose in poses:
        camera = camera_at(pose, width=64, height=48, fx=50.0, fy=50.0, cx=32.0, cy=24.0)
        if first_hit(camera.position[None], camera.forward[None])[0] < 0.3:
            continue
        image, depth = photograph(camera)
        views.append(View(name=f"{len(views):03}.png", camera=camera, image=image))
        depths.append(depth)
    extent = estimate_extent([view.camera for view in views], unbounded=True)
    scene = Scene(
        name="room",
        views=views,
        splits={"train": tuple(range(len(views))), "test": ()},
        box_min=extent.box_min,
        box_max=extent.box_max,
        unbounded=True,
        content_distance=extent.content_distance,
        guessed=extent.guessed,
    )
    return scene, float(np.median(np.stack(depths)))


def outward(n_views: int) -> list[np.ndarray]:
    """Poses of someone who turns around in the room's middle."""
    rng, poses = np.random.default_rng(0), []
    for k in range(n_views):
        angle = 2.4 * k + rng.uniform(-0.1, 0.1)  # the golden angle
        out = np.array([np.cos(angle), np.sin(angle), 0.0])
        eye = np.array([0.25, 0.0, rng.uniform(0.8, 1.9)]) + rng.uniform(0.25, 0.75) * out
        poses.append(look_at(tuple(eye), tuple(eye + out + [0.0, 0.0, rng.uniform(-0.3, 0.2)])))
    return poses


def inward(n_views: int) -> list[np.ndarray]:
    """Poses of someone who walks around the table in it, with the walls behind."""
    rng, poses = np.random.default_rng(0), []
    for k in range(n_views):
        angle = 2.4 * k + rng.uniform(-0.1, 0.1)
        eye = (1.3 * np.cos(angle), rng.uniform(1.4, 1.9) * np.sin(angle), rng.uniform(1.0, 1.8))
        poses.append(look_at(eye, (*rng.uniform(-0.2, 0.2, 2), rng.uniform(0.45, 0.7))))
    return poses


def mixed(n_views: int) -> list[np.ndarray]:
    """Half of each."""
    return outward(n_views // 2) + inward(n_views // 2)


def guessed_scene(**changes: object) -> Scene:
    return replace(tiny_scene(ring(6)), unbounded=True, guessed=True, **changes)  # type: ignore[arg-type]


SHORT = wn.TrainConfig(
    model="rgb", steps=600, rays_per_step=256, threads=1, grid=wn.GridConfig(voxels=12**3)
)


@pytest.mark.parametrize(
    ("poses", "guessed"),
    [
        (outward, True),
        *(pytest.param(p, p is mixed, marks=pytest.mark.slow) for p in (inward, mixed)),
    ],
)
def test_content_distance_of_a_room(
    poses: Callable[[int], list[np.ndarray]], guessed: bool
) -> None:
    scene, distance = of_room(poses(40))
    assert scene.guessed == guessed and scene.content_distance < 0.75 * distance
    config = wn.TrainConfig(model="rgb", threads=2, seed=0)
    sight, seconds = find_sight(scene, config)
    assert sight is not None and seconds > 0.0
    assert sight.content_distance == pytest.approx(distance, rel=0.25)
    if guessed:
        edges = sight.box_max - sight.box_min
        true = np.array([4.0, 5.0, 2.6])
        assert (edges > 0.8 * true).all() and (edges < 1.5 * true).all()
        middle = 0.5 * (sight.box_min + sight.box_max)
        assert (np.abs(middle - [0.0, 0.0, 1.3]) < 0.5).all()


def test_trainings_with_and_without_scaling_have_one_extent() -> None:
    scene, config = of_room(outward(12))[0], wn.TrainConfig(model="rgb", threads=2, coarse_steps=60)
    one, other = (
        find_sight(scene, replace(config, scaling=scaling))[0] for scaling in ("none", "clamped")
    )
    assert one is not None and other is not None
    np.testing.assert_array_equal(one.distances, other.distances)


def test_it_is_for_scenes_without_points() -> None:
    scene = guessed_scene()
    known = replace(scene, content_distances=np.ones(6))
    assert is_needed(scene, SHORT) and is_needed(replace(scene, guessed=False), SHORT)
    assert not is_needed(known, SHORT)
    bounded = replace(scene, unbounded=False)
    assert not bounded.has_alpha and is_needed(bounded, SHORT)
    rgba = np.full((*bounded.views[0].image.shape[:2], 4), 255, np.uint8)
    object_views = [replace(view, image=rgba) for view in bounded.views]
    assert not is_needed(replace(bounded, views=object_views), SHORT)
    assert not is_needed(scene, replace(SHORT, grid=replace(SHORT.grid, contraction="none")))
    assert not is_needed(scene, replace(SHORT, coarse_steps=0))
    assert not is_needed(scene, replace(SHORT, steps=400))  # too short to see anything first
    for steps in (-1, 1, 49):
        with pytest.raises(wn.InputError, match="coarse_steps"):
            replace(SHORT, coarse_steps=steps)


def test_a_given_content_distance_leaves_only_a_guessed_box_to_look_for() -> None:
    given, scene = replace(SHORT, content_distance=2.0), guessed_scene()
    assert is_needed(scene, given)
    assert not is_needed(replace(scene, guessed=False), given)


def test_distances_of_each_camera_are_looked_for_in_any_scene_without_points() -> None:
    each = replace(SHORT, content_distance="per-camera")
    scene = replace(guessed_scene(), guessed=False, unbounded=False)
    assert is_needed(scene, each)
    assert not is_needed(replace(scene, content_distances=np.ones(6)), each)
    assert not is_needed(scene, replace(each, coarse_steps=0))


def found_sight() -> coarse.SeenExtent:
    return coarse.SeenExtent(
        distances=np.arange(1.0, 7.0),
        content_distance=2.5,
        near_content=1.0,
        middle=np.zeros(3),
        box_min=np.full(3, -3.0),
        box_max=np.full(3, 4.0),
    )


def test_training_takes_what_was_found(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = guessed_scene()
    monkeypatch.setattr(coarse, "find_sight", lambda *_: (found_sight(), 1.5))
    trainer = begin(scene, SHORT)
    assert trainer.content_distance == 2.5 and trainer.grid.box_max.tolist() == [4.0, 4.0, 4.0]
    assert trainer.report().seconds == 1.5 and "found by a short" in trainer.scene.notes[-1]
    given = begin(scene, replace(SHORT, content_distance=7.0))
    assert given.content_distance == 7.0 and given.grid.box_max.tolist() == [4.0, 4.0, 4.0]
    own = begin(scene, replace(SHORT, content_distance="per-camera"))
    assert own.state().content_distances == [1.0, 2.0, 3.0, 4.0, 5.0]  # the sixth is for testing
    auto = trainer.state().content_distances
    assert auto == pytest.approx([math.sqrt(2.5 * own) for own in range(1, 6)], rel=1e-12)


def test_the_box_around_a_common_focus_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = replace(guessed_scene(), guessed=False)
    monkeypatch.setattr(coarse, "find_sight", lambda *_: (found_sight(), 1.5))
    trainer = begin(scene, SHORT)
    assert trainer.content_distance == 2.5
    assert np.array_equal(trainer.grid.box_max, scene.box_max)
    assert np.array_equal(trainer.grid.box_min, scene.box_min)
    assert "box" not in trainer.scene.notes[-1]


def test_where_nothing_opaque_grows_the_guess_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = guessed_scene()
    monkeypatch.setattr(coarse, "seen_extent", lambda *_: None)
    trainer = begin(scene, SHORT)
    assert trainer.content_distance == scene.content_distance and trainer.scene.guessed
    assert trainer.scene.notes[-1] == coarse.NOTHING_SEEN and trainer.sight is None
    with pytest.raises(wn.InputError, match="something opaque"):
        begin(scene, replace(SHORT, content_distance="per-camera"))


@pytest.mark.parametrize("some", [True, False])
def test_only_photographs_in_which_no_ray_meets_anything_are_refused(
    some: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where a third of the cameras see enough, training goes on with the guess."""
    scene = guessed_scene()
    config = replace(SHORT, steps=10 * SHORT.coarse_steps)
    points = [np.ones((200 if some and n < 2 else 0, 3)) for n in range(len(scene.views))]
    monkeypatch.setattr(coarse, "seen_points", lambda *_: points)
    if some:
        assert find_sight(scene, config)[0] is None
        return
    with pytest.raises(wn.InputError, match="met nothing opaque"):
        find_sight(scene, config)


def test_too_little_time_finds_nothing() -> None:
    assert find_sight(guessed_scene(), replace(SHORT, time_limit=0.01))[0] is None


@pytest.mark.parametrize(("guessed", "rounds"), [(True, 2), (False, 1)])
def test_progress_counts_all_rounds(guessed: bool, rounds: int) -> None:
    fractions: list[float] = []
    scene = replace(guessed_scene(), guessed=guessed)
    find_sight(scene, SHORT, lambda progress: fractions.append(progress.fraction))
    assert fractions == sorted(fractions) and fractions[-1] == 1.0
    assert [f for f in fractions if f * rounds % 1.0 == 0.0] == [
        (k + 1) / rounds for k in range(rounds)
    ]


def test_a_resumed_training_does_not_look_again(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = guessed_scene()
    config = replace(SHORT, steps=520)
    whole = begin(scene, config)
    half = begin(scene, config)
    while half.steps_done < 100:
        half.update()
    monkeypatch.setattr(coarse, "find_sight", lambda *_: pytest.fail("looked again"))
    rest = begin(scene, config, half.state())
    assert rest.content_distance == whole.content_distance != scene.content_distance
    for trainer in (whole, rest):
        trainer.run()
    assert np.array_equal(whole.grid.values.numpy(), rest.grid.values.numpy())
    assert np.array_equal(whole.grid.box_max, rest.grid.box_max)


def test_a_run_remembers_what_was_found(tmp_path: Path) -> None:
    scene = guessed_scene()
    found = replace(scene, content_distance=2.5, box_max=np.array([4.0, 5.0, 6.0]), guessed=False)
    Run(tmp_path / "a").create(found, "somewhere", 1, 2.5, SHORT, found=True)
    Run(tmp_path / "b").create(scene, "somewhere", 1, 3.0, SHORT)
    again = Run(tmp_path / "a").read_config().as_trained(scene)
    assert again.content_distance == 2.5 and again.box_max.tolist() == [4.0, 5.0, 6.0]
    assert not again.guessed
    assert Run(tmp_path / "b").read_config().as_trained(scene) is scene


def test_what_was_found_does_not_change_what_a_scene_is() -> None:
    scene = guessed_scene()
    own = find_focus(scene.training_cameras).distance
    assert scene_digest(replace(scene, content_distance=own)) == scene_digest(
        replace(scene, content_distance=7.7, content_distances=np.full(6, 7.7))
    )


def test_median_distance_of_a_wall() -> None:
    field = tiny_field(density=-60.0)  # nothing
    values = field.grid.values.numpy().copy()
    values.reshape(*field.grid.size, -1)[3:, :, :, 0] = 400.0  # opaque from x = 0.5 on, about
    array = wp.array(values, dtype=field.grid.values.dtype, device=field.workers.device)
    grid = replace(field.grid, values=array)
    field = replace(field, grid=grid, free=type(field.free).none(field.workers))
    origins = np.array([[-3.0, 0.1, 0.2], [-3.0, 0.1, 0.2], [-2.0, 0.1, 0.2]], np.float32)
    directions = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]], np.float32)
    distance = median_distances(field, origins, directions)
    # The ramp from the empty nodes at x = 0 to the full ones at 0.5 is dense from early on.
    assert distance[0] == pytest.approx(3.1, abs=0.25) and distance[2] == pytest.approx(
        2.1, abs=0.25
    )
    assert np.isnan(distance[1])  # meets nothing


def test_pixels_that_do_not_count_are_not_looked_at() -> None:
    scene = guessed_scene()
    mask = np.zeros((6, 8), bool)
    mask[:, :4] = True
    views = [scene.views[0], replace(scene.views[1], mask=mask)]
    origins, directions, owner = coarse._some_rays(views, tiny_field())
    assert np.bincount(owner).tolist() == [48, 24]
    assert np.allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-6)
    assert np.allclose(origins[owner == 1], views[1].camera.position, atol=1e-6)
    right = directions[owner == 1] @ views[1].camera.c2w[:, 0]
    assert (right < 0.0).all()  # the left half


@pytest.mark.parametrize("contraction", ["none", "linf"])
def test_nodes_nearer_than_the_near_plane_stay_empty(contraction: str) -> None:
    scene = guessed_scene()
    grid = replace(SHORT.grid, voxels=30**3, contraction=contraction, grow_at=())
    config = replace(SHORT, grid=grid, steps=200, march=wn.MarchConfig(near=2.5))
    trainer = Trainer(scene, config)
    assert (trainer.grid.values.numpy() == 0.0).all()
    coarse.leave_out_near(trainer.grid, scene.training_cameras, 0.0)
    assert (trainer.grid.values.numpy() == 0.0).all()
    coarse.leave_out_near(trainer.grid, scene.training_cameras, 2.5)
    raw = trainer.grid.values.numpy()[:, 0].reshape(trainer.grid.size)
    points = points_of(trainer.grid, np.indices(raw.shape).reshape(3, -1).T)
    positions = np.stack([camera.position for camera in scene.training_cameras])
    away = np.linalg.norm(points[:, None] - positions, axis=2).min(axis=1).reshape(raw.shape)
    assert (raw[away < 2.499] == coarse.EMPTY).all() and (raw[away > 2.501] == 0.0).all()
    assert 5 < (raw < 0.0).sum() < raw.size - 5
    trainer.run()
    left = trainer.grid.values.numpy()[:, 0].reshape(raw.shape)
    assert (left[away < 2.499] < -60.0).all() and (left[away > 2.501] > -60.0).all()


def test_the_search_leaves_them_out(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[float] = []
    monkeypatch.setattr(coarse, "leave_out_near", lambda grid, cameras, near: asked.append(near))
    find_sight(guessed_scene(), replace(SHORT, march=wn.MarchConfig(near=0.25)))
    assert asked == [0.25, 0.25]


FEW = ("--model", "rgb", "--threads", "1", "--voxels", "8000", "--steps", "500")


def black_scene(folder: Path) -> Path:
    """Photographs that empty space explains as well as anything."""
    scene = make_scene(folder)
    for path in (scene / "images").iterdir():
        Image.fromarray(np.zeros((12, 16, 3), np.uint8)).save(path)
    return scene


def test_the_command_says_that_nothing_was_found(tmp_path: Path) -> None:
    scene = black_scene(tmp_path)
    done = command("train", scene, "--output", "run", *FEW, folder=tmp_path, limit=None)
    assert done.code == 0, done.err
    assert f"note: {coarse.NOTHING_SEEN}" in done.out
    config = json.loads((done.run / "config.json").read_text())
    assert "found" not in config and coarse.NOTHING_SEEN in config["notes"]


def test_the_command_refuses_photographs_that_show_nothing(tmp_path: Path) -> None:
    scene = black_scene(tmp_path)
    longer = (*FEW[:-1], "2000")
    done = command("train", scene, "--output", "run", *longer, folder=tmp_path, limit=None)
    assert done.code == 2 and "200 steps of a short training met nothing opaque" in done.err
    assert not done.run.exists()


def test_the_command_refuses_distances_of_cameras_that_see_nothing(tmp_path: Path) -> None:
    scene = black_scene(tmp_path)
    each = ("--content-distance", "per-camera")
    done = command("train", scene, "--output", "run", *FEW, *each, folder=tmp_path, limit=None)
    assert done.code == 2 and not done.run.exists()
    assert done.err.count("\n") == 1 and "something opaque; use auto, or a number" in done.err


def test_the_command_keeps_what_it_found(tmp_path: Path) -> None:
    scene = make_scene(tmp_path)
    done = command("train", scene, "--output", "run", *FEW, folder=tmp_path, limit=None)
    assert done.code == 0, done.err
    looking, _, rest = done.out.partition("found by a short training")
    assert "step 25" in looking.partition("looking for how far the cameras see")[2] and rest
    config = Run(done.run).read_config()
    assert config.found is not None
    assert config.found.content_distance == config.content_distance


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGINT for one process there")
def test_stopped_while_it_looks_the_command_leaves_nothing(tmp_path: Path) -> None:
    scene, run = make_scene(tmp_path), tmp_path / "run"
    process = subprocess.Popen(
        [sys.executable, "-m", "warpnerf", "train", str(scene), "--output", str(run), *FEW[:-4]],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout is not None
        for line in process.stdout:
            if "step " in line:
                break
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130 and err == "stopped\n"
    assert "content distance" not in out and not run.exists()
