"""Camera poses as files give them: refused unless rigid, then made exactly rigid."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from warpnerf.checks import MAX_COORDINATE, InputError

RIGID_TOLERANCE = 1e-3
"""Largest error of R^T R against the identity: single precision passes, scale does not."""


def check_pose(matrix: Sequence[Sequence[float]], *, field: str) -> np.ndarray:
    """Turn a camera-to-world matrix from a file into a rigid one.

    The rotation is replaced by the nearest one, U V^T of its singular value decomposition.

    Args:
        matrix: 4x4 or 3x4 numbers, OpenGL axes, translation in scene units.
        field: File, field and frame that it comes from, for the message.

    Returns:
        [3, 4] float64, OpenGL axes, scene units.

    Raises:
        InputError: Another shape, numbers that are not finite, or a matrix that is not rigid.
    """
    rows, columns = len(matrix), sorted({len(row) for row in matrix})
    if rows not in (3, 4) or columns != [4]:
        shape = f"{rows}x{'/'.join(map(str, columns)) or 0}"
        raise InputError(f"{field}: is {shape}, but a camera-to-world matrix is 4x4 or 3x4.")
    pose = np.array(matrix, dtype=np.float64)
    if not np.isfinite(pose).all():
        row, column = np.argwhere(~np.isfinite(pose))[0]
        raise InputError(f"{field}[{row}][{column}]: is not a finite number; correct the pose.")
    if rows == 4 and np.abs(pose[3] - [0.0, 0.0, 0.0, 1.0]).max() > RIGID_TOLERANCE:
        raise InputError(
            f"{field}: its last row is {_numbers(pose[3])}, not [0, 0, 0, 1]; transpose the matrix "
            "if its translation stands there."
        )
    require_rigid(field, pose[:3])
    u, _, vt = np.linalg.svd(pose[:3, :3])
    return np.concatenate([u @ vt, pose[:3, 3:]], axis=1)


def require_rigid(field: str, pose: np.ndarray) -> None:
    """Raise InputError unless a finite [3, 4] matrix is a rotation and a translation."""
    if np.abs(pose).max() > MAX_COORDINATE:
        raise InputError(f"{field}: holds numbers beyond {MAX_COORDINATE:g}; correct the pose.")
    problem = _why_not_rigid(pose[:, :3])
    if problem:
        raise InputError(f"{field}: {problem}.")


def _why_not_rigid(axes: np.ndarray) -> str:
    """Say what keeps a [3, 3] matrix from being a rotation, and the way out; empty if nothing."""
    gram = axes.T @ axes
    lengths = np.sqrt(np.diag(gram))
    if lengths.min() < 1e-6:
        return "its 3x3 part has an axis of length zero; export the pose again"
    # Cosines tell shear from scale, whatever the scale is.
    cosines = gram / np.outer(lengths, lengths) - np.eye(3)
    if np.abs(cosines).max() > RIGID_TOLERANCE:
        return "shears: its axes are not at right angles; export a rigid pose"
    if np.ptp(lengths) > RIGID_TOLERANCE * lengths.max():
        return f"stretches its axes by {_numbers(lengths)}; divide each column by its length"
    if np.abs(gram - np.eye(3)).max() > RIGID_TOLERANCE:
        return (
            f"scales by {lengths.mean():.6g}; divide its 3x3 part by that and leave the "
            "translation as it is"
        )
    if np.linalg.det(axes) < 0.0:
        return "is mirrored (determinant -1); the axes must be x right, y up, z backward"
    return ""


def _numbers(values: np.ndarray) -> str:
    return "[" + ", ".join(f"{value:.6g}" for value in values) + "]"
