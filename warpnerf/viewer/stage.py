"""What stands in the scene besides the field: training cameras, the crop box, the recorded path.

Box and path are the same for all pages. Cameras are put up for each page when it has its first fine
picture: two hundred pyramids would keep a browser from that for a second.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from warpnerf.checks import InputError
from warpnerf.media.camera_path import path_lens
from warpnerf.media.contact_sheet import spread
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.scene import Scene, View
from warpnerf.viewer.viewpoint import DISTANCE, World, fov_to_see

if TYPE_CHECKING:
    import viser

MAX_CAMERAS = 200
"""That are shown; of more, so many evenly spread ones."""
THUMBNAIL = 128
"""Pixels along the longer side of a photograph on its camera."""
EYES = 2.0
"""Lengths of a pyramid from its camera: whoever looks from within does not see it."""
AMONG = 8.0
"""Lengths of a pyramid from the nearest camera, within which one stands among them."""

CAMERA_COLOUR = (255, 60, 0)
"""Which the page's tone mapping turns to orange."""
BOX_COLOUR = (60, 140, 240)
PATH_COLOUR = (70, 180, 90)

CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
EDGES = [(a, b) for a in range(8) for b in range(a) if np.abs(CORNERS[a] - CORNERS[b]).sum() == 1]

PYRAMID = np.array(
    [[0, 0, 0], [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1], [0, -1, 1], [0, -1.2, 1]]
)
"""Vertices: the apex, the corners of the base, and a line that says where up is; y is down."""
SIDES = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1], [5, 6, 6]])
"""The triangles of which the edges are drawn, and by which a pyramid is clicked on."""


class Stage:
    """Things in viser's scene."""

    def __init__(self, server: viser.ViserServer, world: World, scene: Scene | None) -> None:
        """Nothing is there yet."""
        self._server = server
        self._world = world
        self._pages: dict[int, Pyramids] = {}
        self.cameras: dict[str, Camera] = {}
        """Those that are shown, by the names of their photographs."""
        self.orientations = np.empty((0, 4))
        """Of the pyramids, [n, 4] quaternions in viser's axes, w first."""
        self.apexes = np.empty((0, 3))
        """Where they begin, [n, 3] in viser's units."""
        self.extents = np.empty((0, 3))
        """Half the width and the height of their bases, and their length, [n, 3], viser's units."""
        self._views: list[View] = []
        self._photographs: dict[int, np.ndarray | None] = {}
        self._places = np.empty((0, 3))
        self.length = 0.0
        """Of a pyramid, viser's units."""
        self.visible = True
        """Whether cameras are shown."""
        self.scale = 1.0
        """How many times as large as at first."""
        if scene is not None:
            views = [scene.views[index] for index in scene.splits["train"]]
            self._views = [views[index] for index in spread(len(views), MAX_CAMERAS)]
            self.cameras = {view.name: _straight(view.camera) for view in self._views}
            cameras = list(self.cameras.values())
            self._places = np.array([camera.position for camera in cameras])
            self.length = _length(cameras, world)
            poses = [world.pose(camera.c2w) for camera in cameras]
            self.orientations = np.array([wxyz for wxyz, _ in poses])
            self.apexes = np.array([position for _, position in poses])
            slopes = [[c.width / (2.0 * c.fx), c.height / (2.0 * c.fy), 1.0] for c in cameras]
            self.extents = self.length * np.array(slopes)

    def welcome(self, client: viser.ClientHandle) -> Pyramids:
        """The cameras for a new page."""
        self._pages[client.client_id] = pyramids = Pyramids(client, self)
        return pyramids

    def forget(self, client_id: int) -> None:
        """A page has gone."""
        pyramids = self._pages.pop(client_id, None)
        if pyramids is not None:
            pyramids.gone = True

    def show_cameras(self, visible: bool, scale: float) -> None:
        """Show or hide them, so many times as large as at first."""
        self.visible, self.scale = visible, scale
        for pyramids in list(self._pages.values()):
            pyramids.refresh()

    def in_the_way(self, position: np.ndarray) -> frozenset[int]:
        """The cameras in front of the eyes of whoever looks from a position [3], scene units."""
        return frozenset(np.flatnonzero(self._lengths_from(position) < EYES).tolist())

    def photographs_from(self, position: np.ndarray) -> bool:
        """Whether cameras show their photographs from a position [3], scene units.

        Not to whoever stands among them: between the outermost ones, or near one.
        """
        if not len(self._places):
            return False
        inside = (position >= self._places.min(axis=0)) & (position <= self._places.max(axis=0))
        return not inside.all() and float(self._lengths_from(position).min()) >= AMONG

    def _lengths_from(self, position: np.ndarray) -> np.ndarray:
        """How far the cameras are from a position, in lengths of their pyramids as shown, [n]."""
        apart = self._world.scale * np.linalg.norm(self._places - position, axis=1)
        return apart / (self.scale * self.length)

    def photograph(self, index: int) -> np.ndarray | None:
        """What a camera took, small; [h, w, 3] uint8, None: its file is not what it was."""
        if index not in self._photographs:
            try:
                self._photographs[index] = thumbnail(self._views[index].image)
            except InputError:
                self._photographs[index] = None
        return self._photographs[index]

    def base(self, index: int) -> tuple[float, float, np.ndarray]:
        """Width, height and middle [3] of the base of a pyramid, in viser's units."""
        width, height, length = self.scale * self.extents[index]
        forward = self.cameras[self._views[index].name].forward
        return 2.0 * width, 2.0 * height, self.apexes[index] + length * forward

    def clicked(self, index: int, client: viser.ClientHandle) -> None:
        """Have a page stand in a camera."""
        stand_in(client, self.cameras[self._views[index].name], self._world)

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


class Pyramids:
    """The training cameras of one page. Any thread may call."""

    def __init__(self, client: viser.ClientHandle, stage: Stage) -> None:
        """None is shown before ``put_up``."""
        self._client = client
        self._stage = stage
        self._pyramids: Any = None  # all of them, in one call of the page's graphics
        self._photographs: list[tuple[int, Any]] = []  # indices of cameras, and what shows them
        self._folder: Any = None
        self._hidden: frozenset[int] | None = None  # None: to be told again
        self._position = np.full(3, np.inf)
        self._begun = False
        self._lock = threading.Lock()
        self.gone = False
        """Whether the page has been closed."""

    def put_up(self) -> None:
        """Begin to put them up, then their photographs, in a thread; once."""
        if self._stage.cameras and not self._begun:
            self._begun = True
            threading.Thread(target=self._put_up, daemon=True).start()

    def _put_up(self) -> None:
        with self._lock, self._client.atomic():
            if self.gone:
                return
            self._pyramids = self._client.scene.add_batched_meshes_simple(
                "/cameras",
                PYRAMID.astype(np.float32),
                SIDES.astype(np.uint32),
                self._stage.orientations,
                self._stage.apexes,
                batched_scales=np.zeros_like(self._stage.extents),
                batched_colors=CAMERA_COLOUR,
                lod="off",
                wireframe=True,
                side="double",
                cast_shadow=False,
                receive_shadow=False,
            )
            self._pyramids.on_click(self._clicked)
            # All photographs are shown and hidden by one message.
            self._folder = self._client.scene.add_frame(
                "/photographs", show_axes=False, visible=False
            )
        self.refresh()
        for index in range(len(self._stage.cameras)):
            photograph = self._stage.photograph(index)
            with self._lock:
                if self.gone:
                    break
                if photograph is not None:
                    self._add_photograph(index, photograph)

    def _add_photograph(self, index: int, photograph: np.ndarray) -> None:
        width, height, position = self._stage.base(index)
        handle = self._client.scene.add_image(
            f"/photographs/{index:04}",
            photograph,
            width,
            height,
            format="jpeg",
            wxyz=self._stage.orientations[index],
            position=position,
            cast_shadow=False,
            receive_shadow=False,
        )
        handle.on_click(lambda event: self._stage.clicked(index, event.client))
        self._photographs.append((index, handle))

    def _clicked(self, event: Any) -> None:
        """Have the page stand in a camera: a page says which, and may say anything."""
        index = event.instance_index
        if isinstance(index, int) and 0 <= index < len(self._stage.cameras):
            self._stage.clicked(index, event.client)

    def stand_at(self, position: np.ndarray) -> None:
        """Hide those in front of one's eyes at a position [3], scene units, and photographs there.

        Photographs are shown to those who stand outside of all cameras.
        """
        self._position = position
        self._hide()

    def refresh(self) -> None:
        """Show what is to be shown, as large as it is to be."""
        stage = self._stage
        with self._lock:
            self._hidden = None
            for index, handle in self._photographs:
                handle.render_width, handle.render_height, handle.position = stage.base(index)
        self._hide()

    def _hide(self) -> None:
        """Show or hide cameras and photographs: fifty times a second, so only what changes."""
        stage = self._stage
        hidden = (
            stage.in_the_way(self._position)
            if stage.visible
            else frozenset(range(len(stage.cameras)))
        )
        with self._lock:
            if self._folder is None:
                return
            self._folder.visible = stage.visible and stage.photographs_from(self._position)
            if hidden != self._hidden:
                extents = stage.scale * stage.extents
                extents[list(hidden)] = 0.0
                self._pyramids.batched_scales = extents
                self._hidden = hidden


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


def _length(cameras: Sequence[Camera], world: World) -> float:
    """Of the cameras' pyramids, viser's units: shorter where they stand close together."""
    positions = world.scale * np.array([camera.position for camera in cameras])
    apart = np.linalg.norm(positions[:, None] - positions[None], axis=-1)
    np.fill_diagonal(apart, np.inf)
    nearest = float(np.median(apart.min(axis=1)))
    return float(np.clip(0.6 * nearest, 0.03 * DISTANCE, 0.1 * DISTANCE))
