"""Depth files: from depth along the axis to distance along rays, in the scene's units."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from tests.support.cli_process import assert_trained, make_scene, train
from tests.support.tiny_scenes import camera_at, save, write_transforms
from warpnerf.checks import InputError
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.undistort import directions
from warpnerf.scenes.formats.load import load_scene
from warpnerf.scenes.formats.survey import survey
from warpnerf.scenes.images.depths import DepthFile, read_depth

VALUES = np.random.default_rng(0).integers(500, 60000, (6, 8), dtype=np.uint16)

LENSES: dict[str, dict[str, Any]] = {
    "pinhole": {"fy": 11.0, "cx": 3.5},
    "distorted": {"k1": -0.1, "k2": 0.03, "p1": 0.01},
    "fisheye": {"fx": 5.0, "fy": 5.0, "k1": 0.05, "k4": -0.001, "fisheye": True},
}


def rays(camera: Camera) -> np.ndarray:
    v, u = np.indices((camera.height, camera.width)) + 0.5
    return directions(camera, np.stack([u.ravel(), v.ravel()], axis=1)).reshape(*u.shape, 3)


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("kind", ["png", "npy", "tiff"])
def test_depth_is_along_the_ray(tmp_path: Path, lens: str, kind: str) -> None:
    camera = camera_at(np.eye(4), **LENSES[lens])
    path = tmp_path / f"depth.{kind}"
    if kind == "npy":
        np.save(path, VALUES.astype(np.float32)[..., None])
    elif kind == "tiff":
        Image.fromarray(VALUES.astype(np.float32)).save(path)
    else:
        Image.fromarray(VALUES).save(path)
    found = read_depth(DepthFile(path, 0.002), camera).read()
    assert found.dtype == np.float32
    along = found * -rays(camera)[..., 2]
    np.testing.assert_allclose(along, 0.002 * VALUES, rtol=3e-4 if lens != "pinhole" else 1e-6)
    assert np.abs(found / (0.002 * VALUES) - 1.0).max() > 0.05


def test_what_is_not_known_is_not_finite(tmp_path: Path) -> None:
    values = VALUES.astype(np.float64)
    values[0] = [0.0, -1.0, np.nan, np.inf, -np.inf, 1.0, 2.0, 3.0]
    np.save(tmp_path / "d.npy", values)
    found = read_depth(DepthFile(tmp_path / "d.npy", 1.0), camera_at(np.eye(4))).read()
    assert np.array_equal(np.isnan(found[0]), [True] * 5 + [False] * 3)
    assert np.isfinite(found[1:]).all()
    # Behind a fisheye's plane nothing has a depth along the axis.
    camera = camera_at(np.eye(4), fx=2.0, fy=2.0, fisheye=True)
    found = read_depth(DepthFile(tmp_path / "d.npy", 1.0), camera).read()
    np.testing.assert_array_equal(np.isfinite(found[1:]), rays(camera)[1:, :, 2] < 0.0)


def test_depth_of_another_size_is_taken_from_the_nearest(tmp_path: Path) -> None:
    Image.fromarray(VALUES).save(tmp_path / "d.png")
    camera = camera_at(np.eye(4), width=16, height=12, fx=1e6, fy=1e6, cx=8.0, cy=6.0)
    found = read_depth(DepthFile(tmp_path / "d.png", 1.0), camera).read()
    np.testing.assert_allclose(found, np.kron(VALUES, np.ones((2, 2))), rtol=1e-6)
    found = read_depth(DepthFile(tmp_path / "d.png", 1.0), camera, 4).read()
    np.testing.assert_allclose(found, VALUES[1::2, 1::2], rtol=1e-6)


def test_no_more_than_the_file_has_or_the_photograph_needs_is_kept(tmp_path: Path) -> None:
    Image.fromarray(VALUES).save(tmp_path / "d.png")
    file = DepthFile(tmp_path / "d.png", 1.0)
    large = camera_at(np.eye(4), width=800, height=600, cx=400.0, cy=300.0)
    kept = read_depth(file, large)
    assert kept.values.shape == (6, 8) and kept.shape == kept.read().shape == (600, 800)
    small = camera_at(np.eye(4)).downscaled(2)
    kept = read_depth(file, camera_at(np.eye(4)), 2)
    assert kept.values.shape == kept.shape == (3, 4)
    along = kept.read() * -rays(small)[..., 2]
    np.testing.assert_allclose(along, VALUES[1::2, 1::2], rtol=1e-6)


@pytest.mark.parametrize("times", [1, 2, 7])
def test_depth_is_cropped_as_the_reduced_photograph(tmp_path: Path, times: int) -> None:
    # Of 63 x 31 pixels, blocks of 8 cover 56 x 24.
    camera = camera_at(np.eye(4), width=63, height=31, fx=1e6, fy=1e6, cx=31.5, cy=15.5)
    rows, columns = 31 * times, 63 * times
    values = np.arange(columns) + 0.5 + 1000.0 * (np.arange(rows)[:, None] + 0.5)
    np.save(tmp_path / "d.npy", values / times)
    found = read_depth(DepthFile(tmp_path / "d.npy", 1.0), camera, 8).read()
    middles = 8.0 * np.arange(1, 8) - 4.0 + 1000.0 * (8.0 * np.arange(1, 4)[:, None] - 4.0)
    assert np.abs(found - middles).max() <= 500.5 / times + 1e-3


@pytest.mark.parametrize(
    ("write", "says"),
    [
        (lambda path: np.save(path, VALUES.T), "6 pixels|another shape"),
        (
            lambda path: np.save(path, np.dstack([VALUES] * 3)),
            r"the shape \[6, 8, 3\]; depth is one",
        ),
        (lambda path: np.save(path, VALUES.astype(object)), "is not readable as an array"),
        (lambda path: path.write_bytes(b"\x93NUMPY\x01\x00"), "is not readable as an array"),
        (lambda path: None, "does not exist"),
    ],
)
def test_what_is_no_depth_is_refused(tmp_path: Path, write: Any, says: str) -> None:
    write(tmp_path / "d.npy")
    with pytest.raises(InputError, match=rf"d\.npy: .*({says})"):
        read_depth(DepthFile(tmp_path / "d.npy", 1.0), camera_at(np.eye(4)))


@settings(max_examples=300, deadline=None)
@given(st.data())
def test_damage_of_an_array_is_an_input_error(
    tmp_path_factory: pytest.TempPathFactory, data: Any
) -> None:
    path = tmp_path_factory.mktemp("npy") / "d.npy"
    np.save(path, VALUES)
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        content[data.draw(st.integers(0, 127))] = data.draw(st.integers(0, 255))
    path.write_bytes(content)
    try:
        read_depth(DepthFile(path, 1.0), camera_at(np.eye(4)))
    except InputError as error:
        assert "\n" not in str(error)


def test_coloured_depth_is_refused(tmp_path: Path) -> None:
    Image.new("RGB", (8, 6)).save(tmp_path / "d.png")
    with pytest.raises(
        InputError, match=r"d\.png: its pixels are RGB; save one channel of 16 bits"
    ):
        read_depth(DepthFile(tmp_path / "d.png", 1.0), camera_at(np.eye(4)))


@pytest.mark.parametrize(
    ("keys", "unit"),
    [
        ({}, 1e-3),
        ({"depth_unit_scale_factor": 0.01}, 0.01),
        ({"applied_scale": 0.5}, 5e-4),
        ({"applied_scale": 2, "depth_unit_scale_factor": 1}, 2.0),
    ],
)
def test_units_are_those_of_the_file(tmp_path: Path, keys: dict[str, float], unit: float) -> None:
    content = write_transforms(tmp_path)
    Image.fromarray(VALUES).save(tmp_path / "d.png")
    content["frames"][1]["depth_file_path"] = "d.png"
    content["frames"][2]["depth_file_path"] = "e.png"
    save(tmp_path / "transforms.json", content | keys)
    scene = load_scene(tmp_path)
    assert [view.depth is not None for view in scene.views] == [False, True, False, False]
    expected = read_depth(DepthFile(tmp_path / "d.png", unit), scene.views[1].camera).read()
    assert np.array_equal(scene.views[1].depth, expected)
    (warning,) = scene.warnings
    assert "the depth_file_path of 1 of 4 frames leads to no file (first: e.png)" in warning


def test_depth_is_read_as_instant_ngp_names_it(tmp_path: Path) -> None:
    """In scene units, whatever applied_scale is; depth_file_path comes first."""
    content = write_transforms(tmp_path)
    Image.fromarray(VALUES).save(tmp_path / "d.png")
    content["frames"][1]["depth_path"] = "d.png"
    content["frames"][2] |= {"depth_path": "gone.png", "depth_file_path": "d.png"}
    content |= {"enable_depth_loading": True, "integer_depth_scale": 5e-5, "applied_scale": 0.5}
    save(tmp_path / "transforms.json", content)
    scene = load_scene(tmp_path)
    for index, unit in ((1, 5e-5), (2, 5e-4)):
        view = scene.views[index]
        expected = read_depth(DepthFile(tmp_path / "d.png", unit), view.camera).read()
        assert np.array_equal(view.depth, expected)
    assert scene.warnings == ()
    assert survey(tmp_path).diagnostics == ()


def test_depth_that_cannot_be_read_is_left_out(tmp_path: Path) -> None:
    """Training does not need it: such as a coloured picture in place of instant-ngp's depths."""
    content = write_transforms(tmp_path)
    Image.new("RGB", (8, 6)).save(tmp_path / "colours.png")
    np.save(tmp_path / "turned.npy", VALUES.T)
    np.save(tmp_path / "fine.npy", VALUES)
    for index, (key, name) in enumerate(
        (
            ("depth_path", "colours.png"),
            ("depth_file_path", "turned.npy"),
            ("depth_path", "fine.npy"),
        )
    ):
        content["frames"][index][key] = name
    save(tmp_path / "transforms.json", content)
    scene = load_scene(tmp_path)
    assert [view.depth is not None for view in scene.views] == [False, False, True, False]
    assert len(scene.warnings) == 1
    warning = scene.warnings[0]
    assert "depth of 2 of 4 images cannot be read, and is not used" in warning
    assert f"first: {tmp_path / 'colours.png'}: its pixels are RGB" in warning


@pytest.mark.parametrize("ending", ["exr", "EXR", "pfm", "npz"])
def test_depth_in_a_form_that_is_not_read_is_refused(tmp_path: Path, ending: str) -> None:
    (tmp_path / f"d.{ending}").write_bytes(b"v/1\x01")
    with pytest.raises(InputError, match=rf"d\.{ending}: depth is read from images of one channel"):
        read_depth(DepthFile(tmp_path / f"d.{ending}", 1.0), camera_at(np.eye(4)))


@pytest.mark.parametrize(
    "keys",
    [{"applied_scale": 0.0}, {"integer_depth_scale": 0.0}, {"depth_unit_scale_factor": -1.0}],
)
def test_units_that_are_none_are_refused(tmp_path: Path, keys: dict[str, float]) -> None:
    content = write_transforms(tmp_path)
    Image.fromarray(VALUES).save(tmp_path / "d.png")
    content["frames"][1]["depth_path"] = "d.png"
    save(tmp_path / "transforms.json", content | keys)
    with pytest.raises(InputError, match=r"is no unit of depth; give .* above 0"):
        load_scene(tmp_path)


@pytest.mark.parametrize("named", [True, False])
def test_depth_that_instant_ngp_would_not_read_is_not_read(tmp_path: Path, named: bool) -> None:
    content = write_transforms(tmp_path)
    if named:
        content["enable_depth_loading"] = False
        content["frames"][1]["depth_path"] = "d.exr"
        (tmp_path / "d.exr").write_bytes(b"v/1\x01")
    save(tmp_path / "transforms.json", content | {"integer_depth_scale": 0.0})
    scene = load_scene(tmp_path)
    assert len(scene.views) == 4 and all(view.depth is None for view in scene.views)


@pytest.mark.usefixtures("compiled_kernels")
@pytest.mark.parametrize("known", [True, False])
def test_the_command_reports_the_error_of_depth(tmp_path: Path, known: bool) -> None:
    scene = make_scene(tmp_path, lambda c: c["frames"][0].update(depth_file_path="d.png"))
    Image.fromarray(np.full((12, 16), 3000 if known else 0, np.uint16)).save(scene / "d.png")
    done = train(scene, folder=tmp_path)
    assert_trained(done)
    mean = json.loads((done.run / "metrics.json").read_text())["mean"]
    assert ("depth_error" in mean) == known and mean.get("depth_error", 1.0) > 0.0
