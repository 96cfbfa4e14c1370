"""Factors as the sum that they are: planes and lines read at points, multiplied and decoded."""

import torch

PLANES = ((0, 1), (0, 2), (1, 2))
"""Axes of each plane; its line lies along the third."""


def raw_values(
    planes: list[torch.Tensor], lines: list[torch.Tensor], decoder: torch.Tensor, u: torch.Tensor
) -> torch.Tensor:
    """Raw values at points.

    Args:
        planes: [N_a, N_b, width] each.
        lines: [N_c, width] each, along the axis that its plane lacks.
        decoder: [3 * width, n].
        u: [n_points, 3] in nodes.

    Returns:
        [n_points, n]
    """
    products = []
    for (a, b), plane, line in zip(PLANES, planes, lines, strict=True):
        c = 3 - a - b
        weights_a, weights_b = hats(u[:, a], plane.shape[0]), hats(u[:, b], plane.shape[1])
        on_plane = torch.einsum("pi,pj,ijn->pn", weights_a, weights_b, plane)
        products.append(on_plane * (hats(u[:, c], line.shape[0]) @ line))
    return torch.cat(products, dim=1) @ decoder


def hats(u: torch.Tensor, n: int) -> torch.Tensor:
    """How much each of n nodes counts at points: 1 at the node, 0 at its neighbours."""
    distance = (u[:, None] - torch.arange(n, dtype=u.dtype)).abs()
    return (1.0 - distance).clamp(min=0.0)
