"""From the frames of a scene file to a Scene: find the images, split, read, estimate."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from warpnerf.checks import InputError
from warpnerf.runtime.memory import usable_cores
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.focus import estimate_extent
from warpnerf.scenes.cameras.tracks import Tracks
from warpnerf.scenes.cameras.undistort import seen_pixels
from warpnerf.scenes.extent.conventions import check_against_photographs
from warpnerf.scenes.extent.given_depths import believed_bounds, doubted_depths
from warpnerf.scenes.extent.masked import idle_masks, inverted_masks, mask_notes
from warpnerf.scenes.extent.photo_consistency import PhotoConsistency
from warpnerf.scenes.extent.points import Points, extent_by_points
from warpnerf.scenes.files import by_number, exists
from warpnerf.scenes.formats.frame import Frame, lens_warnings, photograph_notes, with_masks_beside
from warpnerf.scenes.formats.georeference import centred, in_words
from warpnerf.scenes.formats.left_over import unused_depths, unused_masks, unused_points
from warpnerf.scenes.formats.reduced import with_reduced
from warpnerf.scenes.images.depths import Depth, readable_depth, unread_depths
from warpnerf.scenes.images.images import exif_orientation, image_shape, read_image
from warpnerf.scenes.images.mask_values import other_values
from warpnerf.scenes.images.masks import (
    PackedMask,
    all_of_blocks,
    masks_of_folder,
    numbers_of_classes,
    read_mask,
)
from warpnerf.scenes.images.photographs import Keeping, Photograph, keep, stay_in_memory
from warpnerf.scenes.images.transparency import NO_ALPHA, outline, show_an_object, shows_nothing
from warpnerf.scenes.scene import Scene, View
from warpnerf.scenes.split import Split, withheld

LOOKED_AT = 16
"""Training photographs, at most, whose transparent pixels tell what the scene is."""
POSED = "pose.json"
"""Lies beside a scene that `warpnerf pose` wrote, whose poses are those of the stored pixels."""

HOLD_OUT = 8
"""Without a split in the file every 8th image is for testing, as in LLFF and Mip-NeRF 360."""


@dataclass(frozen=True, kw_only=True)
class Reading:
    """How photographs are to be read, whatever the format."""

    downscale: int
    """Edge of the blocks of pixels that become one; 1 keeps photographs as they are."""
    masks: Path | None
    """Folder of masks for all photographs, which take the place of those that frames have."""
    keeping: Keeping
    """Where their pixels are kept, and how many threads read them."""
    withhold: Split | None = None
    """What for testing; None: as the capture says, else every 8th."""


def assemble(
    *,
    folder: Path,
    file: Path,
    frames: Sequence[Frame],
    splits: Mapping[str, set[str]],
    warnings: Sequence[str],
    reading: Reading,
    points: Points | None = None,
) -> Scene:
    """Read the images and make the scene.

    Args:
        folder: The scene's folder; its name is the scene's.
        file: The scene file, for messages.
        frames: Frames with different names.
        splits: Names for "train", "test" and "val"; what is left out is filled in, see
            ``complete_splits``.
        warnings: Those so far; the result's begin with them.
        reading: How photographs are to be read; what it withholds for testing takes the place of
            ``splits``.
        points: Of the scene's surfaces, where there are some; tracks go by names of frames.

    Raises:
        InputError: An image, a mask, the split or the placement of the cameras is of no use.
    """
    frames = sorted(frames, key=lambda frame: frame.name)
    names = [frame.name for frame in frames]
    downscale, keeping = reading.downscale, reading.keeping
    if reading.withhold is None:
        complete, notes = complete_splits(file, names, splits)
    else:
        test, note = withheld(reading.withhold, names, [frame.c2w for frame in frames])
        complete, notes = {"train": set(names) - test, "test": test}, [note]
    used = set().union(*complete.values())
    frames = [frame for frame in frames if frame.name in used]
    frames, reduced = with_reduced(frames, downscale)
    notes += reduced
    if reading.masks is not None:
        found = masks_of_folder(reading.masks, [frame.name for frame in frames])
        frames = [replace(frame, mask=mask) for frame, mask in zip(frames, found, strict=True)]
    else:
        unused = unused_masks(folder, frames)
        frames, unfit = with_masks_beside(frames, downscale)
        warnings = [*warnings, *unused, *unfit]
    notes += unused_depths(folder, frames)
    notes += [] if points is not None else unused_points(folder)

    frames, points, offset = centred(frames, points)
    if offset is not None:
        notes.append(
            f"far from the origin, so all coordinates are those of the file less {in_words(offset)}"
        )

    # Decoders release the interpreter lock. The first error cancels what is not yet read.
    with ThreadPoolExecutor(keeping.threads or usable_cores()) as pool:
        trained = [frame for frame in frames if frame.name in complete["train"]]
        some = trained[:: -(-len(trained) // LOOKED_AT)]
        outlines = list(pool.map(lambda frame: outline(frame.path, frame.image), some))
        is_object = show_an_object(outlines)
        # Where alpha is ignored, masks are made of it: the same pixels are kept if there is room.
        holds = any(each.shape != NO_ALPHA for each in outlines) and stay_in_memory(
            keeping,
            sum(pool.map(lambda frame: 3 * math.prod(_shape(frame)[:2]) // downscale**2, frames)),
        )
        read = list(pool.map(lambda frame: _read_frame(frame, downscale, is_object, holds), frames))
        turned = list(pool.map(_may_lie, frames))
    left = [entry for entry in read if entry is not None]
    complete, mask_warnings = _without_masked(file, frames, left, complete)
    given = [entry.frame.mask for entry in left if entry.frame.mask]
    mask_warnings += other_values(given) or idle_masks(given, [entry.mask for entry in left])
    notes += photograph_notes(
        [(entry.frame, entry.whole, entry.photograph.resampling) for entry in left]
    )
    warnings = [*warnings, *lens_warnings([(entry.frame, entry.whole) for entry in left])]
    warnings += _transparency_warning(left) + unread_depths([entry.why_no_depth for entry in left])
    kept = keep([entry.photograph for entry in left], keeping, file=file, downscale=downscale)
    views = [
        View(
            name=entry.name,
            camera=entry.camera,
            image=image,
            depth=entry.depth,
            mask=entry.mask,
        )
        for entry, image in zip(left, kept.images, strict=True)
    ]

    index = {view.name: i for i, view in enumerate(views)}
    indices = {
        split: tuple(sorted(index[name] for name in names)) for split, names in complete.items()
    }
    views, photographs, points, told = check_against_photographs(
        views, indices["train"], points, is_object
    )
    warnings += told
    training = [views[i] for i in indices["train"]]
    masks_left, cameras = [entry.mask for entry in left], [view.camera for view in views]
    notes += mask_notes(masks_left, cameras)
    mask_warnings += inverted_masks(masks_left, cameras, indices["train"])
    bounds, refuted = believed_bounds(photographs, views, _bounds(frames, views))
    warnings += refuted
    deep = [views[i] for i in indices["train"] if left[i].depth is not None]
    warnings += doubted_depths(
        photographs if len(deep) == len(training) else PhotoConsistency.of(deep)
    )
    unbounded = not is_object
    transparent = {view.name for view, see in zip(views, kept.see_through, strict=True) if see}
    try:
        extent = estimate_extent([view.camera for view in training], unbounded=unbounded)
    except InputError as error:
        place = _field(file, "$.frames[].transform_matrix")
        raise InputError(f"{file}:{place} {error}") from None
    observed = tracks = None
    if points is not None:
        extent, observed = extent_by_points(extent, points, views, indices["train"], unbounded)
        if observed is not None and points.tracks is not None:
            tracks = Tracks(positions=points.positions, shown=points.tracks)
    return Scene(
        name=folder.resolve().name,
        views=views,
        splits=indices,
        box_min=extent.box_min,
        box_max=extent.box_max,
        unbounded=unbounded,
        content_distance=extent.content_distance,
        content_distances=None if observed is None else observed.distances,
        guessed=extent.guessed and observed is None,
        near_content=None if observed is None else observed.near_content,
        observations=None if observed is None else observed.observations,
        tracks=tracks,
        points=None if observed is None or points is None else points.sample,
        bounds=bounds,
        offset=offset,
        notes=(*notes, *kept.notes, *extent.notes),
        warnings=(
            *(*warnings, *mask_warnings, *_diagnostics(views, complete, transparent)),
            *_turned_warning(
                folder, [frame.name for frame, lies in zip(frames, turned, strict=True) if lies]
            ),
        ),
    )


def _bounds(frames: Sequence[Frame], views: Sequence[View]) -> np.ndarray | None:
    """The bounds of views, [n_views, 2], if all frames have some."""
    given = {frame.name: frame.bounds for frame in frames if frame.bounds is not None}
    if len(given) < len(frames):
        return None
    return np.array([given[view.name] for view in views])


def complete_splits(
    file: Path, names: Sequence[str], splits: Mapping[str, set[str]]
) -> tuple[dict[str, set[str]], list[str]]:
    """Fill in the splits that a file leaves out.

    Without a training split, it is all images of no other split. Without a test split, every 8th
    training image is for testing instead, counted by name from the first, numbers as such.

    Returns:
        Names for "train" and "test", and "val" where it is given; notes.

    Raises:
        InputError: No image is left to train on.
    """
    notes = []
    given = {split: set(members) for split, members in splits.items() if members}
    train = given.get("train", set(names) - set().union(*given.values()))
    test = given.get("test", set())
    if not test:
        test = set(sorted(train, key=by_number)[::HOLD_OUT])
        train = train - test
        notes.append(f"the file has no test split: every {HOLD_OUT}th image is for testing")
    if not train:
        raise InputError(
            f"{file}:{_field(file, '$.frames')} no image is left to train on, as {len(test)} of "
            f"{len(names)} is for testing; add photographs."
        )
    complete = {"train": train, "test": test}
    if "val" in given:
        complete["val"] = given["val"]
    unused = set(names) - set().union(*complete.values())
    if unused:
        notes.append(
            f"in no split and not used: {len(unused)} of {len(names)} images (first: {min(unused)})"
        )
    return complete, notes


def _field(file: Path, field: str) -> str:
    """A field for messages, where the file is one that has fields."""
    return f" {field}:" if file.suffix == ".json" else ""


def _without_masked(
    file: Path, frames: Sequence[Frame], read: Sequence[_Read], splits: dict[str, set[str]]
) -> tuple[dict[str, set[str]], list[str]]:
    """The splits without images of which masks leave nothing, and a warning of these.

    Raises:
        InputError: No training image is left.
    """
    left = {view.name for view in read}
    gone = [frame for frame in frames if frame.name not in left]
    splits = {split: names & left for split, names in splits.items()}
    classes = numbers_of_classes(frame.mask for frame in gone[:LOOKED_AT] if frame.mask is not None)
    if not splits["train"]:
        way_out = classes or (
            "white pixels count, black ones are ignored, so invert the masks if they are the other "
            "way round"
        )
        raise InputError(f"{file}: the masks leave no pixel of any training image; {way_out}.")
    if not gone:
        return splits, []
    said = f"left out {len(gone)} of {len(frames)} images of which masks leave no pixel (first: "
    return splits, [f"{said}{gone[0].name})" + (classes and f": {classes}")]


def _transparency_warning(read: Sequence[_Read]) -> list[str]:
    """That transparent pixels are ignored."""
    shares = {view.name: view.ignored for view in read if view.ignored > 0.0}
    if not shares:
        return []
    return [
        f"transparent pixels, {np.mean(list(shares.values())):.1%} of {len(shares)} of {len(read)} "
        f"images (first: {min(shares)}), are ignored: too few, too much alike, or too much at "
        "one side to be what surrounds an object"
    ]


def _shape(frame: Frame) -> tuple[int, ...]:
    return image_shape(frame.path) if frame.image is None else frame.image.shape


def _pixels(frame: Frame) -> np.ndarray:
    return read_image(frame.path) if frame.image is None else frame.image


def _may_lie(frame: Frame) -> bool:
    """Whether a photograph is shown turned, and the file does not say what its stored size is."""
    orientation = 1 if frame.image is not None else exif_orientation(frame.path)
    stated = frame.lens.values.get("w"), frame.lens.values.get("h")
    on_side = orientation >= 5
    return orientation != 1 and not (on_side and None not in stated and stated[0] != stated[1])


def _turned_warning(folder: Path, names: Sequence[str]) -> list[str]:
    if not names or exists(folder / POSED):
        return []
    return [
        f"stored turned, with an EXIF rotation that is not applied: {len(names)} images (first: "
        f"{names[0]}); right if their poses are those of the stored pixels, as COLMAP's are, else "
        "save the images upright"
    ]


def _diagnostics(
    views: Sequence[View], splits: Mapping[str, set[str]], transparent: set[str]
) -> list[str]:
    """Warnings of photographs that can be used, and yet are likely not what was meant."""
    warnings = []
    if 0 < len(transparent) < len(views):
        warnings.append(
            f"transparent pixels in only {len(transparent)} of {len(views)} images (first: "
            f"{min(transparent)}): the scene is trained to be empty there; where something is to "
            "be ignored instead, give masks, by --masks"
        )
    shared = splits["train"] & splits["test"]
    if shared:
        warnings.append(
            f"used for training and for testing: {len(shared)} of {len(views)} images (first: "
            f"{min(shared)}), so test scores are too good"
        )
    copies, others = _at_one_pose(views)
    if others:
        warnings.append(
            f"different photographs at the same pose: {len(others)} of {len(views)} images (first: "
            f"{others[0][1]}, as {others[0][0]}), of which one at most is right, unless the camera "
            "stood still; estimate their poses again, or leave them out"
        )
    if copies:
        warnings.append(
            f"the same photograph from the same place: {len(copies)} of {len(views)} images "
            f"(first: {copies[0][1]} is {copies[0][0]} again)"
        )
    return warnings


def _at_one_pose(
    views: Sequence[View],
) -> tuple[list[tuple[str, str]], list[tuple[str, str]]]:
    """Pairs of names whose poses are the same, each view with the first of its kind: those of the
    same pixels, and those of others."""
    copies, different = [], []
    first_at: dict[bytes, list[View]] = {}
    for view in views:
        others = first_at.setdefault(view.camera.c2w.tobytes(), [])
        again = next((o for o in others if np.array_equal(o.image, view.image)), None)
        if again is not None:
            copies.append((again.name, view.name))
            continue
        if others:
            different.append((others[0].name, view.name))
        others.append(view)
    return copies, different


@dataclass(frozen=True, kw_only=True, eq=False)
class _Read:
    """A frame, all of which is read but its photograph."""

    name: str
    frame: Frame
    whole: Camera
    """Of the photograph before it is reduced."""
    camera: Camera
    photograph: Photograph
    depth: Depth | None
    mask: PackedMask | None
    ignored: float = 0.0
    """Share of its pixels that are ignored as transparent."""
    why_no_depth: str = ""
    """Of a depth map that cannot be read."""


def _read_frame(frame: Frame, downscale: int, is_object: bool, holds: bool) -> _Read | None:
    """What belongs to a frame; None where its mask leaves no pixel of it.

    Args:
        frame: To read.
        downscale: Edge of the blocks of pixels that become one.
        is_object: Whether alpha counts; else transparent pixels are ignored.
        holds: Whether a photograph that is decoded for its alpha stays in memory.
    """
    height, width, channels = _shape(frame)
    whole = frame.lens.camera(width=width, height=height, c2w=frame.c2w, image=frame.name)
    if downscale > min(width, height):
        raise InputError(
            f"downscale is {downscale}, but {frame.path} has {width}x{height} pixels; choose a "
            "smaller factor."
        )
    camera = whole if downscale == 1 else whole.downscaled(downscale)
    resampling = frame.resampling(whole, camera)
    mask = seen_pixels(camera)
    given = None
    if frame.mask is not None:
        given = read_mask(frame.mask, width=width, height=height, downscale=downscale)
    if resampling is not None:
        given = resampling.mask(given)
    if given is not None:
        mask = given if mask is None else mask & given
    ignored, pixels = 0.0, None
    if channels == 4 and not is_object:
        pixels = _pixels(frame)
        seen = ~shows_nothing(pixels)
        if not seen.all():
            ignored = 1.0 - float(seen.mean())
            size = (height // downscale, width // downscale)
            seen = all_of_blocks(seen, downscale, size)
            seen = seen if resampling is None else resampling.mask(seen)
            mask = seen if mask is None else mask & seen
    if mask is not None and not mask.any():
        return None
    if mask is not None and mask.all():
        mask = None
    photograph = Photograph(
        path=frame.reduced or frame.path,
        shape=(camera.height, camera.width, channels if is_object else 3),
        downscale=downscale if frame.reduced is None else 1,
        image=frame.image,
        drops_alpha=channels == 4 and not is_object,
        resampling=resampling,
    )
    if holds and pixels is not None and frame.reduced is None:
        photograph = replace(photograph, made=photograph.made_of(pixels))
    depth, why_no_depth = readable_depth(frame.depth, whole, downscale)
    return _Read(
        name=frame.name,
        frame=frame,
        whole=whole,
        camera=camera,
        photograph=photograph,
        depth=depth,
        mask=None if mask is None else PackedMask.of(mask),
        ignored=ignored,
        why_no_depth=why_no_depth,
    )
