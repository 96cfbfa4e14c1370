"""Holes: narrow ones are closed with faces that look the same way, wide ones are told."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest

from tests.exporting.test_decimation import plane
from tests.exporting.test_mesh import RADIUS, signed_volume
from tests.support.solid_fields import LEVEL, ball_field
from warpnerf.exporting.export import export
from warpnerf.exporting.holes import filled
from warpnerf.exporting.surface import extract_surface


def pierced() -> tuple[np.ndarray, np.ndarray]:
    """A ball without the faces around two places: one hole is narrow, one wide."""
    ball = extract_surface(ball_field(), level=LEVEL)
    middles = ball.points[ball.faces].mean(axis=1) - (0.1, -0.05, 0.15)
    narrow = np.linalg.norm(middles - (RADIUS, 0, 0), axis=1) < 0.1
    wide = np.linalg.norm(middles - (-RADIUS, 0, 0), axis=1) < 0.3
    return ball.points.astype(np.float64), ball.faces[~(narrow | wide)].astype(np.int64)


def test_a_narrow_hole_is_closed_and_a_wide_one_is_told() -> None:
    points, faces = pierced()
    closed, _, widths = filled(points, faces, 0.4)
    assert len(widths) == 1 and 0.6 < widths[0] < 1.0
    assert len(closed) == len(points) + 1
    _, all_of_them, widths = filled(points, faces, 2.0)
    assert widths == []
    edges = np.concatenate([all_of_them[:, pair] for pair in ([0, 1], [1, 2], [2, 0])])
    there = {tuple(edge) for edge in edges.tolist()}
    assert len(there) == len(edges) and there == {(b, a) for a, b in there}
    volume = signed_volume(filled(points, faces, 2.0)[0], all_of_them)
    assert 0.85 < volume / (4.0 / 3.0 * np.pi * RADIUS**3) < 1.0
    untouched, same, widths = filled(points, faces, 0.0)
    assert len(untouched) == len(points) and len(same) == len(faces) and len(widths) == 2


def test_borders_that_meet_themselves_stay_open() -> None:
    """Two squares taken out of a plane that have a corner in common."""
    points, faces = plane(5)
    middles = points[faces].mean(axis=1)
    out = (np.abs(middles[:, :2] - (1.5, 1.5)).max(axis=1) < 0.5) | (
        np.abs(middles[:, :2] - (2.5, 2.5)).max(axis=1) < 0.5
    )
    _, kept, widths = filled(points, faces[~out], 3.0)
    for hole in np.unique(kept[len(faces[~out]) :]):
        assert (kept == hole).any()
    assert widths[0] == pytest.approx(5.0 * 2**0.5)  # the border of the plane


def test_open_borders_are_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    logging.getLogger("warpnerf").propagate = True
    box = ((-1.0, -1.1, -1.2), (0.1, 1.1, 1.2))
    with caplog.at_level(logging.INFO, logger="warpnerf"):
        export(ball_field(), tmp_path / "a.ply", level=LEVEL, crop=box)
        assert "the mesh has 1 open border, the widest 1.7 scene units" in caplog.text
        caplog.clear()
        export(ball_field(), tmp_path / "b.ply", level=LEVEL)
        assert "open border" not in caplog.text
