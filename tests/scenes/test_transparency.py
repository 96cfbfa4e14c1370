"""Transparent pixels are nothing around an object, or are ignored: what the scene is must not hang
on a few."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.support.tiny_scenes import picture, write_transforms
from warpnerf.scenes.formats.load import load_scene
from warpnerf.scenes.images.transparency import show_an_object, shows_nothing

H, W = 60, 80
V, U = np.mgrid[0:H, 0:W]


def border(share: float) -> np.ndarray:
    """A frame of about so large a share of the picture."""
    edge = (1.0 - np.sqrt(1.0 - share)) / 2.0
    inside = (abs(V - H / 2) < H * (0.5 - edge)) & (abs(U - W / 2) < W * (0.5 - edge))
    return ~inside


def around(seed: int, share: float) -> np.ndarray:
    """What is not a disc, somewhere, of so large a share of the picture left over."""
    at = np.random.default_rng(seed).uniform(0.35, 0.65, size=2)
    radius = np.sqrt((1.0 - share) * H * W / np.pi)
    return (V - at[0] * H) ** 2 + (U - at[1] * W) ** 2 > radius**2


def circle(ratio: float = 1.0) -> np.ndarray:
    """Around the picture of a fisheye lens, as wide as so large a share of the picture is high."""
    return np.hypot(V - (H - 1) / 2, U - (W - 1) / 2) > ratio * H / 2


def below_the_sky(seed: int, share: float) -> np.ndarray:
    """A sky that was cut out above a skyline, which differs from view to view."""
    phase = np.random.default_rng(seed).uniform(0.0, 6.0)
    return H * share * (1.0 + 0.5 * np.sin(U / 9.0 + phase)) > V


def between(seed: int, share: float) -> np.ndarray:
    """An object that fills the picture's height, with nothing at both sides: about so much."""
    waist = 4.0 * np.sin(V / H * np.pi + seed)
    return abs(U - (W - 1) / 2) > W / 2 * (1.0 - share) + waist


def bust(seed: int) -> np.ndarray:
    """Around a head and shoulders, which reach into both lower corners."""
    at = W / 2 + 9.0 * np.sin(seed)
    shoulders = ((U - (W - 1) / 2) / 39.0) ** 2 + ((V - (H - 1)) / 26.0) ** 2 < 1.0
    head = ((U - at) / 11.0) ** 2 + ((V - 20) / 15.0) ** 2 < 1.0
    return ~(shoulders | head)


NOTHING = np.zeros((H, W), dtype=bool)
ONE = NOTHING.copy()
ONE[0, 0] = True


@pytest.mark.parametrize(
    ("transparent", "is_object"),
    [
        pytest.param([], False, id="no photograph"),
        pytest.param([NOTHING] * 9, False, id="opaque"),
        pytest.param([ONE] * 9, False, id="a pixel of each"),
        pytest.param([border(0.05)] * 9, False, id="undistorted"),
        pytest.param([border(0.12)] * 9, False, id="undistorted, wide"),
        pytest.param([around(k, 0.6) for k in range(9)], True, id="an object"),
        pytest.param([around(0, 0.6)] * 9, True, id="an object that looks alike from all sides"),
        pytest.param([around(k, 0.3) for k in range(9)], True, id="an object, close"),
        pytest.param([border(0.3)] * 9, False, id="undistorted, very wide"),
        pytest.param([circle()] * 9, False, id="fisheye"),
        pytest.param([circle(0.97), circle(0.97)[:, 10:70]] * 5, False, id="fisheye, two sizes"),
        pytest.param([circle(1.0)[:, 5:75]] * 9, False, id="fisheye, cut"),
        pytest.param([abs(U - 40) > 9] * 9, True, id="a bar before nothing"),
        pytest.param([below_the_sky(k, 0.3) for k in range(9)], False, id="no sky"),
        pytest.param([below_the_sky(k, 0.1) for k in range(9)], False, id="little sky"),
        pytest.param([below_the_sky(k, 0.2)[::-1] for k in range(9)], False, id="no floor"),
        pytest.param([below_the_sky(k, 0.6) for k in range(9)], False, id="much sky"),
        pytest.param([bust(k) for k in range(9)], True, id="a bust"),
        *(
            pytest.param([between(k, share) for k in range(9)], True, id=f"object, {share:.1%}")
            for share in (0.125, 0.165, 0.17)
        ),
        pytest.param([around(k, 0.6) for k in range(4)] + [NOTHING] * 5, False, id="in a few"),
        pytest.param(
            [border(0.05), border(0.05)[:50, :70], border(0.05)] * 3, False, id="two sizes"
        ),
    ],
)
def test_what_they_mean(transparent: list[np.ndarray], is_object: bool) -> None:
    assert show_an_object(transparent) == is_object


def test_an_object_that_fills_the_picture_is_told_by_its_outline() -> None:
    few = [3 + 2 * k > U for k in range(9)]
    assert 0.02 < np.median([image.mean() for image in few]) < 0.15
    assert show_an_object(few)


def test_a_bust_reaches_both_lower_corners() -> None:
    seen = ~bust(0)
    assert seen[-3:, :4].mean() > 0.5 and seen[-3:, -4:].mean() > 0.5
    assert 0.4 < bust(0).mean() < 0.6


def test_almost_opaque_is_opaque() -> None:
    image = np.zeros((2, 2, 4), np.uint8)
    image[..., 3] = [[0, 127], [128, 255]]
    assert shows_nothing(image).tolist() == [[True, True], [False, False]]
    assert not shows_nothing(image[..., :3]).any()


@pytest.mark.parametrize("downscale", [1, 2])
def test_the_few_are_ignored(tmp_path: Path, downscale: int) -> None:
    write_transforms(tmp_path, 9)
    plain = load_scene(tmp_path, downscale=downscale)
    for i in range(9):
        rgba = np.dstack([picture(i), np.full((6, 8), 255, np.uint8)])
        rgba[0, :2, 3], rgba[5, 5, 3] = 0, 254
        Image.fromarray(rgba).save(tmp_path / f"images/{i:03d}.png")
    scene = load_scene(tmp_path, downscale=downscale)
    assert scene.unbounded and not scene.has_alpha and scene.kind == plain.kind
    (warning,) = [w for w in scene.warnings if "transparent" in w]
    assert warning.startswith("transparent pixels, 4.2% of 9 of 9 images")
    for ours, theirs in zip(scene.views, plain.views, strict=True):
        mask = np.ones((6 // downscale, 8 // downscale), bool)
        mask[0, : 2 // downscale] = False
        assert ours.mask is not None and np.array_equal(ours.mask, mask)
        np.testing.assert_allclose(ours.image[mask], theirs.image[mask], atol=1)
