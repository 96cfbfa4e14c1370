"""Lenses of other programs: formulas, OpenCV's nearest lenses, undistorted photographs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.scenes.test_colmap import write_model
from warpnerf.checks import InputError
from warpnerf.scenes.cameras.foreign import (
    MODELS,
    TOLERANCE,
    ForeignLens,
    ImagePlane,
    fitted,
)
from warpnerf.scenes.cameras.undistort import directions
from warpnerf.scenes.formats.load import load_scene
from warpnerf.scenes.scene import View

PLANE = ImagePlane(96, 72, 60.0, 61.0, 49.0, 35.0)

PARAMETERS = {
    "FOV": (0.9,),
    "THIN_PRISM_FISHEYE": (0.02, -0.01, 3e-3, -2e-3, 0.003, 0.001, 1e-2, -5e-3),
    "RAD_TAN_THIN_PRISM_FISHEYE": (
        *(0.02, -0.01, 0.003, 0.001, 0.0003, 0.0001, 3e-3, -2e-3, 1e-2, 1e-3, -5e-3, 1e-3),
    ),
    "SIMPLE_DIVISION": (-0.15,),
    "DIVISION": (0.05,),
    "EUCM": (0.6, 1.1),
    "BROWN": (-0.05, 0.02, -0.01, 0.003, 1e-3, -5e-4, 0.1, 0.2),
    "BROWN_FISHEYE": (-0.05, 0.02, -0.01, 0.003, 1e-3, -5e-4, 0.1, 0.2),
    "BROWN_EQUISOLID": (-0.05, 0.02, -0.01, 0.003, 1e-3, -5e-4, 0.1, 0.2),
}

# img_from_cam of pycolmap 4.2.1 for (0.3, -0.2, 1) and (-0.5, 0.7, 1), focal length 1 at (0, 0).
COLMAP = {
    "FOV": [(0.309884754, -0.206589836), (-0.447815991, 0.626942387)],
    "THIN_PRISM_FISHEYE": [(0.28887305, -0.192182872), (-0.414293183, 0.584653465)],
    "RAD_TAN_THIN_PRISM_FISHEYE": [(0.29087826, -0.193694241), (-0.407282326, 0.5765696)],
    "SIMPLE_DIVISION": [(0.294367601, -0.196245068), (-0.454201601, 0.635882241)],
    "DIVISION": [(0.30197577, -0.20131718), (-0.5200104, 0.728014561)],
    "EUCM": [(0.288055195, -0.192036797), (-0.413869974, 0.579417963)],
}


@pytest.mark.parametrize("model", COLMAP)
def test_positions_are_those_of_colmap(model: str) -> None:
    lens = ForeignLens(model, PARAMETERS[model])
    found = lens.project(np.array([[0.3, -0.2, 1.0], [-0.5, 0.7, 1.0]]))
    np.testing.assert_allclose(found, COLMAP[model], atol=1e-9)


def test_positions_are_those_of_metashape() -> None:
    """By hand from the equations of its manual: p1 is with r^2 + 2 x^2, and of p2 the other way."""
    k1, k2, k3, k4, p1, p2, p3, p4 = PARAMETERS["BROWN"]
    x, y = 0.4, -0.3
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4
    more = 1 + p3 * r2 + p4 * r2**2
    u = x * radial + (p1 * (r2 + 2 * x * x) + 2 * p2 * x * y) * more
    v = y * radial + (p2 * (r2 + 2 * y * y) + 2 * p1 * x * y) * more
    found = ForeignLens("BROWN", PARAMETERS["BROWN"], skew=0.01).project(np.array([[x, y, 1.0]]))
    np.testing.assert_allclose(found, [[u + 0.01 * v, v]], atol=1e-15)
    r = np.hypot(x, y)
    theta = np.arctan(r)
    for name, angle in (("BROWN_FISHEYE", theta), ("BROWN_EQUISOLID", 2 * np.sin(theta / 2))):
        there = ForeignLens("BROWN", PARAMETERS["BROWN"]).project(
            np.array([[x * angle / r, y * angle / r, 1.0]])
        )
        found = ForeignLens(name, PARAMETERS[name]).project(np.array([[x, y, 1.0]]))
        np.testing.assert_allclose(found, there, atol=1e-15)


def test_lenses_without_distortion_are_a_pinhole_or_a_fisheye() -> None:
    ray = np.array([[0.3, -0.2, 1.0], [0.0, 0.0, 1.0]])
    for model in MODELS:
        zero = {"FOV": (0.0,), "EUCM": (0.0, 1.0)}.get(model, (0.0,) * MODELS[model].n)
        r = np.hypot(0.3, 0.2)
        angle = 2 * np.sin(np.arctan(r) / 2) if "SOLID" in model else np.arctan(r)
        scale = angle / r if MODELS[model].fisheye else 1.0
        found = ForeignLens(model, zero).project(ray)
        np.testing.assert_allclose(found, [[0.3 * scale, -0.2 * scale], [0.0, 0.0]], atol=1e-12)


def test_a_fisheye_sees_behind_itself_and_a_plane_does_not() -> None:
    behind = np.array([[1.0, 0.0, -1.0]])
    found = ForeignLens("BROWN_FISHEYE", (0.0,) * 8).project(behind)
    np.testing.assert_allclose(found, [[0.75 * np.pi, 0.0]])
    assert np.isnan(ForeignLens("BROWN", (0.0,) * 8).project(behind)).all()


@pytest.mark.parametrize("model", PARAMETERS)
def test_the_nearest_lens_is_off_by_what_it_says(model: str) -> None:
    lens = ForeignLens(model, PARAMETERS[model])
    found = fitted(lens, PLANE)
    assert found is not None
    camera, off = found
    pixels = np.stack(np.meshgrid(np.arange(97.0), np.arange(73.0)), axis=2).reshape(-1, 2)
    rays = directions(camera, pixels) * [1.0, -1.0, -1.0]
    apart = np.linalg.norm(PLANE.pixels(lens.project(rays)) - pixels, axis=1)
    assert apart.max() <= 1.3 * off + 1e-6  # off is of directions between these
    bent = {"THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE", "BROWN_FISHEYE", "BROWN_EQUISOLID"}
    assert (off > TOLERANCE) == (model in bent)


def pattern(positions: np.ndarray) -> np.ndarray:
    """Smooth colours of positions in a photograph, [..., 3] in [0, 255]."""
    u, v = positions[..., 0], positions[..., 1]
    waves = [np.sin(0.11 * u + 0.05 * v), np.cos(0.07 * v), np.sin(0.06 * (u - v))]
    return 128.0 + 100.0 * np.stack(waves, axis=-1)


def centres(width: int, height: int) -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=2)


def scene_of(folder: Path, model: str, channels: int = 3) -> Path:
    """A COLMAP model whose photographs are all the pattern."""
    (folder / "images").mkdir(parents=True)
    pixels = np.round(pattern(centres(PLANE.width, PLANE.height))).astype(np.uint8)
    if channels == 4:
        alpha = np.full((*pixels.shape[:2], 1), 255, np.uint8)
        alpha[:2] = 0
        pixels = np.concatenate([pixels, alpha], axis=2)
    for k in range(4):
        Image.fromarray(pixels).save(folder / f"images/{k:03d}.png")
    place = write_model(folder, model="PINHOLE", text=True)
    focal = [PLANE.fx] if model == "SIMPLE_DIVISION" else [PLANE.fx, PLANE.fy]
    values = " ".join(map(str, [*focal, PLANE.cx, PLANE.cy, *PARAMETERS[model]]))
    (place / "cameras.txt").write_text(f"7 {model} 96 72 {values}\n")
    return folder


def shown(view: View, lens: ForeignLens, plane: ImagePlane) -> tuple[np.ndarray, np.ndarray]:
    """Where in the photograph each of a view's pixels is, and which are inside it."""
    pixels = centres(view.camera.width, view.camera.height).reshape(-1, 2)
    rays = directions(view.camera, pixels) * [1.0, -1.0, -1.0]
    at = plane.pixels(lens.project(rays)).reshape(view.camera.height, view.camera.width, 2)
    inside = (at > 1.0).all(axis=2) & (at < [plane.width - 1.0, plane.height - 1.0]).all(axis=2)
    return at, inside


@pytest.mark.parametrize("model", COLMAP)
def test_photographs_show_what_the_lens_saw(tmp_path: Path, model: str) -> None:
    scene = load_scene(scene_of(tmp_path, model))
    view = scene.views[0]
    plane = PLANE if model != "SIMPLE_DIVISION" else ImagePlane(96, 72, 60.0, 60.0, 49.0, 35.0)
    at, inside = shown(view, ForeignLens(model, PARAMETERS[model]), plane)
    assert np.abs(view.image - pattern(at))[inside].max() < 2.0
    undistorted = "THIN_PRISM" in model
    assert any(
        f"4 photographs have a {model} lens" in note
        and ("they are undistorted" if undistorted else "used in its place") in note
        for note in scene.notes
    )
    if undistorted:
        counts = np.ones((72, 96), bool) if view.mask is None else view.mask
        outside = ((at < 0.0) | (at > [96.0, 72.0])).any(axis=2)
        assert not counts[outside].any()
        assert counts[inside].all()


def test_masks_and_alpha_and_reduction_follow(tmp_path: Path) -> None:
    model = "RAD_TAN_THIN_PRISM_FISHEYE"
    folder = scene_of(tmp_path, model)
    (folder / "masks").mkdir()
    mask = np.full((72, 96), 255, np.uint8)
    mask[:, :30] = 0
    for k in range(4):
        Image.fromarray(mask).save(folder / f"masks/{k:03d}.png.png")
    view = load_scene(folder).views[1]
    at, inside = shown(view, ForeignLens(model, PARAMETERS[model]), PLANE)
    assert view.mask is not None
    away = np.abs(at[..., 0] - 30.0) > 1.0
    assert (view.mask == (at[..., 0] > 30.0))[inside & away].all()

    small = load_scene(folder, downscale=2).views[1]
    assert small.image.shape == (36, 48, 3)
    blocks = view.image.reshape(36, 2, 48, 2, 3).mean(axis=(1, 3))
    assert np.abs(small.image - blocks).mean() < 1.0  # reduced first, then moved
    assert small.mask is not None
    whole = view.mask.reshape(36, 2, 48, 2).all(axis=(1, 3))
    assert np.mean(small.mask != whole) < 0.04
    kept = load_scene(folder, images="files").views[1]
    assert np.array_equal(kept.image, view.image)


def test_transparent_edges_are_ignored_where_they_went(tmp_path: Path) -> None:
    model = "RAD_TAN_THIN_PRISM_FISHEYE"
    view = load_scene(scene_of(tmp_path, model, channels=4)).views[0]
    at, inside = shown(view, ForeignLens(model, PARAMETERS[model]), PLANE)
    assert view.image.shape == (72, 96, 3)
    assert view.mask is not None
    assert not view.mask[inside & (at[..., 1] < 1.5)].any()
    assert view.mask[inside & (at[..., 1] > 2.6)].all()


@pytest.mark.parametrize(
    ("parameters", "says"),
    [
        ("FOV 96 72 60 61 49 35 3.2", "omega is 3.2, not radians from 0 to below pi; export"),
        ("EUCM 96 72 60 61 49 35 1.5 1", "alpha is 1.5, not between 0 and 1; export"),
        ("EUCM 96 72 60 61 49 35 0.5 0", "beta is 0, not above 0; export"),
        ("FOV 96 72 60 61 49 35", "a FOV has 5 parameters, not 4"),
        ("DIVISION 96 72 60 61 49 35 nan", "k is not a finite number"),
        ("DIVISION 96 72 60 61 2900 35 -9", "lens DIVISION shows nearly nothing of 000.png"),
        ("EQUIRECTANGULAR 96 72 96 72", "the lens EQUIRECTANGULAR is not modelled; undistort"),
        ("DIVISION 97 72 60 61 49 35 0.1", "is for images of 97x72 pixels, but 000.png has 96x72"),
    ],
)
def test_bad_parameters_are_named(tmp_path: Path, parameters: str, says: str) -> None:
    scene_of(tmp_path, "FOV")
    (tmp_path / "sparse/0/cameras.txt").write_text(f"7 {parameters}\n")
    with pytest.raises(InputError, match=says):
        load_scene(tmp_path)
