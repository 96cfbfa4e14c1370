"""Batches of pixels in a random order: each ray a function of its step and the seed."""

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
import warp as wp

from tests.training.test_determinism import small_scene
from warpnerf.checks import InputError, require_rays
from warpnerf.fields.lattice import Lattice
from warpnerf.fields.occupancy import FreeCells
from warpnerf.rendering.rays import PixelSampler, RayBatch, camera_rays, runs_of
from warpnerf.runtime.parallel import Workers
from warpnerf.scenes.scene import View

N_RAYS = 64


def sampler(device: str, seed: int = 0) -> PixelSampler:
    views, workers = small_scene().views, Workers(device, 2)
    distances = 2.0 + np.arange(len(views))
    return PixelSampler(views, distances, None, N_RAYS, True, seed, workers)


def drawn(batch: RayBatch) -> dict[str, np.ndarray]:
    return {field.name: getattr(batch, field.name).numpy().copy() for field in fields(batch)}


def test_more_pixels_than_kernels_count_are_refused() -> None:
    camera = replace(small_scene().cameras[0], width=70_000, height=40_000)
    with pytest.raises(InputError, match=r"fewer than 2\^31 pixels, not 70000 x 40000"):
        camera_rays(camera, Workers("cpu", 1))


@pytest.mark.parametrize("dtype", [object, "U3", "M8[s]", complex, bool])
def test_rays_are_of_real_numbers(dtype: Any) -> None:
    rays = np.zeros((2, 3)), np.array([[0.0, 0.0, 1.0]] * 2)
    require_rays(*rays)
    for wrong in (0, 1):
        given = [
            array.astype(int).astype(dtype) if k == wrong else array for k, array in enumerate(rays)
        ]
        with pytest.raises(InputError, match=r"^(origins|directions) must be real numbers, not "):
            require_rays(*given)


@pytest.mark.parametrize("n_steps", [1, 2, 5])
def test_batches_of_several_steps_are_those_of_each(n_steps: int, device: str) -> None:
    single, several = sampler(device), sampler(device)
    each = [drawn(single.draw(step)) for step in range(3, 3 + n_steps)]
    for _ in range(2):  # the second time into the same arrays
        together = several.draw(3, n_steps)
        assert together.count == n_steps * N_RAYS
        for name, found in drawn(together).items():
            assert np.array_equal(found, np.concatenate([one[name] for one in each]))
    assert np.array_equal(drawn(several.draw(3))["directions"], each[0]["directions"])


def test_each_camera_s_rays_have_its_distance(device: str) -> None:
    batch = drawn(sampler(device).draw(0))
    centres = np.array([view.camera.position for view in small_scene().views])
    away = np.linalg.norm(batch["origins"][:, None] - centres, axis=2)
    assert away.min(axis=1).max() < 1e-6
    np.testing.assert_array_equal(batch["content_distance"], 2.0 + away.argmin(axis=1))
    assert len(np.unique(batch["content_distance"])) > 2


def test_steps_and_seeds_draw_what_is_their_own(device: str) -> None:
    batches = [
        drawn(sampler(device, seed).draw(step))["directions"]
        for seed, step in ((0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (2**63 - 1, 0))
    ]
    for number, one in enumerate(batches):
        for other in batches[:number]:
            assert (one != other).any(axis=1).mean() > 0.9
    assert len(np.unique(drawn(sampler(device).draw(2**40))["directions"], axis=0)) == N_RAYS


def masked_views() -> list[View]:
    """Three photographs that say in every pixel which one it is.

    The second has no mask, the third has alpha besides.
    """
    views = []
    for number, view in enumerate(small_scene().views[:3]):
        height, width = view.image.shape[:2]
        row, column = np.indices((height, width))
        image = np.stack([row, column, np.full_like(row, number)], axis=2).astype(np.uint8)
        if number == 2:
            image = np.dstack([image, np.full((height, width), 255, np.uint8)])
        mask = np.random.default_rng(number).random((height, width)) < 0.4 - 0.1 * number
        mask[: 2 + number] = number == 0
        views.append(replace(view, image=image, mask=None if number == 1 else mask))
    return views


def test_masked_pixels_are_never_drawn_and_all_others_alike(device: str) -> None:
    views = masked_views()
    counting = [np.ones(v.image.shape[:2], bool) if v.mask is None else v.mask for v in views]
    n_counting = sum(int(mask.sum()) for mask in counting)
    n_rays = 400 * n_counting + 7
    away = np.full(len(views), 2.0)
    sampler = PixelSampler(views, away, (0.0, 0.0, 0.0), n_rays, False, 3, Workers(device, 2))
    batch = drawn(sampler.draw(0))
    row, column, number = np.round(255.0 * batch["target_rgb"]).astype(int).T
    counts = np.zeros((len(views), *counting[0].shape), int)
    np.add.at(counts, (number, row, column), 1)
    assert (counts[~np.stack(counting)] == 0).all()
    found = counts[np.stack(counting)]
    assert set(found) == {400, 401} and (found == 401).sum() == 7
    for index, view in enumerate(views):
        rays = camera_rays(view.camera, Workers(device, 1))[1].numpy()
        at = row[number == index] * view.camera.width + column[number == index]
        assert np.array_equal(batch["directions"][number == index], rays[at])


def test_a_mask_of_all_pixels_changes_no_bit(device: str) -> None:
    views = small_scene().views
    whole = [replace(v, mask=np.ones(v.image.shape[:2], bool)) for v in views]
    options = (np.full(len(views), 2.0), None, N_RAYS, True, 0, Workers(device, 2))
    for edge in (1.0, 2.5):
        batches = []
        for photographs in (views, whole):
            sampler = PixelSampler(photographs, *options)
            sampler.average_over(edge)
            batches.append(drawn(sampler.draw(5)))
        for name, found in batches[0].items():
            assert np.array_equal(found, batches[1][name])


def test_averages_are_of_pixels_from_now_on_and_until_one(device: str) -> None:
    one, other = sampler(device), sampler(device)
    other.average_over(2.5)
    single, mean = drawn(one.draw(3)), drawn(other.draw(3))
    for name, found in single.items():
        assert np.array_equal(found, mean[name]) == (name != "target_rgb")
    other.average_over(1.0)
    assert np.array_equal(drawn(other.draw(3))["target_rgb"], single["target_rgb"])


MIDDLE = np.array([14, 10, 7])
"""Of the cells that are occupied, which each view sees elsewhere."""


def little_occupied(views: list[View]) -> tuple[Lattice, FreeCells]:
    """A lattice around what the views look at, of whose cells 3 x 3 x 3 are occupied."""
    steps = np.abs(np.indices((21, 21, 21)) - MIDDLE[:, None, None, None]).max(0)
    distance = np.clip(steps - 1, 0, 9).astype(np.uint8)
    lattice = Lattice(size=(43, 43, 43), box_min=np.full(3, -1.0), box_max=np.full(3, 1.0))
    assert len(views) == 3
    cells = wp.array(distance.ravel(), dtype=wp.uint8, device="cpu")
    return lattice, FreeCells(distance=cells, size=(21, 21, 21), border=0.0)


def test_pixels_around_what_is_there_are_not_drawn_and_all_others_alike(on_cpu: None) -> None:
    views = masked_views()
    n_counting = sum(v.image[..., 0].size if v.mask is None else int(v.mask.sum()) for v in views)
    n_rays = 40 * n_counting
    options = ((0.0, 0.0, 0.0), n_rays, False, 3, Workers("cpu", 2))
    sampler = PixelSampler(views, np.full(len(views), 2.0), *options)
    before = drawn(sampler.draw(0))
    share = sampler.cull_background(*little_occupied(views))
    assert 0.02 < share < 0.6
    batch = drawn(sampler.draw(0))
    row, column, number = np.round(255.0 * batch["target_rgb"]).astype(int).T
    height, width = views[0].image.shape[:2]
    counts = np.zeros((len(views), height, width), int)
    np.add.at(counts, (number, row, column), 1)
    masks = np.stack([np.ones((height, width), bool) if v.mask is None else v.mask for v in views])
    assert (counts[~masks] == 0).all()
    # Whole blocks are drawn from, or left out.
    pad = ((0, 0), (0, -height % 4), (0, -width % 4))
    blocks = np.pad(counts, pad).reshape(3, -(-height // 4), 4, -(-width // 4), 4)
    in_block = (blocks.sum((2, 4)) > 0).repeat(4, 1).repeat(4, 2)[:, :height, :width]
    assert 0.0 < in_block[masks].mean() < 0.7
    assert len(batch["offsets"]) == round(share * n_rays) == counts.sum()
    assert set(counts[in_block & masks]) == {40}
    # No ray that passes the cell is left out.
    for index, view in enumerate(views):
        origins, directions = (a.numpy() for a in camera_rays(view.camera, Workers("cpu", 1)))
        low, high = ((MIDDLE + edge) * 2 / 21 - 1 for edge in (-1, 2))
        a, b = (low - origins) / directions, (high - origins) / directions
        meets = np.maximum(a, b).min(1) >= np.minimum(a, b).max(1)
        assert meets.any() and in_block[index].ravel()[meets].all()
    # What is left is drawn as before, in the same order.
    row, column, number = np.round(255.0 * before["target_rgb"]).astype(int).T
    left = in_block[number, row, column]
    for name, values in batch.items():
        assert np.array_equal(values, before[name][left])


def test_the_share_that_is_drawn_is_of_pixels_that_count(on_cpu: None) -> None:
    """Masks that keep only what meets something leave nothing out."""
    views = small_scene().views[:3]
    options = (np.full(3, 2.0), (0.0, 0.0, 0.0), 1000, False, 3, Workers("cpu", 2))
    whole = PixelSampler(views, *options)
    share = whole.cull_background(*little_occupied(views))
    drawn_from = drawn(whole.draw(0))
    assert 0.02 < share < 0.6 and len(drawn_from["offsets"]) == pytest.approx(1000 * share, rel=0.2)
    covered = whole._source.covered.numpy() != 0
    first = whole._source.first_blocks.numpy()
    masked = []
    for view, begin in zip(views, first, strict=True):
        height, width = view.image.shape[:2]
        edge = whole._source.block
        across = -(-width // edge)
        rows, columns = np.mgrid[:height, :width] // edge
        masked.append(replace(view, mask=covered[begin + rows * across + columns]))
    assert PixelSampler(masked, *options).cull_background(*little_occupied(views)) == 1.0


def test_of_few_pixels_that_are_left_there_is_one_ray_at_least(on_cpu: None) -> None:
    views = small_scene().views[:3]
    options = (np.full(3, 2.0), (0.0, 0.0, 0.0), 20, False, 3, Workers("cpu", 2))
    sampler = PixelSampler(views, *options)
    sampler.cull_background(*little_occupied(views))
    few = np.zeros(len(sampler._source.covered), np.uint8)
    few[:: len(few) // 2] = 1  # two or three blocks
    sampler._source.covered.assign(few)
    batches = [drawn(sampler.draw(step)) for step in range(50)]
    counts = [len(batch["offsets"]) for batch in batches]
    assert min(counts) == 1 and sum(counts) < 120
    for batch in batches:
        assert np.allclose(np.linalg.norm(batch["directions"], axis=1), 1.0, atol=1e-6)
    together = drawn(sampler.draw(0, 50))["directions"]
    each = [batch["directions"] for batch in batches]
    covered = np.unique(together, axis=0)
    left = [d for d in each if len(d) > 1 or (d == covered[:, None]).all(-1).any()]
    assert np.array_equal(together, np.concatenate(left))


@pytest.mark.parametrize("parts", [2, 3])
def test_shares_make_the_batch(parts: int, device: str) -> None:
    """Also where some are left out; each has room for more than it is given."""
    views = small_scene().views[:3]
    options = (np.full(3, 2.0), None, 500, True, 3, Workers(device, 2))
    sampler = PixelSampler(views, *options)
    for _ in range(2):
        whole = drawn(sampler.draw(4, 2))
        shares = [drawn(sampler.draw(4, 2, (part, parts))) for part in range(parts)]
        for name, values in whole.items():
            assert np.array_equal(values, np.concatenate([share[name] for share in shares]))
        sampler.cull_background(*little_occupied(views))


def test_where_nothing_or_everything_is_seen_all_pixels_are_drawn(on_cpu: None) -> None:
    views = masked_views()
    options = ((0.0, 0.0, 0.0), 500, False, 3, Workers("cpu", 2))
    sampler = PixelSampler(views, np.full(len(views), 2.0), *options)
    before = drawn(sampler.draw(7))
    lattice, free = little_occupied(views)
    for distance in (0, 9):
        free.distance.fill_(distance)
        assert sampler.cull_background(lattice, free) == 1.0
        for name, found in drawn(sampler.draw(7)).items():
            assert np.array_equal(found, before[name])


def test_runs_by_hand() -> None:
    mask = np.array([[0, 1, 1, 0], [1, 0, 0, 1], [1, 1, 0, 1]], bool)
    assert runs_of(mask).tolist() == [[0, 1], [2, 4], [3, 7], [6, 11]]
    assert runs_of(np.ones((2, 3), bool)).tolist() == [[0, 0]]
