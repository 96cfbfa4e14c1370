"""What makes two trainings the same, and what two states of them are compared by."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.training.test_determinism import small_scene
from warpnerf.config import MarchConfig, TrainConfig
from warpnerf.optim_config import OptimConfig
from warpnerf.scenes.scene import Scene, View
from warpnerf.training.state import differences, scene_digest


def with_view(scene: Scene, index: int, view: View) -> Scene:
    return replace(scene, views=[*scene.views[:index], view, *scene.views[index + 1 :]])


def test_fields_that_decide_the_result_are_named() -> None:
    ours = TrainConfig()
    theirs = TrainConfig(
        steps=5,
        device="cuda",
        threads=3,
        checkpoint_every=1.0,
        march=MarchConfig(far=2.0),
        optim=OptimConfig(beta1=0.5),
    )
    assert list(differences(ours, ours)) == []
    assert list(differences(ours, theirs)) == [
        ("steps", ours.steps, 5),
        ("march.far", None, 2.0),
        ("optim.beta1", ours.optim.beta1, 0.5),
    ]


@pytest.mark.parametrize("what", ["pixel", "channels", "focal", "pose", "position", "split"])
def test_the_digest_sees_what_training_sees(what: str) -> None:
    scene = small_scene()
    before = scene_digest(scene)
    view = scene.views[1]
    c2w = view.camera.c2w.copy()
    if what == "pixel":
        view.image[3, 2, 1] ^= 1
    elif what == "channels":
        scene = with_view(scene, 1, replace(view, image=view.image[..., :3]))
    elif what == "focal":
        scene = with_view(scene, 1, replace(view, camera=replace(view.camera, fx=22.01)))
    elif what == "split":
        scene = replace(scene, splits={"train": (0, 2, 1), "test": (3,)})
    else:
        c2w[0, 3 if what == "position" else 0] += 1e-3
        scene = with_view(scene, 1, replace(view, camera=replace(view.camera, c2w=c2w)))
    assert scene_digest(scene) != before


LENSES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    **{name: ({}, {name: 0.01}) for name in ("k1", "k2", "k3", "p1", "p2")},
    "principal point": ({}, {"cy": 9.5}),
    "other focal length": ({}, {"fy": 22.5}),
    "kind": ({"k1": 0.01}, {"k1": 0.01, "fisheye": True}),
    "fisheye's k4": ({"fisheye": True}, {"fisheye": True, "k4": 0.01}),
    **{f"rational {name}": ({"k4": 0.2}, {"k4": 0.2, name: 0.1}) for name in ("k4", "k5", "k6")},
}
"""Changes of a camera, and what they are compared with."""


@pytest.mark.parametrize("what", LENSES)
def test_the_digest_sees_the_lens(what: str) -> None:
    scene = small_scene()
    one, other = (
        with_view(scene, 1, replace(view, camera=replace(view.camera, **changes)))
        for view in (scene.views[1],)
        for changes in LENSES[what]
    )
    assert scene_digest(one) != scene_digest(other)


def test_the_digest_passes_over_rounding_and_other_views() -> None:
    scene = small_scene()
    before = scene_digest(scene)
    view, held_out = scene.views[1], scene.views[3]
    assert (view.camera.c2w == 0.0).any()  # where rounding may end on either side
    for sign in (-1.0, 1.0):
        c2w = view.camera.c2w + sign * 1e-13
        other = with_view(scene, 1, replace(view, camera=replace(view.camera, c2w=c2w)))
        assert scene_digest(other) == before
    blank = with_view(scene, 3, replace(held_out, image=np.zeros_like(held_out.image)))
    assert scene_digest(blank) == before
