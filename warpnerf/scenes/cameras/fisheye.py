"""OpenCV's fisheye lens model: the angle to the optical axis is distorted, by a polynomial.

    theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)

Pixels lie ``theta_d`` focal lengths from the principal point. A polynomial fitted to an image rises
as far as the image shows something; beyond, a radius has no direction, or more than one.
"""

from __future__ import annotations

import functools
import math

import numpy as np

Coefficients = tuple[float, float, float, float]
"""k1, k2, k3, k4."""

MIN_SLOPE = 0.01
"""Of theta_d by theta: where it is less, a lens counts as folding over."""

N_ANGLES = 4097
"""Angles at which the slope is looked at, from 0 to 180 degrees."""


def distorted_angle(
    coefficients: Coefficients, angle: np.ndarray | float
) -> tuple[np.ndarray, np.ndarray]:
    """theta_d of angles, and its derivative by the angle; radians."""
    k1, k2, k3, k4 = coefficients
    theta = np.asarray(angle, np.float64)
    t2 = theta * theta
    distorted = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    slope = 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)))
    return distorted, slope


@functools.lru_cache(maxsize=64)
def largest_angle(coefficients: Coefficients) -> float:
    """Up to which angle theta_d rises, radians; at most pi."""
    angles = np.linspace(0.0, math.pi, N_ANGLES)
    with np.errstate(all="ignore"):
        falls = ~(distorted_angle(coefficients, angles)[1] > MIN_SLOPE)
    return float(angles[max(0, int(falls.argmax()) - 1)]) if falls.any() else math.pi


def angle_of(coefficients: Coefficients, distorted: np.ndarray) -> np.ndarray:
    """The angle whose theta_d is given, radians; ``largest_angle`` where it is more than that's."""
    last = largest_angle(coefficients)
    angles = np.linspace(0.0, last, N_ANGLES)
    table = distorted_angle(coefficients, angles)[0]
    target = np.minimum(distorted, table[-1])
    theta = np.interp(target, table, angles)
    for _ in range(3):  # the table is good to seven digits, each step doubles them
        value, slope = distorted_angle(coefficients, theta)
        theta = np.clip(theta - (value - target) / slope, 0.0, last)
    return theta
