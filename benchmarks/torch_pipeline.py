"""The rendering and its adjoint in eager torch, as well as we can write it; what we compare with.

Measures nothing by itself: gradient_scaling.py and throughput.py run it. Positions of the samples
in the box are packed, the grid is read by grid_sample, compositing uses cumulated optical depth,
autograd does the rest. What was tried for the grid, forward + backward of 524 288 samples on one
core of an AMD EPYC (Zen 5), 64^3 and 160^3 grids:

    grid_sample, channels last                    68 ms    144 ms
    grid_sample, channels first                   70 ms    180 ms
    embedding_bag, index_add for the adjoint     106 ms    156 ms
    index_select, sum over corners               197 ms    239 ms
    embedding, sum over corners                  334 ms    387 ms
    embedding_bag                                375 ms    403 ms

so it is grid_sample, channels last. On the CPU torch runs it in parallel over the batch only;
`split` cuts the samples into a batch that shares one grid. Its adjoint then makes a gradient grid
for each and adds them, which on a busy machine or a large grid costs more than it brings: whether
to split, on how many threads to run, and how to composite is decided by timing: see
`fastest_by_threads`.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
import torch.nn.functional as F
from workload import DENSITY_SHIFT, Workload

Compositing = Literal["padded", "segmented"]


class ScaleGradient(torch.autograd.Function):
    """The paper's operation: identity forward, gradients times min(1, (t / D)^2) backward."""

    @staticmethod
    def forward(
        ctx: Any,
        rgb: torch.Tensor,  # [n_samples, 3]
        sigma: torch.Tensor,  # [n_samples]
        t: torch.Tensor,  # [n_samples] scene units
        content_distance: float,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        ctx.save_for_backward(t)
        ctx.content_distance = content_distance
        return rgb, sigma

    @staticmethod
    def backward(ctx: Any, *adj: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        adj_rgb, adj_sigma = adj
        (t,) = ctx.saved_tensors
        scale = (t / ctx.content_distance).square().clamp(max=1.0)
        return adj_rgb * scale[:, None], adj_sigma * scale, None, None


@dataclass(frozen=True, kw_only=True)
class Choices:
    """What can be done in more than one way."""

    compositing: Compositing = "padded"
    """padded: [n_rays, n_steps] with empty entries; segmented: one cumulated sum over all."""
    split: int = 1
    """Parts into which the samples are cut, so that grid_sample runs in parallel."""
    threads: int = 1
    """torch.set_num_threads."""


class TorchPipeline:
    """A workload, rendered by torch."""

    def __init__(self, work: Workload, scaled: bool, choices: Choices, device: str = "cpu") -> None:
        """Load a workload.

        Args:
            work: What to render.
            scaled: Whether the paper's operation is there.
            choices: The rest.
            device: As torch names it.
        """

        def load(array: np.ndarray) -> torch.Tensor:
            return torch.from_numpy(array).to(device)

        self._work = work
        self._scaled = scaled
        self.choices = choices
        self.values = (
            load(np.ascontiguousarray(work.values.transpose(3, 0, 1, 2)))[None]
            .to(memory_format=torch.channels_last_3d)
            .requires_grad_()
        )
        """[1, 4, X, Y, Z] raw density, raw rgb."""
        self._origins = load(work.origins)
        self._directions = load(work.directions)
        self._target_rgb = load(work.target_rgb)
        self._background = torch.tensor(work.background, device=device)

    def render(self) -> torch.Tensor:
        """The rays' colours, [n_rays, 3]."""
        work = self._work
        o, d = self._origins, self._directions
        n_rays, n_steps = o.shape[0], work.n_steps
        with torch.no_grad():
            steps = (torch.arange(n_steps, device=o.device) + 0.5) * work.step
            at_faces = torch.stack([(-1.0 - o) / d, (1.0 - o) / d])
            t_enter = at_faces.amin(0).amax(1)
            t_exit = at_faces.amax(0).amin(1)
            inside = (steps >= t_enter[:, None]) & (steps <= t_exit[:, None])
            index = inside.view(-1).nonzero().view(-1)
            n = index.shape[0]
            full = n == n_rays * n_steps  # then what is packed is what is padded
            if full:
                ray = index
                t = steps.expand(n_rays, n_steps).reshape(-1)
                q = torch.addcmul(o[:, None], steps[:, None], d[:, None]).view(-1, 3)
            else:
                ray = index // n_steps
                t = steps[index - ray * n_steps]
                q = torch.addcmul(o[ray], t[:, None], d[ray])

        raw = self._read(q.flip(-1))
        sigma = F.softplus(raw[:, 0] + DENSITY_SHIFT)
        rgb = torch.sigmoid(raw[:, 1:])
        if self._scaled:
            rgb, sigma = ScaleGradient.apply(rgb, sigma, t, work.content_distance)
        tau = sigma * work.step

        if self.choices.compositing == "padded":
            if not full:
                tau = tau.new_zeros(n_rays * n_steps).index_copy(0, index, tau)
                rgb = rgb.new_zeros(n_rays * n_steps, 3).index_copy(0, index, rgb)
            tau = tau.view(n_rays, n_steps)
            depth = tau.cumsum(1)
            weight = torch.exp(tau - depth) * -torch.expm1(-tau)
            seen = torch.bmm(weight[:, None], rgb.view(n_rays, n_steps, 3))[:, 0]
            passed = torch.exp(-depth[:, -1])
        else:
            if full:
                ray = ray // n_steps
            # In float64: over all rays the sum grows too large for float32.
            depth = tau.double().cumsum(0)
            depth = F.pad(depth, (1, 0))
            counts = inside.sum(1)
            end = counts.cumsum(0)
            begin = depth[end - counts]
            weight = torch.exp((begin[ray] - depth[:-1]).float()) * -torch.expm1(-tau)
            seen = rgb.new_zeros(n_rays, 3).index_add(0, ray, weight[:, None] * rgb)
            passed = torch.exp((begin - depth[end]).float())
        return seen + passed[:, None] * self._background

    def _read(self, q: torch.Tensor) -> torch.Tensor:
        """The grid at q [n, 3], z first: [n, 4]."""
        n = q.shape[0]
        split = self.choices.split
        part = -(-n // split)
        if part * split != n:
            q = F.pad(q, (0, 0, 0, part * split - n))
        raw = F.grid_sample(
            self.values.expand(split, -1, -1, -1, -1),
            q.view(split, 1, 1, part, 3),
            align_corners=True,
        )
        return raw.permute(0, 2, 3, 4, 1).reshape(part * split, 4)[:n]

    def loss_of(self, rgb: torch.Tensor) -> torch.Tensor:
        """Mean over rays of the squared error, summed over the channels."""
        return (rgb - self._target_rgb).square().sum() / rgb.shape[0]

    def loss(self) -> torch.Tensor:
        """Of the workload's rays."""
        torch.set_num_threads(self.choices.threads)
        return self.loss_of(self.render())

    def gradient(self, loss: torch.Tensor, keep_graph: bool = False) -> torch.Tensor:
        """Of the loss, [1, 4, X, Y, Z]; fresh memory each time, so nothing needs zeroing."""
        torch.set_num_threads(self.choices.threads)
        return torch.autograd.grad(loss, self.values, retain_graph=keep_graph)[0]

    def training_step(self) -> torch.Tensor:
        """Forward, loss and adjoint: the gradient, [1, 4, X, Y, Z]."""
        return self.gradient(self.loss())

    def saved_bytes(self) -> int:
        """What autograd holds between the passes, apart from what outlives the step."""
        own = (self.values, self._origins, self._directions, self._target_rgb, self._background)
        known = {tensor.untyped_storage().data_ptr() for tensor in own}
        saved: dict[int, int] = {}

        def note(tensor: torch.Tensor) -> torch.Tensor:
            storage = tensor.untyped_storage()
            if storage.data_ptr() not in known:
                saved[storage.data_ptr()] = storage.nbytes()
            return tensor

        with torch.autograd.graph.saved_tensors_hooks(note, lambda tensor: tensor):
            loss = self.loss()
        del loss
        return sum(saved.values())


def fastest_by_threads(
    work: Workload,
    scaled: bool,
    threads: int,
    device: str,
    seconds: Callable[[Callable[[], object]], float],
    rounds: int = 3,
) -> list[TorchPipeline]:
    """For 1 and for `threads` threads, the choices whose training step takes least time here.

    More threads are not always faster, and how they fare changes with what else the machine does:
    a benchmark times all that this returns, in each of its rounds.
    """
    compositings: tuple[Compositing, ...] = ("padded", "segmented")
    pipelines = []
    for count in sorted({1, threads}) if not device.startswith("cuda") else [1]:
        candidates = [
            TorchPipeline(
                work, scaled, Choices(compositing=compositing, split=split, threads=count), device
            )
            for compositing, split in itertools.product(compositings, sorted({1, count}))
        ]
        best = [float("inf")] * len(candidates)
        for candidate in candidates:
            candidate.training_step()
        for _ in range(rounds):
            for i, candidate in enumerate(candidates):
                best[i] = min(best[i], seconds(candidate.training_step))
        pipelines.append(candidates[int(np.argmin(best))])
    return pipelines
