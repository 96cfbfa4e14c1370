"""The extent of scenes without points, by comparing their photographs."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import warpnerf as wn
from tests.support.tiny_scenes import camera_at, look_at
from tests.training.test_coarse import inward, mixed, of_room, outward
from warpnerf.scenes.builtin.room import first_hit, photograph
from warpnerf.scenes.extent import patches, swept
from warpnerf.scenes.extent.photo_consistency import Agreement, PhotoConsistency
from warpnerf.scenes.extent.swept import extent_by_sweep
from warpnerf.scenes.scene import Scene, View
from warpnerf.training import coarse
from warpnerf.training.coarse import prepare_trainer
from warpnerf.training.peers import Peers


@pytest.fixture(scope="module")
def room() -> tuple[Scene, float]:
    return of_room(outward(24))


@pytest.mark.parametrize("poses", [outward, inward, mixed])
def test_the_content_distance_of_a_room(poses: Callable[[int], Sequence[np.ndarray]]) -> None:
    scene, true = of_room(poses(32))
    found = extent_by_sweep(scene)
    assert found is not None
    assert 0.9 * true < found.content_distance < 1.1 * true
    near = np.quantile([photograph(view.camera)[1].min() for view in scene.views], 0.1)
    assert 0.7 * near < found.near_content < found.content_distance


def test_the_box_of_a_room_seen_outward(room: tuple[Scene, float]) -> None:
    found = extent_by_sweep(room[0])
    assert found is not None
    edges = np.sort(found.box_max - found.box_min)
    assert (np.abs(edges - [2.7, 4.1, 5.1]) < [1.0, 0.6, 0.6]).all()  # cameras look level
    assert np.abs(found.middle[:2]).max() < 0.6


@pytest.mark.parametrize("poses", [outward, inward])
def test_places_lie_on_surfaces(poses: Callable[[int], Sequence[np.ndarray]]) -> None:
    """Depths of the sweep are a fifth apart where they are far; few places are wrong."""
    scene, _ = of_room(poses(24))
    photographs = PhotoConsistency.of(scene.views)
    apart = []
    for number, view in enumerate(scene.views):
        away = photographs.surfaces(number) - view.camera.position
        distance = np.linalg.norm(away, axis=1)
        true = first_hit(np.tile(view.camera.position, (len(away), 1)), away / distance[:, None])
        apart.append(np.abs(distance / true - 1.0))
    wrong = np.concatenate(apart)
    assert len(wrong) > 10 * len(scene.views)
    assert np.median(wrong) < 0.06 and np.mean(wrong < 0.25) > 0.85


def test_each_camera_has_a_distance_of_its_own(room: tuple[Scene, float]) -> None:
    scene, _ = room
    found = extent_by_sweep(scene)
    assert found is not None and len(found.distances) == len(scene.views)
    assert np.ptp(found.distances) > 0.2


def test_of_many_photographs_some_are_looked_at(
    room: tuple[Scene, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, _ = room
    monkeypatch.setattr(swept, "MOST_PHOTOGRAPHS", len(scene.views) // 2)
    found = extent_by_sweep(scene)
    assert found is not None
    assert (found.distances[1::2] == found.content_distance).all()
    assert (found.distances[::2] != found.content_distance).any()


def test_what_a_mask_leaves_out_does_not_count(room: tuple[Scene, float]) -> None:
    """Else the same content would be found."""
    scene, _ = room
    left = np.arange(64) < 44
    masked = [replace(view, mask=np.tile(left, (48, 1))) for view in scene.views]
    whole, half = (extent_by_sweep(replace(scene, views=v)) for v in (scene.views, masked))
    assert whole is not None and half is not None
    n_whole, n_half = (len(found.observations) for found in (whole, half))
    assert 0.4 * n_whole < n_half < 0.9 * n_whole


def test_what_is_infinitely_far_is_no_place(room: tuple[Scene, float]) -> None:
    """Cameras that only turn see all of it there, and no baseline says how far it is."""
    scene, _ = room
    eye = scene.views[0].camera.position
    turned = []
    for view in scene.views:
        c2w = view.camera.c2w.copy()
        c2w[:, 3] = eye
        camera = replace(view.camera, c2w=c2w)
        turned.append(replace(view, camera=camera, image=photograph(camera)[0]))
    poses = np.array([view.camera.c2w for view in turned])
    poses[:, :, 3] += 1e-3 * np.random.default_rng(0).normal(size=(len(poses), 3))
    photographs = PhotoConsistency(views=turned, poses=poses)
    places = np.concatenate([photographs.surfaces(i) for i in range(len(turned))])
    assert len(places) < 5 * len(turned) and np.isfinite(places).all()  # of 63 each


def test_of_large_photographs_not_every_pixel_is_read() -> None:
    """Every fifth where 40 x 40 become one."""
    camera = camera_at(
        look_at((0.0, -3.0, 1.0), (0.0, 0.0, 1.0)), width=3840, height=2880, fx=3000.0, fy=3000.0
    )
    small = np.random.default_rng(0).integers(0, 256, (72, 96, 3), np.uint8)
    image = small.repeat(40, axis=0).repeat(40, axis=1)
    image[1::5], image[:, 2::5] = 0, 0
    gray = patches.reduced(View(name="0.png", camera=camera, image=image)).gray
    np.testing.assert_allclose(gray, small.mean(axis=2), rtol=1e-5)


def test_photographs_of_another_size_are_left_out(room: tuple[Scene, float]) -> None:
    """Those that are too small to tell."""
    scene, true = room
    first = scene.views[0]
    tiny = View(name="0.png", camera=first.camera.downscaled(4), image=first.image[::4, ::4])
    found = extent_by_sweep(replace(scene, views=[tiny, *scene.views[1:]]))
    assert found is not None and 0.85 * true < found.content_distance < 1.15 * true


def test_the_first_process_compares_for_all(room: tuple[Scene, float]) -> None:
    """Others might round otherwise, and so have another box."""
    scene, _ = room
    told = extent_by_sweep(scene)

    class Second(Peers):
        def from_first(self, make: Callable[[], Any]) -> Any:
            return pickle.loads(pickle.dumps(told))

    config = wn.TrainConfig(model="rgb", steps=2000, threads=1, grid=wn.GridConfig(voxels=12**3))
    plain = [replace(v, image=np.full_like(v.image, 90)) for v in scene.views]
    trainer = prepare_trainer(replace(scene, views=plain), config, peers=Second())
    assert told is not None and trainer.scene.content_distance == told.content_distance


def test_photographs_that_do_not_tell(room: tuple[Scene, float]) -> None:
    scene, _ = room
    few = replace(scene, splits={"train": (0, 1, 2), "test": ()})
    plain = [replace(v, image=np.full_like(v.image, 90)) for v in scene.views]
    order = np.roll(np.arange(len(scene.views)), 7)
    others = [
        replace(view, image=scene.views[int(k)].image)
        for view, k in zip(scene.views, order, strict=True)
    ]
    for unsure in (few, replace(scene, views=plain), replace(scene, views=others)):
        assert extent_by_sweep(unsure) is None


def test_photographs_that_do_not_fit_are_not_believed(
    room: tuple[Scene, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Agreement, "fits", False)
    assert extent_by_sweep(room[0]) is None


def test_where_they_tell_nothing_is_trained_before(
    room: tuple[Scene, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*args: object) -> None:
        raise AssertionError

    monkeypatch.setattr(coarse, "extent_by_training", fail)
    scene, _ = room
    config = wn.TrainConfig(model="rgb", steps=2000, threads=1, grid=wn.GridConfig(voxels=12**3))
    trainer = prepare_trainer(scene, config)
    found = extent_by_sweep(scene)
    assert found is not None and trainer.observed is not None
    assert trainer.scene.content_distance == found.content_distance
    assert trainer.scene.notes[-1].endswith("found by comparing the photographs")


def test_in_a_box_that_is_known_a_short_training_tells_it(
    room: tuple[Scene, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(coarse, "extent_by_training", lambda *args: (None, 3.0))
    scene = replace(room[0], guessed=False)
    config = wn.TrainConfig(model="rgb", steps=2000, threads=1, grid=wn.GridConfig(voxels=12**3))
    assert prepare_trainer(scene, config).observed is None


def test_where_they_do_not_tell_a_short_training_does(
    room: tuple[Scene, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, _ = room
    told = extent_by_sweep(scene)
    monkeypatch.setattr(coarse, "extent_by_sweep", lambda scene: None)
    monkeypatch.setattr(coarse, "extent_by_training", lambda *args: (told, 3.0))
    config = wn.TrainConfig(model="rgb", steps=2000, threads=1, grid=wn.GridConfig(voxels=12**3))
    assert prepare_trainer(scene, config).observed is told
