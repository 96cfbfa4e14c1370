"""Nodes of a grid and their adjoint in numba, for any number of values that a node holds.

A node's values lie side by side, and are worked on in vectors.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

from numba import njit

from candidates.numba_cpu import FX, FY, FZ, RAW, TILE, F, U


@njit(fastmath=True, error_model="numpy")
def gather_densities(scene, n_values, n, rows, base):
    """Raw densities at the samples, into row RAW."""
    v = scene.values
    y = U(n_values) * U(scene.size[2])
    x = y * U(scene.size[1])
    side = U(n_values)
    for s in range(n):
        fx, fy, fz = rows[FX, s], rows[FY, s], rows[FZ, s]
        gx, gy = F(1.0) - fx, F(1.0) - fy
        near = U(n_values) * U(base[s])
        far = near + x
        a = gx * (gy * v[near] + fy * v[near + y]) + fx * (gy * v[far] + fy * v[far + y])
        near, far = near + side, far + side
        b = gx * (gy * v[near] + fy * v[near + y]) + fx * (gy * v[far] + fy * v[far + y])
        rows[RAW, s] = a + fz * (b - a)


@njit(fastmath=True, inline="always")
def shares_of(rows, s):
    """Of a sample in its eight nodes, by where they lie: x, y, z, the last the fastest."""
    fx, fy, fz = rows[FX, s], rows[FY, s], rows[FZ, s]
    gx, gy, gz = F(1.0) - fx, F(1.0) - fy, F(1.0) - fz
    return (
        gx * gy * gz,
        gx * gy * fz,
        gx * fy * gz,
        gx * fy * fz,
        fx * gy * gz,
        fx * gy * fz,
        fx * fy * gz,
        fx * fy * fz,
    )


@cache
def nodes(n_values: int) -> tuple[Callable[..., Any], ...]:
    """Reading nodes of so many values.

    Returns:
        gather(scene, s, rows, base, out); adj_gather(scene, s, rows, base, adj, out, touched);
        adj_gather_density(scene, s, rows, base, out, touched).
    """

    @njit(fastmath=True, error_model="numpy")
    def gather(scene, s, rows, base, out):
        """All that the nodes hold at a sample."""
        v = scene.values
        y = U(n_values) * U(scene.size[2])
        x = y * U(scene.size[1])
        w000, w001, w010, w011, w100, w101, w110, w111 = shares_of(rows, s)
        at = U(n_values) * U(base[s])
        side = U(n_values)
        for c in range(n_values):
            i = at + U(c)
            low = w000 * v[i] + w010 * v[i + y] + w100 * v[i + x] + w110 * v[i + x + y]
            i += side
            out[c] = low + (w001 * v[i] + w011 * v[i + y] + w101 * v[i + x] + w111 * v[i + x + y])

    @njit(fastmath=True, error_model="numpy")
    def add(out, at, share, adj):
        """Add to a node: all is read before anything is written."""
        for c in range(0, n_values, 8):
            i = at + U(c)
            a, b = out[i] + share * adj[c], out[i + U(1)] + share * adj[c + 1]
            d, e = out[i + U(2)] + share * adj[c + 2], out[i + U(3)] + share * adj[c + 3]
            f, g = out[i + U(4)] + share * adj[c + 4], out[i + U(5)] + share * adj[c + 5]
            h, k = out[i + U(6)] + share * adj[c + 6], out[i + U(7)] + share * adj[c + 7]
            out[i], out[i + U(1)], out[i + U(2)], out[i + U(3)] = a, b, d, e
            out[i + U(4)], out[i + U(5)], out[i + U(6)], out[i + U(7)] = f, g, h, k

    @njit(fastmath=True, error_model="numpy")
    def adj_gather(scene, s, rows, base, adj, out, touched):
        """Hand a sample's gradient to the nodes."""
        y = U(scene.size[2])
        x = y * U(scene.size[1])
        w000, w001, w010, w011, w100, w101, w110, w111 = shares_of(rows, s)
        at, side = U(base[s]), U(n_values)
        add(out, side * at, w000, adj)
        add(out, side * (at + U(1)), w001, adj)
        add(out, side * (at + y), w010, adj)
        add(out, side * (at + y + U(1)), w011, adj)
        add(out, side * (at + x), w100, adj)
        add(out, side * (at + x + U(1)), w101, adj)
        add(out, side * (at + x + y), w110, adj)
        add(out, side * (at + x + y + U(1)), w111, adj)
        for node in (at, at + y, at + x, at + x + y):
            if not touched[node // TILE]:
                touched[node // TILE] = True

    @njit(fastmath=True, error_model="numpy")
    def adj_gather_density(scene, s, rows, base, out, touched):
        """The same of a sample that has no gradient but its density's."""
        y = U(scene.size[2])
        x = y * U(scene.size[1])
        w000, w001, w010, w011, w100, w101, w110, w111 = shares_of(rows, s)
        at, side, adj = U(base[s]), U(n_values), rows[RAW, s]
        out[side * at] += w000 * adj
        out[side * (at + U(1))] += w001 * adj
        out[side * (at + y)] += w010 * adj
        out[side * (at + y + U(1))] += w011 * adj
        out[side * (at + x)] += w100 * adj
        out[side * (at + x + U(1))] += w101 * adj
        out[side * (at + x + y)] += w110 * adj
        out[side * (at + x + y + U(1))] += w111 * adj
        for node in (at, at + y, at + x, at + x + y):
            if not touched[node // TILE]:
                touched[node // TILE] = True

    return gather, adj_gather, adj_gather_density
