"""What stands in the scene besides the field: training cameras, the crop box, the recorded path."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from warpnerf.checks import InputError
from warpnerf.media.camera_path import path_lens
from warpnerf.media.contact_sheet import spread
from warpnerf.scenes.camera import Camera
from warpnerf.scenes.scene import Scene, View
from warpnerf.viewer.viewpoint import DISTANCE, World, fov_to_see

if TYPE_CHECKING:
    import viser

MAX_CAMERAS = 200
"""That are shown; of more, so many evenly spread ones."""
THUMBNAIL = 128
"""Pixels along the longer side of a photograph on its camera."""

CAMERA_COLOUR = (235, 120, 30)
BOX_COLOUR = (60, 140, 240)
PATH_COLOUR = (70, 180, 90)

CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
EDGES = [(a, b) for a in range(8) for b in range(a) if np.abs(CORNERS[a] - CORNERS[b]).sum() == 1]


class Stage:
    """Things in viser's scene, seen by all pages."""

    def __init__(self, server: viser.ViserServer, world: World, scene: Scene | None) -> None:
        """Put the training cameras up."""
        self._server = server
        self._world = world
        self._handles: list[Any] = []
        self._views: list[View] = []  # whose photographs are not shown yet
        self.length = 0.0
        """Of a camera's pyramid, viser's units."""
        self._scale = 1.0
        self.cameras: dict[str, Camera] = {}
        """Those that are shown, by the names of their photographs."""
        if scene is not None:
            views = [scene.views[index] for index in scene.splits["train"]]
            self._views = [views[index] for index in spread(len(views), MAX_CAMERAS)]
            self.cameras = {view.name: _straight(view.camera) for view in self._views}
            self.length = _length(list(self.cameras.values()), world)
            for camera in self.cameras.values():
                self._add_camera(camera)
        self._places = np.array([camera.position for camera in self.cameras.values()]).reshape(
            -1, 3
        )

    def show_photographs(self) -> None:
        """Begin to put the photographs on their cameras, in a thread of its own; once."""
        views, self._views = self._views, []
        if views:
            threading.Thread(target=self._put_up, args=(views,), daemon=True).start()

    def _put_up(self, views: Sequence[View]) -> None:
        for handle, view in zip(self._handles, views, strict=True):
            with suppress(InputError):  # its file is no longer what it was
                handle.image = thumbnail(view.image)

    def show_cameras(self, visible: bool, scale: float) -> None:
        """Show or hide them, so many times as large as at first."""
        self._scale = scale
        for handle, camera in zip(self._handles, self.cameras.values(), strict=True):
            handle.visible = visible
            handle.scale = scale * _frustum_scale(camera, self.length)

    def in_the_way(self, position: np.ndarray) -> list[str]:
        """Names of the cameras that one stands in at a position [3], scene units."""
        apart = self._world.scale * np.linalg.norm(self._places - position, axis=1)
        return [self._handles[i].name for i in np.flatnonzero(apart < self._scale * self.length)]

    def show_box(self, crop: tuple[Sequence[float], Sequence[float]] | None) -> None:
        """Show a box by its corners, scene units; None: none."""
        if crop is None:
            self._server.scene.remove_by_name("/crop")
            return
        low, high = np.array(crop)
        corners = self._world.scale * (low + CORNERS * (high - low))
        self._lines("/crop", corners[EDGES], BOX_COLOUR)

    def show_path(self, positions: np.ndarray) -> None:
        """Show a line through positions [n, 3], scene units; fewer than two: none."""
        if len(positions) < 2:
            self._server.scene.remove_by_name("/path")
            return
        points = self._world.scale * positions
        self._lines("/path", np.stack([points[:-1], points[1:]], axis=1), PATH_COLOUR)

    def _lines(self, name: str, points: np.ndarray, colour: tuple[int, int, int]) -> None:
        self._server.scene.add_line_segments(
            name,
            points.astype(np.float32),
            colors=colour,
            thickness=2.0,
            thickness_units="screen",
        )

    def _add_camera(self, camera: Camera) -> None:
        wxyz, position = self._world.pose(camera.c2w)
        handle = self._server.scene.add_camera_frustum(
            f"/cameras/{len(self._handles):04}",
            fov=2.0 * float(np.arctan(0.5 * camera.height / camera.fy)),
            aspect=camera.width / camera.fx * camera.fy / camera.height,
            scale=_frustum_scale(camera, self.length),
            thickness=1.5,
            thickness_units="screen",
            color=CAMERA_COLOUR,
            format="jpeg",
            wxyz=wxyz,
            position=position,
            cast_shadow=False,
            receive_shadow=False,
        )
        handle.on_click(_to_stand_in(camera, self._world))
        self._handles.append(handle)


def stand_in(client: viser.ClientHandle, camera: Camera, world: World) -> None:
    """Move a page's camera to a photograph's, with all of the photograph in its window."""
    wxyz, position = world.pose(camera.c2w)
    with client.atomic():
        client.camera.fov = fov_to_see(camera, client.camera.aspect)
        client.camera.position = position
        client.camera.look_at = position + DISTANCE * camera.forward
        client.camera.wxyz = wxyz
    client.flush()


def thumbnail(image: np.ndarray) -> np.ndarray:
    """A photograph [H, W, 3 or 4] uint8 made small, over white; [h, w, 3] uint8."""
    picture = Image.fromarray(image)
    picture.thumbnail((THUMBNAIL, THUMBNAIL))
    if picture.mode == "RGBA":
        paper = Image.new("RGBA", picture.size, "white")
        picture = Image.alpha_composite(paper, picture)
    return np.asarray(picture.convert("RGB"))


def _straight(camera: Camera) -> Camera:
    """A camera of straight lines, as viser's are, that sees about as much."""
    return path_lens([camera], None) if camera.fisheye else camera


def _to_stand_in(camera: Camera, world: World) -> Callable[[Any], None]:
    def clicked(event: Any) -> None:
        stand_in(event.client, camera, world)

    return clicked


def _frustum_scale(camera: Camera, length: float) -> float:
    """What viser calls the scale of a pyramid of some length: its volume sets it."""
    return length * float(np.cbrt(camera.width / camera.fx * camera.height / camera.fy / 12.0))


def _length(cameras: Sequence[Camera], world: World) -> float:
    """Of the cameras' pyramids, viser's units: shorter where they stand close together."""
    positions = world.scale * np.array([camera.position for camera in cameras])
    apart = np.linalg.norm(positions[:, None] - positions[None], axis=-1)
    np.fill_diagonal(apart, np.inf)
    nearest = float(np.median(apart.min(axis=1)))
    return float(np.clip(0.6 * nearest, 0.03 * DISTANCE, 0.1 * DISTANCE))
