"""A field comes back as it was, or not at all."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file
from tiny_fields import tiny_field
from tiny_scenes import camera_at, ring

from warpnerf.checkpoint import load_field, save_field
from warpnerf.checks import InputError


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "field.safetensors"
    save_field(path, tiny_field())
    return path


@pytest.mark.parametrize("contraction", ["none", "linf", "l2"])
def test_it_comes_back_bit_for_bit(tmp_path: Path, contraction: str) -> None:
    field = tiny_field(contraction=contraction)
    path = tmp_path / "field.safetensors"
    save_field(path, field)
    back = load_field(path, threads=1)
    np.testing.assert_array_equal(back.grid.values.numpy(), field.grid.values.numpy())
    np.testing.assert_array_equal(back.free.distance.numpy(), field.free.distance.numpy())
    assert (back.steps, back.background) == (field.steps, field.background)
    camera = camera_at(ring(3)[1])
    seen, expected = back.render(camera), field.render(camera)
    assert expected.opacity.max() > 0.5
    for name in ("rgb", "depth", "opacity"):
        np.testing.assert_array_equal(getattr(seen, name), getattr(expected, name))


def test_writing_leaves_nothing_else_behind(file: Path) -> None:
    save_field(file, tiny_field(density=1.0))  # over the older one
    assert [path.name for path in file.parent.iterdir()] == [file.name]


def test_a_failed_write_keeps_the_older_file(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = file.read_bytes()

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space"):
        save_field(file, tiny_field(density=1.0))
    assert file.read_bytes() == before
    assert [path.name for path in file.parent.iterdir()] == [file.name]


def test_a_cut_file_is_refused_by_name(file: Path) -> None:
    content = file.read_bytes()
    for length in [0, 4, 8, 100, len(content) // 2, len(content) - 1]:
        file.write_bytes(content[:length])
        with pytest.raises(InputError, match=r"field\.safetensors"):
            load_field(file, threads=1)


def test_any_flipped_bit_is_refused(file: Path) -> None:
    content = file.read_bytes()
    rng = np.random.default_rng(0)
    start = int.from_bytes(content[:8], "little") + 8
    places = [*range(8), *rng.integers(8, start, 60), *rng.integers(start, len(content), 60)]
    for place in places:
        damaged = bytearray(content)
        damaged[place] ^= 1 << int(rng.integers(8))
        file.write_bytes(damaged)
        with pytest.raises(InputError, match=r"field\.safetensors"):
            load_field(file, threads=1)


@pytest.mark.parametrize("content", [b"", b"{}", b"\x80\x04}.", b"\xff" * 64])
def test_a_foreign_file_is_refused(file: Path, content: bytes) -> None:
    file.write_bytes(content)
    with pytest.raises(InputError, match=r"field\.safetensors"):
        load_field(file)


def test_foreign_safetensors_are_refused(file: Path) -> None:
    save_file({"weight": np.zeros(3, np.float32)}, file)
    with pytest.raises(InputError, match=r"field\.safetensors"):
        load_field(file)


def test_a_field_with_nan_is_refused(tmp_path: Path) -> None:
    field = tiny_field()
    values = field.grid.values.numpy()
    values[7, 2] = np.nan
    field.grid.values.assign(values)
    save_field(tmp_path / "nan.safetensors", field)
    with pytest.raises(InputError, match=r"nan\.safetensors"):
        load_field(tmp_path / "nan.safetensors", threads=1)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.safetensors"):
        load_field(tmp_path / "none.safetensors")
