"""Which camera a page begins from: not one inside of something, nor one that looks away."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tests.support.solid_fields import ball_field, camera_at, cameras_around
from warpnerf.exporting.first_view import _n_seen, widest_view
from warpnerf.scenes.cameras.camera import Camera


def away_from(camera: Camera) -> Camera:
    return replace(camera, c2w=camera.c2w * [-1.0, 1.0, -1.0, 1.0])


def test_it_is_no_camera_inside_of_something_or_that_looks_away() -> None:
    inside = [camera_at((0.1, 0.3, 0.2)), camera_at((0.4, -0.1, 0.1))]
    outside = cameras_around()
    cameras = [*inside, away_from(outside[0]), outside[4], *map(away_from, outside[1:])]
    assert widest_view(ball_field(), cameras) is outside[4]


def test_it_is_the_one_that_sees_more() -> None:
    whole = camera_at((2.4, 0.0, 1.6))
    narrow = replace(camera_at((2.2, 0.9, -1.5)), fx=400.0, fy=400.0)
    assert widest_view(ball_field(), [narrow, whole]) is whole
    assert widest_view(ball_field(), [away_from(whole)] * 2) is not None  # nothing is seen


def test_points_are_seen_in_the_picture_and_before_its_depth() -> None:
    look = camera_at((3.0, 0.0, 0.0), 8, 8)
    depth = np.full((8, 8), 3.0)
    points = np.array(
        [[0.0, 0, 0], [0.2, 0, 0], [-0.3, 0, 0], [6, 0, 0], [0, 1.4, 0], [0, 1.6, 0], [0, 0, -1.4]]
    )
    assert _n_seen(look, depth, points) == 2
    assert _n_seen(look, np.full((8, 8), np.inf), points) == 5
