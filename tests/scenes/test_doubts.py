"""Poses and lenses that photographs of a room refute."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from tests.scenes.test_conventions import SIZE, along_a_wall, held, outward, photographed
from tests.support.tiny_scenes import DATA, camera_at, look_at, needs_capture
from warpnerf.scenes.extent.conventions import check_against_photographs
from warpnerf.scenes.extent.photo_consistency import PhotoConsistency
from warpnerf.scenes.formats.load import load_scene
from warpnerf.scenes.scene import View

REFUTED = "photographs do not fit their poses"


@pytest.fixture(scope="module")
def room() -> list[View]:
    return photographed(outward(20))


def with_focal(views: list[View], factor: float) -> list[View]:
    cameras = [replace(v.camera, fx=factor * v.camera.fx, fy=factor * v.camera.fy) for v in views]
    return [replace(view, camera=camera) for view, camera in zip(views, cameras, strict=True)]


def shuffled(views: list[View]) -> list[View]:
    """Each pose with the photograph of another."""
    order = np.random.default_rng(0).permutation(len(views))
    return [replace(view, image=views[k].image) for view, k in zip(views, order, strict=True)]


@pytest.mark.ci
@pytest.mark.parametrize(
    "factor", [0.5, *(pytest.param(x, marks=pytest.mark.slow) for x in (0.7, 2.0, 4.0))]
)
def test_focal_lengths_of_another_size_are_named(factor: float, room: list[View]) -> None:
    found, _, warning = held(with_focal(room, factor))
    assert warning.startswith("focal lengths do not fit the photographs")
    low, high = map(float, re.findall(r"about ([\d.]+) to ([\d.]+) times", warning)[0])
    assert low <= 1.0 / factor <= high
    assert all(a.camera.fx == factor * b.camera.fx for a, b in zip(found, room, strict=True))


@pytest.mark.ci
def test_focal_lengths_that_cameras_do_not_tell_are_believed() -> None:
    """Along a wall nearly parallel cameras fit with any."""
    wall = photographed(along_a_wall(24))
    for factor in (0.35, 0.5, 2.0, 2.8):
        assert "focal" not in held(with_focal(wall, factor))[2]


@pytest.mark.ci
def test_photographs_of_other_poses_are_named(room: list[View]) -> None:
    assert held(shuffled(room))[2].startswith(REFUTED)
    same = [replace(view, image=room[0].image) for view in room]
    assert held(same)[2].startswith(REFUTED)


def bent(views: list[View], **lens: float | bool) -> list[View]:
    return [replace(view, camera=replace(view.camera, **lens)) for view in views]


@pytest.mark.ci
@pytest.mark.parametrize("lens", [{"k1": -0.3, "k2": 0.1}, {"fisheye": True}])
def test_distortion_of_photographs_without_is_named(
    lens: dict[str, float | bool], room: list[View]
) -> None:
    said = held(bent(room, **lens))[2]
    assert said.startswith("distortion does not fit the photographs, which fit each other better")


@pytest.mark.ci
def test_photographs_with_their_distortion_are_believed(room: list[View]) -> None:
    """Resampled to a lens: what was read between pixels is as good as it was."""
    views = []
    for view in bent(room, k1=-0.2, p1=0.01):
        c = view.camera
        u, v = np.meshgrid(np.arange(c.width) + 0.5, np.arange(c.height) + 0.5)
        straight = np.stack([u.ravel() - c.cx, v.ravel() - c.cy], axis=1) / c.fx
        at = np.floor(c.distort(straight)[0] * c.fx + [c.cx, c.cy]).astype(int)
        image, inside = view.image.copy(), ((at >= 0) & (at < [c.width, c.height])).all(axis=1)
        image[at[inside, 1], at[inside, 0]] = view.image.reshape(-1, 3)[inside]
        views.append(replace(view, image=image))
    assert "distortion" not in held(views)[2]


@pytest.mark.ci
def test_photographs_of_which_some_do_not_fit_are_counted(room: list[View]) -> None:
    turned = mirrored(mirrored(room, 0), 1)
    said = held([*room[:10], *turned[10:]])[2]
    found = re.match(r"some photographs do not fit .*: (\d+) of 10 that .*first: 01[0-9]\)", said)
    assert found is not None and 3 <= int(found[1]) <= 6
    assert held([*room[:18], *turned[18:]])[2] == ""


@pytest.mark.ci
def test_photographs_for_testing_are_looked_at_as_well() -> None:
    """As of another lens."""
    room = photographed(outward(32))
    training = [k for k in range(32) if k % 4]
    zoomed = with_focal(room, 0.5)
    for wrong in (False, True):
        views = [zoomed[k] if wrong and k % 4 == 0 else view for k, view in enumerate(room)]
        said = "; ".join(check_against_photographs(views, training, None, False)[3])
        assert said.startswith("photographs for testing do not fit their poses: ") == wrong
        assert wrong or said == ""


def mirrored(views: list[View], axis: int) -> list[View]:
    """Their photographs turned over along rows (1) or columns (0)."""
    return [replace(view, image=np.ascontiguousarray(np.flip(view.image, axis))) for view in views]


@pytest.mark.ci
@pytest.mark.parametrize(("axis", "how"), [(1, "left to right"), (0, "upside down")])
def test_mirrored_photographs_are_named(axis: int, how: str, room: list[View]) -> None:
    assert f"photographs were mirrored {how} after" in held(mirrored(room, axis))[2]
    poses = np.array([view.camera.c2w for view in room])
    off = [replace(v, camera=replace(v.camera, cx=40.0, cy=30.0)) for v in mirrored(room, axis)]
    assert np.array_equal(PhotoConsistency.of(off).poses, poses)
    picture = PhotoConsistency.of(off).mirrored(across=axis == 1)._picture(0)
    np.testing.assert_array_equal(picture.gray, PhotoConsistency.of(room)._picture(0).gray)
    np.testing.assert_array_equal(picture.centre, [40.0, 30.0])


@pytest.mark.ci
def test_mirrored_photographs_of_an_object_are_named(room: list[View]) -> None:
    """Of cameras that look at one thing nothing else is questioned."""
    around = [
        camera_at(look_at((1.2 * np.cos(a), 1.4 * np.sin(a), 1.3), (-0.3, 0.0, 0.5)), **SIZE)
        for a in np.linspace(0.0, 5.0, 20)
    ]
    table = photographed(around)
    for views, says in ((table, ""), (mirrored(table, 1), "were mirrored left to right")):
        said = check_against_photographs(views, range(len(views)), None, True)[3]
        assert ("; ".join(said) == "") if not says else says in said[0]


@pytest.mark.ci
def test_photographs_that_hardly_overlap_refute_nothing(room: list[View]) -> None:
    """Nor do few, or such without texture."""
    far = room[::3]
    assert held(far)[2] == held(shuffled(far))[2] == ""
    wall = photographed(along_a_wall(5))
    assert held(shuffled(wall))[2] == ""
    bare = [replace(view, image=np.full_like(view.image, 128)) for view in room]
    assert held(bare)[2] == ""


CAPTURES = ["fox_q", "stitch", "cup_colmap", "fern_llff", "lund_door"]


@pytest.mark.ci
@pytest.mark.usefixtures("poses_as_given")
@pytest.mark.parametrize("name", [pytest.param(n, marks=needs_capture(n)) for n in CAPTURES])
def test_captures_fit_also_of_few_of_their_photographs(name: str) -> None:
    scene = load_scene(DATA / name)
    for every in (1, 3, 6):
        _, _, warning = held([scene.views[k] for k in scene.splits["train"][::every]])
        assert "fit" not in warning
