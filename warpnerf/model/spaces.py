"""Scene contraction and NDC by name: what becomes of space outside a grid's box.

A new one is a subclass of ``SpaceKind``; with ``register`` it has a name that configurations, files
and the command know, as the value of ``grid.contraction``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import cache
from typing import Any, ClassVar, Protocol, TypeVar

import numpy as np

from warpnerf.model.interface import Load, loader


class Placed(Protocol):
    """A box and its space: ``warpnerf.scenes.extent.space.Space``, or one like it."""

    @property
    def box_min(self) -> np.ndarray: ...  # noqa: D102
    @property
    def box_max(self) -> np.ndarray: ...  # noqa: D102
    @property
    def border(self) -> float: ...  # noqa: D102
    @property
    def frustum(self) -> Any: ...  # noqa: D102


class SpaceKind(ABC):
    """Between the scene and coordinates c, in which voxels are cubes and the box is [-1, 1]^3."""

    name: ClassVar[str]
    """What configurations, files and the command call it."""
    words: ClassVar[str]
    """What of space outside the box becomes, in words."""
    contracts: ClassVar[bool] = False
    """Whether space outside the box is contracted into a shell around it, as wide as the border."""
    has_frustum: ClassVar[bool] = False
    """Whether the box has coordinates of a frustum, not of the scene."""

    @property
    def bounded(self) -> bool:
        """Whether there is nothing but the box, and it lies in the scene as it is."""
        return not (self.contracts or self.has_frustum)

    @abstractmethod
    def part(self, load: Load) -> Any:
        """What kernels know of it.

        Args:
            load: The kernels' modules, in the precision that is wanted.

        Returns:
            ``warpnerf_kernels.base.parts.Space``.
        """

    @abstractmethod
    def contracted(self, placed: Placed, points: np.ndarray) -> np.ndarray:
        """Coordinates c of points [n, 3], scene units; beyond all c where there is nothing."""

    @abstractmethod
    def expanded(self, placed: Placed, c: np.ndarray) -> np.ndarray:
        """The inverse of ``contracted``; not finite where c is that of no point."""

    @abstractmethod
    def widening(self, placed: Placed, points: np.ndarray) -> np.ndarray:
        """How long edges of voxels are at points [n, 3], about: [n], in those of the box."""

    @abstractmethod
    def squares(
        self, placed: Placed, positions: np.ndarray, directions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """|J^-1|^2 and |d^T J^-1|^2 at positions along unit vectors d, [n, 3] each: [n] each.

        J is the Jacobian of ``contracted``, with c in the units of the box; Frobenius norms.
        """

    def where_wider(self, border: float, times: float) -> float | None:
        """How many half boxes from the middle voxels are so many times as wide as in the box.

        Args:
            border: Of the space.
            times: Above 1.

        Returns:
            That many or more; None: they are nowhere, or that is no box around this one.
        """
        return None


def normalised(placed: Placed, points: np.ndarray) -> np.ndarray:
    """Points [n, 3] in coordinates in which the box is [-1, 1]^3, float64."""
    half = 0.5 * (placed.box_max - placed.box_min)
    return (np.asarray(points, np.float64) - 0.5 * (placed.box_min + placed.box_max)) / half


def in_box(placed: Placed, q: np.ndarray) -> np.ndarray:
    """The inverse of ``normalised``."""
    middle = 0.5 * (placed.box_min + placed.box_max)
    return np.asarray(middle + 0.5 * q * (placed.box_max - placed.box_min))


class Bounded(SpaceKind):
    """A box, and nothing outside."""

    name: ClassVar[str] = "none"
    words: ClassVar[str] = "nothing outside"

    def part(self, load: Load) -> Any:
        """Space as it is."""
        return load("space.none").NONE

    def contracted(self, placed: Placed, points: np.ndarray) -> np.ndarray:
        """c = q."""
        return normalised(placed, points)

    def expanded(self, placed: Placed, c: np.ndarray) -> np.ndarray:
        """q = c."""
        return in_box(placed, c)

    def widening(self, placed: Placed, points: np.ndarray) -> np.ndarray:
        """None."""
        return np.ones(len(points))

    def squares(
        self, placed: Placed, positions: np.ndarray, directions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Those of the identity."""
        return np.full(len(positions), 3.0), np.ones(len(positions))


class Radial(SpaceKind):
    """Contractions c = m(n) q / n, with n a norm of q, m(n) = n up to 1, and 1 + border far away.

    Here m(n) = 1 + b - b / n, with b the border: ``warpnerf_kernels.space.contraction``.
    """

    contracts: ClassVar[bool] = True
    words: ClassVar[str] = "space outside contracted"

    @abstractmethod
    def norm(self, q: np.ndarray) -> np.ndarray:
        """n of q [n, 3]: [n]."""

    @abstractmethod
    def slope(self, q: np.ndarray) -> np.ndarray:
        """dn/dq, [n, 3]; outside of the box."""

    def shrink(self, n: np.ndarray, b: float) -> np.ndarray:
        """m(n) / n, for n from 1 on."""
        return (1.0 + b - b / n) / n

    def ahead(self, n: np.ndarray, b: float) -> np.ndarray:
        """dm/dn, for n from 1 on."""
        return b / (n * n)

    def grown(self, m: np.ndarray, b: float) -> np.ndarray:
        """n of m, for m from 1 on; infinite from 1 + b on."""
        with np.errstate(divide="ignore"):
            return b / np.maximum(1.0 + b - m, 0.0)

    def contracted(self, placed: Placed, points: np.ndarray) -> np.ndarray:
        """All space lies in the box and its shell."""
        q = normalised(placed, points)
        norm = self.norm(q)
        outside = norm > 1.0
        q[outside] *= self.shrink(norm[outside], placed.border)[:, None]
        return q

    def expanded(self, placed: Placed, c: np.ndarray) -> np.ndarray:
        """Infinite at the outer faces of the shell."""
        q = np.array(c, np.float64)
        norm = self.norm(q)
        outside = norm > 1.0
        with np.errstate(divide="ignore", invalid="ignore"):
            factor = self.grown(norm[outside], placed.border) / norm[outside]
            stretched = q[outside] * factor[:, None]
        q[outside] = np.where(q[outside] == 0.0, 0.0, stretched)
        return in_box(placed, q)

    def widening(self, placed: Placed, points: np.ndarray) -> np.ndarray:
        """Half boxes from the middle."""
        return np.maximum(1.0, self.norm(normalised(placed, points)))

    def squares(
        self, placed: Placed, positions: np.ndarray, directions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Of J = s I + s' q slope^T, with s(n) = m(n) / n."""
        half = 0.5 * (placed.box_max - placed.box_min)
        q = normalised(placed, positions)
        n, slope = self.norm(q), self.slope(q)
        # In scene units, with u = half q and e = slope / half, J is s I + s' u e^T, and u . e = n.
        # Along u it is s + s' n = dm/dn, so by Sherman and Morrison J^-1 = (I - k u e^T) / s.
        n = np.maximum(n, 1.0)
        s, ahead = self.shrink(n, placed.border), self.ahead(n, placed.border)
        k = np.where(n > 1.0, (ahead - s) / (n * ahead), 0.0)
        u, e = half * q, slope / half
        ee, ue = (e * e).sum(axis=1), (u * e).sum(axis=1)
        du, de = (directions * u).sum(axis=1), (directions * e).sum(axis=1)
        whole = 3.0 - 2.0 * k * ue + k * k * (u * u).sum(axis=1) * ee
        along = 1.0 - 2.0 * k * du * de + k * k * du * du * ee
        return whole / (s * s), along / (s * s)

    def where_wider(self, border: float, times: float) -> float | None:
        """Where m(n) = n / times, which is n = times (1 + border) at most."""
        low, high = 1.0, times * (1.0 + border)
        for _ in range(100):
            middle = 0.5 * (low + high)
            wider = float(self.shrink(np.array(middle), border)) * times <= 1.0
            low, high = (low, middle) if wider else (middle, high)
        return high


class Linf(Radial):
    """By boxes around the box, as DVGOv2 has it."""

    name: ClassVar[str] = "linf"

    def part(self, load: Load) -> Any:
        """The contraction on the largest coordinate."""
        return load("space.contraction").LINF

    def norm(self, q: np.ndarray) -> np.ndarray:
        """The largest coordinate."""
        return np.asarray(np.abs(q).max(axis=1, initial=0.0))

    def slope(self, q: np.ndarray) -> np.ndarray:
        """Along the axis of the largest coordinate."""
        return np.asarray(np.eye(3)[np.abs(q).argmax(axis=1)] * np.sign(q))


class L2(Radial):
    """By ellipsoids around the one in the box, as mip-NeRF 360 has it."""

    name: ClassVar[str] = "l2"

    def part(self, load: Load) -> Any:
        """The contraction on the length."""
        return load("space.contraction").L2

    def norm(self, q: np.ndarray) -> np.ndarray:
        """The length."""
        return np.asarray(np.linalg.norm(q, axis=1))

    def slope(self, q: np.ndarray) -> np.ndarray:
        """Away from the middle."""
        return np.asarray(q / np.maximum(self.norm(q), 1e-12)[:, None])


class Ndc(SpaceKind):
    """A box in the normalised device coordinates of a frustum, ``placed.frustum``."""

    name: ClassVar[str] = "ndc"
    words: ClassVar[str] = "but the grid is in normalised device coordinates"
    has_frustum: ClassVar[bool] = True

    def part(self, load: Load) -> Any:
        """Rays in the frustum."""
        return load("space.ndc").NDC

    def contracted(self, placed: Placed, points: np.ndarray) -> np.ndarray:
        """What is behind the cameras lies outside."""
        return normalised(placed, np.nan_to_num(placed.frustum.to_ndc(points), nan=-1e6))

    def expanded(self, placed: Placed, c: np.ndarray) -> np.ndarray:
        """Not finite far beyond the frustum."""
        return np.asarray(placed.frustum.to_scene(in_box(placed, c)))

    def widening(self, placed: Placed, points: np.ndarray) -> np.ndarray:
        """That of edges across; those along the depth are longer far away."""
        return np.asarray(np.maximum(placed.frustum.depths(points), placed.frustum.near))

    def squares(
        self, placed: Placed, positions: np.ndarray, directions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """In coordinates (x, y, z): X = x w, Y = y w, dw/dz = w^2 / (depth near)."""
        frustum = placed.frustum
        x, y, w = ((positions - frustum.origin) @ frustum.axes.T).T
        w = np.maximum(w, frustum.near)
        slope = w * w / (frustum.depth * frustum.near)
        zero = np.zeros_like(w)
        local = np.array([[w, zero, x / w * slope], [zero, w, y / w * slope], [zero, zero, slope]])
        local = np.moveaxis(local, -1, 0)  # [n, 3, 3]
        inverse = (frustum.axes.T[None, :, :, None] * local[:, None]).sum(axis=2)
        along = (directions[:, :, None] * inverse).sum(axis=1)
        return np.square(inverse).sum(axis=(1, 2)), np.square(along).sum(axis=1)


SPACES: dict[str, SpaceKind] = {kind.name: kind for kind in (Bounded(), Linf(), L2(), Ndc())}
"""By name."""

AnyKind = TypeVar("AnyKind", bound=type[SpaceKind])


def register(kind: AnyKind) -> AnyKind:
    """Make a kind of space known by its name: to configurations, files, the command; a decorator.

    Args:
        kind: The class.

    Raises:
        ValueError: Another kind has that name, or configurations mean something else by it.
    """
    if kind.name == "auto" or type(SPACES.setdefault(kind.name, kind())) is not kind:
        raise ValueError(f"{kind.name!r} is the name of another kind of space")
    return kind


@cache
def part_of(name: str, precision: str) -> Any:
    """What kernels know of a kind of space.

    Args:
        name: A key of ``SPACES``.
        precision: float32 or float64.

    Returns:
        ``warpnerf_kernels.base.parts.Space``.
    """
    return SPACES[name].part(loader(precision))
