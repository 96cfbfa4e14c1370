"""How close an image is to the truth."""

from __future__ import annotations

import math

import numpy as np

from warpnerf.checks import InputError

SSIM_SIGMA = 1.5
"""Standard deviation of the Gaussian, pixels."""

SSIM_RADIUS = 5
"""The window is 2 * 5 + 1 = 11 pixels wide."""

SSIM_WINDOW = 2 * SSIM_RADIUS + 1
"""Edge of the smallest image that SSIM is defined for, pixels."""

LEAST_ERROR = 1e-10
"""Mean squared error below which images count as equal, so that PSNR stays finite."""


def psnr(rgb: np.ndarray, target_rgb: np.ndarray) -> float:
    """Peak signal-to-noise ratio, -10 log10(mean squared error), at most 100 dB.

    Args:
        rgb: [H, W, 3] in [0, 1].
        target_rgb: [H, W, 3] in [0, 1].

    Raises:
        InputError: Shapes differ, or a value is not finite.
    """
    image, target = _checked(rgb, target_rgb)
    return -10.0 * math.log10(max(float(np.mean((image - target) ** 2)), LEAST_ERROR))


def ssim(rgb: np.ndarray, target_rgb: np.ndarray) -> float:
    """Structural similarity, as mip-NeRF and DVGO report it.

    mean (2 m_x m_y + c1)(2 v_xy + c2) / ((m_x^2 + m_y^2 + c1)(v_x + v_y + c2)),  c = (k * 1)^2

    with moments under an 11 x 11 Gaussian of sigma 1.5, k1 = 0.01, k2 = 0.03, over the windows that
    lie inside the image and over channels. Source: Wang et al. 2004, eq. 13.

    Args:
        rgb: [H, W, 3] in [0, 1].
        target_rgb: [H, W, 3] in [0, 1].

    Raises:
        InputError: Shapes differ, a value is not finite, or an edge is shorter than the window.
    """
    image, target = _checked(rgb, target_rgb)
    if min(image.shape[:2]) < SSIM_WINDOW:
        raise InputError(
            f"SSIM needs images of at least {SSIM_WINDOW} x {SSIM_WINDOW} pixels, not "
            f"{image.shape[1]} x {image.shape[0]}; use a smaller downscale."
        )
    c1, c2 = 0.01**2, 0.03**2
    mean_x, mean_y = _blur(image), _blur(target)
    var_x = _blur(image * image) - mean_x**2
    var_y = _blur(target * target) - mean_y**2
    covariance = _blur(image * target) - mean_x * mean_y
    similarity = (2.0 * mean_x * mean_y + c1) * (2.0 * covariance + c2)
    similarity /= (mean_x**2 + mean_y**2 + c1) * (var_x + var_y + c2)
    return float(similarity.mean())


def _blur(image: np.ndarray) -> np.ndarray:
    """Gaussian means of [H, W, C] over the windows inside: [H - 10, W - 10, C]."""
    offsets = np.arange(-SSIM_RADIUS, SSIM_RADIUS + 1)
    kernel = np.exp(-0.5 * (offsets / SSIM_SIGMA) ** 2)
    kernel /= kernel.sum()
    height, width = image.shape[0] - 2 * SSIM_RADIUS, image.shape[1] - 2 * SSIM_RADIUS
    rows = sum(k * image[i : i + height] for i, k in enumerate(kernel))
    return np.asarray(sum(k * rows[:, i : i + width] for i, k in enumerate(kernel)))


def _checked(rgb: np.ndarray, target_rgb: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    if rgb.shape != target_rgb.shape or rgb.ndim != 3 or not rgb.size:
        raise InputError(
            "images to compare must both be [H, W, channels], not "
            f"{list(rgb.shape)} and {list(target_rgb.shape)}."
        )
    for name, image in (("rgb", rgb), ("target_rgb", target_rgb)):
        if not np.isfinite(image).all():
            raise InputError(f"{name} must be finite, but holds NaN or infinity.")
    return rgb.astype(np.float64), target_rgb.astype(np.float64)
