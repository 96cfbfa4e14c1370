"""Pictures hold the pixels they are given, and depth has its colours."""

from __future__ import annotations

from pathlib import Path

import imageio.v3 as iio
import numpy as np

from warpnerf.media.pictures import (
    colour_and_depth,
    comparison,
    depth_colours,
    depth_legend,
    drawable,
    font,
    picture_files,
    write_png,
)
from warpnerf.rendering.field import Rendering


def test_png_keeps_pixels_and_clips(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (7, 9, 3), dtype=np.uint8)
    rgb = pixels / 255.0
    rgb[0, 0], pixels[0, 0] = (-0.5, 0.5, 1.5), (0, 128, 255)
    write_png(tmp_path / "a.png", rgb)
    np.testing.assert_array_equal(iio.imread(tmp_path / "a.png"), pixels)
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]


def oklab(rgb: np.ndarray) -> np.ndarray:
    """Lightness, and two axes of colour, of sRGB [..., 3]; Ottosson 2020."""
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    lms = linear @ np.array(
        [
            [0.4122214708, 0.2119034982, 0.0883024619],
            [0.5363325363, 0.6806995451, 0.2817188376],
            [0.0514459929, 0.1073969566, 0.6299787005],
        ]
    )
    return np.cbrt(lms) @ np.array(
        [
            [0.2104542553, 1.9779984951, 0.0259040371],
            [0.7936177850, -2.4285922050, 0.7827717662],
            [-0.0040720468, 0.4505937099, -0.8086757660],
        ]
    )


def test_equal_steps_of_depth_look_equal() -> None:
    lab = oklab(depth_colours(np.linspace(0.0, 1.0, 17)[None], 0.0, 1.0)[0])
    steps = np.linalg.norm(np.diff(lab, axis=0), axis=1)
    assert steps.min() > 0.85 * steps.mean() and steps.max() < 1.15 * steps.mean()
    assert (np.diff(lab[:, 0]) < -0.02).all()  # darker all along: readable without colours


def test_depth_goes_from_yellow_to_blue_and_stays_there() -> None:
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


def test_over_a_wide_range_equal_steps_of_disparity_look_equal() -> None:
    disparity = np.linspace(1.0 / 2.0, 1.0 / 40.0, 17)
    rgb = depth_colours(1.0 / disparity[None], 2.0, 40.0)
    np.testing.assert_allclose(rgb, depth_colours(np.linspace(0.0, 1.0, 17)[None], 0.0, 1.0))
    beyond = depth_colours(np.array([[0.0, 1.0, 2.0, 40.0, 1e9, np.inf]]), 2.0, 40.0)[0]
    np.testing.assert_array_equal(beyond[:3], np.repeat(beyond[2:3], 3, axis=0))
    np.testing.assert_array_equal(beyond[3:], np.repeat(beyond[3:4], 3, axis=0))


def test_over_a_narrow_range_or_from_zero_equal_steps_of_depth_look_equal() -> None:
    expected = depth_colours(np.array([[0.0, 0.25, 1.0]]), 0.0, 1.0)
    for near, far in ((2.0, 10.0), (0.0, 100.0)):
        depth = near + (far - near) * np.array([[0.0, 0.25, 1.0]])
        np.testing.assert_allclose(depth_colours(depth, near, far), expected)


def test_comparison_shows_three_panels_above_the_legend() -> None:
    height, width = 6, 5
    rng = np.random.default_rng(0)
    truth, rgb = rng.random((height, width, 3)), rng.random((height, width, 3))
    opacity = np.ones((height, width))
    opacity[0] = 0.0
    depth = np.full((height, width), 2.0) * opacity
    image = comparison(truth, Rendering(rgb=rgb, depth=depth, opacity=opacity), 0.0, 4.0)
    assert image.dtype == np.uint8
    truth, rgb = (np.round(255 * panel) for panel in (truth, rgb))
    panels = image[:height]
    np.testing.assert_array_equal(panels[:, :width], truth)
    shifts = range(width, image.shape[1] - width)
    assert any((panels[:, i : i + width] == rgb).all() for i in shifts)
    last = panels[:, -width:]
    np.testing.assert_array_equal(last[0], 255)
    np.testing.assert_array_equal(last[1:], np.round(255 * depth_colours(depth, 0.0, 4.0))[1:])
    np.testing.assert_array_equal(image[height:], depth_legend(image.shape[1], 0.0, 4.0))


def test_colour_stands_left_of_depth_above_the_legend() -> None:
    rng = np.random.default_rng(0)
    rgb, depth = rng.random((6, 40, 3)), rng.uniform(1.0, 3.0, (6, 40))
    seen = Rendering(rgb=rgb, depth=depth, opacity=np.ones((6, 40)))
    image = colour_and_depth(seen, 1.0, 3.0)
    assert image.dtype == np.uint8
    np.testing.assert_array_equal(image[:6, :40], np.round(255 * rgb))
    np.testing.assert_array_equal(image[:6, -40:], np.round(255 * depth_colours(depth, 1.0, 3.0)))
    np.testing.assert_array_equal(image[6:], depth_legend(84, 1.0, 3.0))


def test_the_legend_holds_all_colours_and_says_the_range() -> None:
    legend = depth_legend(600, 1.0, 3.0).astype(int)
    middle = legend[legend.shape[0] // 2]
    for colour in np.round(255 * depth_colours(np.linspace(1.0, 3.0, 9)[None], 1.0, 3.0)[0]):
        assert np.abs(middle - colour).sum(axis=1).min() < 12
    assert (legend != depth_legend(600, 1.0, 4.0)).any()
    assert (legend != depth_legend(600, 2.0, 3.0)).any()
    for width in (1, 8, 30, 3000):
        for near in (0.0, 0.01):
            assert depth_legend(width, near, 1.0).shape[1] == width


def test_the_legend_of_a_wide_range_says_depths_between() -> None:
    legend = depth_legend(600, 2.0, 40.0).astype(int)
    bar = legend[legend.shape[0] // 3]
    colours = np.round(255 * depth_colours(np.array([[2.0, 5.0, 10.0, 20.0, 40.0]]), 2.0, 40.0)[0])
    at = [int(np.abs(bar - colour).sum(axis=1).argmin()) for colour in colours]
    assert np.abs(bar[at] - colours).sum(axis=1).max() < 12
    height = depth_legend(600, 2.0, 9.0).shape[0]
    ticks = np.flatnonzero((legend[height * 3 // 4 + 1] < 128).all(axis=1))
    middle = ticks[(ticks > at[0] + 9) & (ticks < at[-1] - 9)]
    for place in at[1:3]:  # of 5 and 10
        assert np.abs(middle - place).min() <= 2
    assert (legend[height + 2 :] < 128).any()


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


def test_names_are_drawn_in_letters_that_the_typeface_has() -> None:
    assert drawable("a_1 (b).png") == "a_1 (b).png"
    assert (
        drawable("caf\u00e9 cafe\u0301 Stra\u00dfe \u0141\u00f3d\u017a") == "cafe cafe Strasse Lodz"
    )
    assert drawable("\u4e2d\u6587\n.jpg") == "???.jpg"
    missing = bytes(font(20).getmask("\u4e2d"))
    drawn = {c for c in map(chr, range(0x3000)) if drawable(c) == c and c != " "}
    assert "~" in drawn and "\u201c" in drawn
    assert all(bytes(font(20).getmask(letter)) != missing for letter in drawn)
