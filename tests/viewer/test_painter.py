"""Pixels of the viewer are those of the field, in whatever parts they are made."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.support.tiny_fields import tiny_field
from tests.support.tiny_scenes import camera_at, look_at, ring
from warpnerf.fields.occupancy import FreeCells
from warpnerf.media.pictures import depth_colours, depth_picture, to_bytes
from warpnerf.rendering.field import Field
from warpnerf.viewer.painter import Painter, Settings, Subject
from warpnerf.viewer.recorder import Recorder
from warpnerf.viewer.viewpoint import Viewpoint, World, first_look, fov_to_see

SIZE = (40, 30)
SETTINGS = Settings(near=1.0, far=4.0, within=2.5)
VIEWPOINT = Viewpoint(c2w=ring(5)[1][:3], fov=0.9, width=80, height=60)


@pytest.fixture(scope="module")
def field() -> Field:
    return tiny_field()


def painter(*fields: Field) -> Painter:
    return Painter([Subject(name=str(i), field=lambda f=f: f) for i, f in enumerate(fields)])


def test_colour_depth_and_opacity_are_those_of_the_field(field: Field) -> None:
    seen = field.render(VIEWPOINT.camera(*SIZE))
    wanted: dict[Any, np.ndarray] = {
        "colour": seen.rgb,
        "depth": depth_picture(seen, 1.0, 4.0),
        "opacity": np.repeat(seen.opacity[..., None], 3, axis=-1),
    }
    assert seen.rgb.std() > 0.05 and seen.opacity.std() > 0.05
    for kind, picture in wanted.items():
        painted = painter(field).paint(VIEWPOINT, replace(SETTINGS, kind=kind), SIZE)
        np.testing.assert_array_equal(painted, to_bytes(picture))


def test_the_near_field_is_what_lies_within(field: Field) -> None:
    """Bright where it is dense; nothing of it farther away than said."""
    near = replace(SETTINGS, kind="near field")
    steps = replace(field.steps, far=2.5, transmittance_min=0.0)
    opacity = replace(field, steps=steps).render(VIEWPOINT.camera(*SIZE)).opacity
    assert opacity.max() > 0.3
    wanted = to_bytes(depth_colours(1.0 - np.sqrt(opacity), 0.0, 1.0))
    np.testing.assert_array_equal(painter(field).paint(VIEWPOINT, near, SIZE), wanted)
    nothing = painter(field).paint(VIEWPOINT, replace(near, within=0.5), SIZE)
    assert (nothing == nothing[0, 0]).all()


@pytest.mark.parametrize("layout", ["side by side", "divided", "first", "second"])
def test_bands_put_together_are_the_picture(field: Field, layout: Any) -> None:
    both = painter(field, tiny_field(density=0.0))
    settings = replace(SETTINGS, layout=layout, divider=0.3)
    whole = both.paint(VIEWPOINT, settings, SIZE)
    bands = [both.paint(VIEWPOINT, settings, SIZE, range(a, min(30, a + 7))) for a in (0, 7, 14)]
    bands += [both.paint(VIEWPOINT, settings, SIZE, range(21, 30))]
    np.testing.assert_array_equal(np.concatenate(bands), whole)


def test_two_fields_share_the_page(field: Field) -> None:
    other = tiny_field(density=0.0)
    alone, beside = (painter(f).paint(VIEWPOINT, SETTINGS, SIZE) for f in (field, other))
    assert (alone != beside).any(axis=-1).mean() > 0.3

    def both(**changes: Any) -> np.ndarray:
        settings = replace(SETTINGS, **changes)
        return painter(field, other).paint(VIEWPOINT, settings, SIZE)

    np.testing.assert_array_equal(both(layout="first"), alone)
    np.testing.assert_array_equal(both(layout="second"), beside)
    divided = both(layout="divided", divider=0.25)
    np.testing.assert_array_equal(divided[:, :10], alone[:, :10])
    np.testing.assert_array_equal(divided[:, 11:], beside[:, 11:])
    assert (divided[:, 10] == 255).all()
    side = both(layout="side by side")  # the middle half of each
    np.testing.assert_array_equal(side[:, :20], alone[:, 10:30])
    np.testing.assert_array_equal(side[:, 21:], beside[:, 11:30])
    np.testing.assert_array_equal(both(layout="divided", divider=1.0), alone)
    np.testing.assert_array_equal(both(layout="divided", divider=0.0), beside)


@pytest.mark.parametrize("contraction", ["none", "linf"])
def test_outside_of_the_crop_box_is_nothing(contraction: Any) -> None:
    """From above, the half of the box that is left; and nothing of what lies around the box."""
    field = tiny_field(contraction=contraction)
    finer = replace(field.lattice, size=(42, 42, 42))
    grid = field.storage.resized(field.workers, finer)
    field = replace(field, storage=grid, free=FreeCells.none(field.workers))
    above = Viewpoint(
        c2w=look_at((1e-3, 0.0, 4.0), (0.0, 0.0, 0.0))[:3], fov=1.0, width=60, height=60
    )
    settings = replace(SETTINGS, kind="opacity", crop=((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)))
    whole = painter(field).paint(above, settings, (60, 60))[..., 0]
    half = replace(settings, crop=((-1.0, -1.0, -1.0), (1.0, 0.0, 1.0)))
    cut = painter(field).paint(above, half, (60, 60))[..., 0]
    seen = np.argwhere(cut > 100)
    kept = np.argwhere(whole > 100)
    assert len(kept) > 100 and 0.3 * len(kept) < len(seen) < 0.7 * len(kept)
    for name, cropped in (("whole", whole), ("half", cut)):
        assert cropped[0].max() == 0, name  # the rim of the picture is outside of the box
    everything = painter(field).paint(above, replace(settings, crop=None), (60, 60))
    assert (everything[0].max() > 0) == (contraction != "none")


def test_a_crop_is_made_once_for_a_field(field: Field) -> None:
    one = painter(field)
    settings = replace(SETTINGS, crop=((-1.0, -1.0, -1.0), (1.0, 0.0, 1.0)))
    free = one._crop(0, field, settings.crop)
    assert one._crop(0, field, settings.crop) is free
    assert one._crop(0, field, ((-1.0, -1.0, -1.0), (1.0, 0.5, 1.0))) is not free
    changed = replace(field, free=replace(field.free, border=field.free.border))
    assert one._crop(0, changed, settings.crop) is not free


def test_a_pose_goes_to_viser_and_back() -> None:
    world = World(scale=0.7)
    for pose in ring(4):
        wxyz, position = world.pose(pose[:3])
        there = world.viewpoint(wxyz, position, 0.9, 80, 60)
        assert there is not None
        np.testing.assert_allclose(there.c2w, pose[:3], atol=1e-12)


def test_visers_axes_are_opencvs() -> None:
    """Looking along +z with y down is looking along -z with y up, the other way round."""
    there = World(scale=2.0).viewpoint((1, 0, 0, 0), (2, 4, 6), 0.9, 80, 60)
    assert there is not None
    np.testing.assert_allclose(there.c2w[:, :3], np.diag([1.0, -1.0, -1.0]))
    np.testing.assert_allclose(there.c2w[:, 3], [1.0, 2.0, 3.0])
    camera = there.camera(40, 30)
    assert camera.fy == pytest.approx(15.0 / np.tan(0.45)) and camera.fx == pytest.approx(camera.fy)
    assert (camera.cx, camera.cy) == (20.0, 15.0)
    assert there.camera(41, 30).fx == pytest.approx(camera.fx * 41 / 40)  # stretched by the page


@pytest.mark.parametrize(
    "said",
    [
        {"wxyz": (0, 0, 0, 0)},
        {"wxyz": (float("nan"), 0, 0, 1)},
        {"wxyz": (1, 0, 0)},
        {"position": (1e9, 0, 0)},
        {"position": (float("inf"), 0, 0)},
        {"fov": 0.0},
        {"fov": float("nan")},
        {"fov": 4.0},
        {"width": 0},
        {"height": -3},
        {"width": 10**12},
    ],
)
def test_what_is_no_camera_is_none(said: dict[str, Any]) -> None:
    good = {"wxyz": (1, 0, 0, 0), "position": (0, 0, 0), "fov": 1.0, "width": 80, "height": 60}
    world = World(scale=1.0)
    assert world.viewpoint(**good) is not None
    assert world.viewpoint(**(good | said)) is None


def test_a_canvas_wider_than_any_video_can_be_recorded() -> None:
    recorder = Recorder()
    for x in (0.0, 1.0):
        there = World(scale=1.0).viewpoint((1, 0, 0, 0), (x, 0, 0), 0.9, 10_240, 1440)
        assert there is not None and (there.width, there.height) == (8000, 1125)
        recorder.add(there, 1.0)
    assert recorder.line().shape == (32, 3)


@pytest.mark.parametrize(
    "lens", [{"fisheye": True, "fx": 3.0, "fy": 3.0}, {"width": 9000, "fx": 9000.0}]
)
def test_pages_begin_before_any_photograph(lens: dict[str, Any]) -> None:
    """More than a window can hold, of a fisheye's circle, is seen at 90 degrees."""
    camera = camera_at(ring(5)[2], **lens)
    look = first_look([camera])
    np.testing.assert_array_equal(look.c2w, camera.c2w)
    assert 0.1 < look.fov < 2.0
    if camera.fisheye:
        assert look.fov == pytest.approx(np.pi / 2)


def test_a_window_sees_all_of_a_photograph() -> None:
    camera = camera_at(np.eye(4), width=80, height=60, fx=50.0, fy=50.0, cx=40.0, cy=30.0)
    assert fov_to_see(camera, 2.0) == pytest.approx(2.0 * np.arctan(0.6))  # its height decides
    assert fov_to_see(camera, 1.0) == pytest.approx(2.0 * np.arctan(0.8))  # its width decides
