"""A kind of space: a contraction that begins at the faces of the box without a jump.

In coordinates q, with n the largest and b the border, m(n) = 1 + b (n - 1) / (n - 1 + b) is where
n comes to lie: m'(1) = 1, whatever b is, and m goes to 1 + b. As m / n falls, and by no more than
m / n^2, no displacement becomes longer than twice what it is, as in the contraction without.
"""

from functools import cache
from typing import Any, ClassVar

import numpy as np
import warp as wp

from warpnerf.model.interface import Load
from warpnerf.model.spaces import Linf, register


@cache
def space(load: Load) -> Any:
    types, linf, far = load("base.types"), load("space.contraction"), load("base.parts")
    real, vec3, Box, largest = types.real, types.vec3, types.Box, linf.largest
    infinitely_far = far.INFINITELY_FAR

    @wp.func
    def contract(box: Box, q: vec3) -> vec3:
        n = largest(q)
        if n <= real(1.0):
            return q
        out = n - real(1.0)
        return q * ((real(1.0) + box.border * out / (out + box.border)) / n)

    @wp.func
    def det_jacobian(box: Box, q: vec3) -> real:
        n = largest(q)
        if n <= real(1.0):
            return real(1.0)
        out = n - real(1.0)
        across = (real(1.0) + box.border * out / (out + box.border)) / n
        ahead = box.border / (out + box.border)
        return ahead * ahead * across * across

    @wp.func
    def boxes_out(box: Box, c: vec3) -> real:
        out = largest(c) - real(1.0)
        if out <= real(0.0):
            return real(0.0)
        if out >= box.border:
            return real(infinitely_far)
        return real(1.0) + box.border * out / (box.border - out)

    return linf.LINF.replace(contract=contract, det_jacobian=det_jacobian, boxes_out=boxes_out)


@register
class Smooth(Linf):
    name: ClassVar[str] = "smooth"

    def part(self, load: Load) -> Any:
        return space(load)

    def shrink(self, n: np.ndarray, b: float) -> np.ndarray:
        return (1.0 + b * (n - 1.0) / (n - 1.0 + b)) / n

    def ahead(self, n: np.ndarray, b: float) -> np.ndarray:
        return np.square(b / (n - 1.0 + b))

    def grown(self, m: np.ndarray, b: float) -> np.ndarray:
        with np.errstate(divide="ignore"):
            return 1.0 + b * (m - 1.0) / np.maximum(1.0 + b - m, 0.0)
