"""Coordinate conventions of poses and points, checked against the photographs.

Files do not say which way a camera's axes point, nor whether a matrix is camera to world or its
inverse, nor in which axes and units points are. Photographs do: see ``photo_consistency``.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from warpnerf.checks import InputError
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.focus import find_focus, upside_down
from warpnerf.scenes.cameras.overlap import in_picture
from warpnerf.scenes.cameras.quaternions import quaternions, rotations
from warpnerf.scenes.extent.doubts import doubted_others, doubts, mirrored_photographs
from warpnerf.scenes.extent.photo_consistency import (
    ALMOST_ALL,
    CLEARLY,
    NOTABLY,
    Agreement,
    PhotoConsistency,
)
from warpnerf.scenes.extent.points import Points
from warpnerf.scenes.scene import View

SUPPORTED = 0.7
"""Support of points that are believed, at least; those of captures have 0.78 to 1.26."""
SURELY = 0.75
"""Support of points in other axes or units, for these to be the cameras'."""
BETTER = 0.2
"""By how much that must be more than in their own, where these are in pictures as well."""
RUNNER_UP = 0.9
"""Share of it that no other axes and units may reach."""
EVERY = 3
"""Of many axes and units, those are chosen that have the most support of every third reference."""

LOOKED_AT = 600
"""Points, at most, of which is counted in how many pictures they fall."""
SEEN = 0.5
"""Share of the points that two pictures show, from which on nothing is odd."""
UNSEEN = 0.1
"""Share below which points are not those of these cameras."""
AS_FAR_AS = 100.0
AS_NEAR_AS = 0.02
"""Points farther from the cameras' middle than so many times what these are, or nearer, need
support."""
SCALES = (1.0, 1e-3, 1e3, 1e-2, 1e2)
"""Units that points may be in, in those of the cameras: metres, millimetres, centimetres."""

FLIP = np.array([1.0, -1.0, -1.0, 1.0])
"""From OpenCV's axes to OpenGL's, of the columns of a pose."""

MIRRORED = np.array([1.0, 1.0, -1.0, 1.0])
"""From left-handed axes to OpenGL's, of the rows and columns of a pose."""

Poses = Callable[[np.ndarray], np.ndarray]
"""From poses as they stand to camera to world in OpenGL axes, [n, 3, 4] both."""


def _inverted(poses: np.ndarray) -> np.ndarray:
    turned = poses[:, :, :3].transpose(0, 2, 1)
    return np.concatenate([turned, -turned @ poses[:, :, 3:]], axis=2)


def _columns(*order: int) -> Poses:
    """Axes x, y, z taken from columns 1, 2, 3, with signs."""
    at, signs = [abs(k) - 1 for k in order], np.sign(order)
    return lambda poses: np.concatenate([poses[:, :, at] * signs, poses[:, :, 3:]], axis=2)


def _w_last(poses: np.ndarray) -> np.ndarray:
    """Of quaternions read as w, x, y, z that are x, y, z, w, and translations to the camera."""
    to_camera = (poses[:, :, :3] * FLIP[:3]).transpose(0, 2, 1)
    moved = -to_camera @ poses[:, :, 3:]
    turned = rotations(np.roll(quaternions(to_camera), 1, axis=1)).transpose(0, 2, 1)
    return np.concatenate([turned * FLIP[:3], -turned @ moved], axis=2)


def _with_positions(poses: np.ndarray) -> np.ndarray:
    """Of world to camera in OpenCV axes with the camera's position in place of the translation."""
    to_camera = (poses[:, :, :3] * FLIP[:3]).transpose(0, 2, 1)
    return np.concatenate([poses[:, :, :3], -to_camera @ poses[:, :, 3:]], axis=2)


OPENCV = "camera to world in OpenCV axes (x right, y down, looking along +z)"
READINGS: dict[str, Poses] = {
    OPENCV: lambda poses: poses * FLIP,
    "world to camera in OpenCV axes": lambda poses: _inverted(poses) * FLIP,
    "world to camera in OpenGL axes": _inverted,
    "camera to world in PyTorch3D's axes (x left, y up, looking along +z)": _columns(-1, 2, -3),
    "camera to world in axes x left, y down, looking along -z": _columns(-1, -2, 3),
    "camera to world in LLFF's axes (x down, y right, looking along -z)": _columns(2, -1, 3),
    "camera to world in axes x up, y left, looking along -z": _columns(-2, 1, 3),
    "camera to world in OpenCV axes, in place of LLFF's": _columns(-2, -1, -3),
    "world to camera in OpenCV axes, with quaternions that end with w": _w_last,
    "world to camera in OpenCV axes, with positions of cameras in place of translations": (
        _with_positions
    ),
    "camera to world in left-handed axes as of Unity (x right, y up, looking along +z)": (
        lambda poses: poses * MIRRORED * MIRRORED[:3, None]
    ),
}
"""Other ways to read poses, by their names; OpenCV's is by far the commonest."""

TURNED = {
    "camera to world in axes x left, y down, looking along -z": 180,
    "camera to world in LLFF's axes (x down, y right, looking along -z)": 90,
    "camera to world in axes x up, y left, looking along -z": 90,
}
"""Readings that are also those of photographs that were turned by so many degrees."""

PART = 3
"""Views of a part, at least, whose poses may be in other axes than those of the others."""
NEARLY_EVERY = 0.9
"""Share of the references of such a part that must fit once it is read otherwise."""
FEW = 0.1
"""Share of cameras that may stand on their heads for the axes of all to be questioned."""
MOST_PARTS = 8
"""Folders of photographs, at most, that are looked at one by one."""
ONE_LINE = 0.5
"""Cosine of the largest angle of an optical axis to a line for it to be along that line."""


def check_against_photographs(
    views: Sequence[View], training: Sequence[int], points: Points | None, is_object: bool
) -> tuple[list[View], PhotoConsistency, Points | None, list[str]]:
    """Detect the coordinate conventions of poses and points, by what the photographs show.

    What stands in the files is changed only where the photographs refute it and agree with another
    convention; points that fit no convention are left out.

    Args:
        views: All, with poses as camera to world in OpenGL axes, as the files say.
        training: Indices of those that are looked at.
        points: Of the scene, if it has some.
        is_object: Whether it is one: if the cameras look at it, and there are no points, there is
            nothing to ask.

    Returns:
        The views that fit; the photographs of the training, posed as these; the points that fit;
        and warnings of what was changed or left out, but for points that were only tried.
    """
    photographs = PhotoConsistency.of([views[i] for i in training])
    if is_object and points is None and _look_at_one_thing([views[i].camera for i in training]):
        told = mirrored_photographs(photographs) if photographs.can_tell else []
        return list(views), photographs, None, told
    if points is not None and not len(points.positions):
        points = None
    views, photographs, warnings = _parts_read(list(views), photographs)
    name = _reading(photographs, points)
    if name is not None:
        read = READINGS[name]
        every = read(np.array([view.camera.c2w for view in views]))
        views = [view.posed(pose) for view, pose in zip(views, every, strict=True)]
        photographs = photographs.posed(read(photographs.poses))
        evidence = "photographs" if photographs.can_tell else "points"
        warnings.append(
            f"poses are read as {name}: so the {evidence} fit each other, and not as camera to "
            f"world in OpenGL axes{_or_turned(name)}; convert them, if other programs shall read "
            "them"
        )
    if photographs.can_tell:
        told = doubts(photographs)
        trained = set(training)
        others = [view for i, view in enumerate(views) if i not in trained]
        warnings += told or doubted_others(photographs, others)
    if points is not None:
        points, why = _believed(photographs, points)
        warnings += why
    return list(views), photographs, points, warnings


def _or_turned(name: str) -> str:
    """What else a reading may come from."""
    if name not in TURNED:
        return ""
    return f", unless the photographs were turned by {TURNED[name]} degrees after that"


def _parts_read(
    views: list[View], photographs: PhotoConsistency
) -> tuple[list[View], PhotoConsistency, list[str]]:
    """Poses of a part of the views read in other axes than the rest, where photographs prove it.

    They are only where the rest fits as it stands, and that part does not, but once it is read
    otherwise fits the rest, nearly every view of it, and all fit.

    Returns:
        The views, the photographs posed as these, and a warning, if there is such a part.
    """
    if not photographs.can_tell:
        return views, photographs, []
    best: tuple[float, str, frozenset[str]] | None = None
    for part in _parts(views, not photographs.agreement.fits):
        inside = [k for k, view in enumerate(photographs.views) if view.name in part]
        rest = [k for k, view in enumerate(photographs.views) if view.name not in part]
        if min(len(inside), len(rest)) < PART:
            continue
        given = photographs.of_views(inside)
        if given.agreement.fits or not photographs.of_views(rest).agreement.fits:
            continue
        for name, read in READINGS.items():
            poses = photographs.poses.copy()
            poses[inside] = read(poses[inside])
            then = photographs.posed(poses)
            if (
                _is_proved(given.agreement, given.posed(poses).agreement)
                and _fit_all(then.of_views(rest).agreement)
                and then.agreement.fits
                and then.agreement.gain.mean() >= photographs.agreement.gain.mean() + CLEARLY
            ):
                gain = float(then.agreement.gain.mean())
                best = max(best or (gain, name, part), (gain, name, part), key=lambda b: b[0])
    if best is None:
        return views, photographs, []
    _, name, part = best
    read = READINGS[name]
    views = [
        view.posed(read(view.camera.c2w[None])[0]) if view.name in part else view for view in views
    ]
    posed = {view.name: view.camera.c2w for view in views}
    return (
        views,
        photographs.posed(np.array([posed[view.name] for view in photographs.views])),
        [
            f"poses of {len(part)} of {len(views)} images (first: {min(part)}) are read as {name}: "
            "so the photographs fit each other, and not in the axes of the others; write all in "
            "the same"
        ],
    )


def _is_proved(given: Agreement, other: Agreement) -> bool:
    """Whether references of a part, nearly every one, fit otherwise, and better than as given."""
    each = (other.gain > NOTABLY) & (other.gain > given.gain)
    return other.is_better(given) and bool(np.mean(each) >= NEARLY_EVERY)


def _fit_all(agreement: Agreement) -> bool:
    """Whether almost all references fit: more than where photographs fit as a whole."""
    return agreement.fits and bool(np.mean(agreement.gain > NOTABLY) >= ALMOST_ALL)


def _parts(views: Sequence[View], any_part: bool) -> list[frozenset[str]]:
    """Names of views that may be in other axes than the rest.

    Args:
        views: All.
        any_part: Whether also those that look one way, where the rest looks the other, and those of
            each folder, besides those that stand on their heads.
    """
    cameras = [view.camera for view in views]
    masks = [upside_down(cameras)]
    if any_part:
        axes = np.array([camera.forward for camera in cameras])
        along = axes @ np.linalg.eigh(axes.T @ axes)[1][:, -1]
        if np.mean(np.abs(along) > ONE_LINE) >= ALMOST_ALL:
            masks.append(along > 0.0)
    parts = [{v.name for v, m in zip(views, mask, strict=True) if m} for mask in masks]
    parts += [{view.name for view in views} - part for part in parts]
    if any_part:
        folders: dict[str, set[str]] = {}
        for view in views:
            folders.setdefault(view.name.rpartition("/")[0], set()).add(view.name)
        parts += list(folders.values()) if len(folders) <= MOST_PARTS else []
    return list(dict.fromkeys(frozenset(part) for part in parts))


def _look_at_one_thing(cameras: Sequence[Camera]) -> bool:
    try:
        return not find_focus(cameras).guessed
    except InputError:
        return False


def _reading(photographs: PhotoConsistency, points: Points | None) -> str | None:
    """The other way to read poses that photographs, or else points, prove; None: as they stand.

    Where photographs fit as the poses stand, only OpenCV's axes are tried: for cameras that move
    along a line nearly parallel to each other, these fit nearly as well.
    """
    poses = photographs.poses
    shares = {}
    if points is not None:
        sample = _sample(points)
        shares = {
            name: _share_seen(photographs.posed(read(poses)).cameras, sample)
            for name, read in {"": lambda given: given, **READINGS}.items()
        }
    if not photographs.can_tell:
        found = max(READINGS, key=lambda name: shares.get(name, 0.0))
        told = bool(shares) and shares[""] < UNSEEN and shares[found] > SEEN
        return found if told else None
    agreement, better = photographs.agreement, {}
    # Of cameras of which some stand on their heads, any axes are wrong for some.
    as_likely = () if upside_down(photographs.cameras).mean() > FEW else (OPENCV,)
    for name in as_likely if agreement.fits else READINGS:
        other = photographs.posed(READINGS[name](poses)).agreement
        refuted = bool(shares) and shares[name] < 0.5 * shares[""]
        if not refuted and other.is_better(agreement):
            better[name] = float(other.gain.mean())
    return max(better, key=lambda name: better[name]) if better else None


def _believed(photographs: PhotoConsistency, points: Points) -> tuple[Points | None, list[str]]:
    """Points in the cameras' axes and units, if there are such, and what to say of them."""
    cameras, tell = photographs.cameras, photographs.tell_depths
    share = _share_seen(cameras, _sample(points))
    support = photographs.support(points.positions) if tell else None
    near = AS_NEAR_AS <= _times_as_far(cameras, points.positions) <= AS_FAR_AS
    good = support is None or support >= SUPPORTED
    if share >= SEEN and good and near:
        return points, []
    if tell:
        moved = _moved(photographs, points.positions, share, support or 0.0)
        if moved is not None:
            how, positions = moved
            return replace(points, positions=positions), [
                f"points of {points.source} are read as {how}: so they fit the photographs, and "
                "not as they stand; bring them into the axes and units of the poses, or leave them "
                "out"
            ]
    if good and share >= UNSEEN and (near or support is not None):
        return points, []
    if points.tried:
        return None, []
    return None, [
        f"points of {points.source} are not used: they are not what these cameras photographed, so "
        "their axes, units or scale are likely others than those of the poses; export them "
        "together with the poses, or leave them out"
    ]


def _moved(
    photographs: PhotoConsistency, positions: np.ndarray, share: float, support: float
) -> tuple[str, np.ndarray] | None:
    """Points with axes exchanged, mirrored and scaled so that they surely fit; None: in no way."""
    cameras = photographs.cameras
    sample = positions[:: max(1, -(-len(positions) // LOOKED_AT))]
    for scale in SCALES:
        if not AS_NEAR_AS <= _times_as_far(cameras, scale * sample) <= AS_FAR_AS:
            continue
        rated = []
        for order, signs in _orders():
            if scale == 1.0 and order == (0, 1, 2) and min(signs) > 0.0:
                continue
            seen = _share_seen(cameras, scale * sample[:, order] * signs)
            if seen >= max(SEEN, ALMOST_ALL * share):
                fit = photographs.support(scale * sample[:, order] * signs, EVERY)
                rated.append((seen * (fit or 0.0), seen, order, signs))
        rated.sort(key=lambda entry: -entry[0])
        if not rated:
            continue
        _, seen, order, signs = rated[0]
        found = scale * positions[:, order] * signs
        fit = photographs.support(found) or 0.0
        enough = BETTER if share >= SEEN else 0.0
        rival = rated[1][0] if len(rated) > 1 else 0.0
        if fit >= max(SURELY, support + enough) and rival < RUNNER_UP * rated[0][0]:
            return _in_words(scale, order, signs), found
    return None


def _orders() -> Iterator[tuple[tuple[int, ...], tuple[float, ...]]]:
    """All orders of three axes with all signs."""
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            yield order, signs


def _in_words(scale: float, order: Sequence[int], signs: Sequence[float]) -> str:
    axes = ", ".join(
        f"{'-' if s < 0.0 else ''}{'xyz'[k]}" for k, s in zip(order, signs, strict=True)
    )
    return f"({axes})" if scale == 1.0 else f"{scale:g} ({axes})"


def _sample(points: Points) -> np.ndarray:
    return points.positions[:: max(1, -(-len(points.positions) // LOOKED_AT))]


def _share_seen(cameras: Sequence[Camera], positions: np.ndarray) -> float:
    """Share of positions [n, 3] that two of the cameras have in their pictures."""
    return float(np.mean(np.sum([in_picture(c, positions) for c in cameras], axis=0) >= 2))


def _times_as_far(cameras: Sequence[Camera], positions: np.ndarray) -> float:
    """How many times as far from the cameras' middle positions are, by the median."""
    places = np.array([camera.position for camera in cameras])
    middle = places.mean(axis=0)
    spread = float(np.linalg.norm(places - middle, axis=1).mean())
    return float(np.median(np.linalg.norm(positions - middle, axis=1))) / max(spread, 1e-300)
