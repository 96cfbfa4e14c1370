"""The built-in building: rooms side by side, each with its own cameras."""

import numpy as np
import pytest

from warpnerf.checks import InputError
from warpnerf.scenes.formats.load import load_scene


def test_a_building_is_the_room_again_in_other_places_and_colours() -> None:
    room, building = (
        load_scene(f"builtin:{n}", downscale=16) for n in ("room-sparse", "building-5")
    )
    n = len(room.views)
    assert len(building.views) == 5 * n and len(building.splits["test"]) == 50
    first, last = building.views[3], building.views[4 * n + 3]
    np.testing.assert_array_equal(first.image, room.views[3].image)
    np.testing.assert_array_equal(np.sort(last.image), np.sort(first.image))
    assert (last.image != first.image).any()
    moved = last.camera.position - first.camera.position
    np.testing.assert_allclose(moved, [4.2, 5.2, 0.0])  # in the second row of three
    inside = [
        (building.box_min < c.position) & (c.position < building.box_max) for c in building.cameras
    ]
    assert np.all(inside)
    assert building.photograph is not None
    np.testing.assert_array_equal(building.photograph(last.camera), last.image)


def test_a_building_has_rooms() -> None:
    with pytest.raises(InputError, match="has 1 to 10000 rooms, not 0"):
        load_scene("builtin:building-0")
