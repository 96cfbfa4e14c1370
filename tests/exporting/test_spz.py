"""Compressed splats, read by a reader that was written apart."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.exporting.test_cameras import ball_scene
from tests.reference.splats import rotations
from tests.reference.spz import read_spz
from tests.support.solid_fields import ball_field, cameras_around
from warpnerf.checks import InputError
from warpnerf.exporting.export import export
from warpnerf.exporting.splats import Splats, splats_ply
from warpnerf.exporting.spz import splats_spz
from warpnerf.scenes.cameras.quaternions import to_y


def some_splats(n: int = 300) -> Splats:
    rng = np.random.default_rng(0)
    turns = rng.normal(size=(n, 4))
    return Splats(
        centres=rng.normal(size=(n, 3)).astype(np.float32),
        scales=np.exp(rng.uniform(-5.0, 1.0, (n, 3))).astype(np.float32),
        rotations=(turns / np.linalg.norm(turns, axis=1, keepdims=True)).astype(np.float32),
        opacity=rng.uniform(0.02, 0.99, n).astype(np.float32),
        rgb=rng.uniform(0.0, 1.0, (n, 3)).astype(np.float32),
    )


@pytest.mark.parametrize("up", [None, (0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (0.6, 0.0, 0.8)])
def test_what_is_read_is_what_was_written(up: tuple[float, float, float] | None) -> None:
    """With up turned to y: centres and the axes of splats."""
    made = some_splats()
    vector = None if up is None else np.array(up)
    read = read_spz(b"".join(splats_spz(made, vector)))
    assert len(read) == len(made.centres)
    turn = np.eye(3) if up is None else to_y(vector)
    if up is not None:
        np.testing.assert_allclose(turn @ up, (0.0, 1.0, 0.0), atol=1e-12)
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(turn) == pytest.approx(1.0)
    places = np.array([splat["place"] for splat in read])
    np.testing.assert_allclose(places, made.centres @ turn.T, atol=1e-5)
    alphas = np.array([splat["alpha"] for splat in read])
    np.testing.assert_allclose(alphas, made.opacity, atol=0.51 / 255)
    rgb = np.array([splat["rgb"] for splat in read])
    np.testing.assert_allclose(rgb, made.rgb, atol=0.51 * 0.282095 / 0.15 / 255)
    scales = np.array([splat["scale"] for splat in read])
    np.testing.assert_allclose(np.log(scales), np.log(made.scales), atol=0.51 / 16)
    turns = rotations(np.array([splat["wxyz"] for splat in read]))
    wanted = turn @ rotations(made.rotations.astype(float))
    cosines = np.abs(np.einsum("nij,nij->nj", turns, wanted))  # of axes: signs do not matter
    assert np.degrees(np.arccos(np.clip(cosines, 0.0, 1.0))).max() < 1.5


def test_a_run_is_exported_to_a_tenth(tmp_path: Path) -> None:
    file = export(ball_field(), tmp_path / "ball.spz", scene=ball_scene())
    ply = export(ball_field(), tmp_path / "ball.splat.ply", scene=ball_scene())
    assert file.stat().st_size < ply.stat().st_size / 5
    places = np.array([splat["place"] for splat in read_spz(file.read_bytes())])
    from warpnerf.scenes.cameras.focus import up_direction

    centre = to_y(up_direction(cameras_around()[2:])) @ (0.1, -0.05, 0.15)
    assert np.abs(np.linalg.norm(places - centre, axis=1) - 0.6).max() < 0.2


def test_far_splats_do_not_cost_the_near_ones_their_place() -> None:
    made = some_splats()
    centres = made.centres.copy()
    centres[0], centres[1] = 1e9, 200.0
    read = read_spz(b"".join(splats_spz(replace(made, centres=centres))))
    assert len(read) == len(centres) - 1
    places = np.array([splat["place"] for splat in read])
    np.testing.assert_allclose(places, centres[1:], atol=1e-4)


def test_what_the_format_cannot_hold_is_said(caplog: pytest.LogCaptureFixture) -> None:
    made = some_splats()
    centres, scales = made.centres.copy(), made.scales.copy()
    centres[0], scales[1] = 1e9, 2000.0
    with caplog.at_level("INFO"):
        splats_spz(made)
    assert not caplog.text
    with caplog.at_level("INFO"):
        splats_spz(replace(made, centres=centres, scales=scales))
    assert "1 of 300 splats lie too far out for .spz and are left out" in caplog.text
    assert "1 of 300 splats are larger than .spz has sizes for, and made smaller" in caplog.text


@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_units_that_the_format_has_not_are_refused(unit: float) -> None:
    made = some_splats()
    with pytest.raises(InputError, match=r"write \.splat\.ply"):
        splats_spz(replace(made, scales=unit * made.scales, centres=unit * made.centres))
    assert splats_ply(made)
