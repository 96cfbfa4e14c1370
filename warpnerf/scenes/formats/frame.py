"""One posed photograph of a scene file, before its pixels are read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.foreign import TOLERANCE, ImagePlane
from warpnerf.scenes.cameras.lens import Lens
from warpnerf.scenes.files import printable
from warpnerf.scenes.images.depths import DepthFile
from warpnerf.scenes.images.images import exif_focal_length, image_shape
from warpnerf.scenes.images.masks import Mask, fits, mask_beside, unfit_masks
from warpnerf.scenes.images.resampling import Resampling

LOOKED_AT = 64
"""Photographs of a lens, at most, whose EXIF is read."""
ZOOMED = 0.08
"""By which focal lengths in EXIF, which are rounded, must differ, as a share, to be others."""
SAME_LENS = 0.01
"""By which focal lengths, or width / height, may differ, as a share, where sizes are rounded."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """One entry of a scene file, checked, its image found but not read."""

    name: str
    """The image's path relative to the scene's folder, with /."""
    path: Path
    """The image."""
    c2w: np.ndarray
    """[3, 4] float64, OpenGL axes, scene units."""
    lens: Lens
    mask: Mask | None = None
    """Which pixels count; None: all."""
    depth: DepthFile | None = None
    """True depth; None: not known."""
    image: np.ndarray | None = None
    """As a view has it, where it was read already; None: it is in ``path``."""
    reduced: Path | None = None
    """The same photograph, reduced as is requested; None: it is still to be reduced."""
    bounds: tuple[float, float] | None = None
    """Depth of the nearest and of the farthest content, scene units; None: not known."""
    called: str = ""
    """What the file calls the image, where no file is at that path; empty: it is there."""
    elsewhere: bool = False
    """Whether the image is in a folder that the file does not name, and has its name only."""

    def resampling(self, whole: Camera, reduced: Camera) -> Resampling | None:
        """How the photograph is undistorted to a camera that ``lens`` made; None: not at all.

        Args:
            whole: That camera.
            reduced: The same for the reduced photograph.
        """
        nearest = self.lens.nearest(whole, self.name)
        if self.lens.foreign is None or nearest is None or nearest[2] <= TOLERANCE:
            return None
        plane, share = nearest[0], reduced.fx / whole.fx
        plane = ImagePlane(
            reduced.width,
            reduced.height,
            *(value * share for value in (plane.fx, plane.fy, plane.cx, plane.cy)),
        )
        return Resampling(self.lens.foreign, plane, reduced)


def photograph_notes(used: Sequence[tuple[Frame, Camera, Resampling | None]]) -> list[str]:
    """How photographs were found, and what becomes of resized ones and of lenses not of OpenCV's.

    Args:
        used: Frames, the cameras of their whole photographs, and how these are undistorted.
    """
    notes = []
    named = [frame for frame, *_ in used if frame.called and not frame.elsewhere]
    if named:
        notes.append(
            f"{len(named)} of {len(used)} photographs have another path than the file says, and "
            f"are found by their names (first: {named[0].name} for "
            f"{printable(named[0].called[:80])})"
        )
    resized = [
        (frame.name, (camera.width, camera.height), stated)
        for frame, camera, _ in used
        if (stated := frame.lens.was_for(camera.width, camera.height)) is not None
    ]
    if resized:
        name, (width, height), (w, h) = resized[0]
        notes.append(
            f"{len(resized)} of {len(used)} photographs are of another size than their lenses were "
            f"for (first: {name} {width}x{height}, the lens {w:g}x{h:g}): the lenses are scaled"
        )
    found: dict[tuple[str, bool], list[float]] = {}
    for frame, camera, resampling in used:
        nearest = frame.lens.nearest(camera, frame.name)
        if frame.lens.foreign is not None and nearest is not None:
            key = frame.lens.foreign.model, resampling is not None
            found.setdefault(key, []).append(nearest[2])
    return notes + [
        f"{len(off)} photographs have a {model} lens; OpenCV's nearest one is at most "
        f"{max(off):.2g} pixels off, "
        + ("so they are undistorted to it" if moved else "and is used in its place")
        for (model, moved), off in found.items()
    ]


def lens_warnings(used: Sequence[tuple[Frame, Camera]]) -> list[str]:
    """Where files contradict themselves or their photographs in what lenses are.

    Args:
        used: Frames, and the cameras of their whole photographs.
    """
    warnings = []
    said = [
        (frame, frame.lens.contradiction(camera.width, camera.height)) for frame, camera in used
    ]
    doubted = [(frame, text) for frame, text in said if text]
    if doubted:
        frame, text = doubted[0]
        warnings.append(
            f"{frame.lens.file.name}: the lens of {len(doubted)} of {len(used)} images (first: "
            f"{frame.name}) contradicts itself: {text}"
        )
    others = [
        (frame, camera, frame.lens.other_focal_length(camera.width, camera.height))
        for frame, camera in used
    ]
    if others and all(other is not None for *_, other in others):
        frame, camera, other = others[0]
        warnings.append(
            f"{frame.lens.file.name}: camera_angle_x is taken to be across the width of all "
            f"images, which stand upright (first: {frame.name}), a focal length of {camera.fx:.4g} "
            f"pixels; Blender's, with sensor fit Auto, is along the height: if Blender wrote it, "
            f"give fl_x, {other:.4g}"
        )
    warnings += _zoomed([frame for frame, _ in used])
    shared: dict[tuple[tuple[str, float], ...], dict[tuple[int, int], tuple[Frame, Camera]]] = {}
    for frame, camera in used:
        sizes = shared.setdefault(tuple(frame.lens.values.items()), {})
        sizes.setdefault((camera.width, camera.height), (frame, camera))
    return warnings + [_one_lens(sizes) for sizes in shared.values() if not _go_together(sizes)]


def _zoomed(frames: Sequence[Frame]) -> list[str]:
    """Warnings of lenses that photographs share whose EXIF states different focal lengths."""
    shared: dict[tuple[tuple[str, float], ...], list[Frame]] = {}
    for frame in frames:
        if frame.image is None:
            shared.setdefault(tuple(frame.lens.values.items()), []).append(frame)
    warnings = []
    for group in shared.values():
        if len(group) < 2:
            continue
        some = group[:: max(1, -(-len(group) // LOOKED_AT))]
        kinds: dict[bool, list[tuple[float, str]]] = {}
        for frame in some:
            stated = exif_focal_length(frame.path)
            if stated is not None:
                focal, is_of_film = stated
                kinds.setdefault(is_of_film, []).append((focal, frame.name))
        several = [k for k in kinds.values() if max(k)[0] > (1.0 + ZOOMED) * min(k)[0]]
        if several:
            (least, near), (most, far) = min(several[0]), max(several[0])
            warnings.append(
                f"photographs of several focal lengths by EXIF ({near} {least:.4g} mm, {far} "
                f"{most:.4g} mm) have one lens in {group[0].lens.file.name}: estimate one for each "
                "focal length, or leave out those that were zoomed"
            )
    return warnings


def _go_together(sizes: Mapping[tuple[int, int], tuple[Frame, Camera]]) -> bool:
    """Whether one lens can be that of images of these sizes: resized, or cropped by an angle."""
    cameras = [camera for _, camera in sizes.values()]
    lenses = np.array([(c.fx / c.width, c.fy / c.height, c.fx, c.fy) for c in cameras])
    same = lenses.max(axis=0) <= (1.0 + SAME_LENS) * lenses.min(axis=0)
    (frame, _) = next(iter(sizes.values()))
    by_angle = not frame.lens.values.keys() & {"fl_x", "fl_y"}
    return bool(same[:2].all() or (by_angle and same[2:].all()))


def _one_lens(sizes: Mapping[tuple[int, int], tuple[Frame, Camera]]) -> str:
    """That images of these sizes have one lens."""
    some = [sizes[size] for size in sorted(sizes)[:2]]
    said = f"images of {len(sizes)} sizes (first: " + ", ".join(
        f"{frame.name} {camera.width}x{camera.height}" for frame, camera in some
    )
    if some[0][0].lens.values.keys() & {"fl_x", "fl_y"}:
        return f"{said}) have one lens in pixels: give each frame a lens of its own"
    fx, other = (camera.fx for _, camera in some)
    return (
        f"{said}) have one field of view, and so focal lengths of {fx:.4g} and {other:.4g} pixels: "
        "if one camera took them, turned or cropped, give each frame its fl_x"
    )


def with_masks_beside(frames: Sequence[Frame], downscale: int) -> tuple[list[Frame], list[str]]:
    """Frames with the masks that lie beside their photographs, where they have none; warnings.

    Args:
        frames: Of the scene.
        downscale: Edge of the blocks of pixels that become one.
    """
    photographs = {frame.path for frame in frames}
    found, unfit = [], []
    for frame in frames:
        mask = frame.mask
        if mask is None and frame.image is None:
            mask = mask_beside(frame.path)
            mask = None if mask is None or mask.path in photographs else mask
        if mask is not None and mask.found:
            height, width, _ = image_shape(frame.path)
            if not fits(mask, width=width, height=height, downscale=downscale):
                unfit.append(mask.path.name)
                mask = None
        found.append(replace(frame, mask=mask))
    return found, unfit_masks(unfit)
