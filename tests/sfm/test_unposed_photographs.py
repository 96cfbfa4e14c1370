"""Photographs before their poses are known: lenses, the way up, masks."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image

from tests.support.tiny_scenes import picture
from warpnerf.checks import InputError
from warpnerf.scenes.formats.contents import photographs_in
from warpnerf.sfm.photographs import UnposedPhotograph, put_into, read_photographs


def photograph(
    path: Path,
    *,
    size: tuple[int, int] = (16, 12),
    model: str | None = None,
    focal: float | None = None,
    orientation: int | None = None,
) -> Path:
    exif = Image.Exif()
    if model is not None:
        exif[ExifTags.Base.Model] = model
    if focal is not None:
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLength] = focal
    if orientation is not None:
        exif[ExifTags.Base.Orientation] = orientation
    path.parent.mkdir(exist_ok=True)
    Image.fromarray(picture(1, width=size[0], height=size[1])).save(path, exif=exif)
    return path


def lenses(paths: list[Path], which: str = "auto") -> list[int]:
    return [p.lens for p in read_photographs(paths, lenses=which, masks=None)]  # type: ignore[arg-type]


def test_photographs_of_one_size_camera_and_focal_length_share_a_lens(tmp_path: Path) -> None:
    paths = [
        photograph(tmp_path / "a.jpg", model="X100", focal=23.0),
        photograph(tmp_path / "b.jpg", model="X100", focal=50.0),
        photograph(tmp_path / "c.jpg", model="X100", focal=23.0),
        photograph(tmp_path / "d.jpg", model="phone", focal=23.0),
        photograph(tmp_path / "e.jpg", model="X100", focal=23.0, size=(12, 16)),
        photograph(tmp_path / "f.png"),
    ]
    assert lenses(paths) == [0, 1, 0, 2, 3, 4]
    assert lenses(paths[:4], "one") == [0, 0, 0, 0]
    assert lenses(paths[:4], "each") == [0, 1, 2, 3]
    with pytest.raises(InputError, match=r"e\.jpg has 12x16 pixels, but a\.jpg 16x12, .*auto"):
        lenses(paths, "one")


@pytest.mark.parametrize("orientation", range(1, 9))
def test_which_way_is_up_as_exif_says(tmp_path: Path, orientation: int) -> None:
    """Compared with Pillow, which turns the picture: its top comes from the stored pixels' up."""
    stored = np.zeros((12, 16), np.uint8)
    paths = [photograph(tmp_path / f"{k}.jpg", orientation=orientation) for k in range(3)]
    right, above = read_photographs(paths, lenses="auto", masks=None)[0].up
    # White where the stored pixels' upper half by `up` is.
    rows, columns = np.mgrid[:12, :16]
    stored[right * (columns - 7.5) + above * (5.5 - rows) > 0] = 255
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    Image.fromarray(stored).save(tmp_path / "up.png", exif=exif)
    with Image.open(tmp_path / "up.png") as image:
        from PIL import ImageOps

        shown = np.asarray(ImageOps.exif_transpose(image))
    half = len(shown) // 2
    assert (shown[:half] == 255).all() and (shown[half:] == 0).all()


def test_damaged_exif_is_none(tmp_path: Path) -> None:
    path = photograph(tmp_path / "a.jpg", model="X100", orientation=6)
    raw = bytearray(path.read_bytes())
    place = raw.index(b"Exif\0\0") + 6
    raw[place : place + 16] = b"\xff" * 16
    path.write_bytes(raw)
    found: UnposedPhotograph = read_photographs([path] * 3, lenses="auto", masks=None)[0]
    assert found.up == (0, 1) and found.lens == 0


def test_masks_go_by_the_photographs_names(tmp_path: Path) -> None:
    paths = [photograph(tmp_path / f"{name}.jpg") for name in "abc"]
    photograph(tmp_path / "masks" / "a.png")
    photograph(tmp_path / "masks" / "b.jpg.png")
    found = read_photographs(paths, lenses="auto", masks=tmp_path / "masks")
    assert [p.mask and p.mask.path.name for p in found] == ["a.png", "b.jpg.png", None]
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"holds no mask of 3 photographs .*a\.jpg\.png or a\.png"):
        read_photographs(paths, lenses="auto", masks=tmp_path / "empty")


def test_too_few_and_what_is_no_whole_photograph_are_refused(tmp_path: Path) -> None:
    paths = [photograph(tmp_path / f"{name}.jpg") for name in "ab"]
    with pytest.raises(InputError, match="2 photographs are too few: poses need at least 3"):
        lenses(paths)
    (tmp_path / "c.jpg").write_text("no picture")
    with pytest.raises(InputError, match=r"c\.jpg: is not an image"):
        lenses([*paths, tmp_path / "c.jpg"])
    raw = (tmp_path / "b.jpg").read_bytes()
    (tmp_path / "c.jpg").write_bytes(raw[: len(raw) // 2])
    with pytest.raises(InputError, match=r"c\.jpg: is cut short or damaged"):
        lenses([*paths, tmp_path / "c.jpg"])


@pytest.mark.skipif(os.name != "posix", reason="names that others do not allow")
@pytest.mark.parametrize("name", ["a\nb.jpg", "a\\b.jpg"])
def test_a_name_that_a_scene_cannot_hold_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match="a scene's file cannot name it") as error:
        lenses([photograph(tmp_path / name)] * 3)
    assert str(error.value).isprintable()


def test_files_are_linked_and_copied_where_that_is_not_possible(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = photograph(tmp_path / "a.jpg")
    (tmp_path / "link.jpg").symlink_to(path)
    put_into(tmp_path / "in", tmp_path / "link.jpg", "b.jpg")
    assert (tmp_path / "in" / "b.jpg").samefile(path)
    assert not (tmp_path / "in" / "b.jpg").is_symlink()

    def refuse(*_: object) -> None:
        raise OSError(18, "Invalid cross-device link")

    monkeypatch.setattr("os.link", refuse)
    put_into(tmp_path / "in", path, "c.jpg")
    assert (tmp_path / "in" / "c.jpg").read_bytes() == path.read_bytes()
    assert not (tmp_path / "in" / "c.jpg").samefile(path)


def test_masks_beside_photographs_are_used_and_are_none_themselves(tmp_path: Path) -> None:
    for number in range(3):
        Image.new("RGB", (8, 6)).save(tmp_path / f"{number}.jpg")
    Image.new("L", (8, 6)).save(tmp_path / "1.jpg.mask.png")
    found = read_photographs(photographs_in(tmp_path), lenses="auto", masks=None)
    assert [photograph.path.name for photograph in found] == ["0.jpg", "1.jpg", "2.jpg"]
    assert [None if p.mask is None else p.mask.path.name for p in found] == [
        None,
        "1.jpg.mask.png",
        None,
    ]


def gpano(path: Path, width: int) -> Path:
    """A photograph whose XMP says that it shows all directions."""
    xmp = b'<rdf:Description GPano:ProjectionType="equirectangular"/>'
    Image.new("RGB", (width, 30)).save(path, xmp=xmp)
    return path


def test_panoramas_are_refused_with_a_way_out(tmp_path: Path) -> None:
    for number, width in enumerate((60, 60, 60, 70)):
        Image.new("RGB", (width, 30)).save(tmp_path / f"{number}.jpg")
    paths = photographs_in(tmp_path)
    assert len(read_photographs(paths[:3], lenses="auto", masks=None)) == 3  # by phones, 18:9
    assert len(read_photographs(paths, lenses="auto", masks=None)) == 4
    gpano(tmp_path / "4.jpg", 61)
    gpano(tmp_path / "5.webp", 61)
    with pytest.raises(
        InputError, match=r"4\.jpg: is .*2 of 6 photographs say so.* 90 deg.* leave"
    ):
        read_photographs(photographs_in(tmp_path), lenses="auto", masks=None)
