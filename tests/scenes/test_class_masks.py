"""Masks that hold numbers of classes in place of black and white are told."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageFilter

from tests.support.tiny_scenes import picture, save, write_transforms
from warpnerf.checks import InputError
from warpnerf.scenes.formats.load import load_scene
from warpnerf.scenes.images.mask_values import other_values
from warpnerf.scenes.images.masks import Mask


@pytest.mark.parametrize("coloured", [False, True])
def test_masks_of_classes_are_told(tmp_path: Path, coloured: bool) -> None:
    content = write_transforms(tmp_path)
    values = np.zeros((6, 8, 3) if coloured else (6, 8), np.uint8)
    values[2:], values[4:] = 3, (7, 2, 90) if coloured else 90
    for k, frame in enumerate(content["frames"]):
        Image.fromarray(values).save(tmp_path / f"{k}.png")
        frame["mask_path"] = f"{k}.png"
    save(tmp_path / "transforms.json", content)
    says = (
        r"no pixel of any training image; .*0\.png holds 0, 3, 90, as numbers of classes; write 255"
    )
    with pytest.raises(InputError, match=says):
        load_scene(tmp_path)
    for k in (0, 1, 2):
        Image.fromarray(values.reshape(6, 8, -1).max(axis=2) > 0).save(tmp_path / f"{k}.png")
    assert len(load_scene(tmp_path).warnings) == 1
    warning = load_scene(tmp_path).warnings[0]
    assert "left out 1 of 4 images of which masks leave no pixel" in warning
    assert "3.png holds 0, 3, 90, as numbers of classes" in warning
    black = Image.fromarray(np.arange(48, dtype=np.uint8).reshape(6, 8) % 4)  # as JPEG has it
    black.save(tmp_path / "3.jpg", quality=100)
    content["frames"][3]["mask_path"] = "3.jpg"
    save(tmp_path / "transforms.json", content)
    assert len(load_scene(tmp_path).warnings) == 1
    warning = load_scene(tmp_path).warnings[0]
    assert "classes" not in warning


def warnings_of(folder: Path, masks: list[np.ndarray]) -> str:
    """Of a scene of four photographs, 48 x 64, with these masks."""
    content = write_transforms(folder, scale=8)
    for k, frame in enumerate(content["frames"]):
        Image.fromarray(masks[k % len(masks)]).save(folder / f"{k}.png")
        frame["mask_path"] = f"{k}.png"
    save(folder / "transforms.json", content)
    return "; ".join(w for w in load_scene(folder).warnings if "masks" in w)


def squares(*values: int | tuple[int, ...]) -> np.ndarray:
    """A mask of upright stripes of these values."""
    stripes = np.array_split(np.arange(64), len(values))
    mask = np.zeros((48, 64, *np.shape(values[0])), np.uint8)
    for stripe, value in zip(stripes, values, strict=True):
        mask[:, stripe] = value
    return mask


@pytest.mark.parametrize(
    ("masks", "says"),
    [
        ([squares(0, 200, 255)], "masks hold 3 values (0, 200, 255; 0.png), as numbers of classes"),
        ([squares(0, 90, 180)], "masks hold 3 values (0, 90, 180; 0.png)"),
        ([squares(*range(0, 208, 8))], "masks hold 25 values (0, 16, 24, 32, 40, 48, ...; 0.png)"),
        ([squares(0, 255), squares(0, 180)], "masks hold 3 values (0, 180, 255; 1.png)"),
        (
            [squares((0, 0, 0), (128, 0, 0), (0, 128, 0))],
            "masks hold 3 values (0, #008000, #800000; 0.png)",
        ),
        ([picture(1, width=64, height=48)], "masks look like photographs: 0.png holds"),
    ],
)
def test_classes_that_are_bright_are_told(
    tmp_path: Path, masks: list[np.ndarray], says: str
) -> None:
    assert says in warnings_of(tmp_path / "scene", masks)


def test_masks_of_two_values_and_soft_edges_are_none_of_classes(tmp_path: Path) -> None:
    soft = np.clip(np.add.outer(np.arange(48), 20.0 * np.arange(64)) - 440.0, 0, 255)
    ramp = np.clip(40.0 * (np.arange(64) - 30.0) + np.zeros((48, 1)), 0, 255)
    masks = {
        "binary": squares(0, 255),
        "gray": squares(0, 200),
        "soft": soft.astype(np.uint8),
        "ramp": ramp.astype(np.uint8),
        "one": squares(0, 1),
        "nearly": squares(0, 3, 8, 250, 255, 254),
    }
    for name, mask in masks.items():
        assert warnings_of(tmp_path / name, [mask]) == "", name


@pytest.mark.parametrize("wide", [10.0, 60.0, 100.0])
def test_mattes_with_wide_soft_edges_are_no_photographs(tmp_path: Path, wide: float) -> None:
    u, v = np.meshgrid(np.arange(640) - 320, np.arange(480) - 240)
    disc = Image.fromarray(np.where(u**2 + v**2 < 150**2, 255, 0).astype(np.uint8))
    disc.filter(ImageFilter.GaussianBlur(wide)).save(tmp_path / "matte.png")
    assert other_values([Mask(tmp_path / "matte.png")]) == []
