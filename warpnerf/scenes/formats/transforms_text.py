"""What a transforms.json says that is written here, as instant-ngp and nerfstudio read it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.lens import FISHEYE, RATIONAL


@dataclass(frozen=True, kw_only=True)
class PosedFile:
    """A photograph, its camera and its mask; paths are relative to the scene's folder."""

    path: str
    camera: Camera
    mask: str | None = None


def transforms_text(
    files: Sequence[PosedFile], points: str, splits: Mapping[str, Sequence[str]] | None = None
) -> str:
    """The content of transforms.json.

    A lens that all photographs share stands once, for the whole file.

    Args:
        files: At least one, in the order of the frames.
        points: The file of points that it names, relative to the scene's folder.
        splits: Paths of the photographs of each split; None: readers choose.
    """
    lenses = [_lens(file.camera) for file in files]
    shared = lenses[0] if all(lens == lenses[0] for lens in lenses) else {}
    frames = []
    for file, lens in zip(files, lenses, strict=True):
        frame: dict[str, Any] = {"file_path": file.path}
        if file.mask is not None:
            frame["mask_path"] = file.mask
        if not shared:
            frame |= lens
        pose = [*file.camera.c2w.tolist(), [0.0, 0.0, 0.0, 1.0]]
        frames.append(frame | {"transform_matrix": pose})
    # nerfstudio wants one lens model for all, at the top; here, frames may differ.
    content: dict[str, Any] = {"camera_model": lenses[0]["camera_model"], **shared}
    content["ply_file_path"] = points
    for split, paths in (splits or {}).items():
        if paths:
            content[f"{split}_filenames"] = list(paths)
    return json.dumps(content | {"frames": frames}, indent=1) + "\n"


def _lens(camera: Camera) -> dict[str, Any]:
    """The keys of a lens, with all coefficients of its model."""
    model = "OPENCV"
    coefficients: tuple[str, ...] = ("k1", "k2", "k3", "p1", "p2")
    if camera.fisheye:
        model, coefficients = FISHEYE, ("k1", "k2", "k3", "k4")
    elif camera.rational:
        model, coefficients = RATIONAL, (*coefficients, "k4", "k5", "k6")
    return {
        "camera_model": model,
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        **{name: getattr(camera, name) for name in coefficients},
    }
