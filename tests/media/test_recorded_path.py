"""Paths in files: what is written is read, what is wrong is named, cameras pass the keys."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.tiny_scenes import ring
from warpnerf.checks import InputError
from warpnerf.media.recorded_path import Key, RecordedPath, read_path


def recorded() -> RecordedPath:
    keys = [
        Key(seconds=2.0 * i, fov=40.0 + 5.0 * i, c2w=pose[:3].tolist())
        for i, pose in enumerate(ring(8)[:4])
    ]
    return RecordedPath(width=64, height=48, keys=keys)


@pytest.fixture
def content() -> dict[str, Any]:
    return json.loads(recorded().to_json())


def save(folder: Path, content: Any) -> Path:
    path = folder / "path.json"
    path.write_text(json.dumps(content))
    return path


def test_what_is_written_is_read(tmp_path: Path) -> None:
    path = tmp_path / "path.json"
    path.write_bytes(recorded().to_json())
    read = read_path(path)
    assert (read.width, read.height, read.seconds) == (64, 48, 6.0)
    assert [key.c2w for key in read.keys] == [key.c2w for key in recorded().keys]


def test_the_camera_passes_the_keys_in_their_time() -> None:
    path = recorded()
    cameras = path.cameras(7)  # one for each second
    for key, camera in zip(path.keys, cameras[::2], strict=True):
        np.testing.assert_allclose(camera.c2w, key.c2w, atol=1e-9)
        assert camera.fy == pytest.approx(24.0 / np.tan(np.radians(key.fov / 2)))
        assert (camera.width, camera.height, camera.cx, camera.cy) == (64, 48, 32.0, 24.0)
    for camera in cameras:  # and between them it is a camera
        np.testing.assert_allclose(camera.c2w[:, :3].T @ camera.c2w[:, :3], np.eye(3), atol=1e-9)
    between = cameras[1].position
    ends = [np.array(key.c2w)[:, 3] for key in path.keys[:2]]
    assert np.linalg.norm(between - np.mean(ends, axis=0)) < 0.2 * np.linalg.norm(ends[1] - ends[0])


def test_another_size_sees_as_high() -> None:
    small, large = recorded().cameras(2)[0], recorded().cameras(2, (400, 200))[0]
    assert (large.width, large.height) == (400, 200)
    assert large.fy / large.height == pytest.approx(small.fy / small.height)
    with pytest.raises(InputError, match="width"):
        recorded().cameras(2, (0, 200))


def test_one_place_stands_still(content: dict[str, Any], tmp_path: Path) -> None:
    content["keys"] = content["keys"][:1]
    path = read_path(save(tmp_path, content))
    assert path.seconds == 0.0
    assert {camera.c2w.tobytes() for camera in path.cameras(3)} == {
        np.array(path.keys[0].c2w).tobytes()
    }


@pytest.mark.parametrize(
    ("place", "value", "says"),
    [
        (("warpnerf_path",), 2, "warpnerf_path is 2"),
        (("width",), 0, "width is 0"),
        (("height",), 10**9, "height is 1000000000"),
        (("height",), "48", "height"),
        (("keys",), [], "keys are 0"),
        (("keys",), 3, "keys"),
        (("keys", 1, "seconds"), 0.0, r"keys\[1\].seconds is 0, but must be later"),
        (("keys", 0, "seconds"), -1.0, r"keys\[0\].seconds is -1"),
        (("keys", 3, "seconds"), 1e9, r"keys\[3\].seconds"),
        (("keys", 2, "fov"), 180.0, r"keys\[2\].fov is 180"),
        (("keys", 2, "c2w"), [[1, 0, 0, 0]], r"keys\[2\].c2w must be three rows"),
        (("keys", 2, "c2w", 0), [1, 0, 0], r"keys\[2\].c2w must be three rows"),
        (("keys", 2, "c2w", 0, 3), 1e30, r"keys\[2\].c2w holds 1e\+30"),
        (("keys", 2, "c2w", 0, 0), 5.0, r"keys\[2\].c2w must turn and move only"),
        (("keys", 2, "c2w"), [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0]], "right-handed"),
    ],
)
def test_what_is_wrong_is_named(
    content: dict[str, Any], tmp_path: Path, place: tuple[Any, ...], value: Any, says: str
) -> None:
    node: Any = content
    for step in place[:-1]:
        node = node[step]
    node[place[-1]] = value
    with pytest.raises(InputError, match=says) as refused:
        read_path(save(tmp_path, content))
    assert str(tmp_path / "path.json") in str(refused.value)


@pytest.mark.parametrize("raw", [b"", b"{", b"[]", b"null", b"\xff\xfe", b'{"keys": [NaN]}'])
def test_what_is_no_path_is_refused(tmp_path: Path, raw: bytes) -> None:
    path = tmp_path / "path.json"
    path.write_bytes(raw)
    with pytest.raises(InputError, match=r"path\.json"):
        read_path(path)
    with pytest.raises(InputError, match="none"):
        read_path(tmp_path / "none.json")


def places(node: Any, before: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    inside = node.items() if isinstance(node, dict) else enumerate(node)
    found = []
    for step, value in inside:
        found.append((*before, step))
        if isinstance(value, dict | list):
            found += places(value, (*before, step))
    return found


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner),
    max_leaves=6,
)


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_a_changed_file_gives_cameras_or_a_sentence(
    data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    content = copy.deepcopy(json.loads(recorded().to_json()))
    place = data.draw(st.sampled_from(places(content)))
    node: Any = content
    for step in place[:-1]:
        node = node[step]
    node[place[-1]] = data.draw(JSON)
    path = save(tmp_path_factory.getbasetemp(), content)
    try:
        cameras = read_path(path).cameras(5)
    except InputError as refused:
        assert str(refused).endswith(".")
        return
    assert len(cameras) == 5 and all(np.isfinite(camera.c2w).all() for camera in cameras)
