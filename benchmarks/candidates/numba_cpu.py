"""numba: parallel over threads with gradients of their own, adjoint by hand, samples kept.

A ray is taken in phases, each a loop over its samples on plain rows of numbers: LLVM makes vectors
of all but the walk and the sequential sums. For that the exponential has to be arithmetic (0.15 ns)
instead of a call (3.6 ns), indices unsigned (a signed one may count from the end) and the eight
numbers of a column written out; these two halve the time of what is left. One core of an AMD EPYC,
64^3 grid.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numba import njit, prange
from workload import DENSITY_SHIFT, Workload

F, S, U = np.float32, np.int32, np.uintp
"""Numbers, signed and unsigned integers: every constant is wrapped, or it would all be float64."""
TILE = U(16)
"""Nodes in a run along z that are zeroed and summed together, if any was touched."""
RUN = 4 * int(TILE)
"""Numbers in it."""
T, FX, FY, FZ, ATTENUATION, ALPHA, WEIGHT, LIGHT, BACK, RAW, N_ROWS = range(11)
"""Rows of a thread's scratch; from RAW on four, for density and colour."""


class Scene(NamedTuple):
    """What all rays share."""

    values: np.ndarray  # [X * Y * Z * 4]
    size: np.ndarray  # [3] int32
    to_nodes: np.ndarray  # [3]
    free: np.ndarray  # [MX, MY, MZ] cells to the nearest that is not
    to_cells: np.ndarray  # [3]
    skips: bool
    n_steps: int
    step: np.float32
    background: np.ndarray  # [3]
    scaled: bool
    content_distance: np.float32


@njit(fastmath=True, inline="always")
def exponential(x):
    """2^n exp(r) with a polynomial for |r| <= log(2) / 2; relative error 1e-7."""
    x = min(max(x, F(-87.0)), F(88.0))
    n = np.rint(x * F(1.44269504))
    r = x - n * F(0.693359375) + n * F(2.12194440e-4)
    p = F(1.39261840e-3) * r + F(8.36317893e-3)
    p = p * r + F(4.16665561e-2)
    p = p * r + F(1.66665763e-1)
    p = (p * r + F(0.5)) * (r * r) + r + F(1.0)
    return p * S((S(n) + S(127)) << S(23)).view(F)


@njit(fastmath=True, inline="always")
def log1p(y):
    """log(1 + y) = 2 artanh(y / (2 + y)), for y in [0, 1]; relative error 1e-7."""
    z = y / (F(2.0) + y)
    z2 = z * z
    p = F(0.281577796) * z2 + F(0.279651582)
    p = (p * z2 + F(0.400245965)) * z2 + F(0.666663229)
    return z * (p * z2 + F(2.0))


@njit(fastmath=True, inline="always")
def sigmoid(x):
    return F(1.0) / (F(1.0) + exponential(-x))


@njit(fastmath=True, error_model="numpy")
def walk(scene, o, d, rows, base):
    """Where the ray needs samples: fills rows T to FZ and base, returns how many."""
    enter, leave, fastest = F(0.0), F(1e30), F(0.0)
    for axis in range(3):
        a, b = (F(-1.0) - o[axis]) / d[axis], (F(1.0) - o[axis]) / d[axis]
        enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
        fastest = max(fastest, abs(d[axis]) * scene.to_cells[axis] * scene.step)
    if enter > leave:
        return 0
    mx, my, mz = scene.free.shape
    n = 0
    k = max(S(0), S(enter / scene.step) - S(1))
    end = min(S(scene.n_steps), S(leave / scene.step) + S(2))
    while k < end:
        t = (F(k) + F(0.5)) * scene.step
        x, y, z = o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]
        k += S(1)
        if max(abs(x), abs(y), abs(z)) > F(1.0):
            continue
        x, y, z = x + F(1.0), y + F(1.0), z + F(1.0)
        if scene.skips:
            ix = min(S(x * scene.to_cells[0]), S(mx - 1))
            iy = min(S(y * scene.to_cells[1]), S(my - 1))
            iz = min(S(z * scene.to_cells[2]), S(mz - 1))
            cells = S(scene.free[ix, iy, iz])
            if cells > S(0):
                k += max(S(0), S(F(cells - S(1)) / fastest) - S(1))
                continue
        x, y, z = x * scene.to_nodes[0], y * scene.to_nodes[1], z * scene.to_nodes[2]
        ix = min(S(x), scene.size[0] - S(2))
        iy = min(S(y), scene.size[1] - S(2))
        iz = min(S(z), scene.size[2] - S(2))
        rows[T, n] = t
        rows[FX, n], rows[FY, n], rows[FZ, n] = x - F(ix), y - F(iy), z - F(iz)
        base[n] = (ix * scene.size[1] + iy) * scene.size[2] + iz
        n += 1
    return n


@njit(fastmath=True, error_model="numpy")
def gather(scene, n, rows, base):
    """The grid at the samples, into rows RAW to RAW + 3."""
    v = scene.values
    y = U(4) * U(scene.size[2])
    x = y * U(scene.size[1])
    for s in range(n):
        fx, fy, fz = rows[FX, s], rows[FY, s], rows[FZ, s]
        gx, gy = F(1.0) - fx, F(1.0) - fy
        near, far = U(4) * U(base[s]), U(4) * U(base[s]) + x
        for c in range(4):
            low, high = U(c), U(c) + U(4)
            a = gx * (gy * v[near + low] + fy * v[near + y + low])
            a += fx * (gy * v[far + low] + fy * v[far + y + low])
            b = gx * (gy * v[near + high] + fy * v[near + y + high])
            b += fx * (gy * v[far + high] + fy * v[far + y + high])
            rows[RAW + c, s] = a + fz * (b - a)


@njit(fastmath=True, error_model="numpy")
def shade(scene, n, rows):
    """Raw values to density and colour; row RAW becomes the slope of the density."""
    for s in range(n):
        x = rows[RAW, s] + F(DENSITY_SHIFT)
        e = exponential(-abs(x))
        tau = (max(x, F(0.0)) + log1p(e)) * scene.step
        rows[RAW, s] = (F(1.0) if x >= F(0.0) else e) / (F(1.0) + e)
        attenuation = exponential(-tau)
        series = tau * (F(1.0) - tau * (F(0.5) - tau * (F(1.0 / 6.0) - tau * F(1.0 / 24.0))))
        rows[ATTENUATION, s] = attenuation
        rows[ALPHA, s] = series if tau < F(0.01) else F(1.0) - attenuation
        rows[RAW + 1, s] = sigmoid(rows[RAW + 1, s])
        rows[RAW + 2, s] = sigmoid(rows[RAW + 2, s])
        rows[RAW + 3, s] = sigmoid(rows[RAW + 3, s])


@njit(fastmath=True, error_model="numpy")
def composite_and_back(scene, n, rows, target, loss_weight, out_rgb):
    """Colour of the ray, and from there to the gradients of raw values, in rows RAW to RAW + 3."""
    light = F(1.0)
    for s in range(n):
        rows[WEIGHT, s] = light * rows[ALPHA, s]
        light *= rows[ATTENUATION, s]
        rows[LIGHT, s] = light
    red, green, blue = F(0.0), F(0.0), F(0.0)
    for s in range(n):
        red += rows[WEIGHT, s] * rows[RAW + 1, s]
        green += rows[WEIGHT, s] * rows[RAW + 2, s]
        blue += rows[WEIGHT, s] * rows[RAW + 3, s]
    out_rgb[0] = red + light * scene.background[0]
    out_rgb[1] = green + light * scene.background[1]
    out_rgb[2] = blue + light * scene.background[2]

    two = F(2.0) * loss_weight
    adj_red, adj_green = two * (out_rgb[0] - target[0]), two * (out_rgb[1] - target[1])
    adj_blue = two * (out_rgb[2] - target[2])
    for s in range(n):
        rows[BACK, s] = adj_red * rows[RAW + 1, s] + adj_green * rows[RAW + 2, s]
        rows[BACK, s] += adj_blue * rows[RAW + 3, s]
    behind = adj_red * scene.background[0] + adj_green * scene.background[1]
    behind = light * (behind + adj_blue * scene.background[2])
    for s in range(n - 1, -1, -1):
        adj_weight = rows[BACK, s]
        rows[BACK, s] = rows[LIGHT, s] * adj_weight - behind
        behind += rows[WEIGHT, s] * adj_weight
    for s in range(n):
        ratio = rows[T, s] / scene.content_distance
        scale = min(F(1.0), ratio * ratio) if scene.scaled else F(1.0)
        weight = scale * rows[WEIGHT, s]
        r, g, b = rows[RAW + 1, s], rows[RAW + 2, s], rows[RAW + 3, s]
        rows[RAW, s] *= scale * scene.step * rows[BACK, s]
        rows[RAW + 1, s] = weight * adj_red * r * (F(1.0) - r)
        rows[RAW + 2, s] = weight * adj_green * g * (F(1.0) - g)
        rows[RAW + 3, s] = weight * adj_blue * b * (F(1.0) - b)


@njit(fastmath=True, inline="always")
def add_column(out, at, share, a, b, c, d, e, f, g, h):
    """Add to two nodes that lie side by side: all is read before anything is written."""
    a, b = out[at] + share * a, out[at + U(1)] + share * b
    c, d = out[at + U(2)] + share * c, out[at + U(3)] + share * d
    e, f = out[at + U(4)] + share * e, out[at + U(5)] + share * f
    g, h = out[at + U(6)] + share * g, out[at + U(7)] + share * h
    out[at], out[at + U(1)], out[at + U(2)], out[at + U(3)] = a, b, c, d
    out[at + U(4)], out[at + U(5)], out[at + U(6)], out[at + U(7)] = e, f, g, h


@njit(fastmath=True, error_model="numpy")
def adj_gather(scene, n, rows, base, out, touched):
    """Hand the gradients in rows RAW to RAW + 3 to the nodes."""
    y = U(scene.size[2])
    x = y * U(scene.size[1])
    for s in range(n):
        fx, fy, fz = rows[FX, s], rows[FY, s], rows[FZ, s]
        gx, gy = F(1.0) - fx, F(1.0) - fy
        e, f = fz * rows[RAW, s], fz * rows[RAW + 1, s]
        g, h = fz * rows[RAW + 2, s], fz * rows[RAW + 3, s]
        a, b = rows[RAW, s] - e, rows[RAW + 1, s] - f
        c, d = rows[RAW + 2, s] - g, rows[RAW + 3, s] - h
        node = U(base[s])
        add_column(out, U(4) * node, gx * gy, a, b, c, d, e, f, g, h)
        add_column(out, U(4) * (node + y), gx * fy, a, b, c, d, e, f, g, h)
        add_column(out, U(4) * (node + x), fx * gy, a, b, c, d, e, f, g, h)
        add_column(out, U(4) * (node + x + y), fx * fy, a, b, c, d, e, f, g, h)
        for at in (node, node + y, node + x, node + x + y):
            if not touched[at // TILE]:  # a write would take the line away from other threads
                touched[at // TILE] = True


@njit(inline="always")
def has_gradient(touched, tile):
    """Whether a tile's nodes may have been added to: columns begin in it, or in the one before."""
    return touched[tile] or (tile > 0 and touched[tile - 1])


@njit(parallel=True, fastmath=True, error_model="numpy")
def train(scene, origins, directions, target_rgb, gradients, touched, rows, base, out_rgb):
    """One step: the sum of the threads' gradients is left in the first's, the others zeroed."""
    n_threads, n_numbers = gradients.shape
    n_rays = len(origins)
    for tile in prange(touched.size):
        if has_gradient(touched, tile):
            gradients[0, tile * RUN : (tile + 1) * RUN] = F(0.0)
    touched[:] = False
    for thread in prange(n_threads):
        for i in range(n_rays * thread // n_threads, n_rays * (thread + 1) // n_threads):
            n = walk(scene, origins[i], directions[i], rows[thread], base[thread])
            gather(scene, n, rows[thread], base[thread])
            shade(scene, n, rows[thread])
            composite_and_back(
                scene, n, rows[thread], target_rgb[i], F(1.0) / F(n_rays), out_rgb[i]
            )
            adj_gather(scene, n, rows[thread], base[thread], gradients[thread], touched)
    for tile in prange(touched.size):
        if has_gradient(touched, tile):
            for other in range(1, n_threads):
                for at in range(tile * RUN, min((tile + 1) * RUN, n_numbers)):
                    gradients[0, at] += gradients[other, at]
                    gradients[other, at] = F(0.0)


class NumbaStep:
    """A workload's training step in numba."""

    def __init__(self, work: Workload, threads: int, device: str) -> None:
        """Load a workload."""
        self._threads = threads
        self._shape = work.values.shape
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
        self._gradients = np.zeros((threads, work.values.size), F)
        self._rgb = np.zeros_like(work.origins)
        self._arguments = (
            scene,
            work.origins,
            work.directions,
            work.target_rgb,
            self._gradients,
            np.zeros(-(-work.values.size // RUN), np.bool_),
            np.zeros((threads, N_ROWS + 3, work.n_steps), F),
            np.zeros((threads, work.n_steps), S),
            self._rgb,
        )

    def step(self) -> None:
        """Forward, loss and adjoint."""
        numba.set_num_threads(self._threads)
        train(*self._arguments)

    def gradient(self) -> np.ndarray:
        """[X, Y, Z, 4]"""
        return self._gradients[0].reshape(self._shape)

    def rgb(self) -> np.ndarray:
        """[n_rays, 3]"""
        return self._rgb


def obstacle(device: str) -> str | None:
    """These kernels are for the CPU."""
    return "runs on the CPU only" if device.startswith("cuda") else None


load = NumbaStep
