"""Widths of voxels in pictures, against finite differences of the contraction itself."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.tiny_scenes import camera_at, ring
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.observations import Observations, guessed, observe
from warpnerf.scenes.extent.frustum import Frustum
from warpnerf.scenes.extent.space import Space

VOXELS = 20**3


def orbit(n: int) -> list[Camera]:
    return [camera_at(pose) for pose in ring(n)]


def contracted(points: np.ndarray, space: Space) -> np.ndarray:
    """Points [n, 3] in the units of the scene, but contracted: voxels are cubes there."""
    middle, half = 0.5 * (space.box_min + space.box_max), 0.5 * (space.box_max - space.box_min)
    q = (points - middle) / half
    if space.contraction == "l2":
        n = np.sqrt((q * q).sum(axis=1, keepdims=True))
    else:
        n = np.abs(q).max(axis=1, keepdims=True)
    contracted = np.where(n <= 1.0, q, (1.0 + space.border - space.border / n) * q / n)
    return middle + contracted * half


def observations(n: int = 200, spread: float = 4.0) -> Observations:
    rng = np.random.default_rng(3)
    directions = rng.normal(size=(n, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    weights = rng.uniform(0.5, 1.0, n)
    return Observations(
        positions=rng.uniform(-spread, spread, (n, 3)),
        directions=directions,
        pixels=rng.uniform(50.0, 200.0, n),
        weights=weights / weights.sum(),
    )


def by_differences(space: Space, seen: Observations, f, depth_share: float) -> np.ndarray:  # type: ignore[no-untyped-def]
    """``voxel_widths`` from the mapping alone."""
    step, jacobian = 1e-6, np.empty((len(seen), 3, 3))
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        jacobian[:, :, axis] = (f(seen.positions + shift) - f(seen.positions - shift)) / (2 * step)
    widths = []
    for k, inverse in enumerate(np.linalg.inv(jacobian)):
        d = seen.directions[k]
        view = np.eye(3) - (1.0 - depth_share) * np.outer(d, d)
        widths.append(np.linalg.norm(view @ inverse) / np.sqrt(2.0) * seen.pixels[k])
    return np.array(widths) * space.voxel_edge(VOXELS)


@pytest.mark.parametrize("contraction", ["none", "linf", "l2"])
@pytest.mark.parametrize("depth_share", [0.0, 0.3, 1.0])
def test_widths_are_those_of_the_contraction_s_own_jacobian(
    contraction: str, depth_share: float
) -> None:
    space = Space(
        box_min=np.array([-1.0, -0.5, -2.0]),
        box_max=np.array([0.5, 1.5, 1.0]),
        contraction=contraction,  # type: ignore[arg-type]
        border=0.0 if contraction == "none" else 0.4,
    )
    seen = observations()

    def f(points: np.ndarray) -> np.ndarray:
        return points if contraction == "none" else contracted(points, space)

    expected = by_differences(space, seen, f, depth_share)
    np.testing.assert_allclose(space.voxel_widths(seen, VOXELS, depth_share), expected, rtol=1e-5)


def test_widths_in_a_frustum_are_those_of_its_coordinates() -> None:
    axes = np.array([[0.0, 1.0, 0.0], [0.6, 0.0, 0.8], [0.8, 0.0, -0.6]])
    frustum = Frustum(origin=np.array([0.1, 0.2, 0.3]), axes=axes, near=0.7, depth=3.0)
    space = Space(
        box_min=np.array([-0.5, -0.4, 0.0]),
        box_max=np.array([0.5, 0.4, 2.9]),
        contraction="ndc",
        frustum=frustum,
    )
    rng = np.random.default_rng(5)
    places = np.stack([*rng.uniform(-0.4, 0.4, (2, 50)), rng.uniform(0.2, 2.6, 50)], axis=1)
    seen = observations(50)
    seen = Observations(
        positions=frustum.to_scene(places),
        directions=seen.directions,
        pixels=seen.pixels,
        weights=seen.weights,
    )
    expected = by_differences(space, seen, frustum.to_ndc, 0.3)
    np.testing.assert_allclose(space.voxel_widths(seen, VOXELS, 0.3), expected, rtol=1e-5)


def test_in_a_box_a_voxel_is_as_wide_as_its_edge_has_pixels() -> None:
    space = Space(box_min=np.zeros(3), box_max=np.array([2.0, 2.0, 2.0]))
    seen = guessed(orbit(6), distance=4.0)
    focal = orbit(6)[0].fx
    assert space.voxel_edge(VOXELS) == pytest.approx(0.1)
    np.testing.assert_allclose(space.voxel_widths(seen, VOXELS), 0.1 * focal / 4.0)


def test_each_camera_weighs_as_much_however_much_it_sees() -> None:
    cameras = orbit(3)
    rng = np.random.default_rng(0)
    seen = [rng.uniform(-0.5, 0.5, (n, 3)) for n in (5, 400, 30)]
    found = observe(cameras, seen, training=(0, 1))
    assert len(found) == 45  # at most 40 of a camera, none of the third
    assert found.weights[:5].sum() == pytest.approx(0.5)
    assert found.weights.sum() == pytest.approx(1.0)
    away = np.linalg.norm(found.positions[:5] - cameras[0].position, axis=1)
    np.testing.assert_allclose(found.pixels[:5], cameras[0].fx / away)
    np.testing.assert_allclose(
        cameras[0].position + away[:, None] * found.directions[:5], found.positions[:5]
    )


def test_matches_far_from_the_median_of_their_camera_are_left_out() -> None:
    camera = orbit(1)[0]
    ahead = np.linspace(2.9, 3.1, 20)
    distances = np.concatenate([ahead, [0.01, 100.0]])
    places = camera.position + distances[:, None] * camera.forward
    assert len(observe([camera], [places], [0])) == 20


def test_a_shell_takes_its_part_of_the_voxels() -> None:
    box = {"box_min": np.zeros(3), "box_max": np.array([2.0, 2.0, 2.0])}
    space = Space(**box, contraction="linf", border=0.5)
    assert space.voxel_edge(VOXELS) == pytest.approx(0.15)


def test_outside_of_an_outline_voxels_are_as_much_wider() -> None:
    space = Space(box_min=np.full(3, -1.0), box_max=np.ones(3), contraction="linf", border=0.4)
    outline = space.where_wider(2.0)
    assert outline is not None
    place = np.array([[outline[1][0], 0.0, 0.0]])
    seen = Observations(  # from far behind, so that all of a voxel's width is across
        positions=place,
        directions=np.array([[1.0, 0.0, 0.0]]),
        pixels=np.ones(1),
        weights=np.ones(1),
    )
    width = space.voxel_widths(seen, VOXELS)[0]
    assert width == pytest.approx(2.0 * space.voxel_edge(VOXELS))
    assert Space(box_min=np.zeros(3), box_max=np.ones(3)).where_wider(2.0) is None
