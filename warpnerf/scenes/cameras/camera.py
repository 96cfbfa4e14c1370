"""A calibrated camera.

Convention of the whole project: ``c2w`` maps camera to world with OpenGL axes (x right, y up,
looking along -z); pixel (column u, row v) has its centre at (u + 0.5, v + 0.5); row 0 is the top.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from warpnerf.checked import checked
from warpnerf.checks import InputError, require_at_least, require_finite, require_positive
from warpnerf.scenes.cameras.fisheye import Coefficients, distorted_angle
from warpnerf.scenes.cameras.poses import require_rigid


@checked("Camera")
@dataclass(frozen=True, kw_only=True, eq=False)
class Camera:
    """Pinhole camera with OpenCV's radial and tangential distortion, or a fisheye lens.

    With (x, y) = (X/Z, Y/Z) in OpenCV axes and r^2 = x^2 + y^2, a point lands on the pixel

        R  = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)
        x' = x R + 2 p1 x y + p2 (r^2 + 2 x^2),   u = fx x' + cx
        y' = y R + p1 (r^2 + 2 y^2) + 2 p2 x y,   v = fy y' + cy

    and through a fisheye lens, with its angle theta to the optical axis, up to 180 degrees,

        (x', y') = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) (X, Y) / |(X, Y)|
    """

    width: int
    """Pixels per row."""
    height: int
    """Rows."""
    fx: float
    """Focal length along u, pixels."""
    fy: float
    """Focal length along v, pixels."""
    cx: float
    """Principal point along u, pixels from the left edge of the image."""
    cy: float
    """Principal point along v, pixels from the top edge of the image."""
    c2w: np.ndarray
    """[3, 4] float64, camera to world, OpenGL axes, translation in scene units."""
    k1: float = 0.0
    """Radial distortion, r^2 or theta^2."""
    k2: float = 0.0
    """Radial distortion, r^4 or theta^4."""
    k3: float = 0.0
    """Radial distortion, r^6 or theta^6."""
    p1: float = 0.0
    """Tangential distortion, not of a fisheye lens."""
    p2: float = 0.0
    """Tangential distortion, not of a fisheye lens."""
    k4: float = 0.0
    """Radial distortion: r^2 of the divisor, or theta^8 of a fisheye lens."""
    fisheye: bool = False
    """Whether it is a fisheye lens."""
    k5: float = 0.0
    """Radial distortion, r^4 of the divisor; not of a fisheye lens."""
    k6: float = 0.0
    """Radial distortion, r^6 of the divisor; not of a fisheye lens."""

    def __post_init__(self) -> None:
        """Refuse what makes no rays."""
        self.check()

    def check(self) -> None:
        """Raise InputError where intrinsics or pose make no rays; kernels would not notice.

        Raises:
            InputError: A size or focal length is not above zero, a number is not finite, a
                coefficient is of another lens, or the pose has another shape or is not rigid.
        """
        require_at_least("Camera.width", self.width, 1)
        require_at_least("Camera.height", self.height, 1)
        require_positive("Camera.fx", self.fx)
        require_positive("Camera.fy", self.fy)
        for name in ("cx", "cy", "k1", "k2", "k3", "p1", "p2", "k4", "k5", "k6"):
            require_finite(f"Camera.{name}", getattr(self, name))
        for name in ("p1", "p2", "k5", "k6"):
            if self.fisheye and getattr(self, name) != 0.0:
                raise InputError(f"Camera.{name} must be 0 for a fisheye lens.")
        if not isinstance(self.c2w, np.ndarray) or self.c2w.shape != (3, 4):
            raise InputError(
                f"Camera.c2w must be an array [3, 4], not {list(np.shape(self.c2w))}; leave out a "
                "4x4 matrix's last row."
            )
        if self.c2w.dtype.kind not in "fiu":
            raise InputError(f"Camera.c2w must be real numbers, not {self.c2w.dtype}.")
        if not np.isfinite(self.c2w).all():
            raise InputError("Camera.c2w must be finite, but holds NaN or infinity.")
        require_rigid("Camera.c2w", self.c2w)

    @property
    def position(self) -> np.ndarray:
        """Camera centre, [3] scene units."""
        return self.c2w[:, 3]

    @property
    def forward(self) -> np.ndarray:
        """Unit vector along the optical axis, into the scene, [3]."""
        return -self.c2w[:, 2]

    @property
    def radial(self) -> Coefficients:
        """Radial distortion coefficients: k1, k2, k3, k4."""
        return self.k1, self.k2, self.k3, self.k4

    @property
    def rational(self) -> bool:
        """Whether radial distortion is a quotient of two polynomials."""
        return not self.fisheye and any((self.k4, self.k5, self.k6))

    def distort(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Lens distortion of points on the plane Z = 1, by the equation of the class.

        Args:
            points: [n, 2] (x, y) = (X/Z, Y/Z) in OpenCV axes.

        Returns:
            [n, 2] (x', y'), and [n, 2, 2] its derivative by (x, y).
        """
        if self.fisheye:
            return self._distort_angles(points)
        x, y = points[:, 0], points[:, 1]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        slope = 2.0 * (self.k1 + r2 * (2.0 * self.k2 + r2 * 3.0 * self.k3))  # d radial / d(r^2/2)
        if self.rational:
            divisor = 1.0 + r2 * (self.k4 + r2 * (self.k5 + r2 * self.k6))
            radial = radial / divisor
            rise = 2.0 * (self.k4 + r2 * (2.0 * self.k5 + r2 * 3.0 * self.k6))
            slope = (slope - radial * rise) / divisor
        distorted = np.stack(
            [
                x * radial + 2.0 * self.p1 * x * y + self.p2 * (r2 + 2.0 * x * x),
                y * radial + self.p1 * (r2 + 2.0 * y * y) + 2.0 * self.p2 * x * y,
            ],
            axis=1,
        )
        jacobian = np.empty((len(points), 2, 2))
        jacobian[:, 0, 0] = radial + slope * x * x + 2.0 * self.p1 * y + 6.0 * self.p2 * x
        jacobian[:, 0, 1] = slope * x * y + 2.0 * self.p1 * x + 2.0 * self.p2 * y
        jacobian[:, 1, 0] = jacobian[:, 0, 1]
        jacobian[:, 1, 1] = radial + slope * y * y + 6.0 * self.p1 * y + 2.0 * self.p2 * x
        return distorted, jacobian

    def _distort_angles(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """``distort`` for a fisheye lens: x' = x theta_d / r with theta = atan(r)."""
        r = np.maximum(np.linalg.norm(points, axis=1), 1e-12)
        distorted, slope = distorted_angle(self.radial, np.arctan(r))
        scale = distorted / r
        bend = (slope / (1.0 + r * r) - scale) / (r * r)  # d scale / d(r^2/2)
        jacobian = scale[:, None, None] * np.eye(2)
        jacobian += bend[:, None, None] * points[:, :, None] * points[:, None, :]
        return points * scale[:, None], jacobian

    def moved_back(self, distance: float) -> Camera:
        """The camera moved straight back.

        Args:
            distance: By how much, scene units.

        Returns:
            The same camera at another place.
        """
        c2w = self.c2w.copy()
        c2w[:, 3] -= distance * self.forward
        return replace(self, c2w=c2w)

    def block_for(self, n_pixels: int) -> int:
        """Edge of the smallest blocks of which ``downscaled`` makes at most so many pixels.

        Args:
            n_pixels: At least 1.

        Returns:
            Pixels; no more than the shorter side of the image.
        """
        edge = math.ceil(math.sqrt(self.width * self.height / n_pixels))
        return max(1, min(edge, self.width, self.height))

    def downscaled(self, factor: int) -> Camera:
        """Camera of the image whose pixels are means over ``factor`` by ``factor`` blocks.

        Pixels at the right and bottom that fill no block are cropped. Distortion acts on (X/Z, Y/Z)
        and stays as it is.

        Args:
            factor: Edge of a block, pixels.

        Returns:
            A camera with the same pose and 1 / factor of the pixels along each side.
        """
        return replace(
            self,
            width=self.width // factor,
            height=self.height // factor,
            fx=self.fx / factor,
            fy=self.fy / factor,
            cx=self.cx / factor,
            cy=self.cy / factor,
        )
