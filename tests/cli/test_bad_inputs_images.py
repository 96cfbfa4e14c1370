"""Images that are missing, broken or of another kind, one by one, through the command.

The first image is the only test view: a run's picture of it begins with what was read.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.support.cli_process import Change, assert_refused, assert_trained, make_scene, train
from tests.support.tiny_scenes import hand_made_png, picture

pytestmark = pytest.mark.usefixtures("compiled_kernels")

WIDTH, HEIGHT = 16, 12
RGB = picture(0, width=WIDTH, height=HEIGHT)
GRAY = RGB[:, :, 0]
ALPHA = RGB[:, :, 1]

Edit = Callable[[Path], object]
"""Of the path of the first image."""


def edited(folder: Path, edit: Edit, change: Change | None = None) -> Path:
    """A scene whose first image is edited."""
    scene = make_scene(folder, change)
    edit(scene / "images/000.png")
    return scene


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def cut_jpeg(path: Path) -> None:
    Image.fromarray(RGB).save(path, format="JPEG")
    cut(path)


def with_byte_flipped(path: Path) -> None:
    """In the middle of the pixels."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0x10
    path.write_bytes(content)


def png_header(path: Path, width: int, height: int) -> None:
    hand_made_png(path, size=(width, height), depth=8, colour=2, raw=bytes(1000))


def animated(path: Path) -> None:
    frames = [Image.fromarray(picture(i, width=WIDTH, height=HEIGHT)) for i in range(3)]
    frames[0].save(path, format="GIF", save_all=True, append_images=frames[1:])


def cmyk(path: Path) -> None:
    Image.fromarray(RGB).convert("CMYK").save(path, format="JPEG")


def float_tiff(path: Path) -> None:
    Image.fromarray(GRAY.astype(np.float32)).save(path, format="TIFF")


def rotated_tiff(path: Path) -> None:
    Image.fromarray(RGB).save(path, format="TIFF", tiffinfo={274: 6})


def rotated(path: Path) -> None:
    """Stored upright and turned by its EXIF data, as phones do it."""
    exif = Image.Exif()
    exif[274] = 6
    Image.fromarray(RGB.transpose(1, 0, 2)).save(path, exif=exif)


ONE = "images/000.png: "


@pytest.mark.parametrize(
    ("edit", "says"),
    [
        pytest.param(
            lambda path: shutil.rmtree(path.parent), ["no image of 4"], id="36-all-missing"
        ),
        pytest.param(lambda path: path.write_bytes(b""), [ONE + "is empty"], id="37-empty"),
        pytest.param(
            lambda path: path.write_text("hello"), [ONE + "is not an image"], id="38-text-named-png"
        ),
        pytest.param(cut, [ONE + "is cut short or damaged"], id="39-cut-PNG"),
        pytest.param(cut_jpeg, [ONE + "is cut short or damaged"], id="40-cut-JPEG"),
        pytest.param(with_byte_flipped, [ONE + "is cut short or damaged"], id="41-flipped-byte"),
        pytest.param(
            lambda path: png_header(path, 50_000, 50_000),
            [ONE + "has more than 134 million pixels"],
            id="42-50000x50000-bomb",
        ),
        pytest.param(
            lambda path: png_header(path, 0, 0), [ONE + "is not an image", "damaged"], id="43-0x0"
        ),
        pytest.param(
            lambda path: png_header(path, 5, 1),
            ["$.w", "16x12", "000.png has 5x1"],
            id="44-one-5x1",
        ),
        pytest.param(cmyk, [ONE + "its pixels are CMYK; convert it"], id="52-CMYK-JPEG"),
        pytest.param(float_tiff, [ONE + "its pixels are F; convert it"], id="53-float-TIFF"),
        pytest.param(
            rotated,
            ["$.w", "16x12", "has 12x16: either it is stored turned"],
            id="54-EXIF-rotation-calibrated-as-shown",
        ),
        pytest.param(rotated_tiff, [ONE + "carries a rotation tag"], id="54-rotated-TIFF"),
        pytest.param(animated, [ONE + "holds several frames"], id="55-animated-GIF"),
    ],
)
def test_refused(tmp_path: Path, edit: Edit, says: list[str]) -> None:
    scene = edited(tmp_path, edit)
    outcome = train(scene, folder=tmp_path)
    assert_refused(outcome, *says)
    assert str(scene) in outcome.err


def test_44_all_images_1x1(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, lambda content: content.update(w=1, h=1, cx=0.5, cy=0.5))
    for path in (scene / "images").iterdir():
        Image.fromarray(RGB[:1, :1]).save(path)
    assert_refused(train(scene, folder=tmp_path), "images/000.png is 1 x 1 pixels", "use larger")


# --- Read as what they show ---------------------------------------------------------------------


def sixteen_bit_gray(path: Path) -> np.ndarray:
    values = 257 * GRAY.astype(np.uint16) + np.uint16(100)
    Image.fromarray(np.minimum(values, 65535).astype(np.uint16)).save(path)
    return GRAY


def sixteen_bit_rgb(path: Path) -> np.ndarray:
    values = np.clip(257 * RGB.astype(np.int32) - 100, 0, 65535)  # nearer to RGB than to RGB - 1
    raw = b"".join(b"\0" + row.astype(">u2").tobytes() for row in values)
    hand_made_png(path, size=(WIDTH, HEIGHT), depth=16, colour=2, raw=raw)
    return RGB


def gray_alpha(path: Path) -> np.ndarray:
    Image.merge("LA", [Image.fromarray(GRAY), Image.fromarray(ALPHA)]).save(path)
    return over_white(GRAY, ALPHA)


def palette(path: Path, **options: Any) -> np.ndarray:
    image = Image.fromarray(RGB).quantize(16)
    image.save(path, **options)
    return np.asarray(image.convert("RGB"))


def transparent_palette(path: Path) -> np.ndarray:
    colours = palette(path, transparency=3)
    index = np.asarray(Image.open(path))
    return np.where((index == 3)[:, :, None], 255, colours)


def one_bit(path: Path) -> np.ndarray:
    bits = GRAY > 127
    Image.fromarray(bits).save(path)
    return 255 * bits


def exif_rotation(path: Path) -> np.ndarray:
    exif = Image.Exif()
    exif[274] = 6
    Image.fromarray(RGB).save(path, exif=exif)
    return RGB


def over_white(gray: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    share = alpha / 255.0
    return share * gray + 255.0 * (1.0 - share)


@pytest.mark.parametrize(
    "edit",
    [
        pytest.param(lambda path: Image.fromarray(GRAY).save(path) or GRAY, id="45-gray"),
        pytest.param(gray_alpha, id="46-gray-and-alpha"),
        pytest.param(palette, id="47-palette"),
        pytest.param(transparent_palette, id="48-palette-with-transparency"),
        pytest.param(one_bit, id="49-1-bit"),
        pytest.param(sixteen_bit_gray, id="50-16-bit-gray"),
        pytest.param(sixteen_bit_rgb, id="51-16-bit-RGB"),
        pytest.param(exif_rotation, id="54-EXIF-rotation"),
    ],
)
def test_read_as_what_it_shows(tmp_path: Path, edit: Callable[[Path], np.ndarray]) -> None:
    shown: list[np.ndarray] = []

    def white_behind(content: dict[str, Any]) -> None:
        """An object, as most training images have it, makes the background white."""
        alpha = np.where(np.arange(WIDTH) < WIDTH // 2, 0, 255) + np.zeros_like(GRAY, np.int64)
        for number in (2, 3):
            turned = np.roll(RGB, number, axis=0)
            image = Image.fromarray(np.dstack([turned, alpha.astype(np.uint8)]))
            image.save(tmp_path / f"scene/images/{number:03}.png")

    scene = edited(tmp_path, lambda path: shown.append(edit(path)), white_behind)
    outcome = train(scene, folder=tmp_path)
    is_gray = shown[0].ndim == 2 or bool((shown[0] == shown[0][:, :, :1]).all())
    assert_trained(outcome, "transparent pixels in only", *["gray among coloured ones"] * is_gray)
    (written,) = (outcome.run / "test").iterdir()
    expected = shown[0] if shown[0].ndim == 3 else np.repeat(shown[0][:, :, None], 3, axis=2)
    # Left, with the legend below.
    truth = np.asarray(Image.open(written))[: len(expected), :WIDTH].astype(np.float64)
    assert np.abs(truth - expected).max() <= 0.5


def test_56_PNG_named_jpg(tmp_path: Path) -> None:
    scene = edited(
        tmp_path,
        lambda path: path.rename(path.with_suffix(".jpg")),
        lambda content: content["frames"][0].update(file_path="images/000.jpg"),
    )
    assert_trained(train(scene, folder=tmp_path))


# --- Gone on with, after a warning --------------------------------------------------------------


def test_36_one_missing(tmp_path: Path) -> None:
    scene = edited(tmp_path, lambda path: path.unlink())
    assert_trained(train(scene, folder=tmp_path), "left out 1 of 4 frames for want of an image")


def test_57_mixed_sizes_with_lenses_of_their_own(tmp_path: Path) -> None:
    def own_lens(content: dict[str, Any]) -> None:
        values = {key: content.pop(key) for key in ("fl_x", "fl_y", "cx", "cy", "w", "h")}
        for frame in content["frames"]:
            frame.update(values)
        content["frames"][1].update(w=32, h=24, fl_x=40.0, fl_y=44.0, cx=16.0, cy=12.0)

    scene = make_scene(tmp_path, own_lens)
    Image.fromarray(picture(1, width=32, height=24)).save(scene / "images/001.png")
    assert_trained(train(scene, folder=tmp_path))


def test_57_mixed_sizes_that_the_lens_is_not_for(tmp_path: Path) -> None:
    scene = make_scene(tmp_path)
    Image.fromarray(picture(1, width=32, height=20)).save(scene / "images/001.png")
    assert_refused(train(scene, folder=tmp_path), "$.w", "images/001.png has 32x20")


def test_57_mixed_sizes_under_one_lens(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, lambda content: [content.pop(key) for key in ("w", "h")])
    Image.fromarray(picture(1, width=32, height=24)).save(scene / "images/001.png")
    said = "images of 2 sizes (first: images/000.png 16x12, images/001.png 32x24) have one lens"
    assert_trained(train(scene, folder=tmp_path), said)


def test_58_mask_of_another_size(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, lambda c: c["frames"][1].update(mask_path="mask.png"))
    Image.new("L", (8, 8), 255).save(scene / "mask.png")
    assert_refused(train(scene, folder=tmp_path), "mask.png", "8x8", "as large as the photograph")


def test_58_mask_all_black(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, lambda c: c["frames"][1].update(mask_path="mask.png"))
    Image.new("L", (WIDTH, HEIGHT)).save(scene / "mask.png")
    assert_trained(train(scene, folder=tmp_path), "left out 1 of 4 images of which masks leave no")


def test_59_duplicate_frame(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, lambda c: c["frames"].append(c["frames"][1]))
    assert_trained(
        train(scene, folder=tmp_path), "left out 1 of 5 frames for naming an image again"
    )


def test_59_duplicate_image_and_pose(tmp_path: Path) -> None:
    def again(content: dict[str, Any]) -> None:
        content["frames"].append({**content["frames"][1], "file_path": "images/copy.png"})

    scene = make_scene(tmp_path, again)
    shutil.copy(scene / "images/001.png", scene / "images/copy.png")
    outcome = train(scene, folder=tmp_path)
    assert_trained(outcome, "images/copy.png is images/001.png again")
