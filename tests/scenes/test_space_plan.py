"""Which box and border are chosen, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import warpnerf as wn
from tests.support.tiny_scenes import camera_at, look_at, ring, tiny_scene
from warpnerf.scenes.cameras.observations import Observations, observe
from warpnerf.scenes.extent.sharpness import Sharpness, in_words, sharpness
from warpnerf.scenes.extent.space import Space
from warpnerf.scenes.extent.space_plan import (
    BORDERS,
    UNSEEN_BORDER,
    plan_space,
    predicted_error,
    resolve_space,
    spaces,
)
from warpnerf.scenes.scene import Scene

VOXELS = 100**3
CONFIG = wn.TrainConfig(grid=wn.GridConfig(voxels=VOXELS))


def seen_around(inner: float, outer: float, share: float) -> Observations:
    """A table that a ring of cameras sees, and walls far behind it: a share of the pixels."""
    rng = np.random.default_rng(1)
    cameras = [camera_at(pose) for pose in ring(24)]
    seen = []
    for camera in cameras:
        n = round(40 * share)
        table = rng.uniform(-inner, inner, (40 - n, 3))
        walls = camera.position + camera.forward * outer + rng.uniform(-1.0, 1.0, (n, 3))
        seen.append(np.concatenate([table, walls]))
    return observe(cameras, seen, range(24))


def wide(half: float = 8.0) -> Space:
    """A box around everything."""
    return Space(
        box_min=-half * np.ones(3), box_max=half * np.ones(3), contraction="linf", border=0.2
    )


def scene_that_sees(seen: Observations | None) -> Scene:
    poses = ring(24)
    return replace(tiny_scene(poses), unbounded=True, observations=seen)


def test_a_table_in_a_room_gets_a_box_of_its_own() -> None:
    seen = seen_around(0.5, 9.0, 0.3)
    plan = plan_space(wide(), seen, VOXELS, None, box=True)
    edges = plan.box_max - plan.box_min
    assert (edges < 5.0).all() and (edges > 0.5).all()
    assert (plan.box_min < 0.0).all() and (plan.box_max > 0.0).all()
    assert predicted_error(plan, seen, VOXELS) < predicted_error(wide(), seen, VOXELS) - 3.0


def test_a_box_that_fits_already_is_kept() -> None:
    """As it is around a facade: nothing lies around it, and all of it is as far away."""
    rng = np.random.default_rng(2)
    cameras = [
        camera_at(look_at((x, -10.0, 0.0), (x, 0.0, 0.0))) for x in np.linspace(-4.0, 4.0, 12)
    ]
    wall = [rng.uniform((x - 4.0, -0.1, -3.0), (x + 4.0, 0.1, 3.0), (60, 3)) for x in (-2.0, 2.0)]
    seen = observe(cameras, [wall[k % 2] for k in range(12)], range(12))
    around = Space(
        box_min=np.array([-6.1, -1.2, -3.1]),
        box_max=np.array([6.1, 1.2, 3.1]),
        contraction="linf",
        border=0.2,
    )
    plan = plan_space(around, seen, VOXELS, None, box=True)
    assert np.prod(plan.extent) >= 0.5 * np.prod(around.extent)
    assert plan.border <= 0.3


def test_the_plan_is_that_of_the_least_error_and_does_not_depend_on_the_voxels() -> None:
    seen = seen_around(0.5, 9.0, 0.3)
    plan = plan_space(wide(), seen, VOXELS, None, box=True)
    finer = plan_space(wide(), seen, 8 * VOXELS, None, box=True)
    np.testing.assert_array_equal(plan.box_min, finer.box_min)
    assert plan.border == finer.border
    for border in BORDERS:
        other = replace(plan, border=border)
        assert predicted_error(plan, seen, VOXELS) <= predicted_error(other, seen, VOXELS)


def test_a_box_that_is_hardly_worse_than_the_best_is_kept() -> None:
    seen = seen_around(0.5, 9.0, 0.3)
    tried = spaces(wide(), seen, 0.5, box=True)
    errors = np.array([predicted_error(space, seen, VOXELS) for space in tried])
    worse = np.where(errors > errors.min(), errors, np.inf)
    assert worse.min() < errors.min() + 0.25
    own = tried[int(worse.argmin())]
    kept = plan_space(own, seen, VOXELS, 0.5, box=True)
    np.testing.assert_array_equal(kept.box_min, own.box_min)


def test_what_is_given_stays() -> None:
    seen = seen_around(0.5, 9.0, 0.3)
    kept = plan_space(wide(), seen, VOXELS, None, box=False)
    np.testing.assert_array_equal(kept.box_min, wide().box_min)
    assert kept.border in BORDERS
    assert plan_space(wide(), seen, VOXELS, 0.45, box=True).border == 0.45


def test_a_scene_s_space_follows_its_configuration() -> None:
    scene = scene_that_sees(seen_around(0.5, 9.0, 0.3))
    own = np.stack([scene.box_min, scene.box_max])

    def resolved(**grid: object) -> Space:
        return resolve_space(scene, replace(CONFIG, grid=replace(CONFIG.grid, **grid)))

    planned = resolved()
    assert planned.contraction == "linf"
    assert not np.array_equal(planned.box_min, scene.box_min)
    np.testing.assert_array_equal(planned.content, own)  # type: ignore[arg-type]
    as_scene = resolved(box="scene", border=0.2)
    np.testing.assert_array_equal(np.stack([as_scene.box_min, as_scene.box_max]), own)
    assert as_scene.border == 0.2 and as_scene.content is None
    given = resolved(box=(-0.5, -0.5, -0.4, 0.5, 0.6, 0.7))
    np.testing.assert_array_equal(given.content, own)  # type: ignore[arg-type]
    np.testing.assert_array_equal(given.box_max, [0.5, 0.6, 0.7])
    assert given.border in BORDERS
    bounded = resolved(contraction="none")
    np.testing.assert_array_equal(bounded.box_min, scene.box_min)
    assert bounded.border == 0.0


def test_without_anything_seen_the_box_is_the_scene_s() -> None:
    scene = scene_that_sees(None)
    space = resolve_space(scene, CONFIG)
    np.testing.assert_array_equal(space.box_min, scene.box_min)
    assert space.border == UNSEEN_BORDER


@pytest.mark.parametrize(
    "box",
    [
        (0.0, 0.0, 0.0, 1.0, 1.0),
        (0.0, 0.0, 0.0, 1.0, 0.0, 1.0),
        (0.0, 0.0, 0.0, 1.0, float("nan"), 1.0),
        (0.0, 0.0, float("-inf"), 1.0, 1.0, 1.0),
        (-1e200, -1e200, -1e200, 1e200, 1e200, 1e200),
        (0.0, 0.0, 0.0, 10.0, 1e-7, 1e-7),
        ("a", "b", "c", "d", "e", "f"),
        None,
        3.0,
        "large",
    ],
)
def test_what_is_no_box_is_refused(box: object) -> None:
    with pytest.raises(wn.InputError, match=r"grid\.box must be auto, scene, or six numbers"):
        wn.GridConfig(box=box)  # type: ignore[arg-type]


def test_a_box_is_a_tuple_of_numbers_whatever_it_was_given_as() -> None:
    for box in ([0, 0, 0, 1, 2, 3], np.arange(6.0)):
        assert isinstance(wn.GridConfig(box=box).box, tuple)  # type: ignore[arg-type]


@pytest.mark.parametrize("value", [True, "wide", [0.3], None, 0.0, 1.5, float("nan")])
def test_what_is_no_border_or_growth_is_refused(value: object) -> None:
    with pytest.raises(wn.InputError, match=r"grid\.border must be auto, or above 0"):
        wn.GridConfig(border=value)  # type: ignore[arg-type]
    if value not in (0.0, 1.5):
        with pytest.raises(wn.InputError, match=r"march\.growth must be auto, or a number"):
            wn.MarchConfig(growth=value)  # type: ignore[arg-type]


def test_a_box_around_a_camera_or_around_what_is_seen_is_no_mistake() -> None:
    scene = scene_that_sees(seen_around(0.1, 9.0, 0.0))
    large = replace(CONFIG, grid=replace(CONFIG.grid, box=(-3e4, -3e4, -3e4, 3e4, 3e4, 3e4)))
    assert resolve_space(scene, large).box_max[0] == 3e4
    assert resolve_space(replace(scene, observations=None), large).box_max[0] == 3e4


def test_one_place_that_is_seen_is_enough_to_plan() -> None:
    one = observe([camera_at(ring(1)[0])], [np.zeros((1, 3))], [0])
    assert np.isfinite(predicted_error(wide(), one, VOXELS))


def test_a_box_has_no_place_in_a_frustum() -> None:
    grid = wn.GridConfig(box=(0.0, 0.0, 0.0, 1.0, 1.0, 1.0), contraction="ndc")
    with pytest.raises(wn.InputError, match=r"grid\.box does nothing in normalised device"):
        resolve_space(scene_that_sees(None), replace(CONFIG, grid=grid))


@pytest.mark.parametrize("contraction", ["auto", "none"])
def test_what_is_of_contracted_space_is_refused_in_a_bounded_one(contraction: str) -> None:
    bounded = replace(scene_that_sees(None), unbounded=False)
    grid = replace(CONFIG.grid, contraction=contraction)
    resolve_space(bounded, replace(CONFIG, grid=grid))
    bordered = replace(CONFIG, grid=replace(grid, border=0.3))
    with pytest.raises(wn.InputError, match=r"grid\.border is 0\.3, but grid\.contraction is none"):
        resolve_space(bounded, bordered)
    growing = replace(CONFIG, grid=grid, march=wn.MarchConfig(growth=0.05))
    with pytest.raises(wn.InputError, match=r"march\.growth is 0\.05, but grid\.contraction is"):
        resolve_space(bounded, growing)


def test_a_box_that_no_camera_sees_is_refused() -> None:
    scene = scene_that_sees(None)
    behind = replace(CONFIG, grid=replace(CONFIG.grid, box=(0.0, 0.0, 50.0, 1.0, 1.0, 51.0)))
    with pytest.raises(wn.InputError, match="lies outside of what every training camera"):
        resolve_space(scene, behind)


def test_widths_are_told_with_what_to_do() -> None:
    scene = scene_that_sees(seen_around(0.5, 9.0, 0.3))
    space = resolve_space(scene, CONFIG)
    found = sharpness(scene, space, VOXELS)
    widths = space.voxel_widths(scene.observations, VOXELS)  # type: ignore[arg-type]
    assert found.low <= found.median <= found.high
    assert found.median == pytest.approx(np.median(widths), rel=0.1)
    assert str(Sharpness(low=4.0, median=4.5, high=9.0)).startswith("blurred: 4.5 pixels wide")
    assert "--voxels" in str(Sharpness(low=4.0, median=4.5, high=9.0))
    assert str(Sharpness(low=1.5, median=1.5, high=1.6)) == "1.5 pixels wide where cameras look"
    assert "finer than the photographs" in str(Sharpness(low=0.3, median=0.3, high=0.4))
    for guess in (replace(scene, unbounded=False), scene_that_sees(None)):
        text = str(sharpness(guess, resolve_space(guess, CONFIG), 1000))
        assert text.startswith("about ") and "training" in text and "--voxels" not in text


def test_a_space_is_told_with_its_border_and_what_cameras_see() -> None:
    space = Space(
        box_min=np.zeros(3), box_max=np.array([1.0, 2.0, 3.0]), contraction="linf", border=0.5
    )
    text = in_words(space, "space outside contracted")
    assert text == "1 x 2 x 3 scene units, space outside contracted, border 0.5"
    content = replace(space, content=np.array([[-1.0, -1.0, -1.0], [3.0, 3.0, 4.0]]))
    assert "1 x 2 x 3 scene units of 4 x 4 x 5 that cameras see" in in_words(content, "nothing")
