"""Unbounded space folded into a box, and how much volume the folding takes away.

In normalised coordinates q (the box is [-1, 1]^3), with n a norm of q and b the border:

    f(q) = q                          n <= 1
    f(q) = (1 + b - b / n) q / n      n >  1,      which fills [-(1 + b), 1 + b]^3

Source: Barron et al. 2022 (mip-NeRF 360: L2 norm, b = 1); Sun et al. 2022 (DVGOv2: L-infinity
norm, b = 0.2).
"""

import warp as wp

from ..base.types import real, vec3

NONE = 0
LINF = 1
L2 = 2
NDC = 3  # no contraction of the box's coordinates: these are those of a frustum, see ndc.py


@wp.func
def folds(contraction: int) -> bool:
    """Whether space outside the box is folded in, so that there is none outside."""
    return contraction == LINF or contraction == L2


@wp.func
def norm_of(q: vec3, contraction: int) -> real:
    """The norm that the contraction is built on."""
    if contraction == L2:
        return wp.length(q)
    return wp.max(wp.max(wp.abs(q[0]), wp.abs(q[1])), wp.abs(q[2]))


@wp.func
def contract(q: vec3, border: real, contraction: int) -> vec3:
    """f(q); the identity for NONE and NDC."""
    if not folds(contraction):
        return q
    n = norm_of(q, contraction)
    if n <= real(1.0):
        return q
    return q * ((real(1.0) + border - border / n) / n)


@wp.func
def det_jacobian_of(q: vec3, border: real, contraction: int) -> real:
    """|det df/dq| = b ((1 + b) n - b)^2 / n^6 outside the box, 1 inside; for both norms."""
    if not folds(contraction):
        return real(1.0)
    n = norm_of(q, contraction)
    if n <= real(1.0):
        return real(1.0)
    across = ((real(1.0) + border) * n - border) / (n * n)
    return border / (n * n) * across * across
