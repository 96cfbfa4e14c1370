"""COLMAP models: what is read is what was meant, and damage is told in a sentence."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from tests.support.tiny_scenes import DATA, needs_capture, ring, write_transforms
from warpnerf.checks import InputError
from warpnerf.inspection.inspection import inspect
from warpnerf.scenes.formats import colmap, colmap_files
from warpnerf.scenes.formats.load import load_scene
from warpnerf.scenes.scene import Scene

PARAMETERS = {
    "SIMPLE_PINHOLE": (10.0, 4.25, 2.75),
    "PINHOLE": (10.0, 11.0, 4.25, 2.75),
    "SIMPLE_RADIAL": (10.0, 4.25, 2.75, -0.05),
    "RADIAL": (10.0, 4.25, 2.75, -0.05, 0.01),
    "OPENCV": (10.0, 11.0, 4.25, 2.75, -0.05, 0.01, 0.002, -0.001),
    "FULL_OPENCV": (10.0, 11.0, 4.25, 2.75, -0.05, 0.01, 0.002, -0.001, 0.003, 0.02, -0.01, 0.004),
    "OPENCV_FISHEYE": (10.0, 11.0, 4.25, 2.75, -0.05, 0.01, 0.002, -0.001),
    "SIMPLE_RADIAL_FISHEYE": (10.0, 4.25, 2.75, -0.05),
    "RADIAL_FISHEYE": (10.0, 4.25, 2.75, -0.05, 0.01),
    "SIMPLE_FISHEYE": (10.0, 4.25, 2.75),
    "FISHEYE": (10.0, 11.0, 4.25, 2.75),
}


def quaternion(rotation: np.ndarray) -> tuple[float, float, float, float]:
    """w, x, y, z; by the largest eigenvector, which has no special cases."""
    r = rotation
    k = np.array(
        [
            [r[0, 0] - r[1, 1] - r[2, 2], 0, 0, 0],
            [r[1, 0] + r[0, 1], r[1, 1] - r[0, 0] - r[2, 2], 0, 0],
            [r[2, 0] + r[0, 2], r[2, 1] + r[1, 2], r[2, 2] - r[0, 0] - r[1, 1], 0],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], np.trace(r)],
        ]
    )
    x, y, z, w = np.linalg.eigh(k)[1][:, -1]
    return float(w), float(x), float(y), float(z)


def posed(n: int) -> list[tuple[Any, Any, str]]:
    """World to camera in OpenCV axes, of the poses of ``write_transforms``."""
    images = []
    for number, pose in enumerate(ring(n)):
        rotation = (pose[:3, :3] * [1.0, -1.0, -1.0]).T
        images.append((quaternion(rotation), -rotation @ pose[:3, 3], f"{number:03d}.png"))
    return images


def write_model(
    folder: Path, n: int = 4, model: str = "PINHOLE", text: bool = False, points: int = 3
) -> Path:
    """A model of the scene that ``write_transforms`` writes into the same folder."""
    target = folder / "sparse" / "0"
    target.mkdir(parents=True)
    parameters = PARAMETERS[model]
    if text:
        (target / "cameras.txt").write_text(
            f"# Camera list\n7 {model} 8 6 {' '.join(map(str, parameters))}\n"
        )
        lines = ["# Image list"]
        for number, (q, t, name) in enumerate(posed(n)):
            lines.append(f"{number + 1} {' '.join(map(repr, map(float, (*q, *t))))} 7 {name}")
            lines.append(" ".join(["1.5 2.5 -1"] * (points if number else 0)))
        (target / "images.txt").write_text("\n".join(lines) + "\n")
        return target
    number = colmap_files.MODEL_NAMES.index(model)
    (target / "cameras.bin").write_bytes(
        struct.pack("<Q", 1)
        + struct.pack("<IiQQ", 7, number, 8, 6)
        + struct.pack(f"<{len(parameters)}d", *parameters)
    )
    blob = struct.pack("<Q", n)
    for number, (q, t, name) in enumerate(posed(n)):
        blob += struct.pack("<I7dI", number + 1, *q, *t, 7) + name.encode() + b"\0"
        blob += struct.pack("<Q", points) + points * struct.pack("<2dq", 1.5, 2.5, -1)
    (target / "images.bin").write_bytes(blob)
    return target


def scene_with_model(folder: Path, **options: Any) -> Path:
    write_transforms(folder)
    (folder / "transforms.json").unlink()
    return write_model(folder, **options)


def assert_same(found: Scene, expected: Scene) -> None:
    assert [len(found.splits[s]) for s in found.splits] == [
        len(expected.splits[s]) for s in expected.splits
    ]
    for ours, theirs in zip(found.views, expected.views, strict=True):
        assert np.array_equal(ours.image, theirs.image)
        np.testing.assert_allclose(ours.camera.c2w, theirs.camera.c2w, atol=1e-12)
        for name in ("width", "height", "fx", "fy", "cx", "cy", "k1", "k2", "k3", "p1", "p2"):
            assert getattr(ours.camera, name) == pytest.approx(getattr(theirs.camera, name))
    np.testing.assert_allclose(found.box_min, expected.box_min)
    assert found.content_distance == pytest.approx(expected.content_distance)


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("place", ["sparse/0", "sparse", "colmap/sparse/0", "."])
def test_the_scene_is_that_of_transforms_json(tmp_path: Path, text: bool, place: str) -> None:
    write_transforms(tmp_path / "a")
    expected = load_scene(tmp_path / "a")
    model = scene_with_model(tmp_path / "b", text=text)
    if place != "sparse/0":
        (tmp_path / "b" / place).mkdir(parents=True, exist_ok=True)
        for file in list(model.iterdir()):
            file.rename(tmp_path / "b" / place / file.name)
        model.rmdir()
    found = load_scene(tmp_path / "b")
    assert_same(found, expected)
    assert_same(load_scene(tmp_path / "b" / place), expected)  # the model's own folder
    kind = "text" if text else "binary"
    assert inspect(tmp_path / "b").format == f"COLMAP ({place}, {kind})"


@pytest.mark.parametrize("model", PARAMETERS)
@pytest.mark.parametrize("text", [False, True])
def test_every_lens(tmp_path: Path, model: str, text: bool) -> None:
    scene_with_model(tmp_path, model=model, text=text)
    camera = load_scene(tmp_path).views[0].camera
    given = PARAMETERS[model]
    one_focal = model.startswith("SIMPLE") or model.startswith("RADIAL")
    assert (camera.fx, camera.fy) == (given[0], given[0] if one_focal else given[1])
    rest = given[1 if one_focal else 2 :]
    assert (camera.cx, camera.cy) == rest[:2]
    assert camera.fisheye == ("FISHEYE" in model)
    names = ("k1", "k2", "k3", "k4") if camera.fisheye else ("k1", "k2", "p1", "p2", "k3")
    names = (*names, "k4", "k5", "k6") if model == "FULL_OPENCV" else names
    found = tuple(getattr(camera, name) for name in names)
    given = rest[2 : 2 + len(names)]
    assert found == (*given, *[0.0] * (len(names) - len(given)))


def test_reduced_photographs_have_a_reduced_lens(tmp_path: Path) -> None:
    scene_with_model(tmp_path)
    (tmp_path / "images_2").mkdir()
    for file in (tmp_path / "images").iterdir():
        Image.open(file).resize((4, 3)).save(tmp_path / "images_2" / file.name)
        file.unlink()
    (tmp_path / "images").rmdir()
    camera = load_scene(tmp_path).views[0].camera
    assert (camera.width, camera.height) == (4, 3)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (5.0, 5.5, 2.125, 1.375)


def test_photographs_resized_in_place_scale_the_lens(tmp_path: Path) -> None:
    model = scene_with_model(tmp_path, text=True)
    change(model / "cameras.txt", "8 6 10.0 11.0 4.25 2.75", "32 24 40.0 44.0 17.0 11.0")
    scene = load_scene(tmp_path)
    camera = scene.views[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (10.0, 11.0, 4.25, 2.75)
    said = "4 of 4 photographs are of another size than their lenses were for (first: 000.png 8x6, "
    assert any(note.startswith(f"{said}the lens 32x24)") for note in scene.notes)


@pytest.mark.parametrize(
    ("size", "reduced"),
    [((3115, 2078), (1558, 1039)), ((3118, 2078), (780, 520)), ((4946, 3286), (1237, 822))],
)
def test_reduced_photographs_have_whole_pixels(
    size: tuple[int, int], reduced: tuple[int, int]
) -> None:
    camera = colmap_files.ModelCamera("SIMPLE_PINHOLE", *size, (900.0, size[0] / 2, size[1] / 2))
    lens = colmap._lens(Path("cameras.bin"), 1, camera)
    assert lens.was_for(*reduced) == size
    width, height = reduced
    made = lens.camera(width=width, height=height, c2w=np.eye(3, 4), image="a.png")
    assert (made.cx, made.cy) == pytest.approx((width / 2, height / 2))
    assert made.fx == pytest.approx(900.0 * width / size[0])


@pytest.mark.parametrize("stated", [None, 4, 9])
def test_a_file_that_was_cut_is_noticed(tmp_path: Path, stated: int | None) -> None:
    file = scene_with_model(tmp_path, text=True) / "images.txt"
    comment = "" if stated is None else f"# Number of images: {stated}, mean observations: 3\n"
    file.write_text(comment + file.read_text())
    warnings = load_scene(tmp_path).warnings
    said = [text for text in warnings if "says that it lists 9 images, but lists 4" in text]
    assert len(said) == (stated == 9)


def change(file: Path, before: str, after: str) -> None:
    text = file.read_text()
    assert before in text
    file.write_text(text.replace(before, after))


def all_around(model: Path) -> None:
    change(model / "cameras.txt", "7 PINHOLE", "7 EQUIRECTANGULAR")


def other_camera(model: Path) -> None:
    change(model / "images.txt", " 7 002.png", " 8 002.png")


def no_photographs(model: Path) -> None:
    for file in (model.parents[1] / "images").iterdir():
        file.unlink()


def no_folder(model: Path) -> None:
    no_photographs(model)
    (model.parents[1] / "images").rmdir()


def other_size(model: Path) -> None:
    change(model / "cameras.txt", "PINHOLE 8 6", "PINHOLE 9 6")


def few_parameters(model: Path) -> None:
    change(model / "cameras.txt", "10.0 11.0", "10.0")


def no_number(model: Path) -> None:
    change(model / "cameras.txt", "10.0 11.0", "ten 11.0")


def not_finite(model: Path) -> None:
    change(model / "cameras.txt", "10.0 11.0", "nan 11.0")


def outside(model: Path) -> None:
    change(model / "images.txt", "002.png", "../../002.png")


def short_line(model: Path) -> None:
    (model / "images.txt").write_text("1 1 0 0 0\n")


def empty_model(model: Path) -> None:
    (model / "images.txt").write_text("")


@pytest.mark.parametrize(
    ("act", "says"),
    [
        (all_around, "camera 7: the lens EQUIRECTANGULAR is not modelled; undistort"),
        (other_camera, "its camera 8 is not in cameras.txt"),
        (no_photographs, r"none of the model\'s 4 photographs is in .*images .first: 000.png"),
        (no_folder, r"photographs is in (?!.*sparse/0/images).*images .first.*; put them there"),
        (other_size, "is for images of 9x6 pixels, but 000.png has 8x6"),
        (few_parameters, "a PINHOLE has 4 parameters, not 3"),
        (no_number, "line 2: is no camera as COLMAP writes it"),
        (not_finite, "fl_x is not a finite number"),
        (outside, "leaves the scene's folder"),
        (short_line, "line 1: is no image as COLMAP writes it"),
        (empty_model, r"none of the model\'s 0 photographs"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, act: Any, says: str) -> None:
    act(scene_with_model(tmp_path, text=True))
    with pytest.raises(InputError, match=says):
        load_scene(tmp_path)


def test_a_missing_photograph_is_a_warning(tmp_path: Path) -> None:
    scene_with_model(tmp_path)
    (tmp_path / "images" / "002.png").unlink()
    scene = load_scene(tmp_path)
    assert len(scene.views) == 3
    assert "left out 1 of 4 images for want of a photograph (first: 002.png)" in scene.warnings[0]


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin"])
def test_counts_are_not_believed(tmp_path: Path, name: str) -> None:
    file = scene_with_model(tmp_path) / name
    whole = file.read_bytes()
    for count in (2**63, 10**6):
        file.write_bytes(struct.pack("<Q", count) + whole[8:])
        with pytest.raises(InputError, match=f"{name}: is damaged: it counts {count} "):
            load_scene(tmp_path)
    for length in range(len(whole)):
        file.write_bytes(whole[:length])
        with pytest.raises(InputError, match=name):
            load_scene(tmp_path)


@settings(max_examples=300, deadline=None)
@given(
    st.sampled_from(["cameras.bin", "images.bin", "cameras.txt", "images.txt"]),
    st.lists(st.tuples(st.integers(0, 2000), st.binary(min_size=1, max_size=9)), max_size=4),
)
def test_damage_is_an_input_error(
    tmp_path_factory: pytest.TempPathFactory, name: str, changes: list[tuple[int, bytes]]
) -> None:
    folder = tmp_path_factory.mktemp("model")
    file = scene_with_model(folder, text=name.endswith("txt")) / name
    content = bytearray(file.read_bytes())
    for at, piece in changes:
        at %= len(content)
        content[at : at + len(piece)] = piece
    file.write_bytes(content)
    try:
        load_scene(folder)
    except InputError as error:
        assert name in str(error) or "images" in str(error)


@needs_capture("cup_colmap")
def test_a_capture() -> None:
    scene = load_scene(DATA / "cup_colmap")
    assert len(scene.views) == 77 and not scene.warnings
    assert inspect(DATA / "cup_colmap").focus is not None


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=needs_capture(n)) for n in ("lund_door", "stitch")]
)
def test_both_formats_of_a_capture_agree(name: str) -> None:
    by_json, by_model = load_scene(DATA / name), load_scene(DATA / name / "sparse" / "0")
    cameras = {Path(view.name).name: view.camera for view in by_json.views}
    assert len(by_model.views) >= 0.9 * len(cameras)
    for view in by_model.views:
        expected = replace(cameras[Path(view.name).name], c2w=view.camera.c2w)
        assert view.camera.fx == pytest.approx(expected.fx, rel=1e-3)
        np.testing.assert_allclose(
            view.camera.c2w, cameras[Path(view.name).name].c2w, atol=2e-3 * by_json.content_distance
        )
