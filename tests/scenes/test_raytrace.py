"""The ray tracer: what it leaves out to be quick changes nothing."""

from collections.abc import Callable, Iterator

import numpy as np
import pytest

from warpnerf.scenes.builtin import raytrace, room
from warpnerf.scenes.builtin.raytrace import Tracer, in_threads
from warpnerf.scenes.builtin.solids import Ball, Box, Cylinder, make_rays
from warpnerf.scenes.cameras.camera import Camera


@pytest.fixture
def build() -> Iterator[Callable[[], Tracer]]:
    """Light the room again."""

    def build() -> Tracer:
        room._tracer.cache_clear()
        return room._tracer()

    yield build
    room._tracer.cache_clear()


def test_results_come_in_the_order_of_the_items() -> None:
    assert in_threads(lambda n: n * n, range(50)) == [n * n for n in range(50)]


def test_light_depends_neither_on_threads_nor_on_what_is_lit_together(
    build: Callable[[], Tracer], monkeypatch: pytest.MonkeyPatch
) -> None:
    first = build()._baked
    assert first.shape[1] > 50_000 and first.std() > 0.1
    monkeypatch.setattr(raytrace, "usable_cores", lambda: 1)
    monkeypatch.setattr(raytrace, "_GROUP", 700)
    monkeypatch.setattr(raytrace, "_CELL", 0.3)
    np.testing.assert_array_equal(build()._baked, first)


def test_a_node_needs_only_the_solids_in_its_reach() -> None:
    """Against all solids that cast shadows, whether near or not."""
    rng = np.random.default_rng(0)
    tracer = room._tracer()
    tested = 0
    for _ in range(20):
        centre = rng.uniform(room.ROOM_MIN, room.ROOM_MAX)
        origins = rng.normal(centre[:, None, None], 0.3, (3, 1, 100)).astype(np.float32)
        ends = rng.uniform(room.ROOM_MIN, room.ROOM_MAX)[:, None, None]
        ends = rng.normal(ends, 0.2, (3, 9, 1)).astype(np.float32)
        rays = make_rays(origins, ends - origins)
        hits = [solid.hit(rays) for solid in tracer.solids if not solid.glow]
        expected = np.minimum(np.fmin.reduce(hits), 1.0)
        np.testing.assert_array_equal(tracer._nearest(origins, ends - origins), expected)
        tested += np.count_nonzero((expected > 0.0) & (expected < 1.0))
        assert not tracer._in_reach(origins, ends - origins).all(axis=1).all()
    assert tested > 1000


def turned(rng: np.random.Generator) -> np.ndarray:
    """A rotation [3, 3]."""
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return q * np.linalg.det(q)


def seen_from(position: np.ndarray, rotation: np.ndarray) -> None:
    """A wide picture's depth is the first of all hits."""
    c2w = np.column_stack([rotation, position])
    camera = Camera(width=40, height=30, fx=8.0, fy=8.0, cx=20.0, cy=15.0, c2w=c2w)
    v, u = np.mgrid[:30, :40] + 0.5
    local = np.stack([(u - 20) / 8, (15 - v) / 8, -np.ones_like(u)], axis=-1).reshape(-1, 3)
    directions = local @ rotation.T
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    expected = room.first_hit(np.tile(position, (len(directions), 1)), directions)
    np.testing.assert_allclose(room._tracer().depth(camera).ravel(), expected, rtol=1e-6)


def test_every_solid_in_sight_is_drawn_whichever_way_the_camera_is_turned() -> None:
    rng = np.random.default_rng(1)
    seen = 0
    for _ in range(60):
        position = rng.uniform(room.ROOM_MIN, room.ROOM_MAX)
        rotation = turned(rng)
        if room.first_hit(position[None], -rotation[None, :, 2])[0] > 0.0:
            seen_from(position, rotation)
            seen += 1
    assert seen > 40


@pytest.mark.parametrize("gap", [1e-7, 1e-5, 2e-3])
def test_what_touches_the_camera_is_drawn(gap: float) -> None:
    rng = np.random.default_rng(2)
    sofa = np.array([-1.15 + gap, 0.5, 0.2])
    seen_from(sofa, np.eye(3)[:, [1, 2, 0]])  # straight ahead
    for _ in range(10):
        seen_from(sofa, turned(rng))
        seen_from(np.array([0.6, -1.43, 0.58 + gap]), turned(rng))  # above a ball


SHAPE = {"lo": (-1.0, -1.0, -2.0), "hi": (1.0, 1.0, 2.0), "texture": lambda at: at.points}


@pytest.mark.parametrize(
    ("solid", "far", "side"),
    [
        (Box(**SHAPE), 2.0, 0.999),
        (Cylinder(**SHAPE), 2.0, 0.999),
        (Ball(**{**SHAPE, "lo": (-1.0, -1.0, -1.0), "hi": (1.0, 1.0, 1.0)}), 1.0, 0.0),
    ],
)
def test_hits_and_misses(solid: Box, far: float, side: float) -> None:
    """Rays down the z axis: onto the solid, from inside it, from below it, and past it."""
    origins = np.array([[side, 0, 5], [0, 0, 0.5], [0, 0, -5], [1.001, 0, 5]]).T
    directions = np.tile([[0.0], [0.0], [-2.0]], 4)
    t = solid.hit(make_rays(origins, directions))
    assert t[0] == pytest.approx((5 - far) / 2) and t[1] == 0.0
    assert not np.isfinite(t[2:]).any()
