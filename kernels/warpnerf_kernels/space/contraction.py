"""Scene contraction: unbounded space mapped into a box, and the determinant of its Jacobian.

In normalised coordinates q (the box is [-1, 1]^3), with n a norm of q and b the border:

    f(q) = q                          n <= 1
    f(q) = (1 + b - b / n) q / n      n >  1,      which fills [-(1 + b), 1 + b]^3

Source: Barron et al. 2022 (mip-NeRF 360: L2 norm, b = 1); Sun et al. 2022 (DVGOv2, L-infinity
norm, b = 0.2).
"""

from functools import cache

import warp as wp

from ..base.parts import INFINITELY_FAR, Space, SpaceVectors
from ..base.types import Box, real, vec3
from .none import NONE

wp.set_module_options({"enable_backward": False})

CONTRACT = r"""
vec norm = NORM;
vec n = max(norm, splat(1.0f));
vec shrink = norm > 1.0f ? (1.0f + box.border - box.border / n) / n : splat(1.0f);
vec across = ((1.0f + box.border) * n - box.border) / (n * n);
det_jacobian = norm > 1.0f ? box.border / (n * n) * across * across : det_jacobian;
qx *= shrink;
qy *= shrink;
qz *= shrink;
"""


@cache
def contraction(norm: wp.Function, norm_pack: str | None = None) -> Space:
    """The contraction that is built on a norm.

    Args:
        norm: Of q, from the L2 norm to the L-infinity norm: then no displacement is stretched by
            more than 2, with a border of at most 1.
        norm_pack: The same in C++, of qx, qy, qz; None: there is no vector form.
    """

    @wp.func
    def contract(box: Box, q: vec3) -> vec3:
        """f(q)"""
        n = norm(q)
        if n <= real(1.0):
            return q
        return q * ((real(1.0) + box.border - box.border / n) / n)

    @wp.func
    def det_jacobian(box: Box, q: vec3) -> real:
        """|det df/dq| = b ((1 + b) n - b)^2 / n^6 outside the box, 1 inside; for all norms."""
        n = norm(q)
        if n <= real(1.0):
            return real(1.0)
        across = ((real(1.0) + box.border) * n - box.border) / (n * n)
        return box.border / (n * n) * across * across

    @wp.func
    def boxes_out(box: Box, c: vec3) -> real:
        """The norm of q from that of c."""
        norm_of_c = norm(c)
        if norm_of_c <= real(1.0):
            return real(0.0)
        if norm_of_c < real(1.0) + box.border:
            return box.border / (real(1.0) + box.border - norm_of_c)
        return real(wp.static(INFINITELY_FAR))

    return NONE._replace(
        contracts=True,
        contract=contract,
        det_jacobian=det_jacobian,
        boxes_out=boxes_out,
        stretch=2.0,
        vectors=None if norm_pack is None else SpaceVectors(CONTRACT.replace("NORM", norm_pack)),
    )


@wp.func
def largest(q: vec3) -> real:
    """The L-infinity norm."""
    return wp.max(wp.max(wp.abs(q[0]), wp.abs(q[1])), wp.abs(q[2]))


@wp.func
def length(q: vec3) -> real:
    """The L2 norm."""
    return wp.length(q)


LINF = contraction(largest, "max(max(abs(qx), abs(qy)), abs(qz))")
"""By boxes around the box."""
L2 = contraction(length, "__builtin_elementwise_sqrt(qx * qx + qy * qy + qz * qz)")
"""By ellipsoids around the one in the box."""
