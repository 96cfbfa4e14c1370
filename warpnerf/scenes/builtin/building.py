"""The built-in building: the furnished room again and again, in other colours, in a grid.

"builtin:building-8" has eight rooms; any number will do. Rooms are closed, so that a camera sees
its own and no other. The photographs of all are those of "builtin:room-sparse" with their colours
exchanged, which are traced once: any building is traced in the time of a room.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import permutations

import numpy as np

from warpnerf.checks import InputError
from warpnerf.scenes.builtin.room import MARGIN, ROOM_MAX, ROOM_MIN, room_scene
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.scene import Scene, View

WALL = 0.2
"""Metres between two rooms."""

MOST = 10_000
"""Rooms."""

COLOURS = tuple(permutations(range(3)))
"""Which channel of the room's pictures each channel is, from room to room."""


def building_scene(n_rooms: int, downscale: int = 1) -> Scene:
    """Build "builtin:building-N": 30 training and 10 test views in each room, with true depth.

    Args:
        n_rooms: At least 1.
        downscale: As of ``room_scene``.

    Returns:
        Scene with [H, W, 3] uint8 images; metres. Rooms stand in rows along x, of as many as there
        are rows, about; the first is where "builtin:room" is.

    Raises:
        InputError: There are no rooms, or too many.
    """
    if not 1 <= n_rooms <= MOST:
        raise InputError(f"builtin:building-N has 1 to {MOST} rooms, not {n_rooms}.")
    room = room_scene(downscale=downscale, sparse=True)
    size = np.subtract(ROOM_MAX, ROOM_MIN) + WALL
    columns = math.ceil(math.sqrt(n_rooms))
    digits = len(str(n_rooms - 1))
    places = [
        np.array([size[0] * (k % columns), size[1] * (k // columns), 0.0]) for k in range(n_rooms)
    ]
    images = [
        [np.ascontiguousarray(view.image[..., list(channels)]) for view in room.views]
        for channels in COLOURS[:n_rooms]
    ]
    views: list[View] = []
    train: list[int] = []
    test: list[int] = []
    for k, place in enumerate(places):
        for index, view in enumerate(room.views):
            (train if index in room.splits["train"] else test).append(len(views))
            views.append(
                View(
                    name=f"room_{k:0{digits}}/{view.name}",
                    camera=_moved(view.camera, place),
                    image=images[k % len(COLOURS)][index],
                    depth=view.depth,
                )
            )
    distances = [float(np.median(view.depth)) for view in room.views if view.depth is not None]

    def once_more(camera: Camera) -> np.ndarray | None:
        assert room.photograph is not None
        k = int(np.argmin([np.abs(camera.position - place - _MIDDLE).max() for place in places]))
        picture = room.photograph(_moved(camera, -places[k]))
        return None if picture is None else picture[..., list(COLOURS[k % len(COLOURS)])]

    return Scene(
        name=f"builtin:building-{n_rooms}",
        views=views,
        splits={"train": tuple(train), "test": tuple(test)},
        box_min=np.min(places, axis=0) + ROOM_MIN - MARGIN,
        box_max=np.max(places, axis=0) + ROOM_MAX + MARGIN,
        unbounded=False,
        content_distance=room.content_distance,
        content_distances=np.array(distances * n_rooms),
        notes=(f"{n_rooms} closed rooms in rows of {columns}", *room.notes),
        photograph=once_more,
    )


_MIDDLE = 0.5 * np.add(ROOM_MIN, ROOM_MAX)


def _moved(camera: Camera, by: np.ndarray) -> Camera:
    """The camera in another room."""
    return replace(camera, c2w=np.column_stack([camera.c2w[:, :3], camera.position + by]))
