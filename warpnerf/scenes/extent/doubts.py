"""Doubts about poses and lenses: what photographs refute, whatever is meant by the files."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from warpnerf.scenes.extent.photo_consistency import ALMOST_ALL, NOTABLY, PhotoConsistency
from warpnerf.scenes.scene import View

REFUTED = 0.08
"""Mean gain below which photographs do not fit their poses: captures of cameras that are CLOSE have
0.11 and more, photographs in another order up to 0.06."""
CLOSE = 2.0
"""How far apart neighbours may be for that, as in ``photo_consistency.neighbours``."""
ENOUGH = 6
"""References, at least, that tell."""

FEWEST_UNFIT = 3
SOME = 0.25
"""References, at least, and share of them, that do not fit where the others do: captures have none
with a gain below 0.1 where neighbours are CLOSE."""
MOST_OTHERS = 0.5
"""Share of those for testing that do not fit."""
OTHERS = 0.15
"""Mean gain of the others, at least."""

STRAIGHTER = 0.03
"""Mean gain by which photographs must fit better without distortion: captures with it lose 0.05."""

UNSURE = 0.2
"""Mean gain from which on focal lengths are believed."""
ZOOMS = 2.0 ** (np.array([-6, -5, -4, -3, -2, -1, 1, 2, 3, 4, 5, 6]) / 2.0)
"""Focal lengths that are tried, in those of the files."""
FINER = 2.0 ** np.array([-0.25, 0.25])
"""Those about the best of them."""
PEAK = 0.85
"""Share of the best one's mean gain that half and twice of it have, at most. Where cameras hardly
turn, any focal length fits: depths make up for it."""


def doubts(photographs: PhotoConsistency) -> list[str]:
    """Warnings of what photographs of the training refute: that they are as poses were found by
    them, distortion, focal lengths, or else poses of all or of some."""
    agreement = photographs.agreement
    gain = agreement.gain
    if len(gain) < ENOUGH:
        return []
    if photographs.distorted and _undistorted(photographs):
        return [
            "distortion does not fit the photographs, which fit each other better without it: they "
            "were undistorted since, or it is that of another lens; leave its coefficients out, or "
            "use the photographs that it was estimated by"
        ]
    if gain.mean() >= UNSURE:
        return _some_unfit(photographs)
    mirrored = mirrored_photographs(photographs)
    if mirrored:
        return mirrored
    zoom = _zoom(photographs)
    if zoom is not None:
        return [
            "focal lengths do not fit the photographs, which fit each other with about "
            f"{zoom * FINER[0]:.2g} to {zoom * FINER[1]:.2g} times as much; correct them: they may "
            "be those of photographs of another size, or in millimetres"
        ]
    some = _some_unfit(photographs)
    if not some and gain.mean() < REFUTED and photographs.apart() <= CLOSE:
        return [
            "photographs do not fit their poses: what one shows is not found in its neighbours, at "
            "any depth; poses, focal lengths or the order of the photographs are likely wrong"
        ]
    return some


def doubted_others(photographs: PhotoConsistency, views: Sequence[View]) -> list[str]:
    """A warning of views that are not for training whose photographs do not fit their poses.

    Args:
        photographs: Of the training.
        views: The others.
    """
    gain = photographs.agreement.gain
    if len(views) < FEWEST_UNFIT or len(gain) < ENOUGH or gain.mean() < OTHERS:
        return []
    others = photographs.beside(views)
    unfit = _unfit(others)
    if unfit.sum() < max(FEWEST_UNFIT, MOST_OTHERS * len(unfit)):
        return []
    first = others.views[int(others.agreement.of[unfit][0])].name
    return [
        f"photographs for testing do not fit their poses: {unfit.sum()} of {len(unfit)} that were "
        f"looked at (first: {first}) are not found in their neighbours, those for training are; "
        "their axes, units or lens are likely others, so test scores mean nothing"
    ]


def _unfit(photographs: PhotoConsistency) -> np.ndarray:
    """Which references are found by chance only, though their neighbours are close, [n] bool."""
    agreement = photographs.agreement
    near = [photographs.farthest(i) <= CLOSE for i in agreement.of]
    return np.asarray((agreement.gain < NOTABLY) & np.array(near, bool))


def _undistorted(photographs: PhotoConsistency) -> bool:
    """Whether photographs fit each other clearly better without the distortion of their lenses."""
    given, straight = photographs.agreement, photographs.straight().agreement
    if not straight.fits or len(straight.of) != len(given.of):
        return False
    gain = straight.gain - given.gain
    return bool(gain.mean() >= STRAIGHTER and np.mean(gain > 0.0) >= ALMOST_ALL)


def _some_unfit(photographs: PhotoConsistency) -> list[str]:
    """A warning of references that are found by chance only, where the others are found surely."""
    gain, of = photographs.agreement.gain, photographs.agreement.of
    unfit = _unfit(photographs)
    if unfit.all() or unfit.sum() < FEWEST_UNFIT or unfit.mean() < SOME:
        return []
    if gain[~unfit].mean() < OTHERS:
        return []
    first = photographs.views[int(of[unfit][0])].name
    return [
        f"some photographs do not fit their poses: {unfit.sum()} of {len(gain)} that were looked "
        f"at (first: {first}) are not found in their neighbours, the others are; they may be "
        "turned, mirrored, of another lens, or wrongly posed"
    ]


def mirrored_photographs(photographs: PhotoConsistency) -> list[str]:
    """A warning of photographs that do not fit as they stand, and do once they are mirrored."""
    given, found = photographs.agreement, {}
    if given.fits:
        return []
    for how, across in (("left to right", True), ("upside down", False)):
        other = photographs.mirrored(across=across).agreement
        if other.is_better(given):
            found[how] = float(other.gain.mean())
    if not found:
        return []
    how = max(found, key=lambda how: found[how])
    return [
        f"photographs were mirrored {how} after their poses were found: so they fit each other, "
        "and not as they stand; mirror them back"
    ]


def _zoom(photographs: PhotoConsistency) -> float | None:
    """How many times the focal length photographs prove; None: they do not."""
    zoom, best = 1.0, photographs.agreement
    for steps in (ZOOMS, FINER):
        middle = zoom
        for step in steps:
            other = photographs.zoomed(middle * step).agreement
            if other.is_better(photographs.agreement) and other.gain.mean() > best.gain.mean():
                zoom, best = float(middle * step), other
    if zoom == 1.0:
        return None
    beside = [photographs.zoomed(zoom * factor).agreement for factor in (0.5, 2.0)]
    sharp = max(other.gain.mean() for other in beside) <= PEAK * best.gain.mean()
    return zoom if sharp else None
