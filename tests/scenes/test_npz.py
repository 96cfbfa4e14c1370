"""Scenes in one .npz file: read as meant, damage told in a sentence, headers not believed."""

from __future__ import annotations

import io
import tracemalloc
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from tests.scenes.test_colmap import assert_same
from tests.support.tiny_scenes import picture, ring, save, write_transforms
from warpnerf.checks import InputError
from warpnerf.inspection.inspection import inspect
from warpnerf.scenes.formats.load import load_scene

N = 4
IMAGES = np.stack([picture(number) for number in range(N)])
POSES = np.stack(ring(N))


def write(path: Path, compressed: bool = False, **changes: Any) -> Path:
    arrays = {"images": IMAGES, "poses": POSES, "focal": np.array(10.0)} | changes
    given = {name: array for name, array in arrays.items() if array is not None}
    (np.savez_compressed if compressed else np.savez)(path, **given)
    return path


def test_cameras_of_neus_are_named(tmp_path: Path) -> None:
    np.savez(tmp_path / "cameras_sphere.npz", world_mat_0=np.eye(4), scale_mat_0=np.eye(4))
    with pytest.raises(InputError, match=r"holds projection matrices .* as of IDR and NeuS, which"):
        load_scene(tmp_path)


@pytest.mark.parametrize("kind", ["uint8", "float32", "float64", "big-endian"])
@pytest.mark.parametrize("compressed", [False, True])
def test_the_scene_is_that_of_transforms_json(tmp_path: Path, kind: str, compressed: bool) -> None:
    content = write_transforms(tmp_path / "a")
    save(tmp_path / "a" / "transforms.json", content | {"fl_y": 10.0, "cx": 4.0, "cy": 3.0})
    (tmp_path / "b").mkdir()
    dtype = ">f4" if kind == "big-endian" else kind
    images = IMAGES if kind == "uint8" else (IMAGES / 255.0).astype(dtype)
    file = write(tmp_path / "b" / "tiny.npz", compressed, images=images, poses=POSES[:, :3])
    expected = load_scene(tmp_path / "a")
    for path in (file, tmp_path / "b"):
        found = load_scene(path)
        assert found.name == "tiny" and [view.name for view in found.views][:2] == ["000", "001"]
        assert_same(found, expected)
        assert inspect(path).format == "npz (tiny.npz)"


def test_other_arrays_are_named(tmp_path: Path) -> None:
    assert load_scene(write(tmp_path / "a.npz")).warnings == ()
    others = {f"array_{k}": np.zeros(1) for k in range(8)}
    file = write(tmp_path / "a.npz", i_test=np.arange(2), **others)
    (warning,) = load_scene(file).warnings
    assert warning.startswith("a.npz: arrays that are not read: array_0, array_1, ")
    assert "array_7, ...; save a transforms.json" in warning
    (warning,) = load_scene(write(tmp_path / "a.npz", cx=4.0)).warnings
    assert "not read: cx; save" in warning


def test_alpha_and_masks_and_downscale(tmp_path: Path) -> None:
    rgba = np.stack([picture(number, channels=4) for number in range(N)])
    file = write(tmp_path / "a.npz", images=rgba)
    assert load_scene(file).has_alpha
    assert load_scene(file, downscale=2).views[0].image.shape == (3, 4, 4)
    (tmp_path / "masks").mkdir()
    Image.fromarray(np.eye(6, 8, dtype=np.uint8)).save(tmp_path / "masks" / "002.png")
    masks = [view.mask for view in load_scene(file, masks=tmp_path / "masks").views]
    assert masks[2] is not None and masks[2].sum() == 6 and masks[0] is None


WRONG = {
    "no focal": ({"focal": None}, "holds no focal, but images.npy, poses.npy"),
    "focal below 0": ({"focal": -1.0}, "focal: must be one number above 0"),
    "two focal lengths": ({"focal": [1.0, 2.0]}, "focal: must be one number above 0"),
    "focal as text": ({"focal": "ten"}, "focal: is not readable as an array of numbers"),
    "poses of other shape": ({"poses": POSES[:, :2]}, r"poses: must be \[n, 4, 4\] or"),
    "no poses": ({"poses": POSES[:0], "images": IMAGES[:0]}, "poses: must be"),
    "not rigid": ({"poses": 2 * POSES}, r"poses\[0\]: "),
    "fewer images": ({"images": IMAGES[1:]}, r"images: must be \[4, H, W, 3 or 4\]"),
    "gray images": ({"images": IMAGES[..., 0]}, r"images: must be \[4, H, W, 3 or 4\]"),
    "wide integers": ({"images": IMAGES.astype(int)}, "images: are int64; save floats"),
    "bright images": ({"images": 2.0 * IMAGES}, r"images\[0\]: has values outside of \[0, 1\]"),
    "not finite": ({"images": np.nan * IMAGES}, r"images\[0\]: has values outside of"),
    "objects": ({"images": IMAGES.astype(object)}, "is not readable as an array of numbers"),
    "Fortran's order": ({"images": np.asfortranarray(IMAGES / 255)}, "float64 in Fortran's order"),
}


@pytest.mark.parametrize("what", WRONG)
def test_what_is_wrong_is_named(tmp_path: Path, what: str) -> None:
    changes, says = WRONG[what]
    with pytest.raises(InputError, match=rf"a\.npz: .*{says}"):
        load_scene(write(tmp_path / "a.npz", **changes))


def test_what_is_no_archive_is_told(tmp_path: Path) -> None:
    file = write(tmp_path / "a.npz")
    content = file.read_bytes()
    for wrong in (b"", b"no archive", content[:-30], content[: len(content) // 2]):
        file.write_bytes(wrong)
        with pytest.raises(InputError, match=r"a\.npz: is no whole \.npz file"):
            load_scene(file)
    write(tmp_path / "b.npz")
    with pytest.raises(InputError, match=r"or one \.npz file"):
        load_scene(tmp_path)  # two


def test_headers_are_not_believed(tmp_path: Path) -> None:
    """A header that promises gigabytes is refused before there is room for them."""
    for name, shape in (
        ("images", (N, 2**13, 2**13, 3)),
        ("poses", (2**40, 4, 4)),
        ("focal", (2**50,)),
    ):
        header = io.BytesIO()
        description = {"descr": "<f8", "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(header, description)
        file = write(tmp_path / "a.npz", **{name: None})
        with zipfile.ZipFile(file, "a") as archive:
            archive.writestr(f"{name}.npy", header.getvalue() + bytes(100))
        tracemalloc.start()
        with pytest.raises(InputError, match=f"a.npz: {name}"):
            load_scene(file)
        assert tracemalloc.get_traced_memory()[1] < 2**20
        tracemalloc.stop()


@settings(max_examples=300, deadline=None)
@given(st.data())
def test_damage_is_an_input_error(tmp_path_factory: pytest.TempPathFactory, data: Any) -> None:
    file = tmp_path_factory.mktemp("npz") / "a.npz"
    content = bytearray(write(file, compressed=data.draw(st.booleans())).read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    file.write_bytes(content[: data.draw(st.integers(len(content) // 2, len(content)))])
    try:
        load_scene(file)
    except InputError as error:
        assert "\n" not in str(error)
