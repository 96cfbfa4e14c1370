"""The short trainings that find out how far cameras see, where the cameras do not tell."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import warpnerf as wn
from tests.support.small_model import SQUARED
from tests.support.tiny_fields import tiny_field
from tests.support.tiny_scenes import camera_at, look_at, ring, tiny_scene
from warpnerf.fields.nodes import points_of
from warpnerf.model.spaces import SPACES
from warpnerf.runs.run import Run
from warpnerf.scenes.builtin.room import first_hit, photograph
from warpnerf.scenes.cameras.focus import estimate_extent, find_focus
from warpnerf.scenes.cameras.observations import guessed
from warpnerf.scenes.extent.frustum import contraction_of
from warpnerf.scenes.scene import Scene, View
from warpnerf.training import coarse
from warpnerf.training.coarse import extent_by_training, median_distances, prepare_trainer
from warpnerf.training.plan import needs_search, resolve
from warpnerf.training.state import Progress, scene_digest
from warpnerf.training.trainer import Trainer


def find_sight_of(
    scene: Scene, config: wn.TrainConfig, on_progress: Callable[[Progress], None] | None = None
) -> tuple[coarse.ObservedExtent | None, float]:
    return extent_by_training(scene, resolve(scene, config), on_progress)


def is_needed(scene: Scene, config: wn.TrainConfig) -> bool:
    return needs_search(scene, config, SPACES[contraction_of(scene, config)])


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
    model="rgb",
    loss=SQUARED,
    steps=600,
    rays_per_step=256,
    threads=1,
    grid=wn.GridConfig(voxels=12**3),
)


@pytest.mark.ci
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
    config = wn.TrainConfig(model="rgb", loss=SQUARED, threads=2, seed=0)
    observed, seconds = find_sight_of(scene, config)
    assert observed is not None and seconds > 0.0
    assert observed.content_distance == pytest.approx(distance, rel=0.25)
    if guessed:
        edges = observed.box_max - observed.box_min
        true = np.array([4.0, 5.0, 2.6])
        assert (edges > 0.8 * true).all() and (edges < 1.5 * true).all()
        middle = 0.5 * (observed.box_min + observed.box_max)
        assert (np.abs(middle - [0.0, 0.0, 1.3]) < 0.5).all()


@pytest.mark.ci
def test_trainings_with_and_without_scaling_have_one_extent() -> None:
    scene = of_room(outward(12))[0]
    config = wn.TrainConfig(model="rgb", loss=SQUARED, threads=2, coarse_steps=60)
    one, other = (
        find_sight_of(scene, replace(config, scaling=scaling))[0] for scaling in ("none", "clamped")
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


def test_a_given_content_distance_leaves_only_a_box_to_look_for() -> None:
    given, scene = replace(SHORT, content_distance=2.0), guessed_scene()
    assert is_needed(scene, given)
    assert is_needed(replace(scene, guessed=False), given)
    own = replace(given, grid=replace(given.grid, box="scene"))
    assert is_needed(scene, own)
    assert not is_needed(replace(scene, guessed=False), own)
    boxed = replace(given, grid=replace(given.grid, box=(0.0, 0.0, 0.0, 1.0, 1.0, 1.0)))
    planar = replace(given, grid=replace(given.grid, contraction="ndc"))
    assert not is_needed(scene, boxed) and not is_needed(scene, planar)


def test_distances_of_each_camera_are_looked_for_in_any_scene_without_points() -> None:
    each = replace(SHORT, content_distance="per-camera")
    scene = replace(guessed_scene(), guessed=False, unbounded=False)
    assert is_needed(scene, each)
    assert not is_needed(replace(scene, content_distances=np.ones(6)), each)
    assert not is_needed(scene, replace(each, coarse_steps=0))


def found_extent() -> coarse.ObservedExtent:
    return coarse.ObservedExtent(
        distances=np.arange(1.0, 7.0),
        content_distance=2.5,
        near_content=1.0,
        middle=np.zeros(3),
        observations=guessed([camera_at(pose) for pose in ring(6)], 2.5),
        box_min=np.full(3, -3.0),
        box_max=np.full(3, 4.0),
        found_by="a short training",
    )


def test_training_takes_what_was_found(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = guessed_scene()
    monkeypatch.setattr(coarse, "extent_by_training", lambda *_: (found_extent(), 1.5))
    trainer = prepare_trainer(scene, SHORT)
    assert trainer.plan.content_distance == 2.5 and trainer.scene.box_max.tolist() == [
        4.0,
        4.0,
        4.0,
    ]
    assert trainer.report().seconds == 1.5 and "found by a short" in trainer.scene.notes[-1]
    given = prepare_trainer(scene, replace(SHORT, content_distance=7.0))
    assert given.plan.content_distance == 7.0 and given.scene.box_max.tolist() == [4.0, 4.0, 4.0]
    own = prepare_trainer(scene, replace(SHORT, content_distance="per-camera"))
    assert own.plan.content_distances == (1.0, 2.0, 3.0, 4.0, 5.0)  # the sixth is for testing
    auto = trainer.plan.content_distances
    assert auto == pytest.approx([math.sqrt(2.5 * own) for own in range(1, 6)], rel=1e-12)


def test_the_box_around_a_common_focus_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = replace(guessed_scene(), guessed=False)
    monkeypatch.setattr(coarse, "extent_by_training", lambda *_: (found_extent(), 1.5))
    trainer = prepare_trainer(scene, SHORT)
    assert trainer.plan.content_distance == 2.5
    assert np.array_equal(trainer.scene.box_max, scene.box_max)
    assert np.array_equal(trainer.scene.box_min, scene.box_min)
    assert "box" not in trainer.scene.notes[-1]


def test_where_nothing_opaque_grows_the_guess_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = guessed_scene()
    monkeypatch.setattr(coarse, "observed_extent", lambda *_: None)
    trainer = prepare_trainer(scene, SHORT)
    assert trainer.plan.content_distance == scene.content_distance and trainer.scene.guessed
    assert trainer.scene.notes[-1] == coarse.NOTHING_SEEN and trainer.observed is None
    with pytest.raises(wn.InputError, match="something opaque"):
        prepare_trainer(scene, replace(SHORT, content_distance="per-camera"))


@pytest.mark.parametrize("some", [True, False])
def test_only_photographs_in_which_no_ray_meets_anything_are_refused(
    some: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where a third of the cameras see enough, training continues with the guess."""
    scene = guessed_scene()
    config = replace(SHORT, steps=10 * SHORT.coarse_steps)
    points = [np.ones((200 if some and n < 2 else 0, 3)) for n in range(len(scene.views))]
    monkeypatch.setattr(coarse, "seen_points", lambda *_: points)
    if some:
        assert find_sight_of(scene, config)[0] is None
        return
    with pytest.raises(wn.InputError, match="met nothing opaque"):
        find_sight_of(scene, config)


@pytest.mark.parametrize(("guessed", "rounds"), [(True, 2), (False, 1)])
def test_it_takes_a_tenth_of_the_steps_and_an_eighth_of_the_time_at_most(
    guessed: bool, rounds: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[wn.TrainConfig] = []

    def watched(scene: Scene, config: wn.TrainConfig, **options: object) -> Trainer:
        asked.append(config)
        return Trainer(scene, config, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(coarse, "Trainer", watched)
    monkeypatch.setattr(coarse, "observed_extent", lambda *_: found_extent())
    scene = replace(guessed_scene(), guessed=guessed)
    find_sight_of(scene, replace(SHORT, time_limit=1000.0))
    assert [config.steps for config in asked] == [60] * rounds
    assert sum(config.time_limit or math.inf for config in asked) == pytest.approx(120.0)
    find_sight_of(scene, replace(SHORT, steps=5000, coarse_steps=70))
    assert [config.steps for config in asked[rounds:]] == [70] * rounds
    assert all(config.time_limit is None for config in asked[rounds:])
    # The second round begins with the distance that the first has found.
    distances = [config.content_distance for config in asked[rounds:]]
    assert distances == ["auto", 2.5][:rounds]


def test_too_little_time_finds_nothing() -> None:
    assert find_sight_of(guessed_scene(), replace(SHORT, time_limit=0.01))[0] is None


@pytest.mark.parametrize(("guessed", "rounds"), [(True, 2), (False, 1)])
def test_progress_counts_all_rounds(guessed: bool, rounds: int) -> None:
    fractions: list[float] = []
    scene = replace(guessed_scene(), guessed=guessed)
    find_sight_of(scene, SHORT, lambda progress: fractions.append(progress.fraction))
    assert fractions == sorted(fractions) and fractions[-1] == 1.0
    assert [f for f in fractions if f * rounds % 1.0 == 0.0] == [
        (k + 1) / rounds for k in range(rounds)
    ]


def test_a_resumed_training_does_not_look_again(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = guessed_scene()
    config = replace(SHORT, steps=520)
    whole = prepare_trainer(scene, config)
    half = prepare_trainer(scene, config)
    while half.steps_done < 100:
        half.update()
    monkeypatch.setattr(coarse, "extent_by_training", lambda *_: pytest.fail("looked again"))
    rest = prepare_trainer(scene, config, half.state())
    assert rest.plan.content_distance == whole.plan.content_distance != scene.content_distance
    for trainer in (whole, rest):
        trainer.run()
    assert np.array_equal(whole.storage.values.numpy(), rest.storage.values.numpy())
    assert np.array_equal(whole.lattice.box_max, rest.lattice.box_max)


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
    values = field.storage.values.numpy().copy()
    values.reshape(*field.lattice.size, -1)[3:, :, :, 0] = 400.0  # opaque from x = 0.5 on, about
    array = wp.array(values, dtype=field.storage.values.dtype, device=field.workers.device)
    grid = replace(field.storage, values=array)
    field = replace(field, storage=grid, free=type(field.free).none(field.workers))
    origins = np.array([[-3.0, 0.1, 0.2], [-3.0, 0.1, 0.2], [-2.0, 0.1, 0.2]], np.float32)
    directions = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]], np.float32)
    distance = median_distances(field, origins, directions)
    # The ramp from the empty nodes at x = 0 to the full ones at 0.5 is dense from early on.
    assert distance[0] == pytest.approx(3.1, abs=0.25) and distance[2] == pytest.approx(
        2.1, abs=0.25
    )
    assert np.isnan(distance[1])  # meets nothing


@pytest.mark.parametrize("sigma", [0.5, 2.0, 6.0])
def test_median_distance_in_fog(sigma: float) -> None:
    """Half of the light comes through a depth of log 2; the box ends after 1 scene unit."""
    field = tiny_field()
    values = field.storage.values.numpy()
    values[:, 0] = (
        np.log(np.expm1(sigma / field.storage.density_scale)) - field.storage.density_shift
    )
    field.storage.values.assign(values)
    steps = replace(field.steps, near=0.0, step=0.005)
    field = replace(field, steps=steps, free=type(field.free).none(field.workers))
    origins, along = np.zeros((2, 3), np.float32), np.eye(3, dtype=np.float32)[:2]
    distance = median_distances(field, origins, along)
    if sigma < math.log(2.0):
        assert np.isnan(distance).all()
    else:
        np.testing.assert_allclose(distance, math.log(2.0) / sigma, rtol=0.03)


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
    assert (trainer.storage.values.numpy() == 0.0).all()
    coarse.leave_out_near(trainer.storage, scene.training_cameras, 0.0)
    assert (trainer.storage.values.numpy() == 0.0).all()
    coarse.leave_out_near(trainer.storage, scene.training_cameras, 2.5)
    raw = trainer.storage.values.numpy()[:, 0].reshape(trainer.lattice.size)
    points = points_of(trainer.lattice, np.indices(raw.shape).reshape(3, -1).T)
    positions = np.stack([camera.position for camera in scene.training_cameras])
    away = np.linalg.norm(points[:, None] - positions, axis=2).min(axis=1).reshape(raw.shape)
    assert (raw[away < 2.499] == coarse.EMPTY).all() and (raw[away > 2.501] == 0.0).all()
    assert 5 < (raw < 0.0).sum() < raw.size - 5
    trainer.run()
    left = trainer.storage.values.numpy()[:, 0].reshape(raw.shape)
    assert (left[away < 2.499] < -60.0).all() and (left[away > 2.501] > -60.0).all()


def test_the_search_leaves_them_out(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[float] = []
    monkeypatch.setattr(coarse, "leave_out_near", lambda grid, cameras, near: asked.append(near))
    find_sight_of(guessed_scene(), replace(SHORT, march=wn.MarchConfig(near=0.25)))
    assert asked == [0.25, 0.25]
