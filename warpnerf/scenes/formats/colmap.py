"""COLMAP's sparse models, binary and text: cameras and poses of the photographs next to them.

cameras.bin, images.bin or cameras.txt, images.txt lie in sparse/0, sparse or colmap/sparse/0, and
photographs in images/, or smaller ones in images_2/, images_4/, ... Poses are world to camera in
OpenCV axes, and pixels have their centres at halves, as here.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np

from warpnerf.checks import InputError
from warpnerf.scenes.cameras.foreign import MODELS, ForeignLens
from warpnerf.scenes.cameras.lens import Lens
from warpnerf.scenes.cameras.poses import check_pose
from warpnerf.scenes.extent.points import Points
from warpnerf.scenes.files import (
    photograph_folder,
    printable,
    require_regular_file,
)
from warpnerf.scenes.formats.assemble import Reading, assemble
from warpnerf.scenes.formats.colmap_files import (
    PARAMETERS,
    ModelCamera,
    ModelImage,
    cameras_of_bytes,
    cameras_of_text,
    images_of_bytes,
    images_of_text,
    stated_images,
)
from warpnerf.scenes.formats.colmap_models import (
    beside,
    find_models,
    images_of,
    model_kind,
    other_models,
    scene_folder,
    size_of,
)
from warpnerf.scenes.formats.colmap_points import UnusablePlyError, read_points
from warpnerf.scenes.formats.frame import Frame
from warpnerf.scenes.formats.frame_images import (
    elsewhere_warnings,
    find_photographs,
    others_there,
)
from warpnerf.scenes.formats.split_lists import read_split_lists
from warpnerf.scenes.formats.unnamed_photographs import unnamed_photographs
from warpnerf.scenes.images.masks import mask_in
from warpnerf.scenes.scene import Scene

SAME = 0.02
"""Largest difference of two cameras that are one: in spreads of all, and of unit vectors."""
MIN_SAME = 0.5
"""Share of a scene's cameras that must be a model's for the model's points to be the scene's."""


def _require_once(file: Path, images: Sequence[ModelImage]) -> None:
    """Raise InputError where two images have one number or one name."""
    for what, of in (("number", lambda image: image.number), ("name", lambda image: image.name)):
        (most, n), *_ = Counter(map(of, images)).most_common(1) or [(None, 0)]
        if n > 1:
            raise InputError(
                f"{file}: {n} images have the {what} {printable(str(most)[:80])}; remove all but "
                "one of them, or export it again."
            )


def load_colmap(model: Path, reading: Reading) -> Scene:
    """Load a scene from a sparse model.

    Every 8th photograph is for testing. Box and content distance are those of the model's points,
    where it has some.

    Args:
        model: Folder of cameras.bin and images.bin, or of cameras.txt and images.txt.
        reading: How photographs are to be read.

    Returns:
        The scene; distances are the model's.

    Raises:
        InputError: A file is damaged, a lens is not modelled, or no photograph is there.
    """
    kind = model_kind(model)
    if kind is None:
        raise InputError(f"{model}: holds no COLMAP model: cameras and images, .bin or .txt.")
    camera_file, image_file = model / f"cameras.{kind}", model / f"images.{kind}"
    for file in (camera_file, image_file):
        require_regular_file(file)
    read_cameras, read_images = (
        (cameras_of_bytes, images_of_bytes) if kind == "bin" else (cameras_of_text, images_of_text)
    )
    try:
        cameras, images = read_cameras(camera_file), read_images(image_file)
        _require_once(image_file, images)
    except InputError as error:
        others = [path for path in beside(model) if size_of(path)]
        if not others:
            raise
        way_out = f"or name another model of the scene, such as {printable(str(others[0]))}"
        raise InputError(f"{str(error).removesuffix('.')}; {way_out}.") from None
    folder = scene_folder(model)
    photographs = photograph_folder(folder) or folder

    def field_of(index: int) -> str:
        return f"{image_file}: image {printable(images[index].name[:80])!r}"

    found, moved = find_photographs(folder, photographs, [i.name for i in images], field_of)
    frames: list[Frame] = []
    missing: list[str] = []
    names = {image.name: image.name for image in images}
    for index, image in enumerate(images):
        field, path = field_of(index), found.get(index)
        if path is None or not PurePosixPath(image.name).name:  # such as "."
            missing.append(printable(image.name[:80]))
            continue
        if image.camera not in cameras:
            raise InputError(f"{field}: its camera {image.camera} is not in {camera_file.name}.")
        lens = _lens(camera_file, image.camera, cameras[image.camera])
        called = ""
        if index in moved:
            base = photographs if path.is_relative_to(photographs) else folder
            called, names[image.name] = image.name, path.relative_to(base).as_posix()
        name, pose = names[image.name], _pose(image, field)
        mask = mask_in(folder / "masks", name) or mask_in(folder / "masks", image.name)
        mask = None if mask is None else replace(mask, found=True)
        frames.append(
            Frame(
                name=name,
                path=path,
                c2w=pose,
                lens=lens,
                mask=mask,
                called=called,
                elsewhere=moved.get(index, False),
            )
        )
    if not frames:
        place = folder / "images" if photographs == folder else photographs
        raise InputError(
            f"{image_file}: none of the model's {len(images)} photographs is in {place} (first: "
            f"{missing[0] if missing else 'none'}){others_there(folder)}; put them there."
        )
    warnings = elsewhere_warnings(image_file, frames)
    stated = 0 if kind == "bin" else stated_images(image_file)
    if stated > len(images):
        warnings.append(
            f"{image_file.name}: says that it lists {stated} images, but lists {len(images)}: if "
            "it was not shortened on purpose, export it again"
        )
    bare = [image.name for image in images if not image.keypoints]
    if bare:
        warnings.append(
            f"{image_file.name}: {len(bare)} of {len(images)} images have no line for their "
            f"keypoints (first: {printable(bare[0][:80])}): all are read, but other programs lose "
            "every second one"
        )
    odd = [image.name for image in images if image.odd_keypoints]
    if odd:
        warnings.append(
            f"{image_file.name}: the keypoints of {len(odd)} of {len(images)} images are no X Y "
            f"POINT3D_ID of each (first: {printable(odd[0][:80])}): poses do not depend on them, "
            "but other programs may refuse the file"
        )
    if missing:
        warnings.append(
            f"{image_file.name}: left out {len(missing)} of {len(images)} images for want of a "
            f"photograph (first: {missing[0]})"
        )
    notes, larger = other_models(model, images, folder)
    few, many = unnamed_photographs(photographs, {frame.path for frame in frames}, "the model")
    used = {frame.name for frame in frames}
    there = {name for name in names if names[name] in used}
    splits, listed, lost = read_split_lists(folder, there, set(names), model)
    splits = {split: {names[name] for name in members} for split, members in splits.items()}
    notes = [*notes, *few, *listed]
    warnings = [*warnings, *larger, *many, *lost]
    points = None
    try:
        points = read_points(model, {image.number: names[image.name] for image in images}, folder)
    except UnusablePlyError as error:
        warnings.append(f"no points: {error}")
    scene = assemble(
        folder=folder,
        file=image_file,
        frames=frames,
        splits=splits,
        warnings=warnings,
        reading=reading,
        points=points,
    )
    return replace(scene, notes=(*notes, *scene.notes))


def points_beside(
    folder: Path, frames: Sequence[Frame], applied: np.ndarray | None = None
) -> tuple[Points | None, str]:
    """Points of a model that lies in the folder of a scene with cameras from elsewhere.

    Args:
        folder: The scene's.
        frames: Of the scene.
        applied: [3, 4] that has turned the model's cameras to the scene's, unless they are the
            same already; None: nothing has.

    Returns:
        The points, with tracks by names of frames, where the model's cameras are the scene's; else
        None, and why a model that is there is not used.
    """
    why_not = ""
    for model in find_models(folder):
        points, why = _points_of(model, folder, frames, applied)
        if not why:
            return points, ""
        why_not = why_not or why
    return None, why_not


def _points_of(
    model: Path, folder: Path, frames: Sequence[Frame], applied: np.ndarray | None
) -> tuple[Points | None, str]:
    """As ``points_beside``, of one model."""
    place = model.relative_to(folder).as_posix()
    try:
        images = images_of(model)
        by_name = {image.name.replace("\\", "/").rpartition("/")[2]: image for image in images}
        pairs = [(f, by_name[f.path.name]) for f in frames if f.path.name in by_name]
        poses = np.array([_pose(image, f"{model}: {image.name}") for _, image in pairs])
        ours = np.array([frame.c2w for frame, _ in pairs])
        enough = len(pairs) >= MIN_SAME * len(frames)
        names = {image.number: frame.name for frame, image in pairs}
        if enough and _same_cameras(ours, poses):
            return read_points(model, names, folder), ""
        if enough and applied is not None and _same_cameras(ours, _moved(poses, applied)):
            points = read_points(model, names, folder)
            if points is None:
                return None, ""
            positions = _moved(points.positions[:, :, None], applied)[:, :, 0]
            return replace(points, positions=positions), ""
        return None, f"the points of {place} are not used: its cameras are others"
    except InputError as error:
        return None, f"the points of {place} are not used: {error}"


def _moved(poses: np.ndarray, applied: np.ndarray) -> np.ndarray:
    """Poses [n, 3, 4], or positions [n, 3, 1], by a rotation and translation [3, 4]."""
    moved = applied[:, :3] @ poses
    moved[:, :, -1] += applied[:, 3]
    return moved


def _same_cameras(ours: np.ndarray, theirs: np.ndarray) -> bool:
    """Whether poses [n, 3, 4] are the same, but for rounding and a few."""
    spread = np.linalg.norm(ours[:, :, 3] - ours[:, :, 3].mean(axis=0), axis=1).mean()
    apart = np.linalg.norm(ours[:, :, 3] - theirs[:, :, 3], axis=1)
    turned = np.abs(ours[:, :, :3] - theirs[:, :, :3]).max(axis=(1, 2))
    return bool(np.mean((apart < SAME * spread) & (turned < SAME)) > MIN_SAME)


def _pose(image: ModelImage, field: str) -> np.ndarray:
    """Camera to world, [3, 4], OpenGL axes."""
    w, x, y, z = image.rotation
    length = math.sqrt(w * w + x * x + y * y + z * z)
    if not (math.isfinite(length) and length > 1e-6):
        raise InputError(f"{field}: its quaternion {image.rotation} is none; export it again.")
    w, x, y, z = (value / length for value in (w, x, y, z))
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is refused below
        position = -rotation.T @ np.array(image.translation)
    c2w = np.concatenate([rotation.T * [1.0, -1.0, -1.0], position[:, None]], axis=1)
    return check_pose(c2w.tolist(), field=field)


def _lens(file: Path, number: int, camera: ModelCamera) -> Lens:
    """A camera as a lens."""
    place = f"camera {number}"
    if camera.model not in PARAMETERS:
        raise InputError(
            f"{file}: {place}: the lens {printable(camera.model[:40])} is not modelled; undistort "
            "the images to a pinhole camera (colmap image_undistorter)."
        )
    names = PARAMETERS[camera.model]
    if len(camera.parameters) != len(names):
        raise InputError(
            f"{file}: {place}: a {camera.model} has {len(names)} parameters, not "
            f"{len(camera.parameters)}."
        )
    values: dict[str, float] = {}
    for name, value in zip(names, camera.parameters, strict=True):
        if not math.isfinite(value):
            raise InputError(f"{file}: {place}: {name} is not a finite number; export it again.")
        if name == "fl":
            values["fl_x"] = values["fl_y"] = value
        else:
            values[name] = value
    if min(values["fl_x"], values["fl_y"]) <= 0.0 or min(camera.width, camera.height) < 1:
        raise InputError(f"{file}: {place}: its size and focal lengths must be above 0.")
    values |= {"w": camera.width, "h": camera.height}
    foreign = None
    if camera.model in MODELS:
        rest = [name for name in names if name not in ("fl", "fl_x", "fl_y", "cx", "cy")]
        foreign = ForeignLens(camera.model, tuple(values.pop(name) for name in rest))
        wrong = foreign.wrong
        if wrong:
            raise InputError(f"{file}: {place}: {wrong}; export it again.")
    return Lens(
        file=file,
        values=values,
        fields={name: f"{place}: {name}" for name in values},
        fisheye=foreign is None and camera.model.endswith("FISHEYE"),
        foreign=foreign,
    )
