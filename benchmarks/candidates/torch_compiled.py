"""torch.compile: positions packed by eager torch, everything else one compiled function.

The adjoint is written by hand and the grid read by index, so that the compiler sees all of it and
fuses reading with shading and compositing. Tried and slower on one thread, by a fifth to a half:
autograd through the same function, grid_sample and its adjoint, samples of varying number. The
number of samples is fixed here, so it compiles once for each workload.
"""

from __future__ import annotations

import importlib.util
import itertools
import os
import shutil

import numpy as np
import torch
import torch.nn.functional as F
from workload import DENSITY_SHIFT, Workload

from candidates.torch_eager import TorchScene


class CompiledStep:
    """A workload's training step in compiled torch."""

    def __init__(self, work: Workload, threads: int, device: str) -> None:
        """Load a workload."""
        self._work = work
        self._threads = threads
        self._scene = TorchScene(work.values, work.free, 1, device)
        self._origins, self._directions, self._target_rgb = (
            torch.from_numpy(array).to(device)
            for array in (work.origins, work.directions, work.target_rgb)
        )
        self._values = torch.from_numpy(work.values.reshape(-1, 4)).to(device)
        self._steps = (torch.arange(work.n_steps, device=device) + 0.5) * work.step
        self._last = torch.tensor(work.values.shape[:3], device=device) - 1
        self._background = torch.tensor(work.background, device=device)
        # Workloads differ in shape and in threads; each is compiled again.
        torch._dynamo.config.recompile_limit = 256
        self._compiled = torch.compile(self._shade_and_back, dynamic=False)
        self._gradient = self._rgb = torch.empty(0)

    def step(self) -> None:
        """Forward, loss and adjoint."""
        torch.set_num_threads(self._threads)
        with torch.no_grad():
            index, t, q, _ = self._scene.samples(self._origins, self._directions, self._steps)
            self._gradient, self._rgb = self._compiled(self._values, index, t, q)

    def _shade_and_back(
        self,
        values: torch.Tensor,  # [X * Y * Z, 4]
        index: torch.Tensor,  # [n_samples] in [n_rays, n_steps], flattened
        t: torch.Tensor,  # [n_samples]
        q: torch.Tensor,  # [n_samples, 3]
    ) -> tuple[torch.Tensor, torch.Tensor]:
        work = self._work
        n_rays, n_steps = self._origins.shape[0], work.n_steps
        stride_x, stride_y = work.values.shape[1] * work.values.shape[2], work.values.shape[2]

        u = (q + 1.0) * (0.5 * self._last)
        node = torch.minimum(u.long(), self._last - 1)
        far = u - node
        near = 1.0 - far
        base = node[:, 0] * stride_x + node[:, 1] * stride_y + node[:, 2]
        corners = [
            (base + a * stride_x + b * stride_y + c, x[:, 0] * y[:, 1] * z[:, 2])
            for (a, x), (b, y), (c, z) in itertools.product(enumerate((near, far)), repeat=3)
        ]
        raw = sum(share[:, None] * values[at] for at, share in corners)
        raw_density = raw[:, 0] + DENSITY_SHIFT
        sample_rgb = torch.sigmoid(raw[:, 1:])

        # Composite, [n_rays, n_steps] with empty entries.
        tau = q.new_zeros(n_rays * n_steps)
        tau = tau.index_copy(0, index, F.softplus(raw_density) * work.step).view(n_rays, n_steps)
        rgb = q.new_zeros(n_rays * n_steps, 3)
        rgb = rgb.index_copy(0, index, sample_rgb).view(n_rays, n_steps, 3)
        depth = tau.cumsum(1)
        weight = torch.exp(tau - depth) * -torch.expm1(-tau)
        seen = (weight[..., None] * rgb).sum(1) + torch.exp(-depth[:, -1:]) * self._background

        # And back: dL/dsigma_i = dt (T_{i+1} G_i - what lies behind), G_i = <adj_rgb, c_i>.
        adj_rgb = 2.0 / n_rays * (seen - self._target_rgb)
        adj_weight = (rgb * adj_rgb[:, None]).sum(2)
        behind = (adj_rgb * seen).sum(1, keepdim=True) - (weight * adj_weight).cumsum(1)
        adj_sigma = work.step * (torch.exp(-depth) * adj_weight - behind)
        adj_density = adj_sigma.view(-1)[index] * torch.sigmoid(raw_density)
        adj_sample = weight.view(-1)[index][:, None] * adj_rgb[index // n_steps]
        adj_raw = torch.cat(
            [adj_density[:, None], adj_sample * sample_rgb * (1.0 - sample_rgb)], dim=1
        )
        if work.scaled:
            adj_raw = adj_raw * (t / work.content_distance).square().clamp(max=1.0)[:, None]
        gradient = torch.zeros_like(values)
        for at, share in corners:
            gradient = gradient.index_add(0, at, share[:, None] * adj_raw)
        return gradient, seen

    def gradient(self) -> np.ndarray:
        """[X, Y, Z, 4]"""
        return self._gradient.cpu().numpy().reshape(self._work.values.shape)

    def rgb(self) -> np.ndarray:
        """[n_rays, 3]"""
        return self._rgb.cpu().numpy()


def obstacle(device: str) -> str | None:
    """On the CPU it compiles C++, on CUDA Triton."""
    if device.startswith("cuda"):
        return None if importlib.util.find_spec("triton") else "triton is not installed"
    compilers = (os.environ.get("CXX"), "g++", "clang++")
    if not any(shutil.which(compiler) for compiler in compilers if compiler):
        return "there is no C++ compiler"
    return None


load = CompiledStep
