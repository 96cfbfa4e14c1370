"""The space that a grid fills: a box, what becomes of all outside it, and how fine voxels are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warpnerf.grid_config import Contraction
from warpnerf.model.spaces import SPACES, SpaceKind
from warpnerf.scenes.cameras.observations import Observations
from warpnerf.scenes.extent.frustum import Frustum


@dataclass(frozen=True, kw_only=True, eq=False)
class Space:
    """A box in the scene, or in the coordinates of a frustum, and what of space outside becomes."""

    box_min: np.ndarray
    """[3] float64, lower corner of the box, scene units; with ndc, coordinates of the frustum."""
    box_max: np.ndarray
    """[3] float64, upper corner."""
    contraction: Contraction = "none"
    """What of space outside the box becomes, or that the box lies in a frustum."""
    border: float = 0.0
    """Width of the shell of contracted space around the box, in its half edges; 0 without."""
    frustum: Frustum | None = None
    """Whose coordinates the box has, with ndc."""
    content: np.ndarray | None = None
    """[2, 3] corners of a box around what cameras see, scene units, where that is another one."""

    @property
    def kind(self) -> SpaceKind:
        """What ``contraction`` names."""
        return SPACES[self.contraction]

    @property
    def extent(self) -> np.ndarray:
        """[3] edges of what a grid spans: the box and its shell."""
        return (self.box_max - self.box_min) * (1.0 + self.border)

    @property
    def contracted(self) -> bool:
        """Whether space outside the box is contracted."""
        return self.kind.contracts

    def voxel_edges(self, size: tuple[int, int, int]) -> np.ndarray:
        """Distance between nodes inside the box, [3], where a grid has so many on each axis."""
        return np.asarray(self.extent / (np.array(size) - 1))

    def where_wider(self, times: float) -> tuple[np.ndarray, np.ndarray] | None:
        """The box outside of which voxels are so many times as wide as inside, or wider.

        For linf; of l2 it is the ball in this box.

        Args:
            times: Above 1.

        Returns:
            Lower and upper corner, [3] scene units; None where nothing is outside, or in a frustum.
        """
        n = self.kind.where_wider(self.border, times)
        if n is None:
            return None
        middle, half = 0.5 * (self.box_min + self.box_max), 0.5 * (self.box_max - self.box_min)
        return middle - n * half, middle + n * half

    def voxel_edge(self, voxels: int) -> float:
        """Edge of a voxel inside the box where a grid has so many nodes, scene units."""
        return float((np.prod(self.extent) / voxels) ** (1.0 / 3.0))

    def voxel_widths(
        self, observations: Observations, voxels: int, depth_share: float = 0.0
    ) -> np.ndarray:
        """How wide the voxel around each observation is in the picture that it is seen in.

        A voxel is a cube of contracted space; back in the scene its edges are the columns of
        h J^-1, with h the edge of voxels in the box and J the contraction's Jacobian. The width is
        that of a square in the picture with the same root mean square:

            width^2 = (|P J^-1|^2 + depth_share^2 |d^T J^-1|^2) / 2  (h pixels)^2

        with d the direction of view, P = I - d d^T, and Frobenius norms.

        Args:
            observations: [n] of them.
            voxels: Nodes of the grid.
            depth_share: How much of a voxel's length along the direction of view counts: other
                cameras look at it from aside.

        Returns:
            [n] pixels.
        """
        whole, along = self.kind.squares(self, observations.positions, observations.directions)
        across = whole - (1.0 - depth_share * depth_share) * along
        widths = np.sqrt(0.5 * np.maximum(across, 0.0)) * observations.pixels
        return np.asarray(widths * self.voxel_edge(voxels))


def grid_size(extent: np.ndarray, voxels: int) -> tuple[int, int, int]:
    """Nodes along each axis so that voxels are cubes and about `voxels` in all.

    Args:
        extent: [3] edges of the domain, scene units.
        voxels: Nodes in all.
    """
    edge = (np.prod(extent) / voxels) ** (1.0 / 3.0)
    size = np.maximum(2, np.round(extent / edge).astype(int) + 1)
    return int(size[0]), int(size[1]), int(size[2])


def reach_of_places(box_min: np.ndarray, box_max: np.ndarray, places: np.ndarray) -> float:
    """Distance from the outermost of some places, [n, 3], to the farthest corner of a box."""
    centre, corner = 0.5 * (box_min + box_max), 0.5 * float(np.linalg.norm(box_max - box_min))
    return corner + float(np.linalg.norm(places - centre, axis=1).max(initial=0.0))
