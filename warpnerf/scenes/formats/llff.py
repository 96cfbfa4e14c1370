"""LLFF's poses_bounds.npy: poses and one focal length of the photographs next to it, by name.

Each row holds a matrix [3, 5], camera to world with axes down, right, backward and, in its last
column, height, width and focal length in pixels of the original photographs; then two bounds of
depth, between which what the photograph shows lies. Some programs write 0 for the nearer one, where
they know none; then bounds are not used.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from warpnerf.checks import InputError
from warpnerf.scenes.cameras.lens import Lens
from warpnerf.scenes.cameras.poses import check_pose
from warpnerf.scenes.files import photograph_folder, printable, resolve_inside
from warpnerf.scenes.formats.assemble import Reading, assemble
from warpnerf.scenes.formats.found_photographs import Photographs
from warpnerf.scenes.formats.frame import Frame
from warpnerf.scenes.images.arrays import read_npy
from warpnerf.scenes.scene import Scene

FILE = "poses_bounds.npy"


def load_llff(folder: Path, reading: Reading) -> Scene:
    """Load a scene from poses_bounds.npy. Every 8th photograph is for testing.

    Args:
        folder: The scene's folder, with images/ or images_4/, images_8/, ...
        reading: How photographs are to be read.

    Returns:
        The scene; distances are the file's.

    Raises:
        InputError: The file is damaged, or there are more or fewer photographs than poses.
    """
    file = folder / FILE
    rows = read_npy(file)
    if rows.ndim != 2 or rows.shape[1] != 17:
        raise InputError(f"{file}: must hold an array [n, 17], not {list(rows.shape)}.")
    if not np.isfinite(rows).all():
        raise InputError(f"{file}: must hold finite numbers only; export it again.")
    photographs = photograph_folder(folder)
    paths = Photographs(folder, among=photographs, within=photographs is None).paths
    if not paths:
        raise InputError(f"{folder}: its photographs are not there; put them into images/.")
    places = list(dict.fromkeys(path.parent for path in paths))
    if len(places) > 1:
        first, second = (printable(place.name) for place in places[:2])
        raise InputError(
            f"{folder}: its photographs are in {len(places)} folders (first: {first}, {second}); "
            f"put those of {FILE} into images/."
        )
    if len(paths) != len(rows):
        raise InputError(
            f"{file}: holds {len(rows)} poses, but {places[0]} {len(paths)} photographs; LLFF "
            "pairs them by order, so none may be missing."
        )
    frames = []
    for number, (row, path) in enumerate(zip(rows.astype(np.float64), paths, strict=True)):
        place = f"row {number}"
        resolve_inside(folder, path.relative_to(folder).as_posix(), field=f"{file}: {place}")
        matrix = row[:15].reshape(3, 5)
        down, right, backward, position, size = matrix.T
        height, width, focal = size.tolist()
        if min(height, width, focal) <= 0.0:
            raise InputError(f"{file}: {place}: height, width and focal length must be above 0.")
        near, far = row[15:].tolist()
        if near >= far:
            raise InputError(
                f"{file}: {place}: the near bound must be below the far bound, not {near:.4g} with "
                f"{far:.4g}; they are its last two numbers, in this order."
            )
        pose = np.stack([right, -down, backward, position], axis=1)
        # As angles of view, which hold for reduced photographs as well.
        angles = {
            "camera_angle_x": 2.0 * math.atan(0.5 * width / focal),
            "camera_angle_y": 2.0 * math.atan(0.5 * height / focal),
        }
        fields = dict.fromkeys(angles, f"{place}: focal length")
        frames.append(
            Frame(
                name=path.name,
                path=path,
                c2w=check_pose(pose.tolist(), field=f"{file}: {place}"),
                lens=Lens(file=file, values=angles, fields=fields),
                bounds=(near, far) if near > 0.0 else None,
            )
        )
    dummies = [number for number, frame in enumerate(frames) if frame.bounds is None]
    warnings = []
    if dummies:
        near, far = rows[dummies[0], 15:].tolist()
        warnings.append(
            f"{FILE}: bounds of depth are not used: the near bound of {len(dummies)} of "
            f"{len(rows)} rows is not above 0 (first: row {dummies[0]}, {near:.4g} with {far:.4g})"
        )
    return assemble(
        folder=folder,
        file=file,
        frames=frames,
        splits={},
        warnings=warnings,
        reading=reading,
    )
