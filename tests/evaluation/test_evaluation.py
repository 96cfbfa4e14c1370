"""Figures of views whose truth is known because the field itself made it."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.support.tiny_fields import tiny_field
from tests.support.tiny_scenes import camera_at, ring
from warpnerf.checks import InputError
from warpnerf.evaluation import evaluate as evaluate_module
from warpnerf.evaluation.evaluate import evaluate
from warpnerf.rendering.field import Field
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.scene import Scene, View

SIZE = {"width": 16, "height": 12, "fx": 14.0, "fy": 14.0, "cx": 8.0, "cy": 6.0}


def scene_of(field: Field, *, depth: bool) -> Scene:
    """What the field looks like, as photographs."""
    views = []
    error = 0.25 * (-1.0) ** np.indices((12, 16), np.float32).sum(axis=0)  # either way
    for i, pose in enumerate(ring(4)):
        camera = camera_at(pose, **SIZE)
        seen = field.render(camera)
        views.append(
            View(
                name=f"images/{i}.png",
                camera=camera,
                image=np.round(seen.rgb * 255.0).astype(np.uint8),
                depth=seen.depth + error.astype(np.float32) if depth else None,
            )
        )
    return Scene(
        name="mirror",
        views=views,
        splits={"train": (0, 1, 2), "test": (3,)},
        box_min=field.lattice.box_min,
        box_max=field.lattice.box_max,
        unbounded=False,
        content_distance=3.0,
    )


def test_a_field_scores_well_on_its_own_pictures() -> None:
    field = tiny_field()
    result = evaluate(field, scene_of(field, depth=True), split="all")
    assert [image.name for image in result.images] == [f"images/{i}.png" for i in range(4)]
    # Rounding to 8 bits: an error of 1/255/sqrt(12) rms, 58.9 dB.
    assert result.mean["psnr"] == pytest.approx(58.9, abs=1.5)
    assert result.mean["ssim"] > 0.999
    assert result.mean["depth_error"] == pytest.approx(0.25, abs=1e-5)


def test_what_masks_hide_is_not_measured() -> None:
    field = tiny_field()
    scene = scene_of(field, depth=True)
    mask = np.zeros((12, 16), bool)
    mask[:, :9] = True
    views = []
    for view in scene.views:
        image = np.where(mask[..., None], view.image, 255 - view.image)
        assert view.depth is not None
        depth = np.where(mask, view.depth, 100.0).astype(np.float32)
        views.append(replace(view, image=image, depth=depth, mask=mask))

    def largest(rgb: np.ndarray, target: np.ndarray) -> float:
        return float(np.abs(rgb - target).max())

    mean = evaluate(field, replace(scene, views=views), split="all", lpips=largest).mean
    assert mean["lpips"] < 0.01
    assert mean["psnr"] > 55.0 and mean["ssim"] > 0.999 and mean["flip"] < 0.02
    assert mean["depth_error"] == pytest.approx(0.25, abs=1e-5)
    corner = np.zeros_like(mask)
    corner[0, 0] = True
    views = [replace(view, mask=corner) for view in views]
    figures = evaluate(field, replace(scene, views=views), split="test")
    assert "ssim" not in figures.mean and figures.mean["psnr"] > 50.0
    assert "ssim" not in json.loads(figures.to_json())["images"][0]


def test_another_picture_scores_worse() -> None:
    field = tiny_field()
    scene = scene_of(field, depth=False)
    wrong = replace(scene.views[3], image=255 - scene.views[3].image)
    result = evaluate(field, replace(scene, views=[*scene.views[:3], wrong]))
    assert result.mean["psnr"] < 20.0


def test_a_view_that_is_fog_is_told() -> None:
    field = tiny_field()
    scene = replace(scene_of(field, depth=False), content_distance=30.0)  # all of it is near
    views = list(scene.views)
    views[3] = replace(views[3], image=255 - views[3].image)
    found = evaluate(field, replace(scene, views=views), split="all")
    shares = [image.near_rays for image in found.images]
    assert all(share is not None and share > 0.5 for share in shares)
    (line,) = [line for line in str(found).splitlines() if line.startswith("fog: ")]
    assert (
        f"1 of 4 views look into density within 3 scene units (first: images/3.png, {shares[3]:.0%}"
        in line
    )
    assert json.loads(found.to_json())["images"][3]["near_rays"] == shares[3]
    close = evaluate(field, replace(scene, views=views, content_distance=0.1), split="all")
    assert "fog" not in str(close) and close.images[3].near_rays == 0.0


def test_json_has_the_promised_form() -> None:
    field = tiny_field()
    without = json.loads(evaluate(field, scene_of(field, depth=False)).to_json())
    assert list(without) == ["split", "mean", "floaters", "images"]
    assert list(without["mean"]) == ["psnr", "cc_psnr", "ssim", "flip"]
    assert list(without["floaters"]) == ["within", "near_mass", "near_rays"]
    assert [list(image) for image in without["images"]] == [
        ["name", "psnr", "cc_psnr", "ssim", "flip", "near_rays"]
    ]
    assert without["mean"]["psnr"] == without["images"][0]["psnr"]
    known = json.loads(evaluate(field, scene_of(field, depth=True)).to_json())
    assert list(known["mean"]) == ["psnr", "cc_psnr", "ssim", "flip", "depth_error"]


def test_what_is_not_installed_or_given_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    field = tiny_field()
    scene = scene_of(field, depth=False)
    monkeypatch.setattr(evaluate_module, "has_flip", lambda: False)
    result = evaluate(field, scene)
    assert list(result.mean) == ["psnr", "cc_psnr", "ssim"]
    assert "FLIP" not in str(result)
    pairs = []

    def distance(rgb: np.ndarray, target: np.ndarray) -> float:
        pairs.append((rgb.shape, target.shape))
        return 0.125 * len(pairs)

    result = evaluate(field, scene, "train", lpips=distance)
    assert pairs == [((12, 16, 3), (12, 16, 3))] * 3
    assert [image.lpips for image in result.images] == [0.125, 0.25, 0.375]
    assert result.mean["lpips"] == 0.25
    assert "LPIPS" in str(result) and "0.2500" in str(result)


def test_a_scene_that_can_be_photographed_anew_is() -> None:
    field = tiny_field()
    scene = scene_of(field, depth=False)

    def photograph(camera: Camera) -> np.ndarray:
        return np.round(field.render(camera).rgb * 255.0).astype(np.uint8)

    result = evaluate(field, replace(scene, photograph=photograph))
    floaters = json.loads(result.to_json())["floaters"]
    assert floaters["pulled_views"] == 3
    assert floaters["pulled_psnr"] > 55.0  # rounding to 8 bits
    assert "pulled back by 0.6 scene units" in str(result)


def test_alpha_is_seen_over_the_background_of_the_field() -> None:
    field = tiny_field()
    scene = scene_of(field, depth=False)
    rng = np.random.default_rng(0)
    cut_out = rng.integers(0, 256, (12, 16, 4), dtype=np.uint8)
    shown = []
    evaluate(
        field,
        replace(scene, views=[*scene.views[:3], replace(scene.views[3], image=cut_out)]),
        on_image=lambda view, truth, rendering: shown.append((view.name, truth, rendering)),
    )
    (name, truth, rendering) = shown[0]
    alpha = cut_out[..., 3:] / 255.0
    expected = cut_out[..., :3] / 255.0 * alpha + np.array([0.1, 0.6, 0.9]) * (1.0 - alpha)
    assert name == "images/3.png"
    assert rendering.rgb.shape == (12, 16, 3)
    np.testing.assert_allclose(truth, expected, atol=1e-12)


def test_the_table_names_every_image_and_the_mean() -> None:
    field = tiny_field()
    table = str(evaluate(field, scene_of(field, depth=True), split="train")).splitlines()
    assert len(table) == 6
    assert "PSNR" in table[0]
    assert [line.split()[0] for line in table[1:4]] == [f"images/{i}.png" for i in range(3)]
    assert table[4].startswith("mean")
    assert table[5].startswith("within 0.3 scene units of the training cameras")


def test_a_missing_split_is_named_with_those_that_exist() -> None:
    field = tiny_field()
    with pytest.raises(InputError, match=r"mirror.*'val'.*test, train"):
        evaluate(field, scene_of(field, depth=False), split="val")


def test_progress_is_told_view_by_view() -> None:
    field, told = tiny_field(), []
    evaluate(
        field,
        scene_of(field, depth=False),
        "all",
        on_progress=lambda done, words: told.append((done, words)),
    )
    assert told.pop() == (1.0, "what is near the cameras")
    n = len(told)
    assert n > 1
    assert told == [(k / (n + 1), f"view {k} of {n}") for k in range(1, n + 1)]
