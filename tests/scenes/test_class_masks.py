"""Masks that hold numbers of classes in place of black and white are told."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.support.tiny_scenes import save, write_transforms
from warpnerf.checks import InputError
from warpnerf.scenes.formats.load import load_scene


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
