"""Diagnostics of scenes with one fault each."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import warpnerf as wn
from tests.support.tiny_scenes import (
    look_at,
    picture,
    ring,
    save,
    write_blender,
    write_transforms,
)
from warpnerf.checks import InputError
from warpnerf.config import GridConfig, TrainConfig
from warpnerf.inspection import inspection
from warpnerf.inspection.inspection import Inspection, inspect
from warpnerf.model.interface import Model
from warpnerf.model.models import Deferred, PerSample, Rgb, SphericalHarmonics
from warpnerf.optim_config import OptimConfig
from warpnerf.scenes.formats.load import load_scene


def scene_with(folder: Path, poses: list[np.ndarray]) -> Path:
    content = write_transforms(folder, len(poses), scale=2)
    for frame, pose in zip(content["frames"], poses, strict=True):
        frame["transform_matrix"] = pose.tolist()
    save(folder / "transforms.json", content)
    return folder


def odd(found: Inspection) -> str:
    return "\n".join(found.diagnostics)


def test_an_ordinary_scene(tmp_path: Path) -> None:
    found = inspect(scene_with(tmp_path / "ring", ring(9)))
    facts = json.loads(found.to_json())
    assert found.diagnostics == ()
    assert facts["name"] == "ring"
    assert facts["splits"] == {"test": 2, "train": 7}
    assert facts["sizes"] == [[16, 12, 9]]
    assert facts["focal_length"] == [20.0, 22.0]
    assert facts["field_of_view"][0] == pytest.approx(2 * [2 * np.degrees(np.arctan(0.4))])
    assert facts["distortion"] == {}
    np.testing.assert_allclose(facts["focus"], 0.0, atol=1e-9)
    np.testing.assert_allclose(facts["up"], [0.0, 0.0, 1.0], atol=1e-9)
    assert facts["content_distance"] == pytest.approx(np.sqrt(10.0))
    assert any("median depth" in line for line in facts["how"])
    text = str(found)
    for words in ("instant-ngp", "9: 2 test, 7 train", "16 x 12", "3.162 scene units", "none"):
        assert words in text


def test_what_loading_warns_of_is_odd(tmp_path: Path) -> None:
    folder = scene_with(tmp_path, ring(9))
    content = json.loads((folder / "transforms.json").read_text())
    content["frames"].append(content["frames"][0] | {"file_path": "images/gone.png"})
    content["frames"].append(content["frames"][0])
    content["exposure"] = 3
    save(folder / "transforms.json", content)
    found = odd(inspect(folder))
    for words in ("gone.png", "naming an image again", "not read: exposure"):
        assert words in found


def test_photographs_that_show_nothing_or_too_little_are_odd(tmp_path: Path) -> None:
    folder = scene_with(tmp_path / "dark", ring(9))
    for number in (1, 4):
        Image.new("RGB", (16, 12)).save(folder / f"images/{number:03}.png")
    (finding,) = inspect(folder).diagnostics
    assert finding.startswith("of one colour throughout: 2 of 9 images (first: images/001.png)")
    write_transforms(tmp_path / "tiny", 9)
    found = odd(inspect(tmp_path / "tiny"))
    assert "images/000.png is 8 x 6 pixels, but SSIM needs 11 x 11" in found


@pytest.mark.parametrize(("gray", "says"), [(3, True), (9, False), (0, False)])
def test_gray_photographs_among_coloured_ones_are_said(
    tmp_path: Path, gray: int, says: bool
) -> None:
    """As of a thermal camera beside the other."""
    folder = scene_with(tmp_path, ring(9))
    for k in range(gray):
        file = folder / f"images/{k:03d}.png"
        Image.open(file).convert("L").save(file)
    found = odd(inspect(folder))
    assert ("gray among coloured ones: 3 of 9 images (first: images/000.png)" in found) == says


def test_the_same_photograph_at_other_poses_is_said(tmp_path: Path) -> None:
    """As of a video that stood still; one that differs in a pixel is another."""
    content = write_transforms(tmp_path, 9, scale=16)
    content["frames"][5]["transform_matrix"] = content["frames"][3]["transform_matrix"]
    save(tmp_path / "transforms.json", content)
    pixels = np.array(Image.open(tmp_path / "images/003.png"))
    for k in (4, 5):
        Image.fromarray(pixels).save(tmp_path / f"images/{k:03d}.png")
    pixels[5, 7, 0] ^= 1
    Image.fromarray(pixels).save(tmp_path / "images/006.png")
    for k in (7, 8):  # are said to be of one colour
        Image.fromarray(np.zeros_like(pixels)).save(tmp_path / f"images/{k:03d}.png")
    found = odd(inspect(tmp_path))
    assert (
        "the same photograph at different poses: 1 of 9 images (first: images/004.png is "
        "images/003.png again)"
    ) in found


@pytest.mark.parametrize(
    ("brightest", "n", "says"), [(16, 5, True), (16, 4, False), (17, 9, False)]
)
def test_photographs_that_are_nearly_black_are_said(
    tmp_path: Path, brightest: int, n: int, says: bool
) -> None:
    """As 12 bits in files of 16 are."""
    scene_with(tmp_path, ring(9))
    for k in range(n):
        dark = (picture(k, width=16, height=12) / 255.0 * brightest).round().astype(np.uint8)
        dark[0, 0] = brightest
        Image.fromarray(dark).save(tmp_path / f"images/{k:03d}.png")
    found = odd(inspect(tmp_path))
    assert (f"nearly black: {n} of 9 images (first: images/000.png)" in found) == says


@pytest.mark.parametrize(
    ("n", "value", "rows", "share"),
    [
        (10, 0, slice(0, 2), "16.7%"),  # a bar
        (9, 0, slice(0, 2), ""),  # too few to tell
        (10, 255, slice(0, 2), ""),  # a sky
        (10, 249, slice(0, 2), "16.7%"),
        (10, 255, None, "27.1%"),  # all around
    ],
)
def test_pixels_that_are_the_same_in_all_photographs_are_said(
    tmp_path: Path, n: int, value: int, rows: slice | None, share: str
) -> None:
    """As bars of a video are; those that differ by a few, as in JPEG, are the same, too."""
    scene_with(tmp_path, ring(n))
    for k in range(n):
        pixels = picture(k, width=16, height=12)
        if rows is None:
            pixels[[0, -1]] = value
            pixels[:, [0, -1]] = value
        else:
            pixels[rows] = value + (k % 2) * (4 if value < 128 else -4)
        Image.fromarray(pixels).save(tmp_path / f"images/{k:03d}.png")
    found = odd(inspect(tmp_path))
    assert ("the same in all photographs" in found) == bool(share)
    assert f"{share} of the pixels of {n} of {n} images" in found or not share


@pytest.mark.parametrize("value", [0, 60, 255])
def test_a_background_of_one_colour_is_not_said(tmp_path: Path, value: int) -> None:
    """It has no place, and so goes well with all poses."""
    scene_with(tmp_path, ring(10))
    for k in range(10):
        pixels = np.full((12, 16, 3), value, np.uint8)
        rows, columns = np.mgrid[:12, :16]
        ball = np.hypot(rows - 6, columns - 8 - k % 2) < 4
        pixels[ball] = picture(k, width=16, height=12)[ball]
        Image.fromarray(pixels).save(tmp_path / f"images/{k:03d}.png")
    assert "the same in all photographs" not in odd(inspect(tmp_path))


def test_dark_photographs_are_not_the_same_in_all(tmp_path: Path) -> None:
    scene_with(tmp_path, ring(10))
    for k in range(10):
        dark = (picture(k, width=16, height=12) // 100).astype(np.uint8)
        Image.fromarray(dark).save(tmp_path / f"images/{k:03d}.png")
    found = odd(inspect(tmp_path))
    assert "nearly black: 10 of 10" in found and "the same in all photographs" not in found


@pytest.mark.parametrize(("step", "says"), [(2, True), (3, False)])
def test_where_cameras_look_the_same_way_less_is_still(
    tmp_path: Path, step: int, says: bool
) -> None:
    """There plain walls hardly change either."""
    poses = [look_at((0.1 * k, 0.0, 0.0), (0.1 * k, 5.0, 0.0)) for k in range(10)]
    scene_with(tmp_path, poses)
    for k in range(10):
        pixels = picture(k, width=16, height=12)
        pixels[:2] = 20 + step * (k % 2)
        Image.fromarray(pixels).save(tmp_path / f"images/{k:03d}.png")
    assert ("the same in all photographs" in odd(inspect(tmp_path))) == says


def test_still_pixels_that_are_masked_or_transparent_are_not_said(tmp_path: Path) -> None:
    scene_with(tmp_path / "masks", ring(10))
    mask = np.full((12, 16), 255, np.uint8)
    mask[:2] = 0
    for k in range(10):
        pixels = picture(k, width=16, height=12)
        pixels[:2] = 0
        Image.fromarray(pixels).save(tmp_path / f"masks/images/{k:03d}.png")
        Image.fromarray(mask).save(tmp_path / f"masks/images/{k:03d}_mask.png")
    assert "the same in all" not in odd(inspect(tmp_path / "masks"))
    write_blender(tmp_path / "alpha", "train", ring(10))
    for k in range(10):
        pixels = picture(k, channels=4)
        pixels[[0, -1]] = pixels[:, [0, -1]] = 0
        Image.fromarray(pixels).save(tmp_path / f"alpha/train/r_{k}.png")
    assert load_scene(tmp_path / "alpha").views[0].image.shape[2] == 4
    assert "the same in all" not in odd(inspect(tmp_path / "alpha"))


def test_alpha_in_only_some_images_is_said(tmp_path: Path) -> None:
    folder = scene_with(tmp_path, ring(9))
    for number in (2, 5):
        path = folder / "images" / f"{number:03}.png"
        rgba = Image.open(path).convert("RGBA")
        rgba.putpixel((3, 2), (10, 20, 30, 100 if number == 5 else 255))
        rgba.save(path)
    (finding,) = inspect(folder).diagnostics
    assert "transparent pixels, 0.5% of 1 of 9 images (first: images/005.png), are ign" in finding


@pytest.mark.parametrize(
    ("orientation", "stated", "said"),
    [(1, True, False), (6, False, True), (6, True, False), (3, True, True)],
)
def test_an_exif_rotation_is_said_where_sizes_do_not_settle_it(
    tmp_path: Path, orientation: int, stated: bool, said: bool
) -> None:
    folder = scene_with(tmp_path, ring(9))
    content = json.loads((folder / "transforms.json").read_text())
    for frame in content["frames"]:
        path = folder / frame["file_path"]
        frame["file_path"] = frame["file_path"].replace("png", "jpg")
        exif = Image.Exif()
        exif[274] = orientation
        Image.open(path).save(folder / frame["file_path"], exif=exif)
    if not stated:
        del content["w"], content["h"]
    save(folder / "transforms.json", content)
    told = [line for line in inspect(folder).diagnostics if "EXIF" in line]
    assert len(told) == said
    if said:
        assert told[0].startswith(
            "stored turned, with an EXIF rotation that is not applied: 9 images"
        )


def test_poses_in_opencv_axes_are_recognised(tmp_path: Path) -> None:
    poses = [pose @ np.diag([1.0, -1.0, -1.0, 1.0]) for pose in ring(9)]
    found = inspect(scene_with(tmp_path, poses))
    assert "poses are in OpenCV axes" in odd(found)
    assert found.focus is None


def test_no_common_focus_is_said(tmp_path: Path) -> None:
    along = [look_at((float(i), 0.0, 0.0), (i + 0.5 * (-1) ** i, 5.0, 0.0)) for i in range(12)]
    found = inspect(scene_with(tmp_path, along))
    assert "no common focus" in odd(found)
    assert "guess" in odd(found)
    assert "OpenCV" not in odd(found)


LARGE = {"w": 320, "h": 180, "fl_x": 333.0, "fl_y": 333.0}


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"cx": 0.0}, "principal point far from the middle of the image: 9 of 9 cameras"),
        ({"cx": 0.5, "cy": 0.9}, "principal point far from the middle"),  # shares
        ({"cx": 0.5, "cy": 0.5}, "principal point far from the middle"),
        ({"cx": 0.5, "cy": 0.5, **LARGE}, "principal point far from the middle"),
        ({"cx": 160.0, "cy": 90.0, **LARGE}, None),
        ({"cx": 20.0, "cy": 11.25, **LARGE}, "are pixels of a picture 0.125 times as wide"),
        ({"cx": 6.0, "cy": 8.0}, "is that of a picture turned by 90 degrees: 9 of 9 cameras"),
        ({"cx": 4.0, "cy": 3.0}, "are pixels of a picture 0.5 times as wide"),
        ({"cx": 2.67, "cy": 2.0}, "are pixels of a picture 0.334 times as wide"),
        ({"cx": 12.8, "cy": 9.6}, "are pixels of a picture 1.6 times as wide"),
        ({"cx": 7.2, "cy": 6.6}, None),
        ({"fl_x": 10.0, "fl_y": 16.0}, "as if pixels were not square; width and height may be"),
        ({"fl_x": 10.0, "fl_y": 11.8}, None),
        ({"fl_x": 0.9, "fl_y": 1.2}, "focal length below 0.15 of the image's width: 9 of 9"),
        ({}, None),
    ],
)
def test_lenses_in_other_units_are_said(
    tmp_path: Path, given: dict[str, float], says: str | None
) -> None:
    scene_with(tmp_path, ring(9))
    if given.get("w"):
        for path in (tmp_path / "images").iterdir():
            Image.open(path).resize((320, 180)).save(path)
    path = tmp_path / "transforms.json"
    save(path, json.loads(path.read_text()) | given)
    found = odd(inspect(tmp_path))
    assert (says or "") in found
    if says is None:
        assert "principal" not in found and "turned" not in found and "focal" not in found


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({}, None),
        ({"near": 2.0}, None),
        ({"near": 3.2}, "the near plane begins 3.2"),
        ({"content_distance": 1.0}, "the box begins"),
        ({"content_distance": 2.9}, None),
    ],
)
def test_a_scaling_that_does_nothing_is_said(
    tmp_path: Path, options: dict[str, Any], says: str | None
) -> None:
    write_blender(tmp_path, "train", ring(8))
    found = odd(inspect(tmp_path, **options))
    assert ("the scaling has nothing to do" in found) == (says is not None)
    assert (says or "") in found


@pytest.mark.parametrize("name", ["builtin:room", "builtin:room-sparse"])
def test_the_built_in_scenes_are_in_order(name: str) -> None:
    found = inspect(name, downscale=8)
    assert found.diagnostics == ()
    assert found.focus is None  # its cameras look everywhere, and it knows its distances


def test_costs_grow_with_what_is_asked(tmp_path: Path) -> None:
    folder = scene_with(tmp_path, ring(9))
    one, four = (inspect(folder, threads=n).costs for n in (1, 4))
    assert one["quality"].seconds > 2.0 * one["fast"].seconds > 0.0
    assert one["quality"].plan.memory > 2.0 * one["fast"].plan.memory
    assert four["fast"].plan.memory == one["fast"].plan.memory >= 192 * 160**3  # 16 numbers a node
    assert four["fast"].seconds == pytest.approx(one["fast"].seconds / 4)


def test_costs_are_those_of_the_model(tmp_path: Path) -> None:
    folder = scene_with(tmp_path, ring(9))

    def of(model: Model) -> Inspection:
        return inspect(folder, configs={"mine": wn.TrainConfig(model=model)})

    rgb = of(Rgb())
    for model in (Deferred(), PerSample(), SphericalHarmonics(degree=3)):
        found = of(model)
        nodes = math.prod(found.costs["mine"].plan.stages[-1].size)
        more = 12 * nodes * (model.n_floats - 4)
        assert found.costs["mine"].plan.memory - rgb.costs["mine"].plan.memory == more
        times = found.costs["mine"].seconds / rgb.costs["mine"].seconds
        assert times == pytest.approx(model.relative_time)
        assert f"model {model.name}, rays resampled: about" in str(found)
        assert found.facts()["costs"]["mine"]["model"]["name"] == model.name


def test_voxels_are_described_where_they_say_how_fine_a_field_is(tmp_path: Path) -> None:
    folder = scene_with(tmp_path, ring(9))
    configs = {"grid": wn.TrainConfig(), "tables": wn.TrainConfig(field=wn.Hash())}
    text = str(inspect(folder, configs=configs))
    assert "voxels, grid" in text and "training, tables" in text and "voxels, tables" not in text


def test_photographs_take_memory(tmp_path: Path) -> None:
    folder = scene_with(tmp_path, ring(9))  # 16 x 12 pixels of three numbers
    whole, half = (inspect(folder, downscale=n).costs["fast"].plan.memory for n in (1, 2))
    assert whole - half == 9 * 3 * (16 * 12 - 8 * 6)


def test_fewer_updates_cost_less_by_their_nodes(tmp_path: Path) -> None:
    scene = load_scene(scene_with(tmp_path, ring(9)))

    def seconds(voxels: int, *shares: float) -> float:
        grid = GridConfig(voxels=voxels, grow_at=())
        config = TrainConfig(grid=grid, optim=OptimConfig(accumulate_at=shares))
        return inspection.cost_of(scene, config, 1).seconds

    saved = [seconds(n) - seconds(n, 0.5) for n in (10**6, 2 * 10**6)]
    assert saved[0] > 0.0
    assert saved[1] == pytest.approx(2.0 * saved[0])  # half the updates of half the training
    spared = seconds(10**6) - seconds(10**6, 0.5, 0.75)
    assert spared == pytest.approx(saved[0] * (0.25 * 0.5 + 0.25 * 0.75) / (0.5 * 0.5))


def test_a_scene_that_is_refused_says_how_many_poses_are(tmp_path: Path) -> None:
    folder = scene_with(tmp_path, ring(9))
    content = json.loads((folder / "transforms.json").read_text())
    for index in (2, 6, 7):
        content["frames"][index]["transform_matrix"][0][0] += 0.2
    save(folder / "transforms.json", content)
    says = r"\$\.frames\[2\].*likewise: 2 more \(\$\.frames\[6\], \$\.frames\[7\]\)"
    with pytest.raises(InputError, match=says):
        inspect(folder)


@pytest.mark.parametrize("options", [{"near": -1.0}, {"content_distance": 0.0}])
def test_values_out_of_range_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=next(iter(options))):
        inspect("builtin:room", downscale=8, **options)
