"""points3D of COLMAP, binary and text, against pycolmap and against damage."""

from __future__ import annotations

import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.scenes.test_colmap import scene_with_model
from tests.support.tiny_scenes import DATA, needs_capture
from warpnerf.checks import InputError
from warpnerf.scenes.formats.colmap_files import images_of_bytes
from warpnerf.scenes.formats.colmap_points import read_points
from warpnerf.scenes.formats.load import load_scene

NAMES = {1: "a.jpg", 5: "sub/b.jpg", 9: "unseen.jpg"}
POINTS = [  # position, and the images of its track
    ((1.0, 2.0, 3.0), (1, 5)),
    ((-1.5, 0.0, 0.25), (5,)),
    ((0.0, 0.0, 7.0), (1, 5, 7)),
    ((4.0, 4.0, 4.0), ()),
]


def write(folder: Path, text: bool, points: list = POINTS) -> Path:  # type: ignore[type-arg]
    if text:
        lines = ["# 3D point list", ""]
        for number, (xyz, track) in enumerate(points):
            words = [number + 3, *xyz, 10, 20, 30, 0.5]
            lines.append(" ".join(map(str, [*words, *(w for i in track for w in (i, 4))])))
        (folder / "points3D.txt").write_text("\n".join(lines) + "\n")
        return folder / "points3D.txt"
    blob = struct.pack("<Q", len(points))
    for number, (xyz, track) in enumerate(points):
        blob += struct.pack("<Q3d3BdQ", number + 3, *xyz, 10, 20, 30, 0.5, len(track))
        blob += b"".join(struct.pack("<II", image, 4) for image in track)
    (folder / "points3D.bin").write_bytes(blob)
    return folder / "points3D.bin"


@pytest.mark.parametrize("text", [False, True])
def test_points_and_tracks(tmp_path: Path, text: bool) -> None:
    assert read_points(tmp_path, NAMES, tmp_path) is None
    file = write(tmp_path, text)
    points = read_points(tmp_path, NAMES, tmp_path.parent)
    assert points is not None and points.tracks is not None
    np.testing.assert_array_equal(points.positions, [xyz for xyz, _ in POINTS])
    assert points.source == f"{tmp_path.name}/{file.name}"
    assert set(points.tracks) == set(NAMES.values())
    for name, expected in (("a.jpg", [0, 2]), ("sub/b.jpg", [0, 1, 2]), ("unseen.jpg", [])):
        assert points.tracks[name].tolist() == expected


@pytest.mark.parametrize("text", [False, True])
def test_points_that_cannot_be_are_left_out(tmp_path: Path, text: bool) -> None:
    wrong = [((float("nan"), 0.0, 0.0), (1, 5)), ((0.0, -1e300, 0.0), (5,))]
    write(tmp_path, text, [wrong[0], *POINTS[:2], wrong[1], *POINTS[2:]])
    points = read_points(tmp_path, NAMES, tmp_path)
    assert points is not None and points.tracks is not None
    np.testing.assert_array_equal(points.positions, [xyz for xyz, _ in POINTS])
    assert points.tracks["sub/b.jpg"].tolist() == [0, 1, 2]


@pytest.mark.parametrize("text", [False, True])
def test_without_tracks_nobody_knows(tmp_path: Path, text: bool) -> None:
    write(tmp_path, text, [(xyz, ()) for xyz, _ in POINTS])
    points = read_points(tmp_path, NAMES, tmp_path)
    assert points is not None and points.tracks is None and len(points.positions) == 4
    write(tmp_path, text, [])
    nothing = read_points(tmp_path, NAMES, tmp_path)
    assert nothing is not None and nothing.positions.shape == (0, 3)


def test_a_file_that_is_cut_or_counts_wrongly(tmp_path: Path) -> None:
    file = write(tmp_path, False)
    whole = file.read_bytes()
    for length in range(len(whole)):
        file.write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"points3D.bin: .*; export it again, or move it away"):
            read_points(tmp_path, NAMES, tmp_path)
    for at in (0, 8 + 8 + 24 + 3 + 8):  # how many points, how long the first track is
        for count in (2**63, 10**6):
            file.write_bytes(whole[:at] + struct.pack("<Q", count) + whole[at + 8 :])
            with pytest.raises(InputError, match=r"points3D.bin: "):
                read_points(tmp_path, NAMES, tmp_path)


@pytest.mark.parametrize(
    "line",
    [
        "1 2 3",
        "1 0 0 0 0 0 0",
        "1 0 0 0 0 0 0 1 5",
        "1 0 0 x 0 0 0 1",
        f"1 0 0 0 0 0 0 1 {9**99} 2",
    ],
)
def test_a_line_that_is_no_point(tmp_path: Path, line: str) -> None:
    file = write(tmp_path, True)
    file.write_text(file.read_text() + line + "\n")
    with pytest.raises(InputError, match=r"points3D.txt: has no point as .* in line 7; export"):
        read_points(tmp_path, NAMES, tmp_path)


@settings(max_examples=400, deadline=None)
@given(
    st.booleans(),
    st.lists(st.tuples(st.integers(0, 400), st.binary(min_size=1, max_size=9)), max_size=4),
)
def test_damage_is_an_input_error(
    tmp_path_factory: pytest.TempPathFactory, text: bool, changes: list[tuple[int, bytes]]
) -> None:
    folder = tmp_path_factory.mktemp("points")
    file = write(folder, text)
    content = bytearray(file.read_bytes())
    for at, piece in changes:
        at %= len(content)
        content[at : at + len(piece)] = piece
    file.write_bytes(content)
    try:
        points = read_points(folder, NAMES, folder)
    except InputError as error:
        assert str(error).startswith(f"{file}: ")
    else:
        assert points is not None and np.isfinite(points.positions).all()
        for track in (points.tracks or {}).values():
            assert ((track >= 0) & (track < len(points.positions))).all()


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("track", [(), (1,) * 40])
def test_memory_stays_within_ten_times_the_file(
    tmp_path: Path, text: bool, track: tuple[int, ...]
) -> None:
    points = [((0, 1, 2), track)] * (40_000 if not track else 4000)
    file = write(tmp_path, text, points)
    read_points(tmp_path, NAMES, tmp_path)
    tracemalloc.start()
    read_points(tmp_path, NAMES, tmp_path)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 10 * file.stat().st_size


@needs_capture("cup_colmap")
def test_pycolmap_reads_the_same() -> None:
    pycolmap = pytest.importorskip("pycolmap")
    model = DATA / "cup_colmap" / "sparse" / "0"
    theirs = pycolmap.Reconstruction(model)
    images = images_of_bytes(model / "images.bin")
    ours = read_points(model, {image.number: image.name for image in images}, DATA / "cup_colmap")
    assert ours is not None and ours.tracks is not None
    expected = {tuple(point.xyz): point for point in theirs.points3D.values()}
    assert {tuple(xyz) for xyz in ours.positions} == set(expected)
    names = {number: image.name for number, image in theirs.images.items()}
    seen = {(names[e.image_id], xyz) for xyz, p in expected.items() for e in p.track.elements}
    found = {(n, tuple(ours.positions[i])) for n, track in ours.tracks.items() for i in track}
    assert found == seen


def write_ply(file: Path) -> None:
    head = f"ply\nformat ascii 1.0\nelement vertex {len(POINTS) + 1}\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    rows = [*(xyz for xyz, _ in POINTS), (float("nan"), 0.0, 0.0)]
    file.write_text(head + "".join(f"{x} {y} {z}\n" for x, y, z in rows))


@pytest.mark.parametrize("place", ["sparse/0", "sparse", "."])
@pytest.mark.parametrize("empty", [False, True])
def test_points_as_ply_are_read_without_tracks(tmp_path: Path, place: str, empty: bool) -> None:
    model = tmp_path / "sparse" / "0"
    model.mkdir(parents=True)
    if empty:  # a file that COLMAP requires, of a program that has no points
        write(model, True, [])
    write_ply(tmp_path / place / "points3D.ply")
    points = read_points(model, NAMES, tmp_path)
    assert points is not None and points.tracks is None
    np.testing.assert_array_equal(points.positions, [xyz for xyz, _ in POINTS])
    assert points.source == (Path(place) / "points3D.ply").as_posix()
    write(model, False)  # tracks come first
    points = read_points(model, NAMES, tmp_path)
    assert points is not None and points.source == "sparse/0/points3D.bin"
    write_ply(tmp_path.parent / "points3D.ply")
    assert read_points(tmp_path / "sparse", NAMES, tmp_path / "sparse") is None or place == "sparse"
    (tmp_path.parent / "points3D.ply").unlink()


def test_a_damaged_ply_is_named(tmp_path: Path) -> None:
    (tmp_path / "points3D.ply").write_text("no")
    with pytest.raises(InputError, match=r"points3D.ply: is no PLY file"):
        read_points(tmp_path, NAMES, tmp_path)


def test_a_ply_that_cannot_be_read_does_not_stop_the_capture(tmp_path: Path) -> None:
    scene_with_model(tmp_path)
    (tmp_path / "points3D.ply").write_text("no")
    scene = load_scene(tmp_path)
    assert scene.points is None
    (warning,) = scene.warnings
    assert warning.startswith("no points: ") and "points3D.ply: is no PLY file" in warning
