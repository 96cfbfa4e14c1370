"""Taichi: a loop over threads with gradients of their own, adjoint by hand, samples kept.

Tried and slower: a parallel loop over rays with atomic addition (up to 1.2 times as long on one
thread, 2 to 3 times on two), and reading samples again instead of keeping them (1.4 to 2 times).
"""
# Taichi reads annotations as they are: none may be put off.

import contextlib
import io
import math
import os
from typing import Any

import numpy as np
from workload import DENSITY_SHIFT, Workload

os.environ["ENABLE_TAICHI_HEADER_PRINT"] = "0"
import taichi as ti

vec3 = ti.types.vector(3, ti.f32)
vec4 = ti.types.vector(4, ti.f32)
Kept = ti.types.vector(11, ti.f32)
"""Of a sample: fraction (3), t, slope of the density, exp(-tau), weight, rgb (3), node as bits."""
Vec3s = ti.types.ndarray(dtype=vec3, ndim=1)
Vec4s = ti.types.ndarray(dtype=vec4, ndim=1)
TILE_BITS = 4
TILE = 1 << TILE_BITS
"""Nodes in a run along z that are zeroed and summed together, if any was touched."""


@ti.func
def log1p(y):
    """log(1 + y) = 2 artanh(y / (2 + y)), for y in [0, 1]; relative error 1e-7."""
    z = y / (2.0 + y)
    z2 = z * z
    p = 0.400245965 + z2 * (0.279651582 + z2 * 0.281577796)
    return z * (2.0 + z2 * (0.666663229 + z2 * p))


@ti.func
def gather(values: ti.template(), node, stride_x, stride_y, f):
    """The grid between the eight nodes around a point."""
    g = 1.0 - f
    n01, n10, n11 = node + stride_y, node + stride_x, node + stride_x + stride_y
    value = g[0] * g[1] * (g[2] * values[node] + f[2] * values[node + 1])
    value += g[0] * f[1] * (g[2] * values[n01] + f[2] * values[n01 + 1])
    value += f[0] * g[1] * (g[2] * values[n10] + f[2] * values[n10 + 1])
    value += f[0] * f[1] * (g[2] * values[n11] + f[2] * values[n11 + 1])
    return value


@ti.func
def adj_gather(
    gradients: ti.template(),
    touched: ti.template(),
    thread,
    node,
    stride_x,
    stride_y,
    f,
    adj,
):
    """Hand a gradient to the same nodes."""
    g = 1.0 - f
    high = f[2] * adj
    low = adj - high
    for a, b in ti.static(ti.ndrange(2, 2)):
        at = node + a * stride_x + b * stride_y
        share = (f[0] if ti.static(a == 1) else g[0]) * (f[1] if ti.static(b == 1) else g[1])
        gradients[thread, at] = gradients[thread, at] + share * low
        gradients[thread, at + 1] = gradients[thread, at + 1] + share * high
        if touched[at >> TILE_BITS] == 0:  # a write would take the line away from other threads
            touched[at >> TILE_BITS] = ti.u8(1)


@ti.func
def has_gradient(touched: ti.template(), tile):
    """Whether a tile's nodes may have been added to: columns begin in it, or in the one before."""
    return touched[tile] != 0 or touched[ti.max(tile - 1, 0)] != 0


@ti.kernel
def clear(
    n_threads: ti.template(),
    gradients: ti.types.ndarray(dtype=vec4, ndim=2),
    touched: ti.types.ndarray(dtype=ti.u8, ndim=1),
):
    """Zero what the last step left."""
    ti.loop_config(parallelize=n_threads)
    for tile in range(touched.shape[0]):
        if has_gradient(touched, tile):
            for at in range(tile * TILE, ti.min((tile + 1) * TILE, gradients.shape[1])):
                gradients[0, at] = vec4(0.0)
    ti.loop_config(serialize=True)
    for tile in range(touched.shape[0]):
        touched[tile] = ti.u8(0)


@ti.kernel
def train(
    n_threads: ti.template(),
    size_x: ti.template(),
    size_y: ti.template(),
    size_z: ti.template(),
    n_steps: ti.template(),
    step: ti.template(),
    skips: ti.template(),
    scaled: ti.template(),
    content_distance: ti.template(),
    background: vec3,
    values: Vec4s,
    free: ti.types.ndarray(dtype=ti.u8, ndim=3),
    origins: Vec3s,
    directions: Vec3s,
    target_rgb: Vec3s,
    kept: ti.types.ndarray(dtype=Kept, ndim=2),
    gradients: ti.types.ndarray(dtype=vec4, ndim=2),
    touched: ti.types.ndarray(dtype=ti.u8, ndim=1),
    out_rgb: Vec3s,
):
    """Forward, loss and adjoint; then the threads' gradients are summed in the first's.

    What a workload has only one of is constant: compiled in, it saves a fifth of the time.
    """
    n_rays = origins.shape[0]
    size = ti.Vector([size_x, size_y, size_z])
    stride_x, stride_y = ti.static(size_y * size_z), ti.static(size_z)
    to_nodes = 0.5 * ti.cast(size - 1, float)
    cells = ti.Vector([free.shape[0], free.shape[1], free.shape[2]])
    to_cells = 0.5 * ti.cast(cells, float)
    ti.loop_config(parallelize=n_threads, block_dim=1)
    for thread in range(n_threads):
        for i in range(n_rays * thread // n_threads, n_rays * (thread + 1) // n_threads):
            o, d = origins[i], directions[i]
            a, b = (-1.0 - o) / d, (1.0 - o) / d
            enter, leave = ti.max(ti.min(a, b).max(), 0.0), ti.max(a, b).min()
            fastest = (ti.abs(d) * to_cells).max() * step

            rgb, light, n = vec3(0.0), 1.0, 0
            k = ti.max(0, int(enter / step) - 1)
            end = ti.min(n_steps, int(ti.max(leave, 0.0) / step) + 2)
            while k < end and enter <= leave:
                t = (k + 0.5) * step
                q = o + t * d
                k += 1
                needed = ti.abs(q).max() <= 1.0
                if ti.static(skips):
                    if needed:
                        c = ti.min(ti.cast((q + 1.0) * to_cells, int), cells - 1)
                        distance = int(free[c[0], c[1], c[2]])
                        if distance > 0:
                            needed = False
                            k += ti.max(0, int((distance - 1) / fastest) - 1)
                if needed:
                    u = (q + 1.0) * to_nodes
                    lowest = ti.min(ti.cast(u, int), size - 2)
                    f = u - lowest
                    node = lowest[0] * stride_x + lowest[1] * stride_y + lowest[2]
                    raw = gather(values, node, stride_x, stride_y, f)
                    x = raw[0] + DENSITY_SHIFT
                    e = ti.exp(-ti.abs(x))
                    tau = (ti.max(x, 0.0) + log1p(e)) * step
                    attenuation = ti.exp(-tau)
                    alpha = 1.0 - attenuation
                    if tau < 0.01:
                        alpha = tau * (1.0 - tau * (0.5 - tau * (1.0 / 6.0 - tau / 24.0)))
                    c = 1.0 / (1.0 + ti.exp(-vec3(raw[1], raw[2], raw[3])))
                    weight = light * alpha
                    rgb += weight * c
                    light *= attenuation
                    slope = ti.select(x >= 0.0, 1.0, e) / (1.0 + e)
                    bits = ti.bit_cast(node, ti.f32)
                    kept[thread, n] = Kept(f, t, slope, attenuation, weight, c, bits)
                    n += 1
            rgb += light * background
            out_rgb[i] = rgb

            adj_rgb = 2.0 / n_rays * (rgb - target_rgb[i])
            behind = adj_rgb.dot(rgb)
            light = 1.0
            for s in range(n):
                sample = kept[thread, s]
                c = vec3(sample[7], sample[8], sample[9])
                light *= sample[5]
                adj_weight = adj_rgb.dot(c)
                behind -= sample[6] * adj_weight
                scale = 1.0
                if ti.static(scaled):
                    ratio = sample[3] / content_distance
                    scale = ti.min(1.0, ratio * ratio)
                adj_density = scale * step * sample[4] * (light * adj_weight - behind)
                adj = vec4(adj_density, scale * sample[6] * adj_rgb * c * (1.0 - c))
                adj_gather(
                    gradients,
                    touched,
                    thread,
                    ti.bit_cast(sample[10], ti.i32),
                    stride_x,
                    stride_y,
                    vec3(sample[0], sample[1], sample[2]),
                    adj,
                )
    ti.loop_config(parallelize=n_threads)
    for tile in range(touched.shape[0]):
        if has_gradient(touched, tile):
            for other in range(1, n_threads):
                for at in range(tile * TILE, ti.min((tile + 1) * TILE, gradients.shape[1])):
                    gradients[0, at] = gradients[0, at] + gradients[other, at]
                    gradients[other, at] = vec4(0.0)


class TaichiStep:
    """A workload's training step in Taichi."""

    def __init__(self, work: Workload, threads: int, device: str) -> None:
        """Load a workload; Taichi itself starts with the first."""
        if ti.lang.impl.get_runtime().prog is None:
            with contextlib.redirect_stdout(io.StringIO()):  # it says hello
                ti.init(ti.cpu, fast_math=True, cpu_max_num_threads=os.cpu_count())
        self._shape = work.values.shape
        n_nodes = math.prod(self._shape[:3])

        def load(array: np.ndarray, dtype: Any, shape: tuple[int, ...]) -> ti.Ndarray:
            loaded = ti.ndarray(dtype, shape)
            loaded.from_numpy(np.ascontiguousarray(array))
            return loaded

        n_rays = len(work.origins)
        self._threads = threads
        self._gradients = ti.ndarray(vec4, (threads, n_nodes))
        self._touched = ti.ndarray(ti.u8, -(-n_nodes // TILE))
        self._rgb = ti.ndarray(vec3, n_rays)
        self._arguments = (
            threads,
            *self._shape[:3],
            work.n_steps,
            work.step,
            work.skips,
            work.scaled,
            work.content_distance,
            vec3(*work.background),
            load(work.values.reshape(-1, 4), vec4, (n_nodes,)),
            load(work.free, ti.u8, work.free.shape),
            load(work.origins, vec3, (n_rays,)),
            load(work.directions, vec3, (n_rays,)),
            load(work.target_rgb, vec3, (n_rays,)),
            ti.ndarray(Kept, (threads, work.n_steps)),
            self._gradients,
            self._touched,
            self._rgb,
        )

    def step(self) -> None:
        """Forward, loss and adjoint."""
        clear(self._threads, self._gradients, self._touched)
        train(*self._arguments)
        ti.sync()

    def gradient(self) -> np.ndarray:
        """[X, Y, Z, 4]"""
        return self._gradients.to_numpy()[0].reshape(self._shape)

    def rgb(self) -> np.ndarray:
        """[n_rays, 3]"""
        return self._rgb.to_numpy()


def obstacle(device: str) -> str | None:
    """These kernels are for the CPU."""
    return "runs on the CPU only" if device.startswith("cuda") else None


load = TaichiStep
