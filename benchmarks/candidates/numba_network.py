"""Layers of an MLP on rows of samples, in numba, with their adjoints.

A layer takes four samples at once, so that a weight read is used four times.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from candidates.numba_cpu import F

AT_ONCE = 4
"""Samples whose rows of a layer are worked on together."""


@cache
def layer(n_own: int, n_out: int) -> tuple[Callable[..., Any], ...]:
    """One layer on rows of samples, of which n_own inputs differ from row to row.

    Returns:
        forward(n, x, weights, base, out), for which base [n_out] is what all rows begin with;
        adj_inputs(n, adj, transposed, adj_x); adj_weights(n, x, adj, out), added to.
    """

    @njit(fastmath=True, error_model="numpy")
    def forward(n, x, weights, base, out):
        whole = n - n % AT_ONCE
        for s in range(0, whole, AT_ONCE):
            a, b, c, d = out[s], out[s + 1], out[s + 2], out[s + 3]
            for j in range(n_out):
                a[j] = base[j]
                b[j] = base[j]
                c[j] = base[j]
                d[j] = base[j]
            for i in range(n_own):
                p, q, r, t = x[s, i], x[s + 1, i], x[s + 2, i], x[s + 3, i]
                for j in range(n_out):
                    w = weights[i, j]
                    a[j] += p * w
                    b[j] += q * w
                    c[j] += r * w
                    d[j] += t * w
        for s in range(whole, n):
            a = out[s]
            for j in range(n_out):
                a[j] = base[j]
            for i in range(n_own):
                for j in range(n_out):
                    a[j] += x[s, i] * weights[i, j]

    @njit(fastmath=True, error_model="numpy")
    def adj_inputs(n, adj, transposed, adj_x):
        for s in range(n):
            for i in range(n_own):
                adj_x[s, i] = F(0.0)
            for j in range(n_out):
                a = adj[s, j]
                for i in range(n_own):
                    adj_x[s, i] += a * transposed[j, i]

    @njit(fastmath=True, error_model="numpy")
    def adj_weights(n, x, adj, out):
        whole = n - n % AT_ONCE
        for s in range(0, whole, AT_ONCE):
            for i in range(n_own):
                p, q, r, t = x[s, i], x[s + 1, i], x[s + 2, i], x[s + 3, i]
                for j in range(n_out):
                    out[i, j] += (
                        p * adj[s, j] + q * adj[s + 1, j] + r * adj[s + 2, j] + t * adj[s + 3, j]
                    )
        for s in range(whole, n):
            for i in range(n_own):
                for j in range(n_out):
                    out[i, j] += x[s, i] * adj[s, j]

    return forward, adj_inputs, adj_weights


class Network(NamedTuple):
    """Weights [inputs, outputs] and biases of three layers, and all weights transposed."""

    w1: np.ndarray
    b1: np.ndarray
    w2: np.ndarray
    b2: np.ndarray
    w3: np.ndarray
    b3: np.ndarray
    t1: np.ndarray
    t2: np.ndarray
    t3: np.ndarray


@njit(inline="always")
def network_of(net, thread):
    return Network(
        net.w1[thread],
        net.b1[thread],
        net.w2[thread],
        net.b2[thread],
        net.w3[thread],
        net.b3[thread],
        net.t1[thread],
        net.t2[thread],
        net.t3[thread],
    )


@njit
def clear(net):
    """Not in the parallel loop itself, where numba 0.68 leaves biases as they are."""
    net.w1.fill(F(0.0))
    net.b1.fill(F(0.0))
    net.w2.fill(F(0.0))
    net.b2.fill(F(0.0))
    net.w3.fill(F(0.0))
    net.b3.fill(F(0.0))


@njit
def add_to(net, other):
    net.w1[:] += other.w1
    net.b1[:] += other.b1
    net.w2[:] += other.w2
    net.b2[:] += other.b2
    net.w3[:] += other.w3
    net.b3[:] += other.b3


@cache
def network(n_own: int, width: int) -> tuple[Callable[..., None], Callable[..., None]]:
    """Two hidden layers with ReLU and three outputs, on rows of samples.

    Args:
        n_own: Inputs that differ from row to row.
        width: Of the hidden layers.

    Returns:
        run_network(n, net, k), adj_run_network(n, net, k, gradient).
    """
    forward1, adj_inputs1, adj_weights1 = layer(n_own, width)
    forward2, adj_inputs2, adj_weights2 = layer(width, width)
    forward3, adj_inputs3, adj_weights3 = layer(width, 3)

    @njit(fastmath=True, error_model="numpy")
    def run_network(n, net, k):
        """Rows x to y; the first layer begins with base[0]."""
        forward1(n, k.x, net.w1, k.base[0], k.h1)
        for s in range(n):
            for j in range(width):
                k.h1[s, j] = max(k.h1[s, j], F(0.0))
        forward2(n, k.h1, net.w2, net.b2, k.h2)
        for s in range(n):
            for j in range(width):
                k.h2[s, j] = max(k.h2[s, j], F(0.0))
        forward3(n, k.h2, net.w3, net.b3, k.y)

    @njit(fastmath=True, error_model="numpy")
    def adj_run_network(n, net, k, gradient):
        """From what flows back in rows y to rows adj_x; the network's is added to, but for what
        the first layer begins with: that goes to base[1]."""
        adj_weights3(n, k.h2, k.y, gradient.w3)
        adj_inputs3(n, k.y, net.t3, k.adj2)
        for s in range(n):
            for j in range(3):
                gradient.b3[j] += k.y[s, j]
            for j in range(width):
                k.adj2[s, j] = k.adj2[s, j] if k.h2[s, j] > F(0.0) else F(0.0)
                gradient.b2[j] += k.adj2[s, j]
        adj_weights2(n, k.h1, k.adj2, gradient.w2)
        adj_inputs2(n, k.adj2, net.t2, k.adj1)
        for j in range(width):
            k.base[1, j] = F(0.0)
        for s in range(n):
            for j in range(width):
                k.adj1[s, j] = k.adj1[s, j] if k.h1[s, j] > F(0.0) else F(0.0)
                k.base[1, j] += k.adj1[s, j]
        adj_weights1(n, k.x, k.adj1, gradient.w1)
        adj_inputs1(n, k.adj1, net.t1, k.adj_x)

    return run_network, adj_run_network
