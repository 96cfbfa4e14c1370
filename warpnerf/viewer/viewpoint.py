"""Where a page looks from, and how viser's world lies to the scene's.

viser's axes are OpenCV's (x right, y down, looking along +z), its rotations quaternions w, x, y, z.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from warpnerf.media.camera_path import MAX_SIDE, path_lens
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.focus import up_direction

if TYPE_CHECKING:
    import viser

DISTANCE = 3.0
"""The content distance in viser's units. Its keys move by two of them in a second, and it shows
what lies between a hundredth and a thousand."""

FLIP = np.array([1.0, -1.0, -1.0])
"""From OpenGL's camera axes to OpenCV's, and back."""

FARTHEST = 1e5
"""From the origin, in viser's units, that a page may look from."""

ASPECT = 4.0 / 3.0
"""Of a window that has not said its own yet."""

NARROWEST, WIDEST = math.radians(1.0), math.radians(170.0)
"""Fields of view that a page may request."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Viewpoint:
    """A page's camera: square pixels, no distortion, the axis in the middle of the picture."""

    c2w: np.ndarray
    """[3, 4] camera to world, OpenGL axes, scene units."""
    fov: float
    """Vertical field of view, radians."""
    width: int
    """Of the page's canvas, pixels; at most MAX_SIDE."""
    height: int
    """Of the page's canvas, pixels; at most MAX_SIDE."""

    def camera(self, width: int, height: int) -> Camera:
        """The camera of a picture of any size, which the page stretches over its canvas."""
        focal = 0.5 / math.tan(0.5 * self.fov)  # canvas heights
        return Camera(
            width=width,
            height=height,
            fx=focal * width * self.height / self.width,
            fy=focal * height,
            cx=0.5 * width,
            cy=0.5 * height,
            c2w=self.c2w,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class FirstLook:
    """Where a new page looks from."""

    c2w: np.ndarray
    """[3, 4] camera to world, OpenGL axes, scene units."""
    fov: float
    """Vertical field of view, radians."""
    up: np.ndarray
    """[3], what is up."""


@dataclass(frozen=True, kw_only=True)
class World:
    """viser's world: the scene's, scaled about its origin."""

    scale: float
    """viser's units in a scene unit."""

    @staticmethod
    def of(content_distance: float) -> World:
        """The world of a scene with this content distance, scene units."""
        return World(scale=DISTANCE / content_distance)

    def pose(self, c2w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A pose c2w [3, 4] as viser has it: quaternion [4] and position [3]."""
        from viser.transforms import SO3

        rotation = np.asarray(c2w[:, :3] * FLIP, np.float64)
        return SO3.from_matrix(rotation).wxyz, self.scale * c2w[:, 3]

    def begin(self, server: viser.ViserServer, look: FirstLook) -> None:
        """Have the pages of a server look from here first."""
        _, position = self.pose(look.c2w)
        x, y, z = look.up
        server.scene.set_up_direction((float(x), float(y), float(z)))
        # What stands in the scene has no shading: light from all sides costs a page the least.
        server.scene.configure_default_lights(enabled=False)
        server.scene.configure_environment_map(hdri=None)
        server.scene.add_light_ambient("/light", intensity=math.pi)
        start = server.initial_camera
        start.position, start.look_at = position, position - DISTANCE * look.c2w[:, 2]
        start.up, start.fov = look.up, look.fov

    def viewpoint(
        self,
        wxyz: Sequence[float],
        position: Sequence[float],
        fov: float,
        width: int,
        height: int,
    ) -> Viewpoint | None:
        """What a page says about its camera; None where that is no camera: anybody may say it."""
        from viser.transforms import SO3

        turn, place = np.asarray(wxyz, np.float64), np.asarray(position, np.float64)
        if turn.shape != (4,) or place.shape != (3,) or not np.isfinite([*turn, *place]).all():
            return None
        if np.abs(place).max() > FARTHEST:
            return None
        length = float(np.linalg.norm(turn))
        if not (0.5 < length < 2.0 and NARROWEST <= fov <= WIDEST and width > 0 and height > 0):
            return None
        if max(width, height) > 100 * min(width, height):
            return None
        c2w = np.empty((3, 4))
        c2w[:, :3] = SO3(turn / length).as_matrix() * FLIP
        c2w[:, 3] = place / self.scale
        width, height = _within_most(width, height)
        return Viewpoint(c2w=c2w, fov=fov, width=width, height=height)


def fov_to_see(camera: Camera, aspect: float) -> float:
    """The vertical field of view, radians, in which a window sees all of a photograph's middle.

    Args:
        camera: Of the photograph.
        aspect: Width of the window by its height.
    """
    half = max(0.5 * camera.height / camera.fy, 0.5 * camera.width / camera.fx / aspect)
    return min(2.0 * math.atan(half), WIDEST)


def first_look(cameras: Sequence[Camera], begin: Camera | None = None) -> FirstLook:
    """From where a camera stands, seeing the middle of its photograph.

    Args:
        cameras: Those of the training; they tell which way is up.
        begin: The camera; None: the first of them.
    """
    camera = cameras[0] if begin is None else begin
    lens = path_lens([camera], _within_most(camera.width, camera.height))
    return FirstLook(c2w=lens.c2w, fov=fov_to_see(lens, ASPECT), up=up_direction(cameras))


def _within_most(width: int, height: int) -> tuple[int, int]:
    """A size of the same shape, within MAX_SIDE pixels."""
    shrink = min(1.0, MAX_SIDE / max(width, height))
    return max(1, round(shrink * width)), max(1, round(shrink * height))
