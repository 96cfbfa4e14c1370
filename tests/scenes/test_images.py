"""Images from outside: every kind of pixel, and every way to be broken."""

from __future__ import annotations

import io
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image

from tests.support.tiny_scenes import hand_made_png, picture
from warpnerf.checks import InputError
from warpnerf.scenes.images.images import exif_focal_length, exif_orientation, read_image


def saved(path: Path, image: Image.Image, **options: object) -> Path:
    image.save(path, **options)
    return path


@pytest.mark.parametrize("channels", [3, 4])
@pytest.mark.parametrize("suffix", ["png", "webp", "tif"])
def test_colour_is_read_exactly(tmp_path: Path, channels: int, suffix: str) -> None:
    pixels = picture(1, channels=channels)
    options = {"lossless": True, "exact": True} if suffix == "webp" else {}
    path = saved(tmp_path / f"a.{suffix}", Image.fromarray(pixels), **options)
    result = read_image(path)
    assert result.dtype == np.uint8
    np.testing.assert_array_equal(result, pixels)


def test_format_is_told_by_content_not_by_name(tmp_path: Path) -> None:
    path = saved(tmp_path / "a.jpg", Image.fromarray(picture(2)), format="PNG")
    np.testing.assert_array_equal(read_image(path), picture(2))


def test_gray_becomes_rgb(tmp_path: Path) -> None:
    gray = picture(3, channels=1)[:, :, 0]
    path = saved(tmp_path / "a.png", Image.fromarray(gray))
    np.testing.assert_array_equal(read_image(path), np.stack([gray] * 3, axis=2))


def test_gray_with_alpha_becomes_rgba(tmp_path: Path) -> None:
    pixels = picture(4, channels=2)
    path = saved(tmp_path / "a.png", Image.fromarray(pixels, mode="LA"))
    np.testing.assert_array_equal(read_image(path), pixels[:, :, [0, 0, 0, 1]])


def test_one_bit_becomes_black_and_white(tmp_path: Path) -> None:
    bits = picture(5, channels=1)[:, :, 0] > 127
    path = saved(tmp_path / "a.png", Image.fromarray(bits))
    np.testing.assert_array_equal(read_image(path), 255 * np.stack([bits] * 3, axis=2))


@pytest.mark.parametrize("transparent", [False, True])
def test_palette_becomes_its_colours(tmp_path: Path, transparent: bool) -> None:
    image = Image.new("P", (3, 1))
    image.putpalette([10, 20, 30, 40, 50, 60, 70, 80, 90])
    image.putdata([0, 1, 2])
    options = {"transparency": bytes([255, 0, 128])} if transparent else {}
    result = read_image(saved(tmp_path / "a.png", image, **options))
    np.testing.assert_array_equal(result[0, :, :3], [[10, 20, 30], [40, 50, 60], [70, 80, 90]])
    assert result.shape[2] == (4 if transparent else 3)
    if transparent:
        assert result[0, :, 3].tolist() == [255, 0, 128]


def test_transparent_colour_becomes_alpha(tmp_path: Path) -> None:
    image = Image.new("RGB", (2, 1), (1, 2, 3))
    image.putpixel((1, 0), (9, 9, 9))
    result = read_image(saved(tmp_path / "a.png", image, transparency=(1, 2, 3)))
    assert result[0, :, 3].tolist() == [0, 255]


@pytest.mark.parametrize("suffix", ["png", "tif", "pgm"])
def test_sixteen_bit_gray_is_scaled_to_eight(tmp_path: Path, suffix: str) -> None:
    values = np.array([[0, 128, 129, 257 * 100, 65534, 65535]], dtype=np.uint16)
    path = tmp_path / f"a.{suffix}"
    if suffix == "pgm":
        path.write_bytes(b"P5 6 1 65535\n" + values.astype(">u2").tobytes())
    else:
        saved(path, Image.fromarray(values))
    assert read_image(path)[0, :, 0].tolist() == [0, 0, 1, 100, 255, 255]


@pytest.mark.parametrize("ending", ["jpg", "webp"])
def test_orientation_is_read_where_exif_is(tmp_path: Path, ending: str) -> None:
    exif = Image.Exif()
    exif[274] = 6
    path = saved(tmp_path / f"a.{ending}", Image.fromarray(picture(6)), exif=exif)
    assert exif_orientation(path) == 6


@pytest.mark.parametrize(
    ("millimetres", "of_film", "stated"),
    [
        (4.25, 26, (26.0, True)),
        (4.25, 0, (4.25, False)),
        (4.25, None, (4.25, False)),
        (None, None, None),
        (0.0, 0, None),
    ],
)
def test_focal_lengths_are_read_where_exif_is(
    tmp_path: Path,
    millimetres: float | None,
    of_film: int | None,
    stated: tuple[float, bool] | None,
) -> None:
    exif = Image.Exif()
    details = exif.get_ifd(0x8769)
    if millimetres is not None:
        details[37386] = millimetres
    if of_film is not None:
        details[41989] = of_film
    path = saved(tmp_path / "a.jpg", Image.fromarray(picture(6)), exif=exif)
    assert exif_focal_length(path) == stated
    assert exif_focal_length(saved(tmp_path / "a.png", Image.fromarray(picture(6)))) is None


def test_orientation_of_a_png_is_read_where_it_stands_before_the_pixels(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[274] = 3
    path = saved(tmp_path / "a.png", Image.fromarray(picture(6)), exif=exif)
    assert exif_orientation(path) == 3
    assert exif_orientation(saved(tmp_path / "b.png", Image.fromarray(picture(6)))) == 1


def test_exif_rotation_is_not_applied(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[274] = 6
    path = saved(tmp_path / "a.png", Image.fromarray(picture(6)), exif=exif)
    assert Image.open(path).getexif()[274] == 6
    np.testing.assert_array_equal(read_image(path), picture(6))


def test_rotation_that_pillow_would_apply_is_refused(tmp_path: Path) -> None:
    path = saved(tmp_path / "a.tif", Image.fromarray(picture(6)), tiffinfo={274: 6})
    with pytest.raises(InputError, match=r"a\.tif: carries a rotation tag"):
        read_image(path)


def test_phone_photograph_with_a_preview_behind_it_is_read(tmp_path: Path) -> None:
    main, preview = Image.new("RGB", (8, 6), "red"), Image.new("RGB", (4, 3), "blue")
    path = saved(tmp_path / "a.jpg", main, format="MPO", save_all=True, append_images=[preview])
    result = read_image(path)
    assert result.shape == (6, 8, 3)
    assert result[0, 0, 0] > 200 > 50 > result[0, 0, 2]


def sixteen_bits(channels: int) -> np.ndarray:
    """[2, 4, channels] values around the limits between two colours, and any."""
    values = np.random.default_rng(9).integers(0, 65536, (2, 4, channels), dtype=np.uint16)
    values[0, :, 0] = [128, 129, 255, 256]
    values[0, :, 1] = [65535, 65407, 65406, 0]
    return values


@pytest.mark.parametrize(("channels", "colour"), [(3, 2), (4, 6)])
def test_sixteen_bit_png_is_rounded_to_eight(tmp_path: Path, channels: int, colour: int) -> None:
    values = sixteen_bits(channels)
    raw = b"".join(b"\0" + row.astype(">u2").tobytes() for row in values)
    path = hand_made_png(tmp_path / "a.png", size=(4, 2), depth=16, colour=colour, raw=raw)
    np.testing.assert_array_equal(read_image(path), np.round(values / 257.0))


@pytest.mark.parametrize("channels", [3, 4])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("rows_per_strip", [1, 2])
def test_sixteen_bit_tiff_is_rounded_to_eight(
    tmp_path: Path, channels: int, order: str, rows_per_strip: int
) -> None:
    values = sixteen_bits(channels)
    options = {"photometric": "rgb", "byteorder": order, "rowsperstrip": rows_per_strip}
    if channels == 4:
        options["extrasamples"] = ["unassalpha"]
    tifffile.imwrite(tmp_path / "a.tif", values, **options)
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif"), np.round(values / 257.0))


def test_compressed_sixteen_bit_tiff_is_rounded_to_eight(tmp_path: Path) -> None:
    values = sixteen_bits(3)
    deflate = [cv2.IMWRITE_TIFF_COMPRESSION, 8]
    assert cv2.imwrite(str(tmp_path / "a.tif"), values[:, :, ::-1], deflate)
    with Image.open(tmp_path / "a.tif") as image:
        assert image.tile[0][0] == "libtiff"
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif"), np.round(values / 257.0))


def test_sixteen_bits_that_pillow_misreads_are_refused(tmp_path: Path) -> None:
    values = sixteen_bits(3)
    planes = np.ascontiguousarray(values.transpose(2, 0, 1))
    tifffile.imwrite(tmp_path / "a.tif", planes, photometric="rgb", planarconfig="separate")
    tifffile.imwrite(tmp_path / "b.tif", values.astype(np.int16)[:, :, 0])
    raw = (b"\0" + bytes(range(8))) * 2
    hand_made_png(tmp_path / "c.png", size=(2, 2), depth=16, colour=4, raw=raw)  # gray and alpha
    key = b"\0\1\0\2\0\3"
    raw = (b"\0" + bytes(range(12))) * 2
    hand_made_png(tmp_path / "d.png", size=(2, 2), depth=16, colour=2, raw=raw, transparent=key)
    kinds = {"a.tif": "16-bit RGB", "b.tif": "I", "c.png": "16-bit RGBA", "d.png": "16-bit RGB"}
    for name, kind in kinds.items():
        with pytest.raises(InputError, match=rf"{name}: its pixels are {kind}; convert it to"):
            read_image(tmp_path / name)


def test_hand_made_png_is_sound(tmp_path: Path) -> None:
    raw = (b"\0" + bytes(range(6))) * 2
    path = hand_made_png(tmp_path / "a.png", size=(2, 2), depth=8, colour=2, raw=raw)
    assert read_image(path).tolist() == [[[0, 1, 2], [3, 4, 5]]] * 2


@pytest.mark.parametrize(
    ("mode", "suffix"),
    [("CMYK", "jpg"), ("CMYK", "tif"), ("LAB", "tif"), ("F", "tif"), ("I", "tif")],
)
def test_other_pixels_are_refused_by_name(tmp_path: Path, mode: str, suffix: str) -> None:
    path = saved(tmp_path / f"a.{suffix}", Image.new(mode, (8, 6)))
    with pytest.raises(InputError, match=rf"a\.{suffix}: its pixels are {mode}; convert it to"):
        read_image(path)


@pytest.mark.parametrize("suffix", ["gif", "png", "webp", "tif"])
def test_animation_is_refused(tmp_path: Path, suffix: str) -> None:
    frames = [Image.fromarray(picture(i)) for i in range(2)]
    path = saved(tmp_path / f"a.{suffix}", frames[0], save_all=True, append_images=frames[1:])
    with pytest.raises(InputError, match=rf"a\.{suffix}: holds several frames"):
        read_image(path)


@pytest.mark.parametrize("suffix", ["png", "jpg", "webp", "tif", "bmp"])
@pytest.mark.parametrize("share", [0.3, 0.7])
def test_cut_image_is_refused(tmp_path: Path, suffix: str, share: float) -> None:
    path = saved(tmp_path / f"a.{suffix}", Image.fromarray(picture(7, width=64, height=64)))
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(InputError, match=rf"a\.{suffix}: is (cut short or damaged|not an image)"):
        read_image(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is empty"),
        (b"hello", "is not an image"),
        (b"<html></html>", "is an HTML file, and no image"),
        (b"\0\0\0\x18ftypheic\0\0\0\0mif1heic", "is a HEIC file, and no image"),
        (b"\0\0\0\x1cftypavif\0\0\0\0avifmif1", "is an AVIF file, and no image"),
        (b"\0\0\0\x1cftypisom\0\0\0\0isommp42", "is a video file, and no image"),
        (b"\xff\x0a\xfa\x7f", "is a JPEG XL file, and no image"),
        (b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n", "is not an image"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "git lfs pull"),
    ],
)
def test_what_is_no_image_is_refused(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(content)
    with pytest.raises(InputError, match=rf"a\.png: .*{message}"):
        read_image(path)


@pytest.mark.filterwarnings("ignore::UserWarning")  # Pillow's, on tags
def test_damaged_images_never_raise_anything_else(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    refused = 0
    for format_name in ("PNG", "JPEG", "TIFF", "GIF", "WEBP", "BMP"):
        buffer = io.BytesIO()
        Image.fromarray(picture(8, width=16, height=16)).save(buffer, format_name)
        for _ in range(30):
            damaged = bytearray(buffer.getvalue())
            for position in random.integers(0, min(len(damaged), 300), 5):
                damaged[position] = random.integers(256)
            (tmp_path / "a.png").write_bytes(damaged)
            try:
                assert read_image(tmp_path / "a.png").dtype == np.uint8
            except InputError as error:
                refused += 1
                assert "a.png" in str(error)
    assert refused > 30


@pytest.mark.filterwarnings("ignore::PIL.Image.DecompressionBombWarning")
def test_decompression_bomb_is_refused(tmp_path: Path) -> None:
    for width in (12_000, 100_000):  # 144 megapixels: our limit; 10 gigapixels: Pillow's
        path = hand_made_png(
            tmp_path / "a.png", size=(width, width), depth=8, colour=0, raw=bytes(1000)
        )
        with pytest.raises(InputError, match=r"a\.png: has more than 134 million pixels"):
            read_image(path)


def test_image_that_is_no_regular_file_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.png")
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "dangling.png").symlink_to("nowhere")
    for name, message in [
        ("pipe", "is a pipe or a device"),
        ("folder", "is a folder"),
        ("dangling", "does not exist"),
        ("none", "does not exist"),
    ]:
        with pytest.raises(InputError, match=rf"{name}\.png: .*{message}"):
            read_image(tmp_path / f"{name}.png")
