"""Image metrics of a rendering against its photograph: PSNR, SSIM, FLIP where its package is."""

from __future__ import annotations

import importlib.util
import math
import os
from collections.abc import Callable
from functools import cache

import numpy as np

from warpnerf.checks import InputError, require_extra
from warpnerf.runtime.memory import usable_cores
from warpnerf.scenes.scene import View

SSIM_WINDOW = 11
"""Pixels along the edge of SSIM's window."""

MAX_PSNR = 120.0
"""dB, of images that are equal: a number, so that means and JSON stay finite."""

_RADIUS = SSIM_WINDOW // 2
_SIGMA = 1.5
_BAND = 16
"""Rows of windows that are compared at a time: those of a photograph fit a core's cache, the whole
does not, and takes three times as long."""


def truth(view: View, background: tuple[float, float, float]) -> np.ndarray:
    """A view's photograph over a background, [H, W, 3] float64 in [0, 1]."""
    image = view.image.astype(np.float64) / 255.0
    if image.shape[2] == 3:
        return image
    alpha = image[..., 3:]
    return alpha * image[..., :3] + (1.0 - alpha) * np.array(background)


def psnr(rgb: np.ndarray, target: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Peak signal-to-noise ratio, dB: -10 log10 of the mean squared error, at most MAX_PSNR.

    Args:
        rgb: [H, W, 3] in [0, 1].
        target: The same shape.
        mask: [H, W] bool, at least one pixel true: those that count; None: all.

    Raises:
        InputError: Shapes differ, or a value is not finite.
    """
    a, b = _checked(rgb, target)
    error = float(np.mean((a - b)[... if mask is None else mask] ** 2))
    return -10.0 * math.log10(max(error, 10.0 ** (-MAX_PSNR / 10.0)))


def colour_corrected(
    rgb: np.ndarray, target: np.ndarray, mask: np.ndarray | None = None
) -> np.ndarray:
    """A rendering with the exposure of its photograph: each channel mapped affinely, in [0, 1].

    By least squares, as nothing else says which exposure a photograph has that was not trained on.

    Args:
        rgb: [H, W, 3] in [0, 1].
        target: The same shape.
        mask: [H, W] bool, at least one pixel true: those that count; None: all.

    Raises:
        InputError: Shapes differ, or a value is not finite.
    """
    a, b = _checked(rgb, target)
    counted = (a, b) if mask is None else (a[mask], b[mask])
    x, y = (image.reshape(-1, 3) for image in counted)
    mean_x, mean_y = x.mean(axis=0), y.mean(axis=0)
    variance = ((x - mean_x) ** 2).mean(axis=0)
    covariance = ((x - mean_x) * (y - mean_y)).mean(axis=0)
    gain = covariance / np.maximum(variance, 1e-12)
    return np.clip(mean_y + gain * (a - mean_x), 0.0, 1.0)


def ssim(rgb: np.ndarray, target: np.ndarray, mask: np.ndarray | None = None) -> float | None:
    """Structural similarity, mean over pixels and channels; 1 for equal images.

    Windows are 11 x 11 Gaussians of deviation 1.5, variances are those of the window's weights
    (no sample correction), constants are (0.01)^2 and (0.03)^2, and only windows that lie inside
    the image count. Source: Wang et al. 2004, with the settings of mip-NeRF and DVGO.

    With a mask only windows around pixels that count do, and in them the weights of pixels that do
    not are 0, those of the others as much larger.

    Args:
        rgb: [H, W, 3] in [0, 1], at least 11 x 11.
        target: The same shape.
        mask: [H, W] bool, true for pixels that count; None: all.

    Returns:
        At most 1; None where the mask leaves no window.

    Raises:
        InputError: Shapes differ, an image is too small, or a value is not finite.
    """
    a, b = _checked(rgb, target)
    if min(a.shape[:2]) < SSIM_WINDOW:
        raise InputError(f"SSIM needs images of at least 11 x 11 pixels, not {a.shape[:2]}.")
    total, windows = 0.0, 0
    for begin in range(0, len(a) - 2 * _RADIUS, _BAND):
        rows = slice(begin, begin + _BAND + 2 * _RADIUS)
        of_band = _similarity(a[rows], b[rows], None if mask is None else mask[rows])
        total += float(of_band.sum())
        windows += of_band.size
    return total / windows if windows else None


def _similarity(a: np.ndarray, b: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
    """SSIM of each window, and channel, of some rows that counts."""
    mean, middles = _blur, None
    if mask is not None:
        middles = mask[_RADIUS:-_RADIUS, _RADIUS:-_RADIUS]
        if not middles.any():
            return np.zeros((0, 3))
        weights = mask[..., None].astype(np.float64)
        total = np.maximum(_blur(weights), 1e-12)  # 0 only around pixels that do not count

        def mean(image: np.ndarray) -> np.ndarray:
            return _blur(weights * image) / total

    mean_a, mean_b = mean(a), mean(b)
    var_a, var_b = mean(a * a) - mean_a**2, mean(b * b) - mean_b**2
    covariance = mean(a * b) - mean_a * mean_b
    c1, c2 = 0.01**2, 0.03**2
    similarity = ((2 * mean_a * mean_b + c1) * (2 * covariance + c2)) / (
        (mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2)
    )
    return similarity if middles is None else similarity[middles]


def has_flip() -> bool:
    """Whether the package that computes FLIP is installed: ``pip install warpnerf[metrics]``."""
    return importlib.util.find_spec("flip_evaluator") is not None


def flip(rgb: np.ndarray, target: np.ndarray, mask: np.ndarray | None = None) -> float:
    """LDR-FLIP, mean over pixels: the difference seen when one image takes the other's place.

    Between 0, for equal images, and 1; of images 0.7 m away on a screen 0.7 m and 3840 pixels wide,
    67 pixels to a degree. Source: Andersson et al. 2020, by the authors' package flip-evaluator.

    Args:
        rgb: [H, W, 3] in [0, 1], sRGB.
        target: The same shape.
        mask: [H, W] bool, at least one pixel true: those that count; the others are taken to be
            alike in both. None: all.

    Raises:
        InputError: Shapes differ, a value is not finite, or the package is not installed.
    """
    a, b = _checked(rgb, target)
    require_extra("flip_evaluator", "metrics", "FLIP")
    evaluate = _flip_evaluator()
    a = alike_where_masked(a, b, mask)
    reference, test = (np.ascontiguousarray(image, np.float32) for image in (b, a))
    errors, mean, _ = evaluate(reference, test, "LDR", applyMagma=False)
    return float(mean if mask is None else np.asarray(errors).reshape(mask.shape)[mask].mean())


@cache
def _flip_evaluator() -> Callable[..., tuple[np.ndarray, float, object]]:
    """The package's function, whose threads wait without spinning and are no more than there are
    cores: it brings an OpenMP of its own, which reads the environment when it is loaded.
    """
    settings = {"OMP_WAIT_POLICY": "passive", "OMP_NUM_THREADS": str(usable_cores())}
    added = {name: value for name, value in settings.items() if name not in os.environ}
    os.environ.update(added)
    try:
        from flip_evaluator import evaluate
    finally:
        for name in added:
            del os.environ[name]
    return evaluate


def alike_where_masked(rgb: np.ndarray, target: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
    """An image [H, W, 3] with the target's pixels where a mask [H, W] is false."""
    return rgb if mask is None else np.where(mask[..., None], rgb, target)


def _checked(rgb: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    a, b = np.asarray(rgb, np.float64), np.asarray(target, np.float64)
    if a.shape != b.shape or a.ndim != 3:
        raise InputError(
            f"images must have one shape [H, W, 3], not {list(a.shape)} and {list(b.shape)}."
        )
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise InputError("images must be finite, but hold NaN or infinity.")
    return a, b


def _blur(image: np.ndarray) -> np.ndarray:
    """Gaussian-weighted mean over windows inside the image, [H - 10, W - 10, C]."""
    x = np.arange(-_RADIUS, _RADIUS + 1)
    weights = np.exp(-0.5 * (x / _SIGMA) ** 2)
    weights /= weights.sum()
    for _ in range(2):  # rows, then columns; views, as copies would take twice as long
        n = len(image) - 2 * _RADIUS
        blurred = weights[_RADIUS] * image[_RADIUS : _RADIUS + n]
        pair = np.empty_like(blurred)
        for k in range(_RADIUS):  # weights are the same on both sides
            np.add(image[k : k + n], image[2 * _RADIUS - k : 2 * _RADIUS - k + n], out=pair)
            pair *= weights[k]
            blurred += pair
        image = blurred.swapaxes(0, 1)
    return image
