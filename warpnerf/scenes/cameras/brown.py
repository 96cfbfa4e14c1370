"""Brown's lens as photogrammetric programs have it, Metashape and RealityCapture.

Its first tangential coefficient is OpenCV's second and the other way round, its radial polynomial
goes to r^8, and it may have a skew. Where only the first of that matters, it is OpenCV's lens.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from warpnerf.checks import InputError
from warpnerf.scenes.cameras.foreign import ForeignLens
from warpnerf.scenes.cameras.lens import Lens


def brown_lens(
    file: Path,
    place: str,
    values: dict[str, float],
    *,
    radial: Sequence[float],
    tangential: Sequence[float],
    skew: float = 0.0,
    kind: str = "BROWN",
) -> Lens:
    """The lens of such coefficients.

    Args:
        file: That they come from, for messages.
        place: In the file.
        values: Focal lengths, principal point and size, pixels.
        radial: k1 to k4.
        tangential: p1, p2, with r^2 + 2 x^2 and r^2 + 2 y^2; p3, p4 of what both grow by.
        skew: By how much x' grows with y', focal lengths.
        kind: BROWN, BROWN_FISHEYE or BROWN_EQUISOLID.

    Raises:
        InputError: A coefficient is not finite.
    """
    foreign: ForeignLens | None = ForeignLens(kind, (*radial, *tangential), skew)
    assert foreign is not None
    if foreign.wrong:
        raise InputError(f"{file}: {place}: {foreign.wrong}; export it again.")
    k1, k2, k3, k4 = radial
    p1, p2, p3, p4 = tangential
    if kind == "BROWN" and not any((k4, p3, p4, skew)):
        values = {**values, "k1": k1, "k2": k2, "k3": k3, "p1": p2, "p2": p1}
        foreign = None
    elif kind == "BROWN_FISHEYE" and not any((*tangential, skew)):
        values = {**values, "k1": k1, "k2": k2, "k3": k3, "k4": k4}
        foreign = None
    return Lens(
        file=file,
        values=values,
        fields={name: f"{place}: {name}" for name in values},
        fisheye=foreign is None and kind == "BROWN_FISHEYE",
        foreign=foreign,
    )
