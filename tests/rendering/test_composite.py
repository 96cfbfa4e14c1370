"""Fields put together: parts of rays, composited, are the rays."""

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from tests.support.tiny_fields import tiny_field
from tests.support.tiny_scenes import camera_at, look_at
from warpnerf.checks import InputError
from warpnerf.rendering import render
from warpnerf.rendering.composite import CompositeField, crossings
from warpnerf.rendering.field import Field, Rendering

INF = np.inf
CELLS = np.array(
    [
        [[-INF, -INF, -INF], [0.13, INF, INF]],
        [[0.13, -INF, -INF], [INF, -0.2, INF]],
        [[0.13, -0.2, -INF], [INF, INF, 0.4]],
        [[0.13, -0.2, 0.4], [INF, INF, INF]],
    ]
)
"""Of all space, split three times."""


def whole_field(**options: Any) -> Field:
    """One that light passes, so that all cells are seen, to the last of it."""
    field = tiny_field(density=-3.5, **options)
    return replace(field, steps=replace(field.steps, transmittance_min=0.0))


def composite_of(fields: list[Field], cells: np.ndarray = CELLS) -> CompositeField:
    return CompositeField(
        cells=cells,
        members=[partial(lambda field: field, field) for field in fields],
        surroundings=fields[0].surroundings,
        background=fields[0].background,
        transmittance_min=0.0,
        workers=fields[0].workers,
    )


@pytest.mark.parametrize("together", [False, True])
def test_what_is_no_part_of_a_field_is_refused(together: bool) -> None:
    field: Any = composite_of([whole_field()] * 4) if together else whole_field()
    for wrong in ("x", None, [1.0], float("nan"), -1.0):
        for part in (field.beyond, field.up_to):
            with pytest.raises(InputError, match="distance must be "):
                part(wrong)
    for low, high in (
        ("abc", "def"),
        (None, None),
        ([0, 0], [1, 1]),
        ([1, 1, 1], [0, 2, 2]),
        ([0, 0, 0], [1, 1, 10**400]),
        ([0, 0, 0], [1, 1, float("nan")]),
        ([[0]], [[1, 2], 3]),
    ):
        with pytest.raises(
            InputError, match=r"^(crop must be a lower|cropped: low must be a list)"
        ):
            field.cropped(low, high)
    camera = camera_at(look_at((2.0, 1.1, 0.7), (0.1, 0.0, 0.2)), width=4, height=3)
    dark = field.beyond(float("inf")).render(camera)
    np.testing.assert_allclose(dark.rgb, np.broadcast_to(field.background, (3, 4, 3)), atol=1e-6)
    whole = field.up_to(float("inf")).render(camera)
    np.testing.assert_array_equal(whole.rgb, field.render(camera).rgb)


def test_cells_are_boxes_one_for_each_member() -> None:
    together = composite_of([whole_field()] * 4)
    for cells in (CELLS[:3], CELLS[:, ::-1], np.full((4, 2, 3), np.nan), CELLS[:, :, :2]):
        with pytest.raises(InputError, match=r"^CompositeField\.cells must be \[4, 2, 3\]"):
            replace(together, cells=cells)
    wrong: Any = None
    with pytest.raises(InputError, match=r"^CompositeField\.cells must be an array, not None"):
        replace(together, cells=wrong)


@pytest.mark.parametrize("packed", [True, False])
def test_copies_of_a_field_are_the_field(packed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is counted twice or left out, inside the box and where space is contracted."""
    if not packed:  # the form of CUDA
        whole_variant = render.variant_of
        monkeypatch.setattr(
            render, "variant_of", lambda *a, **k: whole_variant(*a, **{**k, "packed": False})
        )
    field = whole_field(contraction="linf")
    together = composite_of([field] * 4)
    camera = camera_at(look_at((2.0, 1.1, 0.7), (0.1, 0.0, 0.2)), width=24, height=18, fx=20.0)
    away = camera_at(look_at((20.0, 11.0, 7.0), (0.1, 0.0, 0.2)), width=24, height=18, fx=100.0)
    require_same(together.render(camera), field.render(camera))
    require_same(together.render(away), field.render(away))  # its far lies in what it sees
    require_same(together.up_to(23.4).render(away), field.up_to(23.4).render(away))


def require_same(found: Rendering, expected: Rendering) -> None:
    assert 0.2 < expected.opacity.mean() < 0.95
    np.testing.assert_allclose(found.rgb, expected.rgb, atol=2e-6)
    np.testing.assert_allclose(found.opacity, expected.opacity, atol=2e-6)
    np.testing.assert_allclose(found.depth, expected.depth, rtol=2e-5)


def test_each_field_is_seen_in_its_cell_only() -> None:
    """From both sides of a face, and along it: the other field is empty."""
    full = whole_field(contraction="linf")
    empty = tiny_field(density=-30.0, contraction="linf")
    halves = np.array([[[-INF] * 3, [0.0, INF, INF]], [[0.0, -INF, -INF], [INF] * 3]])
    seen = composite_of([full, empty], halves)
    origins = np.array([[-0.5, 0.1, 0.2], [0.5, 0.1, 0.2], [0.5, 0.1, 0.2], [0.0, -2.0, 0.3]])
    directions = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    ends = np.array([[0.0, 0.5], [0.0, 0.0], [0.5, 1e9], [0.0, 0.0]])
    found = seen.render_rays(origins, directions)
    expected = full.render_between(origins, directions, ends)
    np.testing.assert_allclose(found.opacity, expected.opacity, atol=1e-6)
    assert (found.opacity[[0, 2]] > 0.005).all() and (found.opacity[[1, 3]] == 0.0).all()
    assert seen.cropped([-0.3, -1.0, -1.0], [1.0, 1.0, 1.0]).render_rays(
        origins[:1], directions[:1]
    ).opacity == pytest.approx(
        full.render_between(origins[:1], directions[:1], np.array([[0.2, 0.5]])).opacity
    )


def test_every_point_of_a_ray_is_in_one_cell() -> None:
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(200, 3))
    directions[:30, 0] = 0.0
    directions[20:50, 1] = 0.0
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = rng.choice([0.13, -0.2, 0.4, 0.9, -1.0], size=(200, 3))
    enter, leave = crossings(CELLS, origins, directions)
    length = np.where(leave > enter, np.minimum(leave, 50.0) - enter, 0.0)
    np.testing.assert_allclose(length.clip(0.0).sum(axis=0), 50.0)
