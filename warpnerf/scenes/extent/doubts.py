"""Doubts about poses and lenses: what photographs refute, whatever is meant by the files."""

from __future__ import annotations

import numpy as np

from warpnerf.scenes.extent.photo_consistency import PhotoConsistency

REFUTED = 0.08
"""Mean gain below which photographs do not fit their poses: captures of cameras that are CLOSE have
0.11 and more, photographs in another order up to 0.06."""
CLOSE = 2.0
"""How far apart neighbours may be for that, as in ``photo_consistency.neighbours``."""
ENOUGH = 6
"""References, at least, that tell."""

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
    them, focal lengths, or else poses."""
    gain = photographs.agreement.gain
    if len(gain) < ENOUGH or gain.mean() >= UNSURE:
        return []
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
    if gain.mean() < REFUTED and photographs.apart() <= CLOSE:
        return [
            "photographs do not fit their poses: what one shows is not found in its neighbours, at "
            "any depth; poses, focal lengths or the order of the photographs are likely wrong"
        ]
    return []


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
