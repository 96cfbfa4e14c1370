"""Gaussian splats drawn as 3DGS draws them (Kerbl et al. 2023), in numpy and float64.

A splat is projected by the perspective's derivative at its centre, 0.3 pixels squared are added to
its covariance, and splats are blended in the order of their centres' depths. Where a centre lies
far outside of the image, the derivative is that at its margin, as there.
"""

from __future__ import annotations

import numpy as np

DILATION = 0.3  # pixels squared
NEAREST = 0.2  # scene units: what lies nearer to the camera is left out
MARGIN = 1.3  # half images
REACH = 3.0  # standard deviations that are drawn
FAINTEST = 1.0 / 255.0
DENSEST = 0.99
BAND = 16  # rows that are drawn together


def read_splats(data: bytes) -> dict[str, np.ndarray]:
    """The columns of a PLY of floats only, by name."""
    header, body = data.split(b"end_header\n", 1)
    lines = header.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    names = [line.split()[2] for line in lines if line.startswith("property float")]
    (count,) = (int(line.split()[2]) for line in lines if line.startswith("element"))
    table = np.frombuffer(body, "<f4").reshape(count, len(names))
    return {name: table[:, k].astype(np.float64) for k, name in enumerate(names)}


def draw_splats(
    columns: dict[str, np.ndarray],
    c2w: np.ndarray,
    focal: tuple[float, float],
    principal: tuple[float, float],
    size: tuple[int, int],
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> np.ndarray:
    """What a pinhole camera sees of splats, [H, W, 3].

    Args:
        columns: As in a file: x y z, f_dc_0..2, opacity, scale_0..2, rot_0..3.
        c2w: [3, 4], OpenGL axes.
        focal: Pixels, along u and v.
        principal: Pixels.
        size: W, H.
        background: rgb.
    """
    stack = lambda *names: np.stack([columns[name] for name in names], axis=1)  # noqa: E731
    to_camera = c2w[:, :3].T * np.array([[1.0], [-1.0], [-1.0]])  # OpenCV axes
    local = (stack("x", "y", "z") - c2w[:, 3]) @ to_camera.T
    rotation = rotations(stack("rot_0", "rot_1", "rot_2", "rot_3"))
    spread = to_camera @ rotation * np.exp(stack("scale_0", "scale_1", "scale_2"))[:, None, :]
    opacity = 1.0 / (1.0 + np.exp(-columns["opacity"]))
    rgb = np.clip(0.5 + 0.28209479177387814 * stack("f_dc_0", "f_dc_1", "f_dc_2"), 0.0, None)

    order = np.argsort(local[:, 2], kind="stable")
    order = order[local[order, 2] > NEAREST]
    x, y, z = local[order].T
    limit = MARGIN * 0.5 * np.array(size) / focal
    jacobian = np.zeros((len(order), 2, 3))
    jacobian[:, 0, 0], jacobian[:, 1, 1] = focal[0] / z, focal[1] / z
    jacobian[:, 0, 2] = -focal[0] / z * np.clip(x / z, -limit[0], limit[0])
    jacobian[:, 1, 2] = -focal[1] / z * np.clip(y / z, -limit[1], limit[1])
    flat = jacobian @ spread[order]
    covariance = flat @ flat.transpose(0, 2, 1) + DILATION * np.eye(2)
    inverse = np.linalg.inv(covariance)
    centre = np.stack([focal[0] * x / z + principal[0], focal[1] * y / z + principal[1]], axis=1)
    reach = REACH * np.sqrt(covariance[:, (0, 1), (0, 1)])
    low = np.floor(np.clip(centre - reach, -1, size)).astype(int)
    high = np.ceil(np.clip(centre + reach, -1, size)).astype(int)
    image = np.empty((size[1], size[0], 3))
    for top in range(0, size[1], BAND):
        rows = min(BAND, size[1] - top)
        first, last = np.maximum(low, (0, top)), np.minimum(high, (size[0], top + rows))
        extent = np.maximum(last - first, 0)
        n = extent.prod(axis=1)
        splat = np.repeat(np.arange(len(n)), n)
        index = np.arange(n.sum()) - np.repeat(np.cumsum(n) - n, n)
        u = first[splat, 0] + index % np.maximum(extent[splat, 0], 1)
        v = first[splat, 1] + index // np.maximum(extent[splat, 0], 1)
        d = np.stack([u + 0.5, v + 0.5], axis=1) - centre[splat]
        power = np.einsum("ni,nij,nj->n", d, inverse[splat], d)
        alpha = np.minimum(opacity[order[splat]] * np.exp(-0.5 * power), DENSEST)
        drawn = alpha >= FAINTEST
        splat, alpha = splat[drawn], alpha[drawn]
        pixel = ((v - top) * size[0] + u)[drawn]
        sort = np.argsort(pixel, kind="stable")  # each pixel's splats stay in order of depth
        splat, alpha, pixel = splat[sort], alpha[sort], pixel[sort]
        passed = np.cumsum(np.log1p(-alpha))
        before = passed - np.log1p(-alpha)
        begins = np.concatenate([[True], pixel[1:] != pixel[:-1]])[: len(pixel)]
        weight = np.exp(before - before[begins][np.cumsum(begins) - 1]) * alpha
        n_pixels = rows * size[0]
        left = 1.0 - np.bincount(pixel, weight, n_pixels)
        band = np.stack(
            [
                np.bincount(pixel, weight * rgb[order[splat], c], n_pixels) + left * background[c]
                for c in range(3)
            ],
            axis=1,
        )
        image[top : top + rows] = band.reshape(rows, size[0], 3)
    return image


def rotations(quaternions: np.ndarray) -> np.ndarray:
    """[n, 3, 3] of quaternions w, x, y, z [n, 4] of any length."""
    w, x, y, z = (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)
