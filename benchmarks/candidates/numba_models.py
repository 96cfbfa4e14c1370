"""numba for models with more features than a colour: sh, deferred, features.

As numba_cpu.py, whose walk it shares: threads with gradients of their own, a ray taken in phases,
adjoint by hand, samples kept. What a node holds and the units of a layer lie side by side, so a
sample at a time is worked on in vectors of these; densities lie in a row for the ray. Everything
that a model fixes is a constant of the functions that are made for it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numba
import numpy as np
from numba import njit, prange
from workload import DENSITY_SHIFT, MODELS, ModelName, Workload

from candidates.numba_cpu import (
    ALPHA,
    ATTENUATION,
    BACK,
    LIGHT,
    RAW,
    TILE,
    WEIGHT,
    F,
    S,
    Scene,
    T,
    U,
    exponential,
    has_gradient,
    log1p,
    walk,
)
from candidates.numba_cpu import (
    obstacle as obstacle,
)
from candidates.numba_heads import FACTOR, colors, shape_of, view_of
from candidates.numba_network import Network, add_to, clear, network, network_of
from candidates.numba_nodes import gather_densities, nodes


@njit(fastmath=True, error_model="numpy")
def weigh(scene, n, rows):
    """Raw densities in row RAW to weights; row RAW becomes the slope of the density. Returns the
    light that passes."""
    for s in range(n):
        x = rows[RAW, s] + F(DENSITY_SHIFT)
        e = exponential(-abs(x))
        tau = (max(x, F(0.0)) + log1p(e)) * scene.step
        rows[RAW, s] = (F(1.0) if x >= F(0.0) else e) / (F(1.0) + e)
        attenuation = exponential(-tau)
        series = tau * (F(1.0) - tau * (F(0.5) - tau * (F(1.0 / 6.0) - tau * F(1.0 / 24.0))))
        rows[ATTENUATION, s] = attenuation
        rows[ALPHA, s] = series if tau < F(0.01) else F(1.0) - attenuation
        ratio = rows[T, s] / scene.content_distance
        rows[FACTOR, s] = min(F(1.0), ratio * ratio) if scene.scaled else F(1.0)
    light = F(1.0)
    for s in range(n):
        rows[WEIGHT, s] = light * rows[ALPHA, s]
        light *= rows[ATTENUATION, s]
        rows[LIGHT, s] = light
    return light


@njit(fastmath=True, error_model="numpy")
def adj_weigh(scene, n, rows, behind):
    """From what flows back into weights, in row BACK, and into what lies behind all, times its
    light: to the gradients of raw densities, in row RAW."""
    for s in range(n - 1, -1, -1):
        adj_weight = rows[BACK, s]
        rows[BACK, s] = rows[LIGHT, s] * adj_weight - behind
        behind += rows[WEIGHT, s] * adj_weight
    for s in range(n):
        rows[RAW, s] *= rows[FACTOR, s] * scene.step * rows[BACK, s]


class Rows(NamedTuple):
    """A thread's scratch: a row for each sample, or of `deferred` one for the ray. For all threads
    together every array has one more axis, the first."""

    raw: np.ndarray  # [n_steps, n_values] what is read, then what flows back
    color: np.ndarray  # [n_steps, n_channels]
    x: np.ndarray  # [n_steps, inputs]
    h1: np.ndarray  # [n_steps, width], ReLU applied
    h2: np.ndarray
    y: np.ndarray  # [n_steps, 4]
    adj_x: np.ndarray
    adj1: np.ndarray
    adj2: np.ndarray
    lit: np.ndarray  # [n_steps] int32, of each row its sample
    base: np.ndarray  # [2, width] what the first layer begins with, and its adjoint
    of_view: np.ndarray  # [64] harmonics or encoding of the direction


@njit(inline="always")
def rows_of(k, thread):
    return Rows(
        k.raw[thread],
        k.color[thread],
        k.x[thread],
        k.h1[thread],
        k.h2[thread],
        k.y[thread],
        k.adj_x[thread],
        k.adj1[thread],
        k.adj2[thread],
        k.lit[thread],
        k.base[thread],
        k.of_view[thread],
    )


@cache
def functions(name: ModelName) -> Callable[..., None]:
    """The step of a model."""
    model = MODELS[name]
    n_values, width, threshold = model.n_values, model.width, F(model.threshold)
    n_channels, n_own, _ = shape_of(name)
    gather, adj_gather, adj_gather_density = nodes(n_values)
    run_network, adj_run_network = network(n_own, width)
    color_samples, adj_color_samples = colors(name)
    see = view_of(name)
    is_deferred, is_features = name == "deferred", name == "per_sample"

    @njit(fastmath=True, error_model="numpy")
    def train_ray(
        scene, o, d, target, loss_weight, net, rows, base, k, view, gradient, out, touched, out_rgb
    ):
        n = walk(scene, o, d, rows, base)
        if is_features:
            gather_densities(scene, n_values, n, rows, base)
        else:
            for s in range(n):
                gather(scene, s, rows, base, k.raw[s])
                rows[RAW, s] = k.raw[s, 0]
        light = weigh(scene, n, rows)
        lit = 0
        for s in range(n):
            if not is_features or rows[WEIGHT, s] > threshold:
                k.lit[lit] = s
                lit += 1
        if is_features:
            for r in range(lit):
                gather(scene, k.lit[r], rows, base, k.raw[r])
        see(d, view)
        color_samples(lit, rows, k, view, net)
        seen = np.zeros(n_channels, np.float32)
        for r in range(lit):
            for c in range(n_channels):
                seen[c] += rows[WEIGHT, k.lit[r]] * k.color[r, c]
        if is_deferred:
            for c in range(n_channels):
                k.x[0, c] = seen[c]
            for i in range(n_own - n_channels):
                k.x[0, n_channels + i] = view[i]
            for j in range(width):
                k.base[0, j] = net.b1[j]
            run_network(1, net, k)
            for c in range(3):
                out_rgb[c] = seen[c] + (F(1.0) - light) * k.y[0, c]
        else:
            for c in range(3):
                out_rgb[c] = seen[c]
        adj_channels = np.zeros(n_channels, np.float32)
        behind = F(0.0)
        for c in range(3):
            out_rgb[c] += light * scene.background[c]
            adj_channels[c] = F(2.0) * loss_weight * (out_rgb[c] - target[c])
            behind += light * adj_channels[c] * scene.background[c]
        if is_deferred:
            for c in range(3):
                behind -= light * adj_channels[c] * k.y[0, c]
                k.y[0, c] = (F(1.0) - light) * adj_channels[c]
            adj_run_network(1, net, k, gradient)
            for j in range(width):
                gradient.b1[j] += k.base[1, j]
            for c in range(n_channels):
                adj_channels[c] += k.adj_x[0, c]
        for s in range(n):
            rows[BACK, s] = F(0.0)
        for r in range(lit):
            total = F(0.0)
            for c in range(n_channels):
                total += adj_channels[c] * k.color[r, c]
            rows[BACK, k.lit[r]] = total
        adj_weigh(scene, n, rows, behind)
        adj_color_samples(lit, rows, k, view, net, adj_channels, gradient)
        r = 0
        for s in range(n):
            if r < lit and k.lit[r] == s:
                k.raw[r, 0] = rows[RAW, s]
                adj_gather(scene, s, rows, base, k.raw[r], out, touched)
                r += 1
            else:
                adj_gather_density(scene, s, rows, base, out, touched)

    @njit(parallel=True, fastmath=True, error_model="numpy")
    def train(
        scene,
        origins,
        directions,
        target_rgb,
        net,
        all_rows,
        of_network,  # gradients
        gradients,
        touched,
        rows,
        base,
        out_rgb,
    ):
        """One step: the sum of the threads' gradients is left in the first's, others zeroed."""
        n_threads, n_numbers = gradients.shape
        n_rays = len(origins)
        run = TILE * U(n_values)
        for tile in prange(touched.size):
            if has_gradient(touched, tile):
                gradients[0, U(tile) * run : (U(tile) + U(1)) * run] = F(0.0)
        touched[:] = False
        for thread in prange(n_threads):
            k, gradient = rows_of(all_rows, thread), network_of(of_network, thread)
            clear(gradient)
            for i in range(n_rays * thread // n_threads, n_rays * (thread + 1) // n_threads):
                train_ray(
                    scene,
                    origins[i],
                    directions[i],
                    target_rgb[i],
                    F(1.0) / F(n_rays),
                    net,
                    rows[thread],
                    base[thread],
                    k,
                    k.of_view,
                    gradient,
                    gradients[thread],
                    touched,
                    out_rgb[i],
                )
        for other in range(1, n_threads):
            add_to(network_of(of_network, 0), network_of(of_network, other))
        for tile in prange(touched.size):
            if has_gradient(touched, tile):
                for other in range(1, n_threads):
                    for at in range(U(tile) * run, min((U(tile) + U(1)) * run, U(n_numbers))):
                        gradients[0, at] += gradients[other, at]
                        gradients[other, at] = F(0.0)

    return train


class NumbaModels:
    """A workload's training step in numba."""

    def __init__(self, work: Workload, threads: int, device: str) -> None:
        """Load a workload."""
        self._threads = threads
        self._shape = work.values.shape
        model = MODELS[work.model]
        size = np.array(self._shape[:3], S)
        scene = Scene(
            values=work.values.ravel(),
            size=size,
            to_nodes=F(0.5) * (size - 1).astype(F),
            free=work.free,
            to_cells=F(0.5) * np.array(work.free.shape, F),
            skips=work.skips,
            n_steps=work.n_steps,
            step=F(work.step),
            background=np.array(work.background, F),
            scaled=work.scaled,
            content_distance=F(work.content_distance),
        )
        n_steps, width = work.n_steps, model.width
        arrays = work.network or tuple(np.zeros(s, F) for s in [(1, 1), 1] * 3)
        transposed = (np.ascontiguousarray(array.T) for array in arrays[::2])

        def room(*shape: int) -> np.ndarray:
            return np.zeros(shape, F)

        rows = Rows(
            raw=room(threads, n_steps, model.n_values),
            color=room(threads, n_steps, shape_of(work.model).n_channels),
            x=room(threads, n_steps, max(1, model.n_inputs)),
            h1=room(threads, n_steps, width),
            h2=room(threads, n_steps, width),
            y=room(threads, n_steps, 4),
            adj_x=room(threads, n_steps, max(1, model.n_inputs)),
            adj1=room(threads, n_steps, width),
            adj2=room(threads, n_steps, width),
            lit=np.zeros((threads, n_steps), S),
            base=room(threads, 2, width),
            of_view=room(threads, 64),
        )
        network = Network(*arrays, *transposed)
        self._network_gradients = Network(*(room(threads, *array.shape) for array in network))
        self._gradients = np.zeros((threads, work.values.size), F)
        self._rgb = np.zeros_like(work.origins)
        self._has_network = bool(work.network)
        run = int(TILE) * model.n_values
        self._train = functions(work.model)
        self._arguments = (
            scene,
            work.origins,
            work.directions,
            work.target_rgb,
            network,
            rows,
            self._network_gradients,
            self._gradients,
            np.zeros(-(-work.values.size // run), np.bool_),
            np.zeros((threads, FACTOR + 1, n_steps), F),
            np.zeros((threads, n_steps), S),
            self._rgb,
        )

    def step(self) -> None:
        """Forward, loss and adjoint."""
        numba.set_num_threads(self._threads)
        self._train(*self._arguments)

    def gradient(self) -> np.ndarray:
        """[X, Y, Z, n_values]"""
        return self._gradients[0].reshape(self._shape)

    def network_gradient(self) -> np.ndarray:
        """[n_parameters], weights and biases in turn."""
        if not self._has_network:
            return np.zeros(0, F)
        return np.concatenate([array[0].ravel() for array in self._network_gradients[:6]])

    def rgb(self) -> np.ndarray:
        """[n_rays, 3]"""
        return self._rgb


load = NumbaModels
