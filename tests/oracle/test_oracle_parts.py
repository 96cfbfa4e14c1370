"""The oracle's losses, optimiser, cameras and measures, against others' and by hand."""

import math

import cv2
import numpy as np
import pytest
import torch

from tests.reference import (
    adam,
    central_difference,
    distort,
    photometric_loss,
    pinhole_rays,
    relative_error,
    total_variation,
    undistort,
)
from tests.support.reference_tensors import normal, tiny_raw


def test_photometric_loss_by_hand() -> None:
    rgb = torch.tensor([[0.5, 0.0, 1.0], [0.0, 0.0, 0.0]], requires_grad=True)
    target = torch.tensor([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    loss = photometric_loss(rgb, target)
    assert loss.item() == (0.25 + 1.0 + 1.0) / 2
    (gradient,) = torch.autograd.grad(loss, rgb)
    assert gradient.tolist() == [[0.5, 0.0, 1.0], [0.0, -1.0, 0.0]]


def test_total_variation_against_pairs() -> None:
    raw, weights = tiny_raw(), torch.tensor([0.5, 1.0, 2.0, 0.0], dtype=torch.float64)
    expected = 0.0
    for i, j, k, c in np.ndindex(*raw.shape):
        for other in [(i + 1, j, k, c), (i, j + 1, k, c), (i, j, k + 1, c)]:
            if all(other[a] < raw.shape[a] for a in range(3)):
                d = abs(float(raw[i, j, k, c] - raw[other]))
                expected += float(weights[c]) * (d * d / 2 if d <= 1 else d - 0.5)
    assert math.isclose(float(total_variation(raw, weights)), expected)
    raw.requires_grad_()
    (gradient,) = torch.autograd.grad(total_variation(raw, weights), raw)
    direction = normal(*raw.shape, seed=22)
    difference = central_difference(
        lambda values: total_variation(values, weights), raw.detach(), direction, 1e-6
    )
    assert relative_error((gradient * direction).sum(), difference) < 1e-8
    assert not gradient[..., 3].any()


def test_adam_against_torch_and_skips_zero_gradients() -> None:
    param, lr, betas, eps = normal(7, seed=23), 0.1, (0.9, 0.99), 1e-8
    m, v = torch.zeros_like(param), torch.zeros_like(param)
    theirs = param.clone().requires_grad_()
    optimizer = torch.optim.Adam([theirs], lr=lr, betas=betas, eps=eps)
    for step in range(1, 6):
        theirs.grad = normal(7, seed=100 + step)
        optimizer.step()
        param, m, v = adam(param, m, v, theirs.grad, step, lr, *betas, eps)
    torch.testing.assert_close(param, theirs.detach(), rtol=1e-12, atol=0)

    grad = normal(7, seed=24)
    grad[2], grad[5] = 0.0, -0.0
    moved, new_m, new_v = adam(param, m, v, grad, 6, lr, *betas, eps)
    still = torch.tensor([2, 5])
    for new, old in [(moved, param), (new_m, m), (new_v, v)]:
        assert (new == old).nonzero()[:, 0].equal(still)


# cameras

LENSES = [
    {},
    {"k1": -0.12, "k2": 0.03},
    {"k1": 0.08, "k2": -0.02, "p1": 1e-3, "p2": -2e-3, "k3": 0.004},
]


def lens_vector(lens: dict[str, float]) -> np.ndarray:
    return np.array([lens.get(name, 0.0) for name in ("k1", "k2", "p1", "p2", "k3")])


@pytest.mark.parametrize("lens", LENSES)
def test_rays_against_opencv(lens: dict[str, float]) -> None:
    fx, fy, cx, cy = 310.0, 290.0, 205.0, 148.0
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    v, u = np.meshgrid(np.arange(0, 300, 23), np.arange(0, 400, 31), indexing="ij")
    rng = np.random.default_rng(25)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    position = rng.normal(size=3)
    c2w = np.concatenate([rotation, position[:, None]], axis=1)

    origins, directions = pinhole_rays(fx, fy, cx, cy, c2w, u, v, **lens)
    assert origins.shape == directions.shape == (*u.shape, 3)
    assert np.array_equal(origins, np.broadcast_to(position, origins.shape))
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1.0, rtol=1e-15)

    # undistortPoints gives the point that OpenCV means for each pixel centre
    centres = np.stack([u, v], axis=-1).reshape(-1, 1, 2) + 0.5
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-15)
    theirs = cv2.undistortPoints(centres, matrix, lens_vector(lens), criteria=criteria)[:, 0]
    in_camera = directions.reshape(-1, 3) @ rotation
    assert np.all(in_camera[:, 2] < 0.0)
    ours = np.stack([in_camera[:, 0], -in_camera[:, 1]], axis=-1) / -in_camera[:, 2:]
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-10)

    # and projectPoints brings a point on each ray back to the pixel centre
    opencv_axes = in_camera * np.array([1.0, -1.0, -1.0])
    zero = np.zeros(3)
    back = cv2.projectPoints(4.0 * opencv_axes, zero, zero, matrix, lens_vector(lens))[0]
    np.testing.assert_allclose(back, centres, rtol=0, atol=1e-9)


def test_undistort_inverts_to_1e_14() -> None:
    rng = np.random.default_rng(26)
    for lens in LENSES:
        x, y = rng.uniform(-0.7, 0.7, size=(2, 500))
        found = undistort(*distort(x, y, **lens), **lens)
        np.testing.assert_allclose(found, [x, y], rtol=0, atol=5e-14)
        again = distort(*found, **lens)
        np.testing.assert_allclose(again, distort(x, y, **lens), rtol=0, atol=1e-14)
    with pytest.raises(ValueError, match="no inverse"):
        undistort(2.0, 0.0, k1=-0.5)  # r - r^3 / 2 never exceeds 0.55


def test_ray_directions_by_hand() -> None:
    identity = np.eye(4)
    _, ahead = pinhole_rays(100.0, 50.0, 20.5, 10.5, identity, 20, 10)
    assert ahead.tolist() == [0.0, 0.0, -1.0]
    _, corner = pinhole_rays(100.0, 50.0, 20.5, 10.5, identity, 120, 110)
    # 100 pixels right and 100 down: tangents 1 and 2, and down is -y
    np.testing.assert_allclose(corner, np.array([1.0, -2.0, -1.0]) / math.sqrt(6.0))


# measures


def test_measures() -> None:
    x = torch.tensor([0.3, -0.2], dtype=torch.float64)
    direction = torch.tensor([2.0, 1.0], dtype=torch.float64)
    slope = central_difference(lambda p: (p**3).sum(), x, direction, 1e-4)
    assert math.isclose(float(slope), 3 * (0.09 * 2.0 + 0.04), rel_tol=1e-6)
    assert relative_error([1.0, 2.0], [1.0, 4.0]) == 0.5
    assert relative_error(np.array([3.0], dtype=np.float32), torch.tensor([4.0])) == 0.25
    assert math.isnan(relative_error([math.nan, 2.0], [1.0, 4.0]))
    with pytest.raises(ValueError, match="zero"):
        relative_error([1.0], [0.0])
    with pytest.raises(ValueError, match="shapes"):
        relative_error([1.0], [1.0, 2.0])
