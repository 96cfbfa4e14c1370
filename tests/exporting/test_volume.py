"""Volumes: what they hold, where, and that Warp reads them back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import warp as wp

from tests.support.solid_fields import BOX_MAX, BOX_MIN, LEVEL, SIZE, ball_field, cameras_around
from warpnerf.checks import InputError
from warpnerf.exporting.export import export
from warpnerf.exporting.visibility import visibility
from warpnerf.exporting.volume import volume_of


def test_npz_holds_density_and_colour_at_nodes(tmp_path: Path) -> None:
    path = export(ball_field(), tmp_path / "ball.npz")
    with np.load(path, allow_pickle=False) as file:
        stored = dict(file)
    assert stored["density"].shape == SIZE and stored["density"].dtype == np.float32
    np.testing.assert_allclose(stored["box_min"], BOX_MIN)
    np.testing.assert_allclose(stored["box_max"], BOX_MAX)
    axes = [np.linspace(a, b, n) for a, b, n in zip(BOX_MIN, BOX_MAX, SIZE, strict=True)]
    away = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1) - (0.1, -0.05, 0.15)
    radii = np.linalg.norm(away, axis=-1)
    clear = np.abs(radii - 0.6) > 1e-3
    np.testing.assert_array_equal((stored["density"] > LEVEL)[clear], (radii < 0.6)[clear])
    right = away[..., 0] > 0.01
    assert np.abs(stored["rgb"][right, 0] / 255.0 - 0.8808).max() < 0.01
    assert stored["seen"].all()


def test_unseen_nodes_are_empty_and_a_crop_is_a_block() -> None:
    field = ball_field()
    volume = volume_of(
        field, visibility(field, cameras_around()), crop=((0.0, -2, -2), (2, 0.01, 2))
    )
    assert volume.density.shape == (21, 23, 49)
    np.testing.assert_allclose(volume.box_min, (0.0, -1.1, -1.2), atol=1e-9)
    np.testing.assert_allclose(volume.box_max, (1.0, 0.0, 1.2), atol=1e-9)
    assert (volume.density[~volume.seen] == 0.0).all()
    assert volume.density[2, -2, 27] == 0.0  # the middle of the ball
    assert 0.01 < volume.seen.mean() < 0.5
    with pytest.raises(InputError, match="between two nodes"):
        volume_of(field, crop=((0.01, 0, 0), (0.04, 1, 1)))
    with pytest.raises(InputError, match="fewer than two nodes"):
        volume_of(field, crop=((-0.01, 0, 0), (0.04, 1, 1)))


def test_of_folded_space_the_box_is_stored() -> None:
    volume = volume_of(ball_field(contraction="linf"))
    step = (volume.box_max - volume.box_min) / (np.array(volume.density.shape) - 1)
    np.testing.assert_allclose(step, 0.06, rtol=1e-6)
    assert (volume.box_min >= BOX_MIN - 1e-9).all() and (volume.box_min < BOX_MIN + 0.06).all()


def test_warp_reads_the_nvdb(tmp_path: Path) -> None:
    field = ball_field()
    path = export(field, tmp_path / "ball.nvdb")
    with path.open("rb") as file:
        volume = wp.Volume.load_from_nvdb(file, device="cpu")
    points = np.random.default_rng(0).uniform(-0.9, 0.9, (500, 3))
    out = wp.zeros(500, dtype=float, device="cpu")
    where = wp.array(points, dtype=wp.vec3, device="cpu")
    wp.launch(read_volume, 500, inputs=[volume.id, where, out], device="cpu")
    radii = np.linalg.norm(points - (0.1, -0.05, 0.15), axis=1)
    assert (out.numpy()[radii < 0.5] > LEVEL).all()
    assert (out.numpy()[radii > 0.7] < 1e-3).all()


@wp.kernel
def read_volume(volume: wp.uint64, points: wp.array(dtype=wp.vec3), out: wp.array(dtype=float)):
    i = wp.tid()
    place = wp.volume_world_to_index(volume, points[i])
    out[i] = wp.volume_sample_f(volume, place, wp.Volume.LINEAR)
