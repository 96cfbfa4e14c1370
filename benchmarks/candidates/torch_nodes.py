"""What nodes hold, in eager torch: reading it at samples, and handing gradients back.

embedding_bag reads without a copy of eight nodes for each sample; gradients are added in place to a
table that stays. Milliseconds of the two ways to scatter them to the nodes, in a whole step of 4096
rays on one thread, 160^3 grid, dense:

                      sh    deferred    features
    index_add       2341        1045        1565
    add_by_pairs    1594         641        1279

Tried for the adjoint and slower: index_put and scatter_add with rows, a sparse matrix (coordinates
or rows) times the gradients, sorting all nodes and embedding_bag. For reading: index_select with
bmm, grid_sample, a sparse matrix.
"""

from __future__ import annotations

from typing import Any, Literal

import torch
import torch.nn.functional as F

PIECE = 32768
"""Samples whose gradient is scattered to the nodes at once."""
REST = 0.02
"""Share of samples for which another round of `add_by_pairs` is not worth it."""

Scattering = Literal["rows", "pairs"]


def add_by_rows(
    gradient: torch.Tensor,  # [n_nodes, n_values], added to
    node: torch.Tensor,  # [n_samples, 8] int32
    share: torch.Tensor,  # [n_samples, 8]
    adj_raw: torch.Tensor,  # [n_samples, n_values]
) -> None:
    """Hand the gradients of samples to nodes: a row for each of the eight."""
    n, n_values = adj_raw.shape
    if n_values == 1:  # one after the other, which is faster than to sort them
        gradient.view(-1).scatter_add_(0, node.view(-1).long(), (share * adj_raw).view(-1))
        return
    for begin in range(0, n, PIECE):
        part = slice(begin, min(begin + PIECE, n))
        parcels = share[part, :, None] * adj_raw[part, None]
        gradient.index_add_(0, node[part].view(-1), parcels.view(-1, n_values))


def add_by_pairs(
    gradient: torch.Tensor,  # [n_nodes, n_values], added to
    node: torch.Tensor,  # [n_samples, 8] int32
    share: torch.Tensor,  # [n_samples, 8]
    adj_raw: torch.Tensor,  # [n_samples, n_values]
) -> None:
    """The same in rounds of samples that lie in different cells.

    Sorting by cell is an eighth of the work of sorting by node, which index_add does. In a round no
    node is met twice at the same corner: reading, adding and writing runs in parallel, on pairs of
    nodes that follow each other along z. Pairs from an even node on do not overlap, nor do those
    from an odd one.
    """
    if not len(node):
        return
    n_nodes, n_values = gradient.shape
    pairs = [
        gradient[odd : odd + (n_nodes - odd) // 2 * 2].view(-1, 2 * n_values) for odd in (0, 1)
    ]
    corners = (node[0, ::2] - node[0, 0]).tolist()
    first, order = torch.sort(node[:, 0])
    while len(first) > REST * len(node):
        new = torch.ones_like(first, dtype=torch.bool)
        torch.ne(first[1:], first[:-1], out=new[1:])
        for odd in (0, 1):
            at = (new & (first % 2 == odd)).nonzero()[:, 0]
            low, sample = first.index_select(0, at), order.index_select(0, at)
            for begin in range(0, len(low), PIECE // 4):
                part = slice(begin, begin + PIECE // 4)
                adj = adj_raw.index_select(0, sample[part])[:, None]
                weights = share.index_select(0, sample[part]).view(-1, 4, 2, 1)
                for i, corner in enumerate(corners):
                    from_odd = (odd + corner) % 2
                    rows = ((low[part] + (corner - from_odd)) >> 1).long()
                    values = pairs[from_odd].index_select(0, rows)
                    values.view(-1, 2, n_values).addcmul_(adj, weights[:, i])
                    pairs[from_odd].index_copy_(0, rows, values)
        more = ~new
        first, order = first[more], order[more]
    if len(first):
        add_by_rows(gradient, node[order], share[order], adj_raw[order])


class Table:
    """Numbers of nodes, and their gradient."""

    def __init__(self, values: torch.Tensor, corners: torch.Tensor) -> None:
        """No gradient yet.

        Args:
            values: [n_nodes, n_values]
            corners: [8] from a cell's first node to all of them.
        """
        self.values = values
        self.gradient = torch.zeros_like(values)
        """[n_nodes, n_values], added to."""
        self.touched: torch.Tensor | None = None
        """[n] nodes that may have a gradient; None: any."""
        self._corners = corners[1:].tolist()
        self._cells = torch.zeros(len(values), dtype=torch.bool, device=values.device)

    def clear(self) -> None:
        """Zero the gradient, of no other nodes than those that have been touched, if these are
        known."""
        if self.touched is None:
            self.gradient.zero_()
        else:
            self.gradient.index_fill_(0, self.touched, 0.0)

    def note(self, first: torch.Tensor) -> None:
        """Samples are in cells with these first nodes, [n_samples] int32."""
        self._cells.index_fill_(0, first.long(), True)

    def find_touched(self, noted: bool) -> None:
        """Decide what `touched` is: all nodes of cells that were noted, or any."""
        self.touched = None
        if noted:
            touched = self._cells.clone()
            for corner in self._corners:
                touched[corner:] |= self._cells[:-corner]
            self.touched = touched.nonzero()[:, 0]
            self._cells.zero_()


class Interpolate(torch.autograd.Function):
    """Nodes to samples; on the way back gradients are added to the table's."""

    @staticmethod
    def forward(
        ctx: Any,
        on: torch.Tensor,  # anything that requires a gradient, or there would be no way back
        table: Table,
        node: torch.Tensor,  # [n_samples, 8] int32
        share: torch.Tensor,  # [n_samples, 8]
        scattering: Scattering,
        known: torch.Tensor | None,  # [n_samples, n_values] what they read, if somebody has looked
    ) -> torch.Tensor:
        ctx.save_for_backward(node, share)
        ctx.gradient = table.gradient
        ctx.scattering = scattering
        if known is not None:
            return known
        return F.embedding_bag(node, table.values, mode="sum", per_sample_weights=share)

    @staticmethod
    def backward(ctx: Any, *adj: torch.Tensor) -> tuple[None, ...]:
        add = add_by_pairs if ctx.scattering == "pairs" else add_by_rows
        add(ctx.gradient, *ctx.saved_tensors, adj[0])
        return (None,) * 6
