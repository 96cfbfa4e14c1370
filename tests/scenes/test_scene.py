"""Scenes made by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.support.tiny_scenes import camera_at, picture, ring
from warpnerf.checks import InputError
from warpnerf.scenes.scene import Scene, View, require_split


def view_of(**changes: Any) -> View:
    return View(
        **{"name": "a.png", "camera": camera_at(ring(1)[0]), "image": picture(0), **changes}
    )


def scene_of(**changes: Any) -> Scene:
    good = {
        "name": "by hand",
        "views": [view_of(), view_of(name="b.png")],
        "splits": {"train": (0, 1), "test": ()},
        "box_min": np.zeros(3),
        "box_max": np.ones(3),
        "unbounded": False,
        "content_distance": 1.0,
    }
    return Scene(**{**good, **changes})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"image": picture(0).astype(np.float32)}, "image must be uint8 .*not float32"),
        (
            {"image": picture(0, width=9)},
            r"image must be uint8 \[6, 8, 3 or 4\] as its camera is, not .*6, 9, 3",
        ),
        ({"image": picture(0)[:, :, 0]}, "image must be uint8"),
        ({"depth": np.ones((8, 6), np.float32)}, r"depth must be \[6, 8\] .*not \[8, 6\]"),
    ],
)
def test_a_photograph_of_another_camera_is_refused(changes: dict[str, Any], message: str) -> None:
    view_of(depth=np.ones((6, 8), np.float32))
    with pytest.raises(InputError, match=rf"a\.png: {message}"):
        view_of(**changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"views": [view_of(), view_of()]}, "two views have one name"),
        ({"content_distance": 0.0}, "content_distance must be a finite number above 0"),
        ({"content_distance": 1e-320}, r"content_distance must lie between 1e-12 and 1e\+12"),
        ({"box_max": np.full(3, 1e300)}, r"box_min must lie .* within 1e\+12 scene units of 0"),
        ({"points": np.zeros((5, 2))}, r"points must be finite numbers, \[n, 3\], not .*5, 2"),
        ({"points": np.full((5, 3), np.nan)}, "points must be finite numbers"),
        ({"points": np.full((5, 3), "a")}, "points must be finite numbers"),
        ({"splits": {"train": (0, 2)}}, r"splits\['train'\] must be indices of 2 views"),
        ({"splits": {"train": (0,), "test": (-1,)}}, r"splits\['test'\] must be indices"),
        ({"splits": {"train": (), "test": (0,)}}, r"splits\['train'\] must name at least one view"),
    ],
)
def test_a_scene_that_nothing_can_be_trained_on_is_refused(
    changes: dict[str, Any], message: str
) -> None:
    scene_of()
    with pytest.raises(InputError, match=rf"by hand: {message}"):
        scene_of(**changes)


def test_kinds_of_scenes() -> None:
    """By what is trained on: a test view with alpha makes no object."""
    views = [view_of(), view_of(name="b.png", image=picture(1, channels=4)), view_of(name="c.png")]
    scene = scene_of(views=views, splits={"train": (0, 1), "test": (2,)})
    assert scene.has_alpha and scene.kind == "object"
    assert scene_of(views=views, splits=scene.splits, unbounded=True).kind == "unbounded"
    plain = scene_of(views=views, splits={"train": (0, 2), "test": (1,)})
    assert not plain.has_alpha and plain.kind == "bounded"


def test_a_split_without_views_is_not_among_those_that_there_are() -> None:
    with pytest.raises(InputError, match=r"by hand has no 'test' views; it has train or all\.$"):
        require_split(scene_of(), "test")
