"""Rotation matrices and unit quaternions, which is how files of splats and of cameras hold them."""

from __future__ import annotations

import numpy as np


def quaternions(rotations: np.ndarray) -> np.ndarray:
    """Unit quaternions w, x, y, z of rotation matrices.

    Four times the outer product of a quaternion with itself is made of sums and differences of the
    matrix's entries. Of its rows, the one with the largest diagonal entry loses no digits.

    Args:
        rotations: [n, 3, 3].

    Returns:
        [n, 4].
    """
    m = rotations
    diagonal = np.stack(
        [
            1.0 + m[:, 0, 0] + m[:, 1, 1] + m[:, 2, 2],
            1.0 + m[:, 0, 0] - m[:, 1, 1] - m[:, 2, 2],
            1.0 - m[:, 0, 0] + m[:, 1, 1] - m[:, 2, 2],
            1.0 - m[:, 0, 0] - m[:, 1, 1] + m[:, 2, 2],
        ],
        axis=1,
    )
    x, y, z = m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]
    xy, xz, yz = m[:, 0, 1] + m[:, 1, 0], m[:, 0, 2] + m[:, 2, 0], m[:, 1, 2] + m[:, 2, 1]
    rows = np.stack(
        [
            np.stack([diagonal[:, 0], x, y, z], axis=1),
            np.stack([x, diagonal[:, 1], xy, xz], axis=1),
            np.stack([y, xy, diagonal[:, 2], yz], axis=1),
            np.stack([z, xz, yz, diagonal[:, 3]], axis=1),
        ]
    )
    quaternion = rows[diagonal.argmax(axis=1), np.arange(len(m))]
    return quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)


def rotations(quaternions: np.ndarray) -> np.ndarray:
    """Rotation matrices [n, 3, 3] of unit quaternions w, x, y, z [n, 4]."""
    w, x, y, z = quaternions.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def to_y(up: np.ndarray | None) -> np.ndarray:
    """The shortest rotation that turns a unit vector [3] to y, [3, 3]; None: none."""
    x, y, z = (0.0, 1.0, 0.0) if up is None else np.asarray(up, np.float64)
    if y < -1.0 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    axis = np.array([-z, 0.0, x])  # up x y
    cross = np.array([[0.0, -axis[2], 0.0], [axis[2], 0.0, -axis[0]], [0.0, axis[0], 0.0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / (1.0 + y))
