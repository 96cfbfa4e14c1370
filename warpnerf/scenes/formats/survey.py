"""A look at a scene's files besides loading it: format, poses that are refused, keys not read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warpnerf.checks import InputError
from warpnerf.scenes.cameras.poses import check_pose
from warpnerf.scenes.files import exists, printable, read_json
from warpnerf.scenes.formats import llff
from warpnerf.scenes.formats.blender import SPLITS, is_split, other_transforms, split_file
from warpnerf.scenes.formats.colmap_models import find_model, model_kind
from warpnerf.scenes.formats.npz import is_scene_file, single_npz
from warpnerf.scenes.formats.part import ENDING, read_part
from warpnerf.scenes.formats.programs import export_of, exports_in
from warpnerf.scenes.formats.transforms import FrameEntry, TransformsFile

SINGLE_PRECISION = 1e-5
"""Error of a rotation that comes from being written in single precision."""

SHOWN = 3
"""Other files of frames, at most, that are named."""

WITHOUT_EFFECT = {
    *("aabb_scale", "scale", "offset", "up", "n_frames", "sharpness", "colmap_im_id", "rotation"),
    *("orientation_override", "time", "enable_depth_loading"),
    *("camera_id", "image_id"),
}
"""Keys that are not read and do not change the picture."""


@dataclass(frozen=True, kw_only=True)
class Survey:
    """What a look at a scene's files shows."""

    format: str
    """In words."""
    files: tuple[Path, ...]
    """That hold cameras as JSON; none of other scenes."""
    refused: tuple[str, ...]
    """Frames whose poses are refused, as $.frames[0], after their file where there are several."""
    diagnostics: tuple[str, ...]
    """A sentence each."""

    @property
    def built_in(self) -> bool:
        """Whether it is one of the built-in scenes."""
        return self.format.startswith("built in")


def survey(path: str | Path) -> Survey:
    """Look at the files of what ``load_scene`` takes. What is wrong with them is for it to say."""
    kind, files = _files(path)
    refused: list[str] = []
    diagnostics: list[str] = []
    for file in files:
        try:
            data = read_json(file, TransformsFile)
            raw = read_json(file, dict[str, Any])
        except InputError:
            continue
        bent = 0
        for index, frame in enumerate(data.frames):
            place = f"$.frames[{index}]"
            try:
                pose = check_pose(frame.transform_matrix, field=place)
            except InputError:
                refused.append(place if len(files) == 1 else f"{file.name}: {place}")
                continue
            given = np.array(frame.transform_matrix)[:3, :3]
            bent += bool(np.abs(given - pose[:, :3]).max() > SINGLE_PRECISION)
        if bent:
            diagnostics.append(
                f"{file.name}: {bent} of {len(data.frames)} poses are not quite rigid: the nearest "
                "rotations are used"
            )
        times = {repr(frame["time"]) for frame in raw["frames"] if "time" in frame}
        if len(times) > 1:
            diagnostics.append(
                f"{file.name}: frames have {len(times)} different times, but the scene is trained "
                "as if nothing moved: what does is smeared; keep the frames of one time, or mask it"
            )
        unread = _unread_keys(raw)
        if unread:
            diagnostics.append(f"{file.name}: keys that are not read: {', '.join(unread)}")
    return Survey(
        format=kind, files=tuple(files), refused=tuple(refused), diagnostics=tuple(diagnostics)
    )


def _files(path: str | Path) -> tuple[str, list[Path]]:
    """The format that ``load_scene`` sees, and the files of it."""
    if isinstance(path, str) and path.startswith("builtin:"):
        return "built in: an exact ray tracer, with true depth", []
    path = Path(path)
    if path.name.endswith(ENDING):
        return f"part of {read_part(path).part_of}", []
    if not exists(path):
        return "none", []
    if path.is_dir():
        return _files_of_folder(path)
    if is_split(path):
        return _blender(path.parent)
    if path.name == llff.FILE:
        return f"LLFF ({llff.FILE})", []
    if path.suffix == ".npz":
        return f"npz ({printable(path.name)})", []
    export = export_of(path)
    if export is not None:
        return export.described(path.parent), []
    return f"instant-ngp / nerfstudio ({printable(path.name)})", [path]


def _files_of_folder(folder: Path) -> tuple[str, list[Path]]:
    if exists(folder / split_file("train")):
        return _blender(folder)
    files = [folder / "transforms.json"] if exists(folder / "transforms.json") else []
    return (forms_in(folder) or ["none"])[0], files


def forms_in(folder: Path) -> list[str]:
    """All forms of scenes that a folder has, in words: ``load_scene`` reads the first.

    A COLMAP model beside another scene gives that one its points, and is none of its own.
    """
    forms = [_blender(folder)[0]] if exists(folder / split_file("train")) else []
    if exists(folder / "transforms.json"):
        forms.append("instant-ngp / nerfstudio (transforms.json)")
    model = find_model(folder)
    if model is not None and not forms:
        words = {"bin": "binary", "txt": "text"}[str(model_kind(model))]
        forms.append(f"COLMAP ({model.relative_to(folder).as_posix()}, {words})")
    if exists(folder / llff.FILE):
        forms.append(f"LLFF ({llff.FILE})")
    forms += [export.described(folder) for export in exports_in(folder)]
    archive = single_npz(folder)
    if archive is not None and (not forms or is_scene_file(archive)):
        forms.append(f"npz ({printable(archive.name)})")
    others = other_transforms(folder)
    if forms and others:
        more = f", ... ({len(others)})" if others[SHOWN:] else ""
        forms.append(", ".join(printable(file.name) for file in others[:SHOWN]) + more)
    return forms


def _blender(folder: Path) -> tuple[str, list[Path]]:
    files = [folder / split_file(split) for split in SPLITS]
    files = [file for file in files if exists(file)]
    return f"Blender / NeRF-synthetic ({', '.join(file.name for file in files)})", files


def _unread_keys(raw: dict[str, Any]) -> list[str]:
    """Keys of a file and of its frames that nobody reads, and that nobody knows to be harmless."""
    known = {*WITHOUT_EFFECT, *TransformsFile.__struct_fields__, *FrameEntry.__struct_fields__}
    given = {*raw, *(key for frame in raw["frames"] for key in frame)}
    return sorted(printable(key[:40]) for key in given - known)
