"""Pose estimation: from photographs or a video to a scene, by structure from motion."""

from __future__ import annotations

import glob
import json
import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Sequence, Set
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from warpnerf.checked import checked_arguments
from warpnerf.checks import InputError
from warpnerf.runtime.memory import usable_cores
from warpnerf.runtime.process import is_alive
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.lens import FISHEYE
from warpnerf.scenes.cameras.undistort import COEFFICIENTS
from warpnerf.scenes.files import exists, printable
from warpnerf.scenes.formats.contents import (
    NEEDED,
    VIDEOS,
    photographs_in,
    unread_photographs,
    what_is_there,
)
from warpnerf.scenes.formats.transforms_text import PosedFile, transforms_text
from warpnerf.scenes.images.masks import mask_beside, read_mask, unfit_masks
from warpnerf.sfm import scene_files
from warpnerf.sfm.config import Lenses, PoseConfig
from warpnerf.sfm.frames import sharp_frames
from warpnerf.sfm.photographs import UnposedPhotograph, masks_of, put_into, read_photographs
from warpnerf.sfm.summary import WELL_COVERED, Posing, nothing_placed, summary
from warpnerf.sfm.worker import estimate, require_pycolmap

EXHAUSTIVE_UP_TO = 200
"""Photographs of which every pair is matched; 200 have 19900 pairs."""

IMAGES, MASKS = "images", "masks"
WORK = "work"
"""Folder of the prepared scene in which COLMAP works; it goes before the scene is there."""

STAGES = {
    "frames": (0.0, 0.15),
    "features": (0.15, 0.35),
    "matches": (0.35, 0.8),
    "poses": (0.8, 1.0),
}
"""Of the work: where on the way to its end each begins and ends, roughly."""

Progress = Callable[[float, str], None]


@checked_arguments
def pose(
    source: str | Path,
    output: str | Path,
    config: PoseConfig | None = None,
    *,
    overwrite: bool = False,
    on_progress: Progress = lambda fraction, text: None,
) -> Posing:
    """Make a scene of photographs, or of a video, without poses: structure from motion by COLMAP.

    The photographs stay as they are. Where they do not lie in ``output`` they are put there, as
    hard links where the disk allows it, so that the folder is whole by itself. The scene's unit is
    arbitrary, as photographs do not tell it; z is up, as far as the cameras tell.

    Args:
        source: A folder of photographs, directly in it or in its images/, or a video.
        output: The scene's folder, with transforms.json, the points, and a COLMAP model; may be
            that of the photographs.
        config: How; by default ``PoseConfig()``.
        overwrite: Whether a posed scene in ``output`` may be replaced.
        on_progress: Called with the share that is done, [0, 1], and a few words.

    Returns:
        How many were placed, how well, and why others were not.

    Raises:
        InputError: A photograph or the video cannot be read, nothing could be placed, ``output``
            is taken, or pycolmap is missing.
        ChildProcessError: COLMAP failed, or was ended.
    """
    config = config or PoseConfig()
    source, output = Path(source), Path(output)
    require_pycolmap()
    is_video = _is_video(source)
    if is_video and config.masks is not None:
        raise InputError("--masks go with photographs, not with a video; leave them out.")
    scene_files.require_free(output, source, overwrite)

    def report(stage: str, share: float, text: str) -> None:
        begin, end = STAGES[stage]
        first = 0.0 if is_video else STAGES["features"][0]
        on_progress((begin + share * (end - begin) - first) / (1.0 - first), f"{stage}: {text}")

    with _prepared(output) as prepared:
        made_of = inputs(source, config)
        if is_video:
            paths = sharp_frames(
                source,
                prepared / IMAGES,
                config.frames,
                lambda share: report("frames", share, f"{share:.0%} of the video read"),
            )
        else:
            paths = photographs_in(source)
        lenses: Lenses = "one" if is_video else config.lenses
        photographs = read_photographs(
            paths, lenses=lenses, masks=config.masks, threads=config.threads
        )
        in_scene = {
            **_into_scene([p.path for p in photographs], IMAGES, prepared, output),
            **_into_scene([p.mask.path for p in photographs if p.mask], MASKS, prepared, output),
        }
        matching = config.matching
        if matching == "auto":
            many = is_video or len(photographs) > EXHAUSTIVE_UP_TO
            matching = "sequential" if many else "exhaustive"
        found = estimate(
            _job(photographs, config, matching, prepared),
            lambda stage, done, of: report(stage, done / max(of, 1), f"{done} of {of}"),
        )
        if "unread" in found:
            name = printable(found["unread"][0])
            raise InputError(f"{source}: COLMAP cannot read {name}; save it as JPEG or PNG.")
        if not found["registered"]:
            raise InputError(nothing_placed(source, found, len(photographs)))
        posing = summary(output, photographs, found)
        posing = replace(
            posing, notes=(*_notes(source, photographs, matching, is_video), *posing.notes)
        )
        shutil.rmtree(prepared / WORK)
        older = scene_files.read_record(output)
        staying = {*in_scene.values()}.intersection([] if older is None else older.written)
        _write(prepared, posing, found, in_scene, photographs, made_of, staying)
        scene_files.move_into(prepared, output)
    on_progress(1.0, f"{posing.registered} of {posing.photographs} photographs placed")
    return posing


def inputs(source: Path, config: PoseConfig) -> dict[str, Any]:
    """What a posed scene is made of, as pose.json records it: files, and how.

    Args:
        source: Photographs' folder, or a video.
        config: How poses are estimated; the number of threads does not count.
    """
    files = photographs_in(source) if source.is_dir() else [source]
    found = masks_of(files, config.masks) if source.is_dir() else []
    masks = None if config.masks is None else config.masks.resolve()
    settings = asdict(config) | {"masks": masks}
    how = {name: str(value) for name, value in settings.items() if name != "threads"}
    of_masks = {"masks": _states([mask.path for mask in found if mask is not None])}
    return {
        "source": str(source.resolve()),
        "files": _states(files),
        "how": how,
        **(of_masks if of_masks["masks"] else {}),  # records were without before
    }


def _states(files: Sequence[Path]) -> list[list[str | int]]:
    """Name, size and time of the last change of files."""
    states = [(path, path.stat()) for path in files]
    return [[path.name, state.st_size, state.st_mtime_ns] for path, state in states]


def is_made_of(folder: Path, source: Path, config: PoseConfig) -> bool:
    """Whether a folder holds the posed scene that ``pose`` would make."""
    record = scene_files.read_record(folder)
    if record is None or not exists(folder / scene_files.TRANSFORMS):
        return False
    return record.made_of == inputs(source, config)


def _is_video(source: Path) -> bool:
    """Whether the source is a video, not a folder of photographs.

    Raises:
        InputError: It is neither.
    """
    if not exists(source):
        raise InputError(f"{source}: does not exist; name a folder of photographs, or a video.")
    if source.is_dir():
        if len(photographs_in(source)) >= NEEDED:
            return False
        raise InputError(f"{source}: no photographs to pose: {what_is_there(source)}.")
    if source.suffix.lower() in VIDEOS:
        return True
    raise InputError(
        f"{source}: is neither a folder of photographs nor a video ({', '.join(VIDEOS)}); name the "
        "folder that it is in."
    )


@contextmanager
def _prepared(output: Path) -> Iterator[Path]:
    """A folder beside or in the scene's, on the same disk, which is gone at the end."""
    place = next(folder for folder in (output, *output.absolute().parents) if folder.is_dir())
    _sweep(place, output.name)
    folder = place / f".{output.name}.{os.getpid()}.tmp"
    try:
        (folder / WORK).mkdir(parents=True)
        yield folder
    except ChildProcessError:
        raise
    except OSError as error:
        raise InputError(
            f"--output {output} cannot be written: {error.strerror or error}; make room or give "
            "access, or name another place."
        ) from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _sweep(place: Path, name: str) -> None:
    """Remove what processes left behind that were killed."""
    for folder in place.glob(f".{glob.escape(name)}.*.tmp"):
        number = folder.name.split(".")[-2]
        if number.isdecimal() and not is_alive(int(number)):
            shutil.rmtree(folder, ignore_errors=True)


def _into_scene(
    files: Sequence[Path], folder: str, prepared: Path, output: Path
) -> dict[Path, str]:
    """Put files into a folder of the prepared scene, but those that the scene's folder holds.

    Returns:
        Their paths relative to the scene's folder.
    """
    root, paths = output.resolve(), {}
    for file in dict.fromkeys(files):
        inside = [
            place for place in (prepared.resolve(), root) if file.resolve().is_relative_to(place)
        ]
        if inside:
            paths[file] = file.resolve().relative_to(inside[0]).as_posix()
        else:
            put_into(prepared / folder, file, file.name)
            paths[file] = f"{folder}/{file.name}"
    return paths


def _job(
    photographs: Sequence[UnposedPhotograph], config: PoseConfig, matching: str, prepared: Path
) -> dict[str, Any]:
    """What ``sfm.mapping`` is asked to do; masks are put where COLMAP looks for them."""
    shared = Counter(p.lens for p in photographs)
    work = prepared.absolute() / WORK
    for p in photographs:
        if p.mask is not None:
            width, height = p.size
            counts = read_mask(p.mask, width=width, height=height, downscale=1)
            (work / MASKS).mkdir(exist_ok=True)
            Image.fromarray(counts).save(work / MASKS / f"{p.path.name}.png")
    return {
        "images": str(photographs[0].path.parent.absolute()),
        "work": str(work),
        "model": str(prepared.absolute() / scene_files.MODEL),
        "points": str(prepared.absolute() / scene_files.POINTS),
        "masks": str(work / MASKS) if exists(work / MASKS) else None,
        "photographs": [
            {
                "name": p.path.name,
                "lens": p.lens,
                "up": p.up,
                "camera_model": _camera_model(config.camera_model, shared[p.lens]),
            }
            for p in photographs
        ],
        "matching": matching,
        "mapper": config.mapper,
        "max_image_size": config.max_image_size,
        "threads": min(config.threads or usable_cores(), usable_cores()),
    }


def _camera_model(asked: str, sharing: int) -> str:
    if asked != "auto":
        return asked
    return "RADIAL" if sharing >= WELL_COVERED else "SIMPLE_RADIAL"


def _notes(
    source: Path, photographs: Sequence[UnposedPhotograph], matching: str, is_video: bool
) -> Iterator[str]:
    """What is unusual about the photographs, a sentence each."""
    unread = [] if is_video else unread_photographs(source)
    if unread:
        yield (
            f"left out {len(unread)} files whose format is not read (first: {unread[0].name}); "
            "convert them to JPEG"
        )
    beside = [] if is_video else [mask_beside(p.path) for p in photographs if p.mask is None]
    left = [mask for mask in beside if mask is not None]
    inverse = [mask.path.name for mask in left if not mask.white_counts]
    if inverse:
        yield (
            "masks in which white is ignored are not used for poses, nor put into the scene: "
            f"{len(inverse)} (first: {inverse[0]}); invert them, and name them as "
            f"{photographs[0].path.name}.mask.png"
        )
    unfit = [mask.path.name for mask in left if mask.white_counts]
    if not any(p.mask is not None and not p.mask.found for p in photographs):
        yield from unfit_masks(unfit)
    sizes = {p.size: p.path.name for p in reversed(photographs)}
    if len(sizes) > 1:
        shown = ", ".join(f"{name} {w}x{h}" for (w, h), name in sorted(sizes.items())[:2])
        yield f"photographs of {len(sizes)} sizes (first: {shown}), each with a lens of its own"
    if not is_video and all(width == 2 * height for width, height in sizes):
        yield (
            "all photographs are exactly twice as wide as high: if they are panoramas of 360 "
            "degrees, the poses are wrong; cut each into pictures of 90 degrees first"
        )
    if matching == "sequential" and not is_video:
        yield (
            f"{len(photographs)} photographs are compared with their neighbours by name only; if "
            "they were not taken in this order, use --matching exhaustive"
        )


def _write(
    prepared: Path,
    posing: Posing,
    found: dict[str, Any],
    in_scene: dict[Path, str],
    photographs: Sequence[UnposedPhotograph],
    made_of: dict[str, Any],
    staying: Set[str],
) -> None:
    """Write transforms.json and pose.json, which lists files of the older scene that stay, too."""
    placed = [p for p in photographs if p.path.name in found["registered"]]
    files = [
        PosedFile(
            path=in_scene[p.path],
            camera=_camera(found["cameras"][p.path.name], found["registered"][p.path.name]),
            mask=in_scene[p.mask.path] if p.mask else None,
        )
        for p in placed
    ]
    text = transforms_text(sorted(files, key=lambda file: file.path), scene_files.POINTS)
    (prepared / scene_files.TRANSFORMS).write_text(text, encoding="utf-8")
    written = [
        path.relative_to(prepared).as_posix() for path in prepared.rglob("*") if path.is_file()
    ]
    content = {
        "registered": posing.registered,
        "photographs": posing.photographs,
        "points": posing.points,
        "reprojection_error": posing.error,
        "lenses": posing.lenses,
        "not_registered": posing.missing,
        "notes": posing.notes,
        "made_of": made_of,
        "written": sorted({*written, *staying, scene_files.SUMMARY}),
    }
    (prepared / scene_files.SUMMARY).write_text(
        json.dumps(content, indent=1) + "\n", encoding="utf-8"
    )


def _camera(lens: dict[str, Any], pose: list[list[float]]) -> Camera:
    """A camera as the process of COLMAP reports it: its lens under the names of the files."""
    return Camera(
        width=lens["w"],
        height=lens["h"],
        fx=lens["fl_x"],
        fy=lens["fl_y"],
        cx=lens["cx"],
        cy=lens["cy"],
        c2w=np.array(pose),
        fisheye=lens["model"] == FISHEYE,
        **{name: lens.get(name, 0.0) for name in COEFFICIENTS},
    )
