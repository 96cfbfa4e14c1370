"""Pixels of photographs that are drawn: their order, what rays see through them, and averages."""

from typing import Any

import numpy as np
import pytest
import warp as wp
from warpnerf_kernels.space import camera as camera32

from tests.kernels.test_camera_rays import (
    CX,
    CY,
    FX,
    FY,
    HEIGHT,
    LENSES,
    WIDTH,
    expected_rays,
    pose,
    view,
)
from tests.support.kernel_runner import Kernels
from tests.support.problems import unit
from warpnerf.runtime.parallel import NODES


def draw(
    kernels: Kernels,
    n: int,
    seed: int,
    background: Any,
    mode: int,
    jitter: int,
    rays_before: int = 0,
    at_once: int = NODES,
) -> dict[str, Any]:
    """Pixels of three views; the red and green of each pixel say which one it is.

    The first view has no alpha.
    """
    views, photographs = [], []
    for number in range(3):
        v, u = np.divmod(np.arange(WIDTH * HEIGHT), WIDTH)
        rgba = np.stack([u, v, np.full_like(u, 100 * number), np.full_like(u, 51)], axis=-1)
        channels = 3 if number == 0 else 4
        pixels = rgba[:, :channels].astype(np.uint8).ravel()
        photographs.append(wp.array(pixels, dtype=wp.uint8, device=kernels.device))
        place = {"first_pixel": number * WIDTH * HEIGHT, "channels": channels}
        lens = LENSES[2]
        views.append(view(kernels, pose(number), lens, pixels=photographs[-1], **place))
    rays, target = launch_draw(
        kernels, n, source_of(kernels, views), seed, background, mode, jitter, rays_before, at_once
    )
    fields = ("origins", "directions", "offsets", "background", "content_distance")
    return {"target": target.numpy(), **{name: getattr(rays, name).numpy() for name in fields}}


def source_of(kernels: Kernels, views: list[Any], pixels_of_view: int = WIDTH * HEIGHT) -> Any:
    """Three photographs to draw from, anywhere."""
    camera = kernels.module("space.camera")
    source = camera.PixelSource()
    source.views = wp.array(views, dtype=camera.CameraParams, device=kernels.device)
    source.n_pixels = 3 * pixels_of_view
    source.content_distances = kernels.array([2.0, 3.0, 5.0])
    source.block = 1
    source.first_blocks = wp.empty(0, dtype=wp.int32, device=kernels.device)
    source.covered = wp.empty(0, dtype=wp.uint8, device=kernels.device)
    return source


def launch_draw(
    kernels: Kernels,
    n: int,
    source: Any,
    seed: int,
    background: Any = (0.0, 0.0, 0.0),
    mode: int = 0,
    jitter: int = 0,
    rays_before: int = 0,
    at_once: int = NODES,
    which: Any = None,
) -> tuple[Any, Any]:
    """A batch's rays, and what they should see."""
    camera, vec3 = kernels.module("space.camera"), kernels.types.vec3
    how, rays, target = camera.Draw(), kernels.types.Rays(), kernels.zeros(n, vec3)
    how.seed, how.rays_before, how.jitter = seed, rays_before, jitter
    how.background, how.background_mode = vec3(*background), mode
    rays.origins, rays.directions = kernels.zeros(n, vec3), kernels.zeros(n, vec3)
    rays.offsets, rays.content_distance = kernels.zeros(n), kernels.zeros(n)
    rays.background = kernels.zeros(n, vec3)
    if which is None:
        which = wp.zeros(n, dtype=wp.int32, device=kernels.device)
    picked = [wp.zeros(n, dtype=wp.int32, device=kernels.device) for _ in range(2)]
    picks = wp.array(np.arange(n), dtype=wp.int32, device=kernels.device)
    kernels.workers.launch(camera.pick_pixels, n, source, how, *picked, at_once=at_once)
    given = source, *picked, picks, how, rays, target, which
    kernels.workers.launch(camera.sample_pixels, n, *given, at_once=at_once)
    return rays, target


def test_sampled_pixels_are_their_rays(kernels64: Kernels) -> None:
    black = draw(kernels64, 5000, 7, (0.0, 0.0, 0.0), 0, 0)
    white = draw(kernels64, 5000, 7, (1.0, 1.0, 1.0), 0, 0)
    assert (black["offsets"] == 0.5).all()
    assert (black["background"] == 0.0).all() and (white["background"] == 1.0).all()
    number = np.searchsorted([2.0, 3.0, 5.0], black["content_distance"])
    counts = np.bincount(number, minlength=3)
    assert (np.abs(counts - 5000 / 3) < 200).all()
    alpha = np.where(number == 0, 1.0, 0.2)[:, None]
    np.testing.assert_allclose(white["target"] - black["target"], np.tile(1 - alpha, 3), atol=1e-12)
    pixel = black["target"] / alpha * 255.0
    np.testing.assert_allclose(pixel[:, 2], 100 * number, atol=1e-9)
    u, v = pixel[:, 0].round().astype(int), pixel[:, 1].round().astype(int)
    assert len(np.unique(number * WIDTH * HEIGHT + v * WIDTH + u)) == 5000
    for k in range(3):
        of_view = number == k
        origins, directions = expected_rays(pose(k), LENSES[2])
        at = v[of_view], u[of_view]
        np.testing.assert_allclose(black["origins"][of_view], origins[at], rtol=1e-14)
        np.testing.assert_allclose(black["directions"][of_view], directions[at], atol=1e-12)


def test_exposures_are_taken_out_of_pixels_before_their_background(kernels64: Kernels) -> None:
    """And rays say whose pixel they see, but where that is not opaque."""
    n, vec3 = 600, kernels64.types.vec3
    photographs = [
        wp.array(np.tile(rgba, WIDTH * HEIGHT), dtype=wp.uint8, device=kernels64.device)
        for rgba in ([51, 102, 153], [51, 102, 153, 255], [51, 102, 153, 102])
    ]
    views = [
        view(kernels64, pose(k), {}, pixels=pixels, channels=3 + (k > 0), first_pixel=k * 4800)
        for k, pixels in enumerate(photographs)
    ]
    source = source_of(kernels64, views)
    gains, offsets = 0.5 + np.arange(9.0).reshape(3, 3), 0.01 * np.arange(9.0).reshape(3, 3)
    source.gains, source.offsets = kernels64.array(gains, vec3), kernels64.array(offsets, vec3)
    which = wp.zeros(n, dtype=wp.int32, device=kernels64.device)
    rays, target = launch_draw(kernels64, n, source, 7, (0.3, 0.6, 0.9), which=which)
    number = np.searchsorted([2.0, 3.0, 5.0], rays.content_distance.numpy())
    pixel = (np.array([0.2, 0.4, 0.6]) - offsets) / gains
    pixel[2] = 0.4 * pixel[2] + 0.6 * np.array([0.3, 0.6, 0.9])
    np.testing.assert_allclose(target.numpy(), pixel[number], atol=1e-12)
    np.testing.assert_array_equal(which.numpy(), np.array([0, 1, -1])[number])


def mean_over_square(image: Any, edge: float) -> Any:
    """Of each pixel: the integral of the photograph over a square around its middle, by its area.

    Summed over a fine raster; edges that are multiples of a quarter pixel are exact.
    """
    fine = 8
    pad = 4
    padded = np.pad(image, [(pad, pad), (pad, pad), (0, 0)], mode="edge")
    fine_image = padded.repeat(fine, axis=0).repeat(fine, axis=1)
    half = round(edge * fine / 2)
    found = np.zeros_like(image)
    for row, column in np.ndindex(*image.shape[:2]):
        y, x = (int((at + pad + 0.5) * fine) for at in (row, column))
        square = fine_image[y - half : y + half, x - half : x + half]
        found[row, column] = square.mean(axis=(0, 1))
    return found


@pytest.mark.parametrize("edge", [0.0, 1.0, 1.5, 2.0, 2.75, 3.0, 4.0])
def test_pixels_are_averaged_over_a_square(kernels64: Kernels, edge: float) -> None:
    """By their alpha, with exposures taken out; but not where there is a mask."""
    n, vec3, rng = 3 * WIDTH * HEIGHT, kernels64.types.vec3, np.random.default_rng(4)
    images = [
        rng.integers(0, 256, (HEIGHT, WIDTH, 3 + (k == 1))).astype(np.uint8) for k in range(3)
    ]
    images[1][..., 3] = np.where(rng.random((HEIGHT, WIDTH)) < 0.7, 255, images[1][..., 3])
    images[1][:20, :20, 3] = 255
    images[0][:15, :40] //= 2
    images[0][:15, :40] += 1
    images[1][:20, :20, :3] //= 2
    images[1][:20, :20, :3] += 1
    photographs = [
        wp.array(image.ravel(), dtype=wp.uint8, device=kernels64.device) for image in images
    ]
    views = [
        view(kernels64, pose(k), {}, pixels=pixels, channels=3 + (k == 1), first_pixel=k * 4800)
        for k, pixels in enumerate(photographs)
    ]
    runs = wp.array([[0, 0]], dtype=wp.vec2i, device=kernels64.device)  # all of them in one
    views[2].runs = runs
    source = source_of(kernels64, views)
    source.average = edge
    gains, offsets = 0.5 + np.arange(9.0).reshape(3, 3), 0.01 * np.arange(9.0).reshape(3, 3)
    source.gains, source.offsets = kernels64.array(gains, vec3), kernels64.array(offsets, vec3)
    which = wp.zeros(n, dtype=wp.int32, device=kernels64.device)
    behind = np.array([0.3, 0.6, 0.9])
    rays, target = launch_draw(kernels64, n, source, 7, behind, which=which)
    number = np.searchsorted([2.0, 3.0, 5.0], rays.content_distance.numpy())
    directions = rays.directions.numpy()
    for k, image in enumerate(images):
        alpha = image[..., 3:] / 255.0 if k == 1 else np.ones((HEIGHT, WIDTH, 1))
        seen = np.dstack([alpha * (image[..., :3] / 255.0 - offsets[k]) / gains[k], alpha])
        mean = mean_over_square(seen, 1.0 if k == 2 else max(edge, 1.0))
        expected = (mean[..., :3] + (1.0 - mean[..., 3:]) * behind).reshape(-1, 3)
        through = expected_rays(pose(k), {})[1].reshape(-1, 3)
        of_view = np.flatnonzero(number == k)
        pixel = np.array([(through @ directions[i]).argmax() for i in of_view])
        assert np.array_equal(np.sort(pixel), np.arange(WIDTH * HEIGHT))
        np.testing.assert_allclose(target.numpy()[of_view], expected[pixel], rtol=0, atol=1e-9)
        tells = mean[..., 3] > 0.999
        if k < 2 and edge > 1.0:  # no mean of what is cut off, of any part in it
            cut = np.isin(image[..., :3], (0, 255)).any(axis=2)
            tells &= mean_over_square(cut[..., None].astype(float), edge)[..., 0] == 0.0
        tells = tells.ravel()[pixel]
        assert (tells.mean() > 0.02 and (k == 2) == tells.all()) or edge <= 1.0
        assert np.array_equal(which.numpy()[of_view], np.where(tells, k, -1))


def test_all_pixels_are_drawn_before_any_is_again(kernels64: Kernels) -> None:
    """In an order of their own each time, in which near ones are far apart."""
    n = 3 * WIDTH * HEIGHT
    found = draw(kernels64, 3 * n + 7, 7, (0.0, 0.0, 0.0), 0, 0)
    number = np.searchsorted([2.0, 3.0, 5.0], found["content_distance"])
    u, v = np.round(found["target"][:, :2].T * 255.0 / np.where(number == 0, 1.0, 0.2)).astype(int)
    pixels = number * WIDTH * HEIGHT + v * WIDTH + u
    epochs = pixels[: 3 * n].reshape(3, n)
    assert (np.sort(epochs, axis=1) == np.arange(n)).all()
    assert len(np.unique(pixels[3 * n :])) == 7
    places = [np.arange(n), *epochs]
    between = np.corrcoef([*places, np.roll(epochs[0], 1), np.roll(epochs[0], 2)])
    assert np.abs(between - np.eye(len(between))).max() < 0.05
    for epoch in epochs:  # as many of each photograph in each batch, but for chance
        counts = np.stack([np.bincount(b, minlength=3) for b in (epoch // 4800).reshape(144, 100)])
        assert 20.0 < counts.var(axis=0).mean() < 25.0  # 100 * 1/3 * 2/3, less what is not put back


@wp.kernel(enable_backward=False)
def shuffle_all(n: wp.int64, seed: int, epoch: int, out: wp.array(dtype=wp.int64)):
    place = wp.tid()
    out[place] = wp.int64(camera32.shuffled(wp.uint64(place), wp.uint64(n), seed, epoch))


@pytest.mark.parametrize("n", [1, 2, 3, 5, 16, 17, 100, 4096, 4097])
def test_an_order_has_each_number_once(n: int, on_cpu: None) -> None:
    out = wp.zeros(n, dtype=wp.int64, device="cpu")
    orders = []
    for seed, epoch in ((0, 0), (0, 1), (1, 0), (2**31 - 1, 2**31 - 1)):
        wp.launch(shuffle_all, n, inputs=[n, seed, epoch, out], device="cpu")
        orders.append(out.numpy().copy())
        assert np.array_equal(np.sort(orders[-1]), np.arange(n))
    if n > 10:
        assert all((a != b).mean() > 0.8 for k, a in enumerate(orders) for b in orders[:k])


def test_pixels_beyond_32_bits_are_drawn_evenly(kernels32: Kernels) -> None:
    """Three photographs of 2^31 - 1 pixels each, all of which lie in one place."""
    n, pixels = 20_000, 2**31 - 1
    black = wp.zeros(3, dtype=wp.uint8, device=kernels32.device)
    views = []
    for number in range(3):
        place = {"first_pixel": number * pixels, "channels": 0, "pixels": black}
        views.append(view(kernels32, pose(number), {}, width=2**16, height=2**15, **place))
    rays, _target = launch_draw(kernels32, n, source_of(kernels32, views, pixels), 7)
    number = np.searchsorted([2.0, 3.0, 5.0], rays.content_distance.numpy())
    assert (np.abs(np.bincount(number, minlength=3) - n / 3) < 300).all()
    for k in range(3):
        # Rows and columns from the rays, as far as float32 tells them.
        local = rays.directions.numpy()[number == k] @ pose(k)[:, :3]
        u, v = CX - FX * local[:, 0] / local[:, 2], CY + FY * local[:, 1] / local[:, 2]
        for values, size in ((u, 2**16), (v, 2**15)):
            share = np.histogram(values / size, bins=8, range=(0.0, 1.0))[0] / len(values)
            assert np.abs(share - 0.125).max() < 0.02


def test_random_background_and_jitter(kernels64: Kernels) -> None:
    drawn = draw(kernels64, 5000, 11, (0.0, 0.0, 0.0), 1, 1)
    for values in (*drawn["background"].T, drawn["offsets"]):
        assert values.min() >= 0.0 and values.max() < 1.0
        assert abs(values.mean() - 0.5) < 0.02 and abs(values.std() - 12**-0.5) < 0.01
    together = np.corrcoef(np.column_stack([drawn["background"], drawn["offsets"]]).T)
    assert np.abs(together - np.eye(4)).max() < 0.06
    # a pixel with alpha shows its own ray's background
    number = np.searchsorted([2.0, 3.0, 5.0], drawn["content_distance"])
    see_through = number == 1
    blue = drawn["target"][see_through, 2]
    expected = 0.2 * 100 / 255 + 0.8 * drawn["background"][see_through, 2]
    np.testing.assert_allclose(blue, expected, atol=1e-12)


def test_a_batch_is_a_function_of_its_seed(kernels32: Kernels) -> None:
    one, same = (draw(kernels32, 300, 5, (0.0, 0.0, 0.0), 1, 1) for _ in range(2))
    other = draw(kernels32, 300, 6, (0.0, 0.0, 0.0), 1, 1)
    for name in one:
        assert np.array_equal(one[name], same[name])
    assert not np.array_equal(one["directions"], other["directions"])
    assert np.allclose(unit(one["directions"]), one["directions"], atol=1e-6)


def test_rays_are_counted_through_the_training(kernels32: Kernels) -> None:
    options = (5, (0.0, 0.0, 0.0), 1, 1)
    whole = draw(kernels32, 300, *options, rays_before=2**32 - 100, at_once=7)
    parts = [
        draw(kernels32, n, *options, rays_before=before)
        for n, before in ((60, 2**32 - 100), (40, 2**32 - 40), (200, 2**32))
    ]
    for name, found in whole.items():
        assert np.array_equal(found, np.concatenate([part[name] for part in parts]))
