"""Patches of photographs: reduced, gray, without distortion, read at any place, and compared."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.scene import View

SIDE = 96
"""Pixels of a photograph's longer side, about."""
ENOUGH = 8
"""Pixels in each direction whose mean is a reduced one, at least, where there are more."""
LEAST_SIDE = 24
"""Pixels of the shorter one; smaller photographs tell nothing."""

PATCH = np.stack(np.meshgrid(*2 * [np.linspace(-3.0, 3.0, 5)]), axis=-1).reshape(-1, 2)
"""Where a patch is sampled, [25, 2] pixels from its middle."""
RIM = 4.0
"""Pixels that a patch's middle keeps from the edges."""
PATCHES = 9, 7
"""Along a photograph's width and height."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Picture:
    """A photograph as of a pinhole camera."""

    gray: np.ndarray
    """[H, W] float32 in [0, 255]; NaN where the lens sees nothing."""
    stored: np.ndarray
    """The same as of the lens that it has."""
    focal: np.ndarray
    """[2] pixels."""
    centre: np.ndarray
    """[2] principal point, pixels."""

    def mirrored(self, across: bool, down: bool) -> Picture:
        """Mirrored left to right, and upside down, but for the principal point: a file's is that of
        the photograph that poses were found by."""
        gray = self.gray[:: -1 if down else 1, :: -1 if across else 1]
        return replace(self, gray=np.ascontiguousarray(gray))


def reduced(view: View) -> Picture:
    """A photograph, reduced by averaging, in gray, and as of a pinhole camera."""
    whole = view.camera
    factor = max(1, min(round(max(whole.width, whole.height) / SIDE), *_most(whole)))
    camera = whole.downscaled(factor)
    image = view.image[: camera.height * factor, : camera.width * factor]
    # By rows, so that no copy of a large photograph in floats is made.
    rows, every = image.reshape(camera.height, factor, -1), max(1, factor // ENOUGH)
    shape = (-1, camera.width, factor, image.shape[2])
    gray = np.stack([_gray(row[::every].reshape(shape)[:, :, ::every]) for row in rows])
    focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    stored = gray
    bent = (camera.k1, camera.k2, camera.k3, camera.p1, camera.p2, camera.rational, camera.fisheye)
    if any(bent):
        u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        straight = (np.stack([u.ravel(), v.ravel()], axis=1) - centre) / focal
        pixels = camera.distort(straight)[0] * focal + centre
        gray = bilinear(gray, pixels).reshape(gray.shape)
    return Picture(gray=gray, stored=stored, focal=focal, centre=centre)


def _most(camera: Camera) -> tuple[int, int]:
    """By how much a photograph may be reduced."""
    return camera.width // LEAST_SIDE, camera.height // LEAST_SIDE


def _gray(pixels: np.ndarray) -> np.ndarray:
    """One reduced row [width] of pixels [n, width, n, channels]."""
    mean = pixels.mean(axis=(0, 2), dtype=np.float32)
    gray = mean[:, :3].mean(axis=1)
    return gray * mean[:, 3] / np.float32(255.0) if mean.shape[1] == 4 else gray


def spread_middles(shape: tuple[int, ...]) -> np.ndarray:
    """Middles of patches, spread over a photograph [H, W], [n, 2]."""
    across, along = PATCHES
    u, v = np.meshgrid(
        np.linspace(RIM, shape[1] - RIM, across), np.linspace(RIM, shape[0] - RIM, along)
    )
    return np.stack([u.ravel(), v.ravel()], axis=1)


def project(picture: Picture, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels [..., 2] of places [..., 3] in a camera's OpenGL axes, and which lie before it."""
    depth = -places[..., 2]
    front = depth > 0.0
    depth = np.where(front, np.maximum(depth, 1e-300), 1.0)
    straight = np.stack([places[..., 0], -places[..., 1]], axis=-1) / depth[..., None]
    return straight * picture.focal + picture.centre, front


def bilinear(gray: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Gray values at pixels [..., 2], float32; NaN outside."""
    height, width = gray.shape
    x, y = pixels[..., 0] - 0.5, pixels[..., 1] - 0.5
    inside = (x >= 0.0) & (y >= 0.0) & (x <= width - 1) & (y <= height - 1)
    x, y = np.where(inside, x, 0.0).astype(np.float32), np.where(inside, y, 0.0).astype(np.float32)
    column = np.minimum(x.astype(np.int32), width - 2)
    row = np.minimum(y.astype(np.int32), height - 2)
    x, y, at, flat = x - column, y - row, row * width + column, gray.ravel()
    above = flat[at] + x * (flat[at + 1] - flat[at])
    below = flat[at + width] + x * (flat[at + width + 1] - flat[at + width])
    return np.where(inside, above + y * (below - above), np.float32(np.nan))


def correlation(patch: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Normalised cross-correlation along the last axis; NaN where a value is."""
    a = patch - patch.mean(axis=-1, keepdims=True)
    b = other - other.mean(axis=-1, keepdims=True)
    norm = np.sqrt((a * a).sum(axis=-1) * (b * b).sum(axis=-1) + np.float32(1e-3))
    return np.asarray((a * b).sum(axis=-1) / norm)
