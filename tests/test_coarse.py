"""The short trainings that find out how far cameras see, where the cameras do not tell."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from tiny_fields import tiny_field
from tiny_scenes import camera_at, look_at, ring, tiny_scene

import warpnerf as wn
from warpnerf.scenes.builtin.room import first_hit, photograph
from warpnerf.scenes.scene import Scene, View, estimate_extent, find_focus
from warpnerf.training import coarse
from warpnerf.training.coarse import begin, find_sight, is_needed, median_distances
from warpnerf.training.run import Run
from warpnerf.training.state import scene_digest


def outward_scan(n_views: int = 40) -> tuple[Scene, float]:
    """The built-in room by someone who turns around in its middle, and the median true distance."""
    rng = np.random.default_rng(0)
    views, depths = [], []
    while len(views) < n_views:
        angle = 2.4 * len(views) + rng.uniform(-0.1, 0.1)  # the golden angle
        out = np.array([np.cos(angle), np.sin(angle), 0.0])
        eye = np.array([0.25, 0.0, rng.uniform(0.8, 1.9)]) + rng.uniform(0.25, 0.75) * out
        pose = look_at(tuple(eye), tuple(eye + out + [0.0, 0.0, rng.uniform(-0.3, 0.2)]))
        camera = camera_at(pose, width=64, height=48, fx=50.0, fy=50.0, cx=32.0, cy=24.0)
        if first_hit(eye[None], camera.forward[None])[0] < 0.3:
            continue
        image, depth = photograph(camera)
        views.append(View(name=f"{len(views):03}.png", camera=camera, image=image))
        depths.append(depth)
    extent = estimate_extent([view.camera for view in views], unbounded=True)
    scene = Scene(
        name="scan",
        views=views,
        splits={"train": tuple(range(n_views)), "test": ()},
        box_min=extent.box_min,
        box_max=extent.box_max,
        unbounded=True,
        content_distance=extent.content_distance,
        guessed=extent.guessed,
    )
    return scene, float(np.median(np.stack(depths)))


def guessed_scene(**changes: object) -> Scene:
    return replace(tiny_scene(ring(6)), unbounded=True, guessed=True, **changes)  # type: ignore[arg-type]


SHORT = wn.TrainConfig(
    model="rgb", steps=600, rays_per_step=256, threads=1, grid=wn.GridConfig(voxels=12**3)
)


def test_a_scan_from_the_middle_of_a_room_gets_the_rooms_size() -> None:
    scene, distance = outward_scan()
    assert scene.guessed and scene.content_distance < 0.4 * distance  # far from the truth
    config = wn.TrainConfig(model="rgb", threads=2, seed=0)
    sight, seconds = find_sight(scene, config)
    assert sight is not None and seconds > 0.0
    assert sight.content_distance == pytest.approx(distance, rel=0.25)
    edges = sight.box_max - sight.box_min
    true = np.array([4.0, 5.0, 2.6])
    assert (edges > 0.8 * true).all() and (edges < 1.5 * true).all()
    assert (np.abs(sight.middle - [0.0, 0.0, 1.3]) < 0.5).all()


def test_it_is_for_scenes_whose_extent_is_a_guess() -> None:
    scene = guessed_scene()
    assert is_needed(scene, SHORT)
    assert not is_needed(replace(scene, guessed=False), SHORT)
    assert not is_needed(replace(scene, unbounded=False), SHORT)
    assert not is_needed(scene, replace(SHORT, grid=replace(SHORT.grid, contraction="none")))
    assert not is_needed(scene, replace(SHORT, coarse_steps=0))
    assert not is_needed(scene, replace(SHORT, steps=400))  # too short to see anything first
    with pytest.raises(wn.InputError, match="coarse_steps"):
        replace(SHORT, coarse_steps=-1)


def test_training_takes_what_was_found(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = guessed_scene()
    sight = coarse.SeenExtent(
        distances=np.arange(1.0, 7.0),
        content_distance=2.5,
        near_content=1.0,
        middle=np.zeros(3),
        box_min=np.full(3, -3.0),
        box_max=np.full(3, 4.0),
    )
    monkeypatch.setattr(coarse, "find_sight", lambda scene, config: (sight, 1.5))
    trainer = begin(scene, SHORT)
    assert trainer.content_distance == 2.5 and trainer.grid.box_max.tolist() == [4.0, 4.0, 4.0]
    assert trainer.report().seconds == 1.5
    given = begin(scene, replace(SHORT, content_distance=7.0))
    assert given.content_distance == 7.0 and given.grid.box_max.tolist() == [4.0, 4.0, 4.0]
    own = begin(scene, replace(SHORT, content_distance="per-camera"))
    assert own.state().content_distances == [1.0, 2.0, 3.0, 4.0, 5.0]  # the sixth is for testing
    assert begin(replace(scene, guessed=False), SHORT).content_distance == scene.content_distance
    monkeypatch.setattr(coarse, "find_sight", lambda scene, config: (None, 1.5))
    assert begin(scene, SHORT).content_distance == scene.content_distance


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
