"""What is filmed is what the field shows, with depths in the colours that the legend says."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.support.tiny_fields import tiny_field
from tests.support.tiny_scenes import camera_at, ring, tiny_scene
from warpnerf.checks import InputError
from warpnerf.media.camera_path import camera_path
from warpnerf.media.filming import depth_range, render_stills, render_video
from warpnerf.media.pictures import colour_and_depth
from warpnerf.rendering.field import Rendering

SIZE = (24, 18)


def path(n: int = 4) -> list[Any]:
    return camera_path(tiny_scene(ring(6)), "orbit", n, size=SIZE)


class Wall:
    """Stands for a field: depths that rise from top to bottom."""

    def __init__(self, near: float, far: float, opacity: float) -> None:
        self._seen = near, far, opacity

    def render(self, camera: Any) -> Rendering:
        shape = (camera.height, camera.width)
        near, far, opacity = self._seen
        depth = np.repeat(np.linspace(near, far, shape[0])[:, None], shape[1], axis=1)
        return Rendering(
            rgb=np.ones((*shape, 3), np.float32),
            depth=(depth * opacity).astype(np.float32),
            opacity=np.full(shape, opacity, np.float32),
        )


def test_frames_show_colour_and_depth(tmp_path: Path) -> None:
    field, cameras = tiny_field(), path()
    done: list[int] = []
    folder = render_video(
        field, cameras, tmp_path / "film", depths=(1.0, 5.0), on_frame=done.append
    )
    assert done == [1, 2, 3, 4]
    for number, camera in enumerate(cameras):
        expected = colour_and_depth(field.render(camera), 1.0, 5.0)
        pixels = np.asarray(Image.open(folder / f"{number:05}.png"))
        np.testing.assert_array_equal(pixels, expected)
    first, second = (Image.open(folder / f"0000{n}.png").tobytes() for n in (0, 1))
    assert first != second


def test_depths_span_what_is_seen() -> None:
    field, cameras = tiny_field(), path(20)
    near, far = depth_range(field, cameras)
    looks = [field.render(camera) for camera in cameras]
    solid = [r.opacity > 0.5 for r in looks]
    depths = np.concatenate(
        [r.depth[at] / r.opacity[at] for r, at in zip(looks, solid, strict=True)]
    )
    assert depths.size
    assert np.mean((depths > near) & (depths < far)) > 0.9
    assert near < np.percentile(depths, 5.0) and near > 0.5 * depths.min()
    assert far > np.percentile(depths, 95.0) and far < 1.5 * depths.max()


@pytest.mark.parametrize(
    ("near", "far", "opacity", "expected"),
    [
        (100.0, 254.0, 1.0, (100.0, 260.0)),
        (0.0321, 0.0321, 0.6, (0.032, 0.033)),
        (2.0, 2.0, 1.0, (2.0, 2.1)),
        (0.31, 7.25, 1.0, (0.31, 7.3)),
    ],
)
def test_depths_are_rounded_outward(
    near: float, far: float, opacity: float, expected: tuple[float, float]
) -> None:
    wall: Any = Wall(near, far, opacity)
    assert depth_range(wall, path()) == expected


def test_few_far_samples_do_not_stretch_the_range() -> None:
    class Hole(Wall):
        def render(self, camera: Any) -> Rendering:
            seen = super().render(camera)
            seen.depth[0, 0] = 1e4 * seen.opacity[0, 0]
            seen.depth[-1], seen.opacity[-1] = 0.0, 0.1  # what is not opaque does not count
            return seen

    wall: Any = Hole(3.0, 5.0, 1.0)
    assert depth_range(wall, path()) == (3.0, 4.9)


def test_where_nothing_is_seen_depths_are_made_up() -> None:
    wall: Any = Wall(3.0, 4.0, 0.2)
    assert depth_range(wall, path()) == (0.0, 1.0)


def test_stills_have_the_names_they_are_given(tmp_path: Path) -> None:
    field = tiny_field()
    cameras = {f"{i}.png": camera_at(pose) for i, pose in enumerate(ring(3))}
    render_stills(field, cameras, tmp_path / "stills", depths=(1.0, 5.0))
    assert {p.name for p in (tmp_path / "stills").iterdir()} == set(cameras)
    pixels = np.asarray(Image.open(tmp_path / "stills" / "1.png"))
    expected = colour_and_depth(field.render(cameras["1.png"]), 1.0, 5.0)
    np.testing.assert_array_equal(pixels, expected)


@pytest.mark.parametrize("name", ["../x", "/x.png", "a/b.png", "a/", "", ".", "..", "a\0b"])
def test_stills_stay_in_their_folder(tmp_path: Path, name: str) -> None:
    cameras = {"a.png": path()[0], name: path()[0]}
    with pytest.raises(InputError, match="by names of files without a path, not "):
        render_stills(tiny_field(), cameras, tmp_path / "stills")
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("depths", [(2.0, 2.0), (3.0, 1.0), (-1.0, 2.0), (0.0, float("nan"))])
def test_depths_in_the_wrong_order_are_refused(tmp_path: Path, depths: Any) -> None:
    with pytest.raises(InputError, match="range of depths"):
        render_video(tiny_field(), path(), tmp_path / "film", depths=depths)
    with pytest.raises(InputError, match="range of depths"):
        render_stills(tiny_field(), {"a.png": path()[0]}, tmp_path / "film", depths=depths)
    assert list(tmp_path.iterdir()) == []


def test_cameras_that_make_no_video_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="at least one camera"):
        render_video(tiny_field(), [], tmp_path / "film")
    with pytest.raises(InputError, match="one width and one height"):
        render_video(tiny_field(), [path()[0], camera_at(ring(1)[0])], tmp_path / "film")
    with pytest.raises(InputError, match="at least one camera"):
        render_stills(tiny_field(), {}, tmp_path / "film")
