"""Poses from files: exactly rigid, or refused with the reason."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from tests.support.tiny_scenes import look_at
from warpnerf.checks import InputError
from warpnerf.scenes.cameras.poses import check_pose

POSE = look_at((3.0, 1.0, 2.0), (0.0, 0.0, 0.0))


@pytest.mark.parametrize("rows", [3, 4])
def test_rigid_pose_is_kept(rows: int) -> None:
    result = check_pose(POSE[:rows].tolist(), field="f")
    assert result.shape == (3, 4)
    np.testing.assert_allclose(result, POSE[:3], atol=1e-14)


def test_rounded_pose_becomes_the_nearest_rigid_one() -> None:
    rounded = POSE.copy()
    rounded[:3, :3] = np.round(rounded[:3, :3], 4)
    assert np.abs(rounded[:3, :3].T @ rounded[:3, :3] - np.eye(3)).max() > 1e-5
    result = check_pose(rounded.tolist(), field="f")
    np.testing.assert_allclose(result[:, :3].T @ result[:, :3], np.eye(3), atol=1e-14)
    np.testing.assert_allclose(result, POSE[:3], atol=2e-4)
    np.testing.assert_array_equal(result[:, 3], POSE[:3, 3])


def times(factor: float | list[float]) -> Callable[[np.ndarray], None]:
    def change(pose: np.ndarray) -> None:
        pose[:3, :3] *= np.array(factor)

    return change


def shear(pose: np.ndarray) -> None:
    pose[:3, 0] += 0.1 * pose[:3, 1]


def shear_a_mirror(pose: np.ndarray) -> None:
    pose[:3, 0] = pose[:3, 1]


def transpose(pose: np.ndarray) -> None:
    pose[:] = pose.T.copy()


def put(row: int, column: int, value: float) -> Callable[[np.ndarray], None]:
    def change(pose: np.ndarray) -> None:
        pose[row, column] = value

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (times(0.0), "axis of length zero"),
        (times(2.0), "scales by 2; divide its 3x3 part"),
        (times(-2.0), "scales by 2"),
        (times(1.002), "scales by 1.002"),
        (times([1.0, 1.0, 0.5]), r"stretches its axes by \[1, 1, 0.5\]"),
        (times([1.0, 1.0, -1.0]), "is mirrored"),
        (times(-1.0), "is mirrored"),
        (shear, "shears: its axes are not at right angles"),
        (shear_a_mirror, "shears"),
        (transpose, r"its last row is \[3, 1, 2, 1\], not \[0, 0, 0, 1\]; transpose"),
        (put(3, 3, 2.0), r"its last row is \[0, 0, 0, 2\]"),
        (put(3, 3, 0.0), r"its last row is \[0, 0, 0, 0\]"),
        (put(0, 3, np.nan), r"\[0\]\[3\]: is not a finite number"),
        (put(1, 1, np.inf), r"\[1\]\[1\]: is not a finite number"),
        (put(2, 3, 1e200), "numbers beyond 1e\\+12"),
    ],
)
def test_other_matrices_are_refused(change: Callable[[np.ndarray], None], message: str) -> None:
    pose = POSE.copy()
    change(pose)
    with pytest.raises(InputError, match=rf"t\.json: \$\.matrix.*{message}"):
        check_pose(pose.tolist(), field="t.json: $.matrix")


@pytest.mark.parametrize(
    ("matrix", "shape"),
    [
        ([], "0x0"),
        (POSE[:2].tolist(), "2x4"),
        (POSE[:, :3].tolist(), "4x3"),
        ([*POSE[:3].tolist(), [0.0]], "4x1/4"),
        ([[], [], [], []], "4x0"),
    ],
)
def test_other_shapes_are_refused(matrix: list[list[float]], shape: str) -> None:
    with pytest.raises(InputError, match=rf"t\.json: is {shape}, but .* is 4x4 or 3x4"):
        check_pose(matrix, field="t.json")
