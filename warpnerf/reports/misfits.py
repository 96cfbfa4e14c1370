"""Photographs that a field does not explain: of a wrong pose, say, or of something that moved."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

FEWEST = 6
"""Photographs, at least, that tell how well one is usually explained."""
BELOW = 3.5
"""dB below the median, at least."""
DEVIATIONS = 5.5
"""Likewise, in standard deviations, as the median absolute deviation tells them. Of captures whose
poses are right, photographs lie up to 5.2 deviations below it; one that is turned by 3 degrees, or
has the pose of another, 6.4 to 17, where the others are alike and many show the same."""
NORMAL = 1.4826
"""Standard deviations of a normal distribution in one median absolute deviation."""
NAMED = 3
"""That are named, at most."""


def misfits(psnr: Mapping[str, float]) -> list[str]:
    """Photographs that are explained far worse than the others, the worst first.

    Args:
        psnr: Of training views, by name, dB.
    """
    if len(psnr) < FEWEST:
        return []
    found = np.array(list(psnr.values()))
    median = np.median(found)
    deviation = NORMAL * np.median(np.abs(found - median))
    least = float(median - max(BELOW, DEVIATIONS * deviation))
    return sorted((name for name in psnr if psnr[name] < least), key=psnr.__getitem__)


def in_words(psnr: Mapping[str, float]) -> str | None:
    """A sentence that names them, and the way out.

    Args:
        psnr: Of training views, by name, dB.

    Returns:
        None: there are none.
    """
    worst = misfits(psnr)
    if not worst:
        return None
    named = [f"{name} ({psnr[name]:.1f} dB)" for name in worst[:NAMED]]
    if len(worst) > NAMED:
        named.append(f"{len(worst) - NAMED} more")
    several = len(worst) > 1
    listed = ", ".join(named[:-1]) + " and " + named[-1] if several else named[0]
    median = float(np.median(list(psnr.values())))
    return (
        f"photograph{'s' if several else ''} that the field does not explain: {listed}, where half "
        f"of all have {median:.1f} dB or more; poses may be wrong, or something moved there; look "
        "at them, and take such ones out of the scene's folder or file of poses"
    )
