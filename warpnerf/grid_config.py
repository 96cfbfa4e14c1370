"""The voxel grid's configuration: resolution, box, contraction and growth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from warpnerf.checked import checked
from warpnerf.checks import (
    MAX_COORDINATE,
    InputError,
    require_at_least,
    require_one_of,
    require_shares,
    require_whole,
    said,
)
from warpnerf.model.spaces import SPACES
from warpnerf.optim_config import SceneKind

Contraction = str
"""The name of a kind of space: none, linf, l2, ndc, or one that is registered, see
``warpnerf.model.spaces``."""

GROW_AT: dict[SceneKind, tuple[float, ...]] = {
    "object": (0.1, 0.2, 0.3, 0.4),
    "bounded": (0.3, 0.4, 0.5, 0.6),
    "unbounded": (0.3, 0.4, 0.5, 0.6),
}
"""What ``GridConfig.grow_at`` is by default. Around an object most of the first box is empty, and a
growth leaves that out; elsewhere coarse grids do more in the same time."""

MAX_VOXELS = 2**31
"""Nodes are counted in 32 bits."""

MIN_EDGE = 1e-3
"""Of a box, in its longest edges: voxels are cubes, and one axis alone takes all nodes of a rod."""


def is_number(value: object) -> bool:
    """Whether a value is a number, and no bool."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _checked_box(box: object) -> tuple[float, ...]:
    """The six numbers of a box; what is none is refused."""
    try:
        ends = tuple(map(float, box))  # type: ignore[call-overload]
    except (TypeError, ValueError):
        ends = ()
    edges = [high - low for low, high in zip(ends[:3], ends[3:], strict=False)]
    within = all(abs(end) <= MAX_COORDINATE for end in ends)
    if len(ends) != 6 or not within or not min(edges) > MIN_EDGE * max(edges):
        raise InputError(
            "grid.box must be auto, scene, or six numbers, x y z of a lower corner and x y z of an "
            f"upper one, each above its lower one, no edge below {MIN_EDGE:g} of the longest, not "
            f"{said(box)}."
        )
    return ends


@checked("grid")
@dataclass(frozen=True, kw_only=True)
class GridConfig:
    """The voxel grid: resolution, bounding box, contraction of unbounded space, growth."""

    voxels: int | Literal["auto"] = 160**3
    """Nodes of the final grid, in all. It grows from step 200 on: a shorter training keeps the grid
    that it begins with, of 1/16 as many after four growths. auto: 224^3, and 300^3 where the field
    is vm."""
    grow_at: Literal["auto"] | tuple[float, ...] = "auto"
    """Shares of the training at which the number of nodes doubles. auto: as suits the kind of
    scene (``GROW_AT``)."""
    shift_at_growth: float = 0.0
    """Taken from all raw densities at each growth, before their activation; DVGO takes 1."""
    alpha_init: float = 1e-3
    """Opacity of one voxel's length before training."""
    contraction: str = "auto"
    """How space outside the box is contracted. ndc: the grid lies in normalised device coordinates
    instead, for cameras that look the same way. auto: ndc for captures of LLFF that do, linf for
    other unbounded scenes, else none. Others are registered by name (``model.spaces``)."""
    planes: int = 64
    """Nodes of the final grid along the depth of normalised device coordinates; with ndc only."""
    box: Literal["auto", "scene"] | tuple[float, ...] = "auto"
    """Where voxels are cubes of one size: lower and upper corner, x y z each, scene units; not with
    ndc. scene: the scene's own box. auto: where space outside is contracted and it is known what
    cameras see, the box that blurs their photographs least (``scenes.extent.space_plan``), else the
    scene's."""
    border: float | Literal["auto"] = "auto"
    """Width of the shell that holds space outside the box, in half edges of the box; (0, 1]. auto:
    chosen together with the box."""

    def __post_init__(self) -> None:
        """Refuse what makes no grid."""
        if not isinstance(self.voxels, str):
            self._require_countable(self.voxels)
        elif self.voxels != "auto":
            raise InputError(
                f"grid.voxels must be auto or a whole number, not {said(self.voxels)}."
            )
        require_one_of("grid.contraction", self.contraction, ("auto", *SPACES))
        require_whole("grid.planes", self.planes, 2)
        if not 0 < self.alpha_init < 1:
            raise InputError(
                f"grid.alpha_init must lie between 0 and 1, not {said(self.alpha_init)}."
            )
        if self.border != "auto" and not (is_number(self.border) and 0 < self.border <= 1):
            raise InputError(
                f"grid.border must be auto, or above 0 and at most 1, not {said(self.border)}."
            )
        if not (isinstance(self.box, str) and self.box in ("auto", "scene")):
            object.__setattr__(self, "box", _checked_box(self.box))
        if not isinstance(self.grow_at, str):
            require_shares("grid.grow_at", self.grow_at)
        elif self.grow_at != "auto":
            raise InputError(
                f"grid.grow_at must be auto or shares between 0 and 1, not {said(self.grow_at)}."
            )
        require_at_least("grid.shift_at_growth", self.shift_at_growth, 0.0)
        if self.shift_at_growth > 0.0 and not self.grow_at:
            raise InputError(
                f"grid.shift_at_growth is {self.shift_at_growth:g}, but grid.grow_at is empty; "
                "give shares at which the grid grows, or leave shift_at_growth out."
            )
        if self.contraction != "auto":
            self.require_planes_used(self.contraction)

    def _require_countable(self, voxels: int) -> None:
        if hasattr(voxels, "__index__") and voxels >= MAX_VOXELS:
            raise InputError(
                "grid.voxels must be below 2^31 (1290 x 1290 x 1290), which kernels can count; use "
                "fewer --voxels."
            )
        require_whole("grid.voxels", voxels, 8)

    def require_planes_used(self, contraction: Contraction) -> None:
        """Raise InputError where ``planes``, of NDC depth, is given, but does nothing.

        Args:
            contraction: The grid's, decided.
        """
        if not SPACES[contraction].has_frustum and self.planes != GridConfig.planes:
            raise InputError(
                f"grid.planes is {self.planes}, but grid.contraction is {contraction}, and planes "
                "are of ndc; leave planes out."
            )

    def grows_at(self, kind: SceneKind) -> tuple[float, ...]:
        """When the voxel grid grows, as shares of the training: ``grow_at``, decided for a kind of
        scene.

        Args:
            kind: object, bounded or unbounded.

        Returns:
            Shares of the training.
        """
        return GROW_AT[kind] if isinstance(self.grow_at, str) else self.grow_at

    def nodes_after(self, grown: int, kind: SceneKind) -> int:
        """About how many voxel grid nodes there are after so many steps of growth.

        Args:
            grown: At most as often as ``grows_at`` has shares.
            kind: object, bounded or unbounded.

        Returns:
            Nodes in all; 8 at least.
        """
        return max(8, self.n_nodes >> len(self.grows_at(kind)) - grown)

    @property
    def n_nodes(self) -> int:
        """Nodes of the final grid: ``voxels``, where it is a number.

        Raises:
            TypeError: It is auto, which ``TrainConfig.for_kind`` decides.
        """
        if isinstance(self.voxels, str):
            raise TypeError("grid.voxels is auto, so no number yet; see TrainConfig.for_kind")
        return self.voxels
