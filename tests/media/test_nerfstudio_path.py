"""nerfstudio's camera_path.json: frames, field of view, and its coordinates."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.tiny_scenes import ring
from warpnerf.checks import InputError
from warpnerf.media.nerfstudio_path import read_nerfstudio_path

TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def write(folder: Path, poses: list[np.ndarray], **changes: Any) -> Path:
    """As its viewer saves it."""
    tree = {
        "default_fov": 50.0,
        "camera_type": "perspective",
        "render_height": 36,
        "render_width": 64,
        "fps": 10,
        "seconds": 99.0,
        "is_cycle": False,
        "keyframes": [{"matrix": "ignored"}],
        "camera_path": [
            {"camera_to_world": pose.reshape(-1).tolist(), "fov": 40.0 + k, "aspect": 16 / 9}
            for k, pose in enumerate(poses)
        ],
    }
    path = folder / "camera_path.json"
    path.write_text(json.dumps(tree | changes))
    return path


def test_frames_are_the_cameras_in_the_scenes_coordinates(tmp_path: Path) -> None:
    poses = [np.vstack([pose[:3], [0, 0, 0, 1]]) for pose in ring(8)[:5]]
    scale, shift = 0.25, np.array([0.3, -0.1, 0.2])
    moved = []
    for pose in poses:
        other = pose.copy()
        other[:3, :3] = TURN @ pose[:3, :3]
        other[:3, 3] = scale * (TURN @ pose[:3, 3] + shift)
        moved.append(other)
    transforms = tmp_path / "dataparser_transforms.json"
    transform = np.concatenate([TURN, shift[:, None]], axis=1).tolist()
    transforms.write_text(json.dumps({"transform": transform, "scale": scale}))
    read = read_nerfstudio_path(write(tmp_path, moved), transforms)
    assert read.seconds == pytest.approx(0.5) and read.fps == pytest.approx(10.0)
    assert (read.width, read.height) == (64, 36)
    for k, camera in enumerate(read.cameras(5)):
        np.testing.assert_allclose(camera.c2w, poses[k][:3], atol=1e-9)
        assert camera.fy == pytest.approx(18.0 / np.tan(np.radians(20.0 + 0.5 * k)))
    plain = read_nerfstudio_path(write(tmp_path, poses), None)
    np.testing.assert_allclose(plain.cameras(5)[2].c2w, poses[2][:3], atol=1e-9)


def test_what_was_applied_before_and_an_offset_are_accounted_for(tmp_path: Path) -> None:
    """As its datasets have it: what its runs keep begins before what transforms.json applied."""
    applied = np.array([[0.0, 1.0, 0.0, 0.5], [1.0, 0.0, 0.0, -1.0], [0.0, 0.0, -1.0, 2.0]])
    poses = [pose[:3] for pose in ring(8)[:3]]  # of transforms.json
    tree = {"applied_transform": applied.tolist(), "applied_scale": 2.0, "frames": []}
    (tmp_path / "transforms.json").write_text(json.dumps(tree))
    whole = np.concatenate([TURN @ applied[:, :3], (TURN @ applied[:, 3])[:, None]], axis=1)
    transforms = tmp_path / "dataparser_transforms.json"
    transforms.write_text(json.dumps({"transform": whole.tolist(), "scale": 0.5 * 2.0}))
    theirs = []  # as its data parser turns and scales poses that were applied to
    for pose in poses:
        other = np.vstack([TURN @ pose, [0.0, 0.0, 0.0, 1.0]])
        other[:3, 3] *= 0.5
        theirs.append(other)
    offset = (100.0, -200.0, 300.0)
    path = write(tmp_path, theirs)
    read = read_nerfstudio_path(path, transforms, tmp_path, offset)
    for camera, pose in zip(read.cameras(3), poses, strict=True):
        np.testing.assert_allclose(camera.c2w[:, :3], pose[:, :3], atol=1e-9)
        np.testing.assert_allclose(camera.c2w[:, 3], pose[:, 3] - np.array(offset), atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"camera_type": "equirectangular"}, "only perspective is rendered"),
        ({"camera_path": []}, "has 0 frames"),
        ({"render_width": 0}, "render_width and render_height"),
        ({"fps": -24}, r"json: fps is -24, but must be a number from 0 on"),
        ({"seconds": -1}, r"json: seconds is -1, but must be"),
        ({"camera_path": [{"camera_to_world": [1.0] * 12, "fov": 50}]}, "must be 16 numbers"),
        ({"camera_path": [{"camera_to_world": [1.0] * 16, "fov": 50}]}, r"keys\[0\].c2w must turn"),
        ({"camera_path": 3}, "camera_path"),
    ],
)
def test_what_no_camera_can_do_is_refused(
    tmp_path: Path, changes: dict[str, Any], says: str
) -> None:
    path = write(tmp_path, [np.eye(4)], **changes)
    with pytest.raises(InputError, match=says):
        read_nerfstudio_path(path, None)


@pytest.mark.parametrize(
    ("tree", "says"),
    [
        ({"transform": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "scale": 1.0}, "three rows of four"),
        ({"transform": np.eye(3, 4).tolist(), "scale": 0.0}, "scale above 0"),
        ({"transform": (2 * np.eye(3, 4)).tolist(), "scale": 1.0}, "turn and move only"),
    ],
)
def test_transforms_that_are_none_are_refused(
    tmp_path: Path, tree: dict[str, Any], says: str
) -> None:
    file = tmp_path / "dataparser_transforms.json"
    file.write_text(json.dumps(tree))
    with pytest.raises(InputError, match=says):
        read_nerfstudio_path(write(tmp_path, [np.eye(4)]), file)
