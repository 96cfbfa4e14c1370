"""Fields in half precision: what a file leaves out is not seen, and what is damaged is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from tests.support.tiny_fields import tiny_field
from tests.support.tiny_scenes import camera_at, ring
from warpnerf.checks import InputError
from warpnerf.fields.dense import DenseGrid
from warpnerf.fields.nodes import nodes_of_cells
from warpnerf.fields.occupancy import FreeCells
from warpnerf.model.models import Deferred, Rgb
from warpnerf.rendering.field import Field
from warpnerf.runs.checkpoint import load_field, save_field
from warpnerf.runs.compact import expanded
from warpnerf.runs.tensor_file import DamagedFileError, digest_of


def with_free_space() -> Field:
    """A field of which one half is free, with a node in the other that was never trained."""
    field = tiny_field(model=Deferred())
    assert isinstance(field.storage, DenseGrid)
    values = field.storage.values.numpy().reshape(5, 6, 7, 16)
    values[0, 0, 0] = 0.0
    grid = replace(
        field.storage,
        values=wp.array(values.reshape(-1, 16), dtype=field.storage.values.dtype, device="cpu"),
    )
    free = np.zeros(field.lattice.cells, np.uint8)
    free[1] = 1
    distance = wp.array(free.ravel(), dtype=wp.uint8, device="cpu")
    cells = FreeCells(distance=distance, size=free.shape, border=0.0)
    return replace(field, storage=grid, free=cells)


def rewrite(path: Path, header: Any = None, **tensors: np.ndarray | None) -> None:
    """Forge a file whose digest is right: tensors replaced, or left out where they are None."""
    with safe_open(path, framework="numpy") as file:
        text = file.metadata()["header"]
    contents = {k: v for k, v in (load_file(path) | tensors).items() if v is not None}
    metadata = {"header": text, "sha256": digest_of(text, contents)}
    save_file(contents, path, metadata=metadata)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "field.safetensors"
    save_field(path, with_free_space(), "float16")
    return path


def test_features_of_free_space_and_of_untrained_nodes_are_left_out(file: Path) -> None:
    field, tensors = with_free_space(), load_file(file)
    assert tensors["values.features"].shape == (3 * 6 * 7 - 1, 15)
    assert tensors["values.features"].dtype == tensors["values.density"].dtype == np.float16
    back = load_field(file, threads=1)
    values, expected = (f.storage.tensors()["values"] for f in (back, field))
    np.testing.assert_allclose(values[:3], expected[:3], rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(values[..., 0], expected[..., 0], rtol=1e-3, atol=1e-6)
    assert not values[3:, :, :, 1:].any() and expected[3:, :, :, 1:].all()


def test_it_is_rendered_as_before(file: Path) -> None:
    field = with_free_space()
    camera = camera_at(ring(3)[1])
    seen, expected = load_field(file, threads=1).render(camera), field.render(camera)
    assert expected.opacity.max() > 0.5
    for name in ("rgb", "depth", "opacity"):
        np.testing.assert_allclose(getattr(seen, name), getattr(expected, name), atol=4e-3)


def test_stored_once_more_it_is_the_same(file: Path) -> None:
    save_field(file.with_name("again"), load_field(file, threads=1), "float16")
    assert file.with_name("again").read_bytes() == file.read_bytes()


@pytest.mark.parametrize("size", [(5, 6, 7), (2, 3, 9), (9, 8, 4)])
def test_nodes_of_a_cell_are_all_that_samples_in_it_read(size: tuple[int, int, int]) -> None:
    lattice = replace(tiny_field().lattice, size=size)
    rng = np.random.default_rng(0)
    for _ in range(20):
        cell = rng.integers(lattice.cells)
        cells = np.zeros(lattice.cells, bool)
        cells[tuple(cell)] = True
        wanted = np.zeros(size, bool)
        last = np.array(size) - 1
        places = np.stack(np.meshgrid(*[np.linspace(1e-6, 1 - 1e-6, 41)] * 3), -1).reshape(-1, 3)
        low = ((cell + places) * last / lattice.cells).astype(int)
        for corner in np.ndindex(2, 2, 2):
            wanted[tuple((low + corner).T)] = True
        np.testing.assert_array_equal(nodes_of_cells(lattice, cells), wanted)
    assert nodes_of_cells(lattice, np.ones((1, 1, 1), bool)).all()


def test_what_half_precision_cannot_hold_stays_whole(tmp_path: Path) -> None:
    field = with_free_space()
    values = field.storage.tensors()["values"].copy()
    values[0, 1, 1] = 1e5
    storage = DenseGrid.from_tensors(
        field.storage.kind, field.model, field.lattice, {"values": values}, wp.get_device("cpu")
    )
    path = tmp_path / "field.safetensors"
    save_field(path, replace(field, storage=storage), "float16")
    stored = load_file(path)
    assert stored["values.density"].dtype == stored["values.features"].dtype == np.float32
    back = load_field(path, threads=1).storage.tensors()["values"]
    np.testing.assert_array_equal(back[:3], values[:3])


def test_a_field_that_nothing_was_trained_of_is_stored(tmp_path: Path) -> None:
    field = tiny_field(model=Rgb())
    assert isinstance(field.storage, DenseGrid)
    field.storage.values.zero_()
    save_field(tmp_path / "field.safetensors", field, "float16")
    assert load_file(tmp_path / "field.safetensors")["values.features"].shape == (0, 3)
    back = load_field(tmp_path / "field.safetensors", threads=1).storage.tensors()["values"]
    assert not back.any()


def test_a_precision_that_there_is_not(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="precision must be one of float32, float16, not 'half'"):
        save_field(tmp_path / "field", tiny_field(model=Rgb()), "half")  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "tensors",
    [
        {"values.density": None},
        {"values.features": None},
        {"values.kept": None},
        {"values.kept": np.full(27, 255, np.uint8)},
        {"values.kept": np.zeros(26, np.uint8)},
        {"values.kept": np.zeros((27, 1), np.uint8)},
        {"values.kept": np.zeros(27, np.float32)},
        {"values.density": np.zeros((5, 6, 8), np.float16)},
        {"values.density": np.zeros((5, 6, 7), np.uint8)},
        {"values.features": np.zeros((125, 14), np.float16)},
        {"values.features": np.zeros((124, 15), np.float16)},
        {"values.features": np.zeros(125, np.float16)},
        {"values.features": np.full((125, 15), np.inf, np.float16)},
        {"values": np.zeros((5, 6, 7, 16), np.float32)},
    ],
    ids=lambda tensors: " ".join(tensors),
)
def test_what_does_not_fit_is_refused(file: Path, tensors: dict[str, np.ndarray | None]) -> None:
    rewrite(file, **tensors)
    with pytest.raises(DamagedFileError, match=r"field\.safetensors"):
        load_field(file, threads=1)


@pytest.mark.parametrize("n", [10**5, 10**7])
def test_a_size_that_no_memory_holds_is_refused(file: Path, n: int) -> None:
    with pytest.raises(DamagedFileError, match="its nodes of 'values' do not fit"):
        expanded(file, load_file(file), (n, n, n))
