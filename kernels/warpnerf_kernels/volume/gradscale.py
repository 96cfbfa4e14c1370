"""Gradient scaling by distance: Philip & Deschaintre 2023, "Floaters No More", eq. 7.

Space close to a camera is crossed by many rays of few cameras: samples per volume go as 1 / t^2.
Each sample's gradient is multiplied by s(t), which takes that out again; the image is untouched.

    NONE        s = 1
    QUADRATIC   s = (t / content_distance)^2
    CLAMPED     s = min(1, (t / content_distance)^2)        the paper's method

Contraction changes volume as well. JACOBIAN_DENSITY multiplies (t / content_distance)^2 by
|det J|, which makes up for the measured density of samples in contracted space; JACOBIAN_PAPER
divides by it, as printed in the paper (eq. 8); JACOBIAN_NONE leaves it out, as in its experiments.
"""

from typing import Any

import warp as wp

from ..base.simd import VECTORS
from ..base.types import real

NONE = 0
QUADRATIC = 1
CLAMPED = 2

JACOBIAN_NONE = 0
JACOBIAN_DENSITY = 1
JACOBIAN_PAPER = 2


@wp.func
def distance_scale(
    t: real,  # of the sample, scene units from the camera
    content_distance: real,  # scene units, > 0
    det_jacobian: real,
    scaling: int,
    jacobian: int,
) -> real:
    """s(t). Divides by content_distance, so that t >= content_distance is exactly untouched."""
    if scaling == NONE:
        return real(1.0)
    ratio = t / content_distance
    scale = ratio * ratio
    if jacobian == JACOBIAN_DENSITY:
        scale = scale * det_jacobian
    if jacobian == JACOBIAN_PAPER:
        scale = scale / det_jacobian
    if scaling == CLAMPED:
        scale = wp.min(real(1.0), scale)
    return scale


@wp.func_native(
    VECTORS
    + f"""
constexpr int NONE = {NONE}, CLAMPED = {CLAMPED};
constexpr int DENSITY = {JACOBIAN_DENSITY}, PAPER = {JACOBIAN_PAPER};
"""
    + r"""
auto& pack = packs.data[slot];
const vec ratio = load(pack.t) / content_distance;
vec scale = ratio * ratio;
if (jacobian == DENSITY) scale *= load(pack.det_jacobian);
if (jacobian == PAPER) scale /= load(pack.det_jacobian);
if (scaling == CLAMPED) scale = scale > 1.0f ? splat(1.0f) : scale;
store(pack.scale, scaling == NONE ? splat(1.0f) : scale);
"""
)
def scale_pack(
    content_distance: wp.float32,
    scaling: int,
    jacobian: int,
    packs: wp.array(dtype=Any),  # their scale written
    slot: int,
):
    """distance_scale of a pack's samples."""
    ...
