"""Video and still rendering of a field, along a path or from photographs."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from warpnerf.checked import checked_arguments
from warpnerf.checks import InputError, said
from warpnerf.media.camera_path import path_lens
from warpnerf.media.panels import USUAL, Output, Panels
from warpnerf.media.pictures import png
from warpnerf.media.video import require_alpha, write_video
from warpnerf.rendering.composite import AnyField
from warpnerf.rendering.field import Rendering
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.files import beginning
from warpnerf.writing import write_atomically

STILL = "warpnerf render"
"""What made a still, as its file says."""

MARKED = 4096
"""Bytes at the beginning of a PNG file in which that stands."""

N_LOOKS = 9
"""Cameras of a path that a range of depths is taken from."""

LOOK_SIZE = 96
"""Pixels along the longer side of such a look."""

VISIBLE = 0.02
"""Opacity of a pixel that is told from the background."""


@checked_arguments
def render_video(
    field: AnyField,
    cameras: Sequence[Camera],
    path: str | Path,
    *,
    fps: float = 30.0,
    depths: tuple[float, float] | None = None,
    show: Sequence[Output] = USUAL,
    transparent: bool = False,
    on_frame: Callable[[int], None] | None = None,
) -> Path:
    """Render a video: colour and depth side by side, or other outputs.

    Args:
        field: What to look at.
        cameras: From ``camera_path``, or any of one size; one for each frame.
        path: .mp4 (.gif where PyAV is missing), .gif, .mov, or a new folder for PNG files.
        fps: Frames per second.
        depths: What gets the first and the last colour, scene units; None: see ``depth_range``.
        show: Outputs from left to right: colour, depth above a legend, opacity, normals.
        transparent: With an alpha channel and without background: to .mov or PNG files.
        on_frame: Called with the number of frames that are done.

    Returns:
        Where it went.

    Raises:
        InputError: No camera, cameras of different sizes, a path that cannot be written to, or
            depths in the wrong order.
        OSError: It cannot be written; what was there before is left as it was.
    """
    if not cameras:
        raise InputError("a video needs at least one camera.")
    if len({(camera.width, camera.height) for camera in cameras}) > 1:
        raise InputError("the cameras of a video must all have one width and one height.")
    panels = _panels(field, cameras, depths, show, transparent)
    require_alpha(path, transparent)

    def frames() -> Iterator[np.ndarray]:
        for number, camera in enumerate(cameras):
            yield panels.picture(camera)
            if on_frame is not None:
                on_frame(number + 1)

    return write_video(path, frames(), fps)


@checked_arguments
def render_stills(
    field: AnyField,
    cameras: dict[str, Camera],
    folder: str | Path,
    *,
    depths: tuple[float, float] | None = None,
    show: Sequence[Output] = USUAL,
    transparent: bool = False,
    on_frame: Callable[[int], None] | None = None,
) -> None:
    """Render still images of colour and depth, as in a video.

    Args:
        field: What to look at.
        cameras: By the names of the files, which go into the folder.
        folder: Made if it does not exist; stills of the same names that are there are replaced.
        depths: As for ``render_video``.
        show: As for ``render_video``.
        transparent: With an alpha channel and without background.
        on_frame: Called with the number of pictures that are done.

    Raises:
        InputError: No camera, a name that is not that of a file in the folder, one of a file there
            that is no still, or depths in the wrong order.
        OSError: A picture cannot be written; each is there whole or not at all.
    """
    if not cameras:
        raise InputError("stills need at least one camera.")
    for name in cameras:
        if name in ("", ".", "..") or Path(name).name != name or "\0" in name:
            raise InputError(
                f"stills go into one folder, by names of files without a path, not {said(name)}."
            )
    folder = Path(folder)
    _require_stills(folder / name for name in cameras)
    panels = _panels(field, list(cameras.values()), depths, show, transparent)
    folder.mkdir(exist_ok=True)
    for number, (name, camera) in enumerate(cameras.items()):
        write_atomically(folder / name, png(panels.picture(camera), STILL))
        if on_frame is not None:
            on_frame(number + 1)


def _require_stills(paths: Iterable[Path]) -> None:
    """Raise InputError where something other than a still is in the place of one."""
    mark = b"Software\0" + STILL.encode()
    for path in paths:
        if os.path.lexists(path) and mark not in beginning(path, MARKED):
            raise InputError(
                f"{path} is not a picture that was rendered so, and is not replaced; name another "
                "folder, or move the file."
            )


def _panels(
    field: AnyField,
    cameras: Sequence[Camera],
    depths: tuple[float, float] | None,
    show: Sequence[Output],
    transparent: bool,
) -> Panels:
    if depths is not None:
        near, far = checked_depths(depths)
    else:
        near, far = depth_range(field, cameras) if "depth" in show else (0.0, 1.0)
    return Panels(field=field, outputs=tuple(show), near=near, far=far, transparent=transparent)


def depth_range(field: AnyField, cameras: Sequence[Camera]) -> tuple[float, float]:
    """Depths between which nearly all lies that some of the cameras see, scene units.

    That is the ``range_of`` the opaque pixels of all these cameras together, so that it serves a
    whole set of pictures.
    """
    seen = []
    for look in _looks(field, cameras):
        solid = look.opacity > 0.5
        seen.append(look.depth[solid] / look.opacity[solid])
    return range_of(np.concatenate(seen))


def sees_anything(field: AnyField, cameras: Sequence[Camera]) -> bool:
    """Whether some of the cameras see anything but the background."""
    return any((look.opacity > VISIBLE).any() for look in _looks(field, cameras))


def _looks(field: AnyField, cameras: Sequence[Camera]) -> Iterator[Rendering]:
    """What some of the cameras see, in small pictures."""
    picks = np.unique(np.linspace(0, len(cameras) - 1, N_LOOKS).astype(int))
    for camera in (cameras[pick] for pick in picks):
        share = min(1.0, LOOK_SIZE / max(camera.width, camera.height))
        size = (max(1, round(share * camera.width)), max(1, round(share * camera.height)))
        yield field.render(path_lens([camera], size))


def range_of(depths: np.ndarray) -> tuple[float, float]:
    """Percentiles 2 and 98 of depths [n], scene units, so that few far ones do not stretch it.

    Rounded outward to two digits, so that a legend can say them; 0 and 1 where there are none.
    """
    if not depths.size:
        return 0.0, 1.0
    low, high = np.percentile(depths, [2.0, 98.0])
    near, digits = _rounded(low, math.floor)
    far, _ = _rounded(high, math.ceil)
    return near, max(far, round(near + 10.0**-digits, digits))


def _rounded(depth: float, rounding: Callable[[float], int]) -> tuple[float, int]:
    """A depth of two digits, and how many of them are behind the point; negative: before it."""
    digits = 1 - math.floor(math.log10(max(depth, 1e-30)))
    return round(rounding(round(depth * 10.0**digits, 6)) * 10.0**-digits, digits), digits


def checked_depths(depths: tuple[float, float]) -> tuple[float, float]:
    """The same depths.

    Raises:
        InputError: They are not finite, or the first is not below the second.
    """
    near, far = depths
    if not 0.0 <= near < far < np.inf:
        raise InputError(
            f"a range of depths goes from at least 0 up to something farther, not {near:g} {far:g}."
        )
    return near, far
