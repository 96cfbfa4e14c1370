"""A hash as its definition has it: node by node, with whole numbers that do not overflow."""

import itertools
import math

import torch


def raw_values(
    tables: list[torch.Tensor],
    cells: list[tuple[float, float, float]],
    most: int,
    matrices: list[torch.Tensor],
    shares: torch.Tensor,
) -> torch.Tensor:
    """Raw values at points.

    Args:
        tables: [n_entries, width] of each level.
        cells: Of each level along the field's edges.
        most: Nodes of a level that has an entry for each of them; others hash (i, j).
        matrices: [n_levels * width, n]; with a hidden layer [n_levels * width, n_units] and
            [n_units, n].
        shares: [n_points, 3] where points lie in the field, [0, 1].

    Returns:
        [n_points, n]
    """
    levels = []
    for table, edges in zip(tables, cells, strict=True):
        nodes = [math.ceil(n) + 1 for n in edges]
        points = []
        for share in shares.tolist():
            u = [s * n for s, n in zip(share, edges, strict=True)]
            low = [min(int(x), n - 2) for x, n in zip(u, nodes, strict=True)]
            total = torch.zeros(table.shape[1], dtype=torch.float64)
            for corner in itertools.product((0, 1), repeat=3):
                node = [a + b for a, b in zip(low, corner, strict=True)]
                weight = math.prod(1.0 - abs(x - n) for x, n in zip(u, node, strict=True))
                total = total + weight * table[entry_of(node, nodes, most)]
            points.append(total)
        levels.append(torch.stack(points))
    numbers = torch.cat(levels, dim=1)
    for hidden in matrices[:-1]:
        numbers = (numbers @ hidden).clamp(min=0.0)
    return numbers @ matrices[-1]


def entry_of(node: list[int], nodes: list[int], most: int) -> int:
    """Where a node's numbers lie in its level's table."""
    i, j, k = node
    if math.prod(nodes) <= most:
        return (i * nodes[1] + j) * nodes[2] + k
    hashed = (i * 2654435761 % 2**32) ^ (j * 805459861 % 2**32)
    return hashed % most // 4 * 4 + k
