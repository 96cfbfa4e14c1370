"""Files from outside: JSON, paths and images, good and bad."""

from __future__ import annotations

import io
import os
import struct
import zlib
from pathlib import Path

import msgspec
import numpy as np
import pytest
from PIL import Image
from tiny_scenes import picture

from warpnerf.checks import InputError
from warpnerf.data.files import find_image, read_image, read_json, resolve_inside


class Numbers(msgspec.Struct):
    values: list[float]


@pytest.mark.parametrize(
    "raw", [b'{"values": [1, 2.5]}', b'\xef\xbb\xbf{"values": [1, 2.5], "other": {}}']
)
def test_json_is_read_with_and_without_byte_order_mark(tmp_path: Path, raw: bytes) -> None:
    (tmp_path / "a.json").write_bytes(raw)
    assert read_json(tmp_path / "a.json", Numbers).values == [1.0, 2.5]


@pytest.mark.parametrize(
    ("raw", "message"),
    [
        (b"", "is empty"),
        (b" \n", "is empty"),
        (b'{"values": [1,]}', "not valid JSON: .*line 1 column 15"),
        (b'{"values": [1', "not valid JSON"),
        (b"[" * 100_000, "brackets nested too deeply"),
        (b'{"values": [NaN]}', "NaN is not a number"),
        (b'{"values": [-Infinity]}', "-Infinity is not a number"),
        (b'{"values": [' + b"9" * 5000 + b"]}", "of 5000 digits is out of range"),
        (b'{"values": [' + b"9" * 400 + b"]}", "of 400 digits is out of range"),
        (b'{"values": [1], "values": [2]}', "'values' is given twice"),
        (b'{"values": ["1"]}', r"expected `float`, got `str`, at `\$.values\[0\]`"),
        (b'{"values": [true]}', r"expected `float`, got `bool`, at `\$.values\[0\]`"),
        (b"{}", r"missing required field `values`, at `\$`"),
        (b"[]", r"expected `object`, got `array`, at `\$`"),
        (b'{"values": \xff}', "not text in UTF-8"),
    ],
)
def test_bad_json_is_refused_by_name(tmp_path: Path, raw: bytes, message: str) -> None:
    (tmp_path / "a.json").write_bytes(raw)
    with pytest.raises(InputError, match=rf"a\.json: .*{message}"):
        read_json(tmp_path / "a.json", Numbers)


def test_json_that_is_no_regular_file_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.json")
    (tmp_path / "folder.json").mkdir()
    for name, message in [
        ("pipe", "a pipe or a device"),
        ("folder", "is a folder"),
        ("none", "does not exist"),
    ]:
        with pytest.raises(InputError, match=rf"{name}\.json: .*{message}"):
            read_json(tmp_path / f"{name}.json", Numbers)


@pytest.mark.parametrize("text", ["images/a.png", "./images//a.png", r"images\a.png", "x/../a"])
def test_paths_inside_the_folder_are_resolved(tmp_path: Path, text: str) -> None:
    expected = {"x/../a": "a"}.get(text, "images/a.png")
    assert resolve_inside(tmp_path, text, field="f") == tmp_path / expected


def test_absolute_path_into_the_folder_is_accepted(tmp_path: Path) -> None:
    assert resolve_inside(tmp_path, str(tmp_path / "a.png"), field="f") == tmp_path / "a.png"


@pytest.mark.parametrize(
    "text", ["..", "../a.png", "images/../../a.png", r"..\a.png", "/etc/passwd", r"C:\a.png"]
)
def test_paths_that_leave_the_folder_are_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(InputError, match=r"t\.json: \$\.p: .* leaves the scene's folder"):
        resolve_inside(tmp_path, text, field="t.json: $.p")


@pytest.mark.parametrize("text", ["", "a\0b", "\ud800"])
def test_texts_that_are_no_paths_are_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(InputError, match=r"t\.json: \$\.p: .* is not a path"):
        resolve_inside(tmp_path, text, field="t.json: $.p")


def test_links_may_stay_in_the_folder_but_not_leave_it(tmp_path: Path) -> None:
    scene = tmp_path / "scene"
    (scene / "images").mkdir(parents=True)
    (tmp_path / "secret.png").touch()
    (scene / "inward").symlink_to(scene / "images")
    (scene / "outward").symlink_to(tmp_path)
    (scene / "loop").symlink_to("loop")
    assert resolve_inside(scene, "inward/a.png", field="f") == scene / "inward/a.png"
    assert resolve_inside(scene, "loop", field="f") == scene / "loop"
    with pytest.raises(InputError, match="follows a link out of the scene's folder"):
        resolve_inside(scene, "outward/secret.png", field="f")


def test_scene_folder_may_itself_be_a_link(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    assert resolve_inside(tmp_path / "link", "a", field="f") == tmp_path / "link/a"


def test_image_is_found_with_and_without_extension(tmp_path: Path) -> None:
    (tmp_path / "a.png").touch()
    (tmp_path / "b.jpg").touch()
    (tmp_path / "a").mkdir()
    assert find_image(tmp_path, "a", field="f") == tmp_path / "a.png"
    assert find_image(tmp_path, "a.png", field="f") == tmp_path / "a.png"
    assert find_image(tmp_path, "b", field="f") == tmp_path / "b.jpg"
    assert find_image(tmp_path, "c", field="f") is None
    assert find_image(tmp_path, "n" * 5000, field="f") is None


def saved(path: Path, image: Image.Image, **options: object) -> Path:
    image.save(path, **options)
    return path


def hand_made_png(
    path: Path, *, size: tuple[int, int], depth: int, colour: int, raw: bytes
) -> Path:
    """A PNG that Pillow does not write; raw rows begin with their filter byte."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return (
            struct.pack(">I", len(content))
            + kind
            + content
            + struct.pack(">I", zlib.crc32(kind + content))
        )

    header = struct.pack(">IIBBBBB", *size, depth, colour, 0, 0, 0)
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(raw))
        + chunk(b"IEND", b"")
    )
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


@pytest.mark.parametrize(
    ("colour", "n_bytes", "mode"), [(2, 6, "RGB"), (6, 8, "RGBA"), (4, 4, "RGBA|LA")]
)
def test_sixteen_bit_colour_is_refused(
    tmp_path: Path, colour: int, n_bytes: int, mode: str
) -> None:
    raw = (b"\0" + bytes(range(2 * n_bytes))) * 2
    path = hand_made_png(tmp_path / "a.png", size=(2, 2), depth=16, colour=colour, raw=raw)
    with pytest.raises(InputError, match=rf"a\.png: .*16-bit ({mode}); convert it to 8-bit RGB"):
        read_image(path)


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
        (b"<html></html>", "is not an image"),
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
