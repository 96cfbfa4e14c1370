"""Heads in numba, with their adjoints: sh, deferred, features.

Rows of samples go through together; everything that a model fixes is a constant.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from workload import MODELS, ModelName

from candidates.numba_cpu import RAW, WEIGHT, F, sigmoid
from candidates.numba_network import network

FACTOR = RAW + 1
"""Another row of numbers of samples: what a sample's gradients are multiplied by."""


class Shape(NamedTuple):
    """What a model fixes."""

    n_channels: int  # accumulated along a ray
    n_own: int  # inputs of the network that differ from row to row
    n_view: int  # and of those of the direction


def shape_of(name: ModelName) -> Shape:
    """Of a model."""
    model = MODELS[name]
    return Shape(
        n_channels=model.n_features if name == "deferred" else 3,
        n_own={"sh": 1, "deferred": model.n_inputs, "per_sample": 9}[name],
        n_view=model.n_inputs - 9,
    )


@cache
def view_of(name: ModelName) -> Callable[..., None]:
    """What a head sees of the direction of view: view(d, out)."""
    n_frequencies = MODELS[name].n_frequencies

    @njit(fastmath=True, error_model="numpy")
    def encode(d, out):
        """The direction, its sines and cosines."""
        for axis in range(3):
            out[axis] = d[axis]
            for k in range(n_frequencies):
                angle = d[axis] * F(1 << k)
                out[3 + 6 * k + axis] = F(np.sin(angle))
                out[6 + 6 * k + axis] = F(np.cos(angle))

    @njit(fastmath=True, error_model="numpy")
    def harmonics(d, out):
        """Up to degree 2."""
        x, y, z = d[0], d[1], d[2]
        out[0] = F(0.28209479177387814)
        out[1] = F(-0.4886025119029199) * y
        out[2] = F(0.4886025119029199) * z
        out[3] = F(-0.4886025119029199) * x
        out[4] = F(1.0925484305920792) * x * y
        out[5] = F(-1.0925484305920792) * y * z
        out[6] = F(0.31539156525252005) * (F(2.0) * z * z - x * x - y * y)
        out[7] = F(-1.0925484305920792) * x * z
        out[8] = F(0.5462742152960396) * (x * x - y * y)

    return harmonics if name == "sh" else encode


@cache
def colors(name: ModelName) -> tuple[Callable[..., Any], ...]:
    """Colours of samples.

    Returns:
        color_samples(n, rows, k, view, net);
        adj_color_samples(n, rows, k, view, net, adj_channels, gradient).
    """
    n_channels, n_own, n_view = shape_of(name)
    width = MODELS[name].width
    run_network, adj_run_network = network(n_own, width)
    is_sh, is_deferred = name == "sh", name == "deferred"

    @njit(fastmath=True, error_model="numpy")
    def color_samples(n, rows, k, view, net):
        """Rows raw to color; of `per_sample`, n are those that have one."""
        if is_sh:
            for s in range(n):
                red, green, blue = F(0.0), F(0.0), F(0.0)
                for b in range(9):
                    red += view[b] * k.raw[s, 1 + 3 * b]
                    green += view[b] * k.raw[s, 2 + 3 * b]
                    blue += view[b] * k.raw[s, 3 + 3 * b]
                k.color[s, 0], k.color[s, 1], k.color[s, 2] = red, green, blue
        elif is_deferred:
            for s in range(n):
                for c in range(n_channels):
                    k.color[s, c] = k.raw[s, 1 + c]
        else:
            for s in range(n):
                for i in range(n_own):
                    k.x[s, i] = k.raw[s, 4 + i]
            for j in range(width):
                k.base[0, j] = net.b1[j]
            for i in range(n_view):
                for j in range(width):
                    k.base[0, j] += view[i] * net.w1[n_own + i, j]
            run_network(n, net, k)
            for s in range(n):
                for c in range(3):
                    k.color[s, c] = k.raw[s, 1 + c] + k.y[s, c]
        for s in range(n):
            for c in range(n_channels):
                k.color[s, c] = sigmoid(k.color[s, c])

    @njit(fastmath=True, error_model="numpy")
    def adj_color_samples(n, rows, k, view, net, adj_channels, gradient):
        """Rows color to what flows back into raw values but densities, in rows raw."""
        for r in range(n):
            s = k.lit[r]
            share = rows[FACTOR, s] * rows[WEIGHT, s]
            for c in range(n_channels):
                color = k.color[r, c]
                k.color[r, c] = share * adj_channels[c] * color * (F(1.0) - color)
        if is_sh:
            for r in range(n):
                for b in range(9):
                    for c in range(3):
                        k.raw[r, 1 + 3 * b + c] = view[b] * k.color[r, c]
        elif is_deferred:
            for r in range(n):
                for c in range(n_channels):
                    k.raw[r, 1 + c] = k.color[r, c]
        else:
            for r in range(n):
                for c in range(3):
                    k.y[r, c] = k.color[r, c]
            adj_run_network(n, net, k, gradient)
            for j in range(width):
                gradient.b1[j] += k.base[1, j]
            for i in range(n_view):
                for j in range(width):
                    gradient.w1[n_own + i, j] += view[i] * k.base[1, j]
            for r in range(n):
                for c in range(3):
                    k.raw[r, 1 + c] = k.color[r, c]
                for i in range(n_own):
                    k.raw[r, 4 + i] = k.adj_x[r, i]

    return color_samples, adj_color_samples
