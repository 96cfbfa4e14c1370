"""A camera path, put together in the page: places where its camera stood, and the way between."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from warpnerf.media.recorded_path import Key, RecordedPath
from warpnerf.viewer.viewpoint import DISTANCE, Viewpoint, World

if TYPE_CHECKING:
    import viser

PREVIEW_FPS = 15
MOST_KEYS = 500
FILE_NAME = "path.json"


class Recorder:
    """The keys that were recorded."""

    def __init__(self) -> None:
        """None yet."""
        self._keys: list[Key] = []
        self._size = (0, 0)

    def add(self, viewpoint: Viewpoint, seconds: float) -> None:
        """Pass here, so many seconds after the key before. The last one's window is the picture's.

        A key more than MOST_KEYS is forgotten.

        Args:
            viewpoint: Where a page looks from.
            seconds: Ignored for the first key.
        """
        if len(self._keys) >= MOST_KEYS:
            return
        at = self._keys[-1].seconds + seconds if self._keys else 0.0
        self._size = viewpoint.width, viewpoint.height
        fov = math.degrees(viewpoint.fov)
        self._keys = [*self._keys, Key(seconds=at, fov=fov, c2w=viewpoint.c2w.tolist())]

    def drop(self) -> None:
        """Forget the last key."""
        self._keys = self._keys[:-1]

    def clear(self) -> None:
        """Forget all."""
        self._keys = []

    def __len__(self) -> int:
        """How many keys there are."""
        return len(self._keys)

    @property
    def path(self) -> RecordedPath | None:
        """What the file will hold; None without a key."""
        if not self._keys:
            return None
        width, height = self._size
        return RecordedPath(width=width, height=height, keys=self._keys)

    def line(self) -> np.ndarray:
        """The way between the keys, [n, 3] scene units."""
        path = self.path
        if path is None or len(self) < 2:
            return np.empty((0, 3))
        return np.array([camera.position for camera in path.cameras(16 * len(self))])


def preview(
    client: viser.ClientHandle,
    path: RecordedPath,
    world: World,
    clients: Callable[[], Mapping[int, object]],
) -> None:
    """Fly a page's camera along a path, in its own time, as long as it is one of the clients."""
    cameras = path.cameras(max(2, round(PREVIEW_FPS * path.seconds)))
    began = time.monotonic()
    for number, camera in enumerate(cameras):
        time.sleep(max(0.0, began + number / PREVIEW_FPS - time.monotonic()))
        if client.client_id not in clients():
            return
        wxyz, position = world.pose(camera.c2w)
        with client.atomic():
            client.camera.fov = 2.0 * math.atan(0.5 * camera.height / camera.fy)
            client.camera.position = position
            client.camera.look_at = position + DISTANCE * camera.forward
            client.camera.wxyz = wxyz
