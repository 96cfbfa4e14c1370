"""Rays of cameras with lens distortion."""

from typing import Any

import cv2
import numpy as np
import pytest

from tests import reference
from tests.support.kernel_runner import Kernels
from warpnerf.scenes.cameras.fisheye import largest_angle

LENSES: list[dict[str, float]] = [
    {},
    {"k1": -0.12, "k2": 0.03},
    {"k1": 0.08, "k2": -0.02, "p1": 1e-3, "p2": -2e-3, "k3": 0.004},
    {"p1": 4e-3},
    {"p2": -5e-3},
    {"k3": 0.03},
    # At the corners, nearly as much as can be undone.
    {"k1": -0.54, "k2": 0.04, "k3": 0.1, "p1": 0.01, "p2": 0.01},
]
# OpenCV's rational lens, of which projectPoints alone is the oracle: a depth camera's, one whose
# divisor falls below a half at the corners, one that bends by it alone, one that needs short
# strides, and a wide one.
RATIONAL: list[dict[str, float]] = [
    {
        "k1": 0.35,
        "k2": -2.1,
        "k3": 1.2,
        "p1": 3e-4,
        "p2": -2e-4,
        "k4": 0.25,
        "k5": -1.95,
        "k6": 1.15,
    },
    {"k1": 0.1, "k4": -0.9, "p1": 2e-3},
    {"k4": 0.15, "k5": 0.03, "k6": 0.01},
    {"k4": 1.0908, "k5": 1.0312, "k6": -1.0195, "p1": 0.0087, "p2": 0.0002},
    {"k1": 12.0, "k2": 4.0, "k3": 0.2, "k4": 12.3, "k5": 8.0, "k6": 1.5},
]
# Where Newton's method alone goes astray, the oracle's too.
TWISTED = {"k1": 1.6, "k2": -1.9, "k3": -0.6, "p1": -0.005, "p2": 0.006}
# k1 to k4; the first sees 49 degrees to a corner, the second 86, the third 126.
FISHEYES: list[tuple[float, float, float, float]] = [
    (-0.04, 0.02, -0.006, 0.0008),
    (0.08, -0.03, 0.01, -0.001),
    (-0.06, 0.01, 0.0, 0.0),
]
WIDER = (1.0, 0.5, 0.4)
"""Focal lengths of these lenses, times FX and FY."""
FX, FY, CX, CY, WIDTH, HEIGHT = 62.0, 58.0, 41.0, 29.6, 80, 60


def pose(seed: int) -> Any:
    rng = np.random.default_rng(seed)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    return np.concatenate([rotation, rng.normal(size=(3, 1))], axis=1)


def view(kernels: Kernels, c2w: Any, lens: dict[str, float], **changes: Any) -> Any:
    types, view = kernels.types, kernels.module("space.camera").CameraParams()
    view.rotation = types.mat33(*c2w[:, :3].ravel())
    view.position = types.vec3(*c2w[:, 3])
    view.focal = types.vec2(FX, FY)
    view.principal = types.vec2(CX, CY)
    view.radial = types.vec3(*(lens.get(k, 0.0) for k in ("k1", "k2", "k3")))
    view.tangential = types.vec2(lens.get("p1", 0.0), lens.get("p2", 0.0))
    view.divisor = types.vec3(*(lens.get(k, 0.0) for k in ("k4", "k5", "k6")))
    view.rational = int(any(lens.get(k) for k in ("k4", "k5", "k6")))
    view.width, view.height = WIDTH, HEIGHT
    view.first_pixel = 0
    for name, value in changes.items():
        setattr(view, name, value)
    return view


def rays(kernels: Kernels, c2w: Any, lens: dict[str, float]) -> tuple[Any, Any]:
    n, vec3 = WIDTH * HEIGHT, kernels.types.vec3
    origins, directions = kernels.zeros(n, vec3), kernels.zeros(n, vec3)
    kernels.workers.launch(
        kernels.module("space.camera").camera_rays, n, view(kernels, c2w, lens), origins, directions
    )
    shape = (HEIGHT, WIDTH, 3)
    return origins.numpy().reshape(shape), directions.numpy().reshape(shape)


def expected_rays(c2w: Any, lens: dict[str, float]) -> tuple[Any, Any]:
    v, u = np.meshgrid(np.arange(HEIGHT), np.arange(WIDTH), indexing="ij")
    return reference.pinhole_rays(FX, FY, CX, CY, c2w, u, v, **lens)


@pytest.mark.parametrize("lens", LENSES, ids=str)
def test_rays_against_the_oracle(lens: dict[str, float], kernels64: Kernels) -> None:
    c2w = pose(len(lens))
    origins, directions = rays(kernels64, c2w, lens)
    expected = expected_rays(c2w, lens)
    np.testing.assert_allclose(origins, expected[0], rtol=1e-15)
    np.testing.assert_allclose(directions, expected[1], rtol=0, atol=1e-12)
    if lens:
        plain = expected_rays(c2w, {})[1]
        assert np.abs(plain - expected[1]).max() > 1e-3


@pytest.mark.parametrize("lens", [*LENSES, TWISTED, *RATIONAL], ids=str)
def test_rays_against_opencv(lens: dict[str, float], kernels64: Kernels) -> None:
    """projectPoints brings a point on each ray back to the pixel centre."""
    c2w = pose(9)
    in_camera = rays(kernels64, c2w, lens)[1].reshape(-1, 3) @ c2w[:, :3]
    matrix = np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1]])
    vector = np.array([lens.get(k, 0.0) for k in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")])
    points = 3.0 * in_camera * [1.0, -1.0, -1.0]
    back = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, vector)[0].reshape(-1, 2)
    v, u = np.divmod(np.arange(WIDTH * HEIGHT), WIDTH)
    np.testing.assert_allclose(back, np.stack([u, v], axis=-1) + 0.5, rtol=0, atol=1e-8)


def test_float32_rays(kernels32: Kernels) -> None:
    for lens in LENSES:
        directions = rays(kernels32, pose(3), lens)[1]
        np.testing.assert_allclose(directions, expected_rays(pose(3), lens)[1], rtol=0, atol=1e-6)
        np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1.0, atol=3e-7)


def test_float32_rays_of_rational_lenses(kernels32: Kernels, kernels64: Kernels) -> None:
    for lens in RATIONAL:
        found, expected = (rays(kernels, pose(3), lens)[1] for kernels in (kernels32, kernels64))
        np.testing.assert_allclose(found, expected, rtol=0, atol=2e-6)
        assert np.abs(expected - rays(kernels64, pose(3), {})[1]).max() > 0.01


def test_a_divisor_of_nothing_changes_nothing(kernels64: Kernels) -> None:
    """The same lens as a rational one: another way to the same point."""
    n, camera = WIDTH * HEIGHT, kernels64.module("space.camera")
    for lens in LENSES[1:]:
        as_rational = view(kernels64, pose(4), lens, rational=1)
        origins, found = (
            kernels64.zeros(n, kernels64.types.vec3),
            kernels64.zeros(n, kernels64.types.vec3),
        )
        kernels64.workers.launch(camera.camera_rays, n, as_rational, origins, found)
        expected = rays(kernels64, pose(4), lens)[1].reshape(-1, 3)
        np.testing.assert_allclose(found.numpy(), expected, rtol=0, atol=1e-13)


def fisheye_view(kernels: Kernels, number: int) -> Any:
    k1, k2, k3, k4 = FISHEYES[number]
    return view(
        kernels,
        pose(number),
        {"k1": k1, "k2": k2, "k3": k3},
        focal=kernels.types.vec2(WIDER[number] * FX, WIDER[number] * FY),
        fisheye=1,
        k4=k4,
        angle_max=largest_angle(FISHEYES[number]),
    )


def fisheye_directions(kernels: Kernels, view: Any) -> Any:
    n, vec3 = WIDTH * HEIGHT, kernels.types.vec3
    origins, directions = kernels.zeros(n, vec3), kernels.zeros(n, vec3)
    camera = kernels.module("space.camera")
    kernels.workers.launch(camera.camera_rays, n, view, origins, directions)
    return directions.numpy()


def expected_fisheye(number: int) -> Any:
    v, u = np.divmod(np.arange(WIDTH * HEIGHT), WIDTH)
    focal = WIDER[number] * FX, WIDER[number] * FY
    return reference.fisheye_rays(*focal, CX, CY, pose(number), u, v, k=FISHEYES[number])[1]


@pytest.mark.parametrize("number", range(len(FISHEYES)))
def test_fisheye_rays_against_the_oracle(number: int, kernels64: Kernels) -> None:
    expected = expected_fisheye(number)
    found = fisheye_directions(kernels64, fisheye_view(kernels64, number))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
    farthest = np.degrees(np.arccos((expected @ -pose(number)[:, 2]).min()))
    assert farthest == pytest.approx((49.0, 86.0, 126.0)[number], abs=1.0)


@pytest.mark.parametrize("number", [0, 1])
def test_fisheye_rays_against_opencv(number: int, kernels64: Kernels) -> None:
    """projectPoints brings a point on each ray back to the pixel centre, where it is ahead."""
    directions = fisheye_directions(kernels64, fisheye_view(kernels64, number))
    in_camera = directions @ pose(number)[:, :3] * [1.0, -1.0, -1.0]
    ahead = in_camera[:, 2] > 0.02
    assert ahead.mean() > 0.99
    fx, fy = WIDER[number] * FX, WIDER[number] * FY
    matrix = np.array([[fx, 0, CX], [0, fy, CY], [0, 0, 1]])
    back = cv2.fisheye.projectPoints(
        3.0 * in_camera[None, ahead], np.zeros(3), np.zeros(3), matrix, np.array(FISHEYES[number])
    )[0][0]
    v, u = np.divmod(np.arange(WIDTH * HEIGHT), WIDTH)
    np.testing.assert_allclose(back, np.stack([u, v], axis=-1)[ahead] + 0.5, rtol=0, atol=1e-8)


def test_float32_fisheye_rays(kernels32: Kernels) -> None:
    for number in range(len(FISHEYES)):
        found = fisheye_directions(kernels32, fisheye_view(kernels32, number))
        np.testing.assert_allclose(found, expected_fisheye(number), rtol=0, atol=2e-6)
        np.testing.assert_allclose(np.linalg.norm(found, axis=-1), 1.0, atol=3e-7)


def test_beyond_what_a_fisheye_sees_is_its_rim(kernels64: Kernels) -> None:
    # theta - 0.2 theta^3 rises up to theta^2 = 1 / 0.6, where it is 0.86.
    view = fisheye_view(kernels64, 0)
    view.radial, view.k4 = kernels64.types.vec3(-0.2, 0.0, 0.0), 0.0
    view.focal = kernels64.types.vec2(30.0, 30.0)
    view.angle_max = largest_angle((-0.2, 0.0, 0.0, 0.0))
    assert view.angle_max == pytest.approx(np.sqrt(0.99 / 0.6), abs=1e-3)
    directions = fisheye_directions(kernels64, view) @ pose(0)[:, :3]
    v, u = np.divmod(np.arange(WIDTH * HEIGHT), WIDTH)
    x, y = (u + 0.5 - CX) / 30.0, (v + 0.5 - CY) / 30.0
    beyond = np.hypot(x, y) > 0.87
    angles = np.arccos(-directions[:, 2])
    assert 0.3 < beyond.mean() < 0.9
    np.testing.assert_allclose(angles[beyond], view.angle_max, atol=1e-6)
    assert (angles[~beyond] < view.angle_max).all()
    turn = np.arctan2(directions[:, 1], directions[:, 0])
    np.testing.assert_allclose(turn, np.arctan2(-y, x), atol=1e-12)
