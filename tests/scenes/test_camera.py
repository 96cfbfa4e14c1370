"""Cameras made by hand: refused where no kernel would notice."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.support.tiny_fields import tiny_field
from tests.support.tiny_scenes import camera_at, ring
from warpnerf.checks import InputError
from warpnerf.scenes.cameras.camera import Camera

POSE = ring(1)[0]


def with_nan(pose: np.ndarray) -> np.ndarray:
    pose = pose[:3].copy()
    pose[1, 3] = np.nan
    return pose


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"c2w": with_nan(POSE)}, "c2w must be finite, but holds NaN"),
        ({"c2w": POSE}, r"c2w must be an array \[3, 4\], not \[4, 4\]; leave out"),
        ({"c2w": POSE[:3].tolist()}, r"c2w must be an array \[3, 4\]"),
        ({"c2w": np.zeros((3, 4))}, "c2w: its 3x3 part has an axis of length zero"),
        ({"c2w": POSE[:3] * 7.0}, "c2w: scales by 7; divide its 3x3 part"),
        ({"c2w": POSE[:3] * [-1.0, 1.0, 1.0, 1.0]}, "c2w: is mirrored"),
        ({"c2w": np.full((3, 4), 1e300)}, r"c2w: holds numbers beyond 1e\+12"),
        ({"c2w": POSE[:3].astype(complex)}, "c2w must be real numbers, not complex128"),
        ({"width": 0}, "width must be a finite number of at least 1, not 0"),
        ({"height": -2}, "height must be a finite number of at least 1, not -2"),
        ({"fx": 0.0}, "fx must be a finite number above 0, not 0"),
        ({"fy": np.nan}, "fy must be a finite number above 0, not nan"),
        ({"cx": np.inf}, "cx must be a finite number, not inf"),
        ({"k2": np.nan}, "k2 must be a finite number, not nan"),
    ],
)
def test_what_makes_no_rays_is_refused(changes: dict[str, Any], message: str) -> None:
    good = vars(camera_at(POSE))
    Camera(**good)
    with pytest.raises(InputError, match=rf"Camera\.{message}"):
        Camera(**{**good, **changes})


def test_a_pose_that_was_changed_afterwards_is_refused_when_rendering() -> None:
    camera = camera_at(POSE.copy())
    camera.c2w[0, 3] = np.nan
    with pytest.raises(InputError, match=r"Camera\.c2w must be finite"):
        tiny_field().render(camera)
