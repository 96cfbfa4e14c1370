"""Dr.Jit on LLVM: two recorded loops over the steps, all rays at once, adjoint by hand.

The adjoint reads samples again: keeping them in memory was no faster on a 64^3 grid, and took 1.4
times as long on 160^3. Scattering is expanded, Dr.Jit's word for a copy of the gradient for each
thread; atomic, or reduced within a packet, the step takes three to five times as long. It is
frozen, which saves tracing it again.
"""

from __future__ import annotations

import math

import drjit as dr
import numpy as np
from drjit.llvm import Array3f, Array3i, Array4f, Bool, Float, Int, UInt
from workload import DENSITY_SHIFT, Workload


def larger(a: Float, b: Float | float) -> Float:
    """Of each pair. Not dr.maximum: LLVM before 16 cannot select it for every vector."""
    return dr.select(a > b, a, b)


def smaller(a: Float, b: Float | float) -> Float:
    """Of each pair."""
    return dr.select(a < b, a, b)


def log1p(y: Float) -> Float:
    """log(1 + y) = 2 artanh(y / (2 + y)), for y in [0, 1]; relative error 1e-7."""
    z = y / (2.0 + y)
    z2 = z * z
    p = dr.fma(z2, dr.fma(z2, 0.281577796, 0.279651582), 0.400245965)
    return z * dr.fma(z2, dr.fma(z2, p, 0.666663229), 2.0)


class DrJitStep:
    """A workload's training step in Dr.Jit."""

    def __init__(self, work: Workload, threads: int, device: str) -> None:
        """Load a workload."""
        self._work = work
        self._threads = threads
        nodes = work.values.shape[:3]
        self._last = Array3i(*(n - 2 for n in nodes))
        self._to_nodes = Array3f(*(0.5 * (n - 1) for n in nodes))
        self._strides = (nodes[1] * nodes[2], nodes[2])
        self._last_cell = Array3i(*(n - 1 for n in work.free.shape))
        self._to_cells = Array3f(*(0.5 * n for n in work.free.shape))
        self._values = Float(work.values.ravel())
        self._free = UInt(work.free.ravel().astype(np.uint32))
        self._rays = tuple(
            Array3f(np.ascontiguousarray(array.T))
            for array in (work.origins, work.directions, work.target_rgb)
        )
        self._frozen = dr.freeze(self._step)
        self._gradient, self._rgb = Float(), Array3f()

    def step(self) -> None:
        """Forward, loss and adjoint."""
        dr.set_thread_count(self._threads)
        self._gradient, self._rgb = self._frozen(self._values, self._free, *self._rays)
        dr.eval(self._gradient, self._rgb)
        dr.sync_thread()

    def _step(
        self,
        values: Float,  # [X * Y * Z * 4]
        free: UInt,  # [MX * MY * MZ]
        origins: Array3f,
        directions: Array3f,
        target_rgb: Array3f,
    ) -> tuple[Float, Array3f]:
        work = self._work
        n_rays = len(work.origins)
        a, b = (-1.0 - origins) / directions, (1.0 - origins) / directions
        near, far = smaller(a, b), larger(a, b)
        enter = larger(larger(near.x, larger(near.y, near.z)), 0.0)
        leave = smaller(far.x, smaller(far.y, far.z))
        first = Int(enter / work.step) - 1
        first = dr.select(first > 0, first, 0)
        end = Int(larger(leave, 0.0) / work.step) + 2
        end = dr.select(enter <= leave, dr.select(end < work.n_steps, end, work.n_steps), 0)

        def forward(k: Int, light: Float, rgb: Array3f) -> tuple[Int, Float, Array3f]:
            needed, k_next, _, node, fraction = self._sample(k, origins, directions, free)
            _, attenuation, alpha, c = self._shade(values, node, fraction, needed)
            rgb = dr.fma(c, dr.select(needed, light * alpha, 0.0), rgb)
            return k_next, dr.select(needed, light * attenuation, light), rgb

        _, light, rgb = dr.while_loop(
            (Int(first), dr.full(Float, 1.0, n_rays), dr.zeros(Array3f, n_rays)),
            lambda k, light, rgb: k < end,
            forward,
        )
        rgb = dr.fma(Array3f(*work.background), light, rgb)
        adj_rgb = 2.0 / n_rays * (rgb - target_rgb)
        gradient = dr.zeros(Float, math.prod(work.values.shape))

        def backward(k: Int, light: Float, behind: Float) -> tuple[Int, Float, Float]:
            needed, k_next, t, node, fraction = self._sample(k, origins, directions, free)
            slope, attenuation, alpha, c = self._shade(values, node, fraction, needed)
            weight = dr.select(needed, light * alpha, 0.0)
            light = dr.select(needed, light * attenuation, light)
            adj_weight = dr.dot(adj_rgb, c)
            behind -= weight * adj_weight
            scale = Float(1.0)
            if work.scaled:
                scale = smaller(dr.square(t / work.content_distance), 1.0)
            adj_density = scale * work.step * slope * (light * adj_weight - behind)
            adj = scale * weight * adj_rgb * c * (1.0 - c)
            adj_raw = Array4f(adj_density, adj.x, adj.y, adj.z)
            for share, at in self._columns(node, fraction):
                high = (share * fraction.z) * adj_raw
                low = dr.fma(share, adj_raw, -high)
                dr.scatter_add(gradient, low, at, needed, dr.ReduceMode.Expand)
                dr.scatter_add(gradient, high, at + 1, needed, dr.ReduceMode.Expand)
            return k_next, light, behind

        dr.while_loop(
            (Int(first), dr.full(Float, 1.0, n_rays), dr.dot(adj_rgb, rgb)),
            lambda k, light, behind: k < end,
            backward,
        )
        return gradient, rgb

    def _sample(
        self, k: Int, origins: Array3f, directions: Array3f, free: UInt
    ) -> tuple[Bool, Int, Float, UInt, Array3f]:
        """Whether step k needs sampling; the next to look at; t, lowest node, fraction."""
        work = self._work
        t = (Float(k) + 0.5) * work.step
        q = dr.fma(directions, t, origins)
        needed = (dr.abs(q.x) <= 1.0) & (dr.abs(q.y) <= 1.0) & (dr.abs(q.z) <= 1.0)
        k = k + 1
        if work.skips:
            cell = dr.clip(Array3i((q + 1.0) * self._to_cells), 0, self._last_cell)
            flat = (cell.x * work.free.shape[1] + cell.y) * work.free.shape[2] + cell.z
            distance = dr.gather(UInt, free, UInt(flat), needed)
            speed = dr.abs(directions) * self._to_cells * work.step
            fastest = larger(speed.x, larger(speed.y, speed.z))
            leap = Int(Float(Int(distance) - 1) / fastest) - 1
            k = dr.select(leap > 0, k + leap, k)
            needed &= distance == 0
        u = (q + 1.0) * self._to_nodes
        lowest = dr.clip(Array3i(u), 0, self._last)
        node = lowest.x * self._strides[0] + lowest.y * self._strides[1] + lowest.z
        return needed, k, t, UInt(node), u - Array3f(lowest)

    def _columns(self, node: UInt, fraction: Array3f) -> list[tuple[Float, UInt]]:
        """Shares and lower nodes of the four columns around a point."""
        f, g = fraction, 1.0 - fraction
        x, y = self._strides
        return [
            (g.x * g.y, node),
            (g.x * f.y, node + y),
            (f.x * g.y, node + x),
            (f.x * f.y, node + (x + y)),
        ]

    def _shade(
        self, values: Float, node: UInt, fraction: Array3f, needed: Bool
    ) -> tuple[Float, Float, Float, Array3f]:
        """Slope of the density, exp(-tau), opacity and colour at samples."""
        low, high = Array4f(0.0), Array4f(0.0)
        for share, at in self._columns(node, fraction):
            low = dr.fma(dr.gather(Array4f, values, at, needed), share, low)
            high = dr.fma(dr.gather(Array4f, values, at + 1, needed), share, high)
        raw = dr.fma(high - low, fraction.z, low)
        x = raw[0] + DENSITY_SHIFT
        e = dr.exp(-dr.abs(x))
        tau = (larger(x, 0.0) + log1p(e)) * self._work.step
        attenuation = dr.exp(-tau)
        series = tau * (1.0 - tau * (0.5 - tau * (1.0 / 6.0 - tau * (1.0 / 24.0))))
        return (
            dr.select(x >= 0.0, 1.0, e) / (1.0 + e),
            attenuation,
            dr.select(tau < 0.01, series, 1.0 - attenuation),
            dr.rcp(1.0 + dr.exp(-Array3f(raw[1], raw[2], raw[3]))),
        )

    def gradient(self) -> np.ndarray:
        """[X, Y, Z, 4]"""
        return self._gradient.numpy().reshape(self._work.values.shape)

    def rgb(self) -> np.ndarray:
        """[n_rays, 3]"""
        return self._rgb.numpy().T


def obstacle(device: str) -> str | None:
    """It needs LLVM's library, which it does not bring along."""
    if device.startswith("cuda"):
        return "runs on the CPU only"
    if not dr.has_backend(dr.JitBackend.LLVM):
        return "Dr.Jit finds no LLVM library"
    return None


load = DrJitStep
