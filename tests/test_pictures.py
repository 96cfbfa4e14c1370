"""Pictures hold the pixels they are given, and depth has its colours."""

from __future__ import annotations

from pathlib import Path

import imageio.v3 as iio
import numpy as np

from warpnerf.field import Rendering
from warpnerf.pictures import comparison, depth_colours, picture_files, write_png


def test_png_keeps_pixels_and_clips(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (7, 9, 3), dtype=np.uint8)
    rgb = pixels / 255.0
    rgb[0, 0], pixels[0, 0] = (-0.5, 0.5, 1.5), (0, 128, 255)
    write_png(tmp_path / "a.png", rgb)
    np.testing.assert_array_equal(iio.imread(tmp_path / "a.png"), pixels)
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]


def test_depth_goes_from_red_to_blue_and_stays_there() -> None:
    rgb = depth_colours(np.array([[0.0, 1.0, 3.0, 5.0, 9.0]]), 1.0, 5.0)
    assert rgb.shape == (1, 5, 3)
    near, far = rgb[0, 1], rgb[0, 3]
    assert near.argmax() == 0
    assert far.argmax() == 2
    np.testing.assert_array_equal(rgb[0, 0], near)
    np.testing.assert_array_equal(rgb[0, 4], far)


def test_different_depths_have_different_colours() -> None:
    rgb = depth_colours(np.linspace(2.0, 6.0, 50), 2.0, 6.0)
    assert ((rgb >= 0.0) & (rgb <= 1.0)).all()
    distance = np.linalg.norm(rgb[:, None] - rgb[None], axis=2)
    assert distance[~np.eye(50, dtype=bool)].min() > 0.01


def test_comparison_shows_three_panels() -> None:
    height, width = 6, 5
    rng = np.random.default_rng(0)
    truth, rgb = rng.random((height, width, 3)), rng.random((height, width, 3))
    opacity = np.ones((height, width))
    opacity[0] = 0.0
    depth = np.full((height, width), 2.0) * opacity
    image = comparison(truth, Rendering(rgb=rgb, depth=depth, opacity=opacity), 0.0, 4.0)
    np.testing.assert_array_equal(image[:, :width], truth)
    assert any((image[:, i : i + width] == rgb).all() for i in range(width, image.shape[1] - width))
    last = image[:, -width:]
    np.testing.assert_array_equal(last[0], 1.0)
    np.testing.assert_allclose(last[1:], depth_colours(depth, 0.0, 4.0)[1:])


def test_every_view_gets_a_picture_of_its_own() -> None:
    names = ["a/b.png", "a_b.png", "a_B.png", "a_b_2.png", "c.jpg", "c.jpg.png", "c.png"]
    assert picture_files(names) == {
        "a/b.png": "a_b.png",
        "a_b.png": "a_b_2.png",
        "a_B.png": "a_B_3.png",
        "a_b_2.png": "a_b_2_2.png",
        "c.jpg": "c.jpg.png",
        "c.jpg.png": "c.jpg_2.png",
        "c.png": "c.png",
    }


def test_names_of_pictures_fit_a_file_system(tmp_path: Path) -> None:
    long = "images/" + 240 * "x"
    names = [f"{long}1.png", f"{long}2.png", "\u00e4" * 240 + ".png", "\ud800.png"]
    files = picture_files(names)
    for name in files.values():
        write_png(tmp_path / name, np.zeros((2, 2, 3)))
    assert len(list(tmp_path.iterdir())) == len(names)
    assert files[names[0]].endswith("x1.png")
