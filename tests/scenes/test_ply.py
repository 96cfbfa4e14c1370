"""PLY files: positions are read as others write them, and damage is told in a sentence."""

from __future__ import annotations

import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from warpnerf.checks import InputError
from warpnerf.scenes.formats.ply import read_ply

POINTS = np.array([[1.5, -2.0, 3.25], [0.0, 1e-3, -7.0], [4.0, 5.0, 6.0]])
PROPERTIES = "property float x\nproperty float y\nproperty float z\n"


def head(form: str, n: int, properties: str = PROPERTIES, more: str = "") -> bytes:
    return (
        f"ply\nformat {form} 1.0\ncomment of a test\nelement vertex {n}\n{properties}{more}"
        "end_header\n"
    ).encode()


def example(form: str) -> bytes:
    """Positions between other properties, and faces behind them."""
    properties = "property uchar red\nproperty double x\nproperty float y\nproperty float z\n"
    properties += "property int number\n"
    more = "element face 1\nproperty list uchar int vertex_indices\n"
    if form == "ascii":
        body = "".join(f"7 {x!r} {y!r} {z!r} -3\n" for x, y, z in POINTS.tolist()) + "3 0 1 2\n"
        return head(form, 3, properties, more) + body.encode()
    order = "<" if "little" in form else ">"
    body_bytes = b"".join(struct.pack(order + "Bdffi", 7, *point, -3) for point in POINTS)
    return head(form, 3, properties, more) + body_bytes + struct.pack(order + "Biii", 3, 0, 1, 2)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("ending", [b"\n", b"\r\n"])
def test_positions_are_read(tmp_path: Path, form: str, ending: bytes) -> None:
    content = example(form)
    at = content.index(b"end_header\n") + 11
    (tmp_path / "a.ply").write_bytes(content[:at].replace(b"\n", ending) + content[at:])
    np.testing.assert_allclose(read_ply(tmp_path / "a.ply"), POINTS, rtol=1e-7)


@pytest.mark.parametrize("form", ["ascii", "binary"])
def test_what_trimesh_writes(tmp_path: Path, form: str) -> None:
    points = np.random.default_rng(0).normal(size=(50, 3))
    colours = np.full((50, 4), 99, np.uint8)
    trimesh.PointCloud(points, colours).export(tmp_path / "a.ply", encoding=form)
    np.testing.assert_allclose(read_ply(tmp_path / "a.ply"), points, rtol=1e-5)


def test_no_vertices(tmp_path: Path) -> None:
    for form in ("ascii", "binary_little_endian"):
        (tmp_path / "a.ply").write_bytes(head(form, 0))
        assert read_ply(tmp_path / "a.ply").shape == (0, 3)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "does not begin with `ply`"),
        (b"solid\n", "does not begin with `ply`"),
        (b"ply\n", "ends within its header"),
        (b"ply\nformat ascii 1.0\nend_header\n", "names no format, or no x, y and z"),
        (head("ascii", 0).replace(b"format ascii 1.0\n", b""), "names no format"),
        (head("ascii", 0, "property float x\nproperty float y\n"), "no x, y and z"),
        (head("ascii", 0, PROPERTIES + "property float x\n"), "no x, y and z"),
        (head("packed", 0), r"not understood, \'format packed 1.0\'"),
        (head("ascii", 0, "property list uchar float x\n"), "not understood, .property list"),
        (head("ascii", 0, "property half x\n"), "not understood, .property half x"),
        (
            b"ply\nformat ascii 1.0\nelement face 2\nproperty list uchar int v\nend_header\n",
            "has no vertices as its first element, but .element face 2",
        ),
        (b"ply\n" + b"comment\n" * 2000, "more than 1000 lines in its header"),
        (head("ascii", 10**17), "counts 100000000000000000 vertices, but ends before"),
        (head("ascii", 10**30), "has no vertices as its first element"),
        (head("binary_little_endian", 10**17) + bytes(99), "vertices, but ends before"),
        (head("ascii", 2) + b"1 2 3\n1 2\n\n\n\n\n", "no x, y and z as numbers at its vertex 1"),
        (head("ascii", 1) + b"1 2 three\n", "no x, y and z as numbers at its vertex 0"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, content: bytes, says: str) -> None:
    file = tmp_path / "a.ply"
    file.write_bytes(content)
    with pytest.raises(InputError, match=says) as error:
        read_ply(file)
    assert str(error.value).startswith(f"{file}: ")


def test_a_folder_is_no_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is a folder, not a file"):
        read_ply(tmp_path)


@settings(max_examples=400, deadline=None)
@given(
    st.sampled_from(["ascii", "binary_little_endian", "binary_big_endian"]),
    st.lists(st.tuples(st.integers(0, 400), st.binary(min_size=1, max_size=9)), max_size=4),
    st.integers(0, 400),
)
def test_damage_is_an_input_error(
    tmp_path_factory: pytest.TempPathFactory,
    form: str,
    changes: list[tuple[int, bytes]],
    cut: int,
) -> None:
    content = bytearray(example(form))
    for at, piece in changes:
        at %= len(content)
        content[at : at + len(piece)] = piece
    file = tmp_path_factory.mktemp("ply") / "a.ply"
    file.write_bytes(content[: len(content) - cut % len(content) if cut % 3 == 0 else None])
    try:
        positions = read_ply(file)
    except InputError as error:
        assert str(error).startswith(f"{file}: ")
    else:
        assert positions.dtype == np.float64 and positions.shape[1:] == (3,)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_memory_stays_within_ten_times_the_file(tmp_path: Path, form: str) -> None:
    n = 100_000
    file = tmp_path / "a.ply"
    body = b"0 1 2\n" * n if form == "ascii" else bytes(12 * n)
    file.write_bytes(head(form, n) + body)
    read_ply(file)
    tracemalloc.start()
    assert read_ply(file).shape == (n, 3)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 10 * file.stat().st_size
