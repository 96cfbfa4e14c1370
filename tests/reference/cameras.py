"""Rays of a pinhole camera with OpenCV's lens distortion, and of a fisheye, in numpy float64."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Float64 = NDArray[np.float64]

RESIDUAL = 1e-14  # of the inverse, relative to the larger of 1 and the distorted coordinate
N_ITERATIONS = 200


def distort(
    x: ArrayLike,
    y: ArrayLike,
    k1: float = 0.0,
    k2: float = 0.0,
    p1: float = 0.0,
    p2: float = 0.0,
    k3: float = 0.0,
) -> tuple[Float64, Float64]:
    """OpenCV's radial and tangential distortion of normalised image coordinates (y downwards).

    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y

    Args:
        x: Undistorted coordinates [...], tangent of the angle to the right.
        y: Undistorted coordinates [...], tangent of the angle downwards.
        k1: Radial coefficient of r^2.
        k2: Radial coefficient of r^4.
        p1: First tangential coefficient.
        p2: Second tangential coefficient.
        k3: Radial coefficient of r^6.

    Returns:
        Distorted (x', y') [...].
    """
    x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    r2 = x * x + y * y
    radial = 1.0 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    return (
        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
    )


def undistort(
    x_distorted: ArrayLike,
    y_distorted: ArrayLike,
    k1: float = 0.0,
    k2: float = 0.0,
    p1: float = 0.0,
    p2: float = 0.0,
    k3: float = 0.0,
) -> tuple[Float64, Float64]:
    """Invert `distort` by Newton's method, from the distorted point, to 1e-14.

    Args:
        x_distorted: Distorted coordinates [...].
        y_distorted: Distorted coordinates [...].
        k1: Radial coefficient of r^2.
        k2: Radial coefficient of r^4.
        p1: First tangential coefficient.
        p2: Second tangential coefficient.
        k3: Radial coefficient of r^6.

    Returns:
        Undistorted (x, y) [...].

    Raises:
        ValueError: Newton reaches no inverse of a point, or one where the image folds over itself.
    """
    target_x = np.asarray(x_distorted, dtype=np.float64)
    target_y = np.asarray(y_distorted, dtype=np.float64)
    x, y = target_x.copy(), target_y.copy()
    tolerance = RESIDUAL * np.maximum(1.0, np.maximum(np.abs(target_x), np.abs(target_y)))
    with np.errstate(all="ignore"):  # a point that diverges is reported below
        for _ in range(N_ITERATIONS):
            found_x, found_y = distort(x, y, k1, k2, p1, p2, k3)
            error_x, error_y = found_x - target_x, found_y - target_y
            r2 = x * x + y * y
            radial = 1.0 + k1 * r2 + k2 * r2**2 + k3 * r2**3
            slope = 2.0 * (k1 + 2.0 * k2 * r2 + 3.0 * k3 * r2**2)  # d radial / dx = slope * x
            xx = radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
            xy = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y  # = yx: the map is a gradient
            yy = radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x
            determinant = xx * yy - xy * xy
            if np.all((np.abs(error_x) <= tolerance) & (np.abs(error_y) <= tolerance)):
                break
            x = x - (yy * error_x - xy * error_y) / determinant
            y = y - (xx * error_y - xy * error_x) / determinant
    found = (
        (np.abs(error_x) <= tolerance)
        & (np.abs(error_y) <= tolerance)
        & (determinant > 0.0)
        & (xx > 0.0)
    )
    if not np.all(found):
        raise ValueError(
            f"{np.count_nonzero(~found)} of {found.size} points have no inverse under the "
            f"distortion ({k1=}, {k2=}, {p1=}, {p2=}, {k3=})."
        )
    return x, y


def pinhole_rays(
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    c2w: ArrayLike,
    u: ArrayLike,
    v: ArrayLike,
    k1: float = 0.0,
    k2: float = 0.0,
    p1: float = 0.0,
    p2: float = 0.0,
    k3: float = 0.0,
) -> tuple[Float64, Float64]:
    """Rays through the centres of pixels.

    (x, y) = undistort((u + 1/2 - cx) / fx, (v + 1/2 - cy) / fy)
    d = R (x, -y, -1) / |R (x, -y, -1)|

    Args:
        fx: Focal length along a row, pixels.
        fy: Focal length along a column, pixels.
        cx: Principal point, pixels from the left edge of the image.
        cy: Principal point, pixels from the top edge of the image.
        c2w: Camera to world [3, 4] or [4, 4], OpenGL axes: x right, y up, looking along -z.
        u: Column index of each pixel [...]; its centre is at u + 0.5.
        v: Row index of each pixel [...]; row 0 is the top one.
        k1: Radial coefficient of r^2.
        k2: Radial coefficient of r^4.
        p1: First tangential coefficient.
        p2: Second tangential coefficient.
        k3: Radial coefficient of r^6.

    Returns:
        (origins, directions), each [..., 3]; directions are unit vectors.
    """
    pose = np.asarray(c2w, dtype=np.float64)
    column, row = np.broadcast_arrays(
        np.asarray(u, dtype=np.float64), np.asarray(v, dtype=np.float64)
    )
    x, y = undistort((column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy, k1, k2, p1, p2, k3)
    in_camera = np.stack([x, -y, -np.ones_like(x)], axis=-1)  # [..., 3]
    in_world = in_camera @ pose[:3, :3].T
    directions = in_world / np.linalg.norm(in_world, axis=-1, keepdims=True)
    origins = np.broadcast_to(pose[:3, 3], directions.shape).copy()
    return origins, directions


def fisheye_rays(
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    c2w: ArrayLike,
    u: ArrayLike,
    v: ArrayLike,
    k: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
) -> tuple[Float64, Float64]:
    """Rays through the centres of pixels of OpenCV's fisheye lens.

    theta is the root in (0, pi) of theta + k1 theta^3 + k2 theta^5 + k3 theta^7 + k4 theta^9 = r,
    by halving intervals, where (x, y) = ((u + 1/2 - cx) / fx, (v + 1/2 - cy) / fy) and r = |(x, y)|
    d = R (sin theta x / r, -sin theta y / r, -cos theta)

    Args:
        fx: Focal length along a row, pixels.
        fy: Focal length along a column, pixels.
        cx: Principal point, pixels from the left edge of the image.
        cy: Principal point, pixels from the top edge of the image.
        c2w: Camera to world [3, 4] or [4, 4], OpenGL axes: x right, y up, looking along -z.
        u: Column index of each pixel [...]; its centre is at u + 0.5.
        v: Row index of each pixel [...]; row 0 is the top one.
        k: k1, k2, k3, k4, with which the left side rises up to pi.

    Returns:
        (origins, directions), each [..., 3]; directions are unit vectors.
    """
    pose = np.asarray(c2w, dtype=np.float64)
    x = (np.asarray(u, dtype=np.float64) + 0.5 - cx) / fx
    y = (np.asarray(v, dtype=np.float64) + 0.5 - cy) / fy
    r, azimuth = np.hypot(x, y), np.arctan2(-y, x)
    low, high = np.zeros_like(r), np.full_like(r, np.pi)
    for _ in range(60):
        theta = 0.5 * (low + high)
        powers = sum(c * theta ** (2 * n + 3) for n, c in enumerate(k))
        beyond = theta + powers > r
        low, high = np.where(beyond, low, theta), np.where(beyond, theta, high)
    across = np.sin(theta)
    in_camera = np.stack(
        [across * np.cos(azimuth), across * np.sin(azimuth), -np.cos(theta)], axis=-1
    )
    directions = in_camera @ pose[:3, :3].T
    return np.broadcast_to(pose[:3, 3], directions.shape).copy(), directions
