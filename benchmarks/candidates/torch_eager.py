"""Eager torch, as well as we can write it.

Positions of the samples in the box are packed, and once more those of them that are not free; the
grid is read by grid_sample, compositing uses cumulated optical depth, autograd does the rest. What
was tried for the grid, forward + backward of 524 288 samples on one core of an AMD EPYC, 64^3 and
160^3 grids:

    grid_sample, channels last                    68 ms    144 ms
    grid_sample, channels first                   70 ms    180 ms
    embedding_bag, index_add for the adjoint     106 ms    156 ms
    index_select, sum over corners               197 ms    239 ms
    embedding, sum over corners                  334 ms    387 ms
    embedding_bag                                375 ms    403 ms

so it is grid_sample, channels last. On the CPU torch runs it in parallel over the batch only;
`split` cuts the samples into a batch that shares one grid. Its adjoint then makes a gradient grid
for each and adds them, which on a busy machine or a large grid costs more than it brings: whether
to split, and how to composite, is decided by timing: see `fastest`. An adjoint by hand instead of
autograd's was no faster.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from measuring import Stopwatch
from workload import DENSITY_SHIFT, Workload

Compositing = Literal["padded", "segmented"]

BLOCK = 8
"""Steps that are looked at together first, where some space is free."""


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


class Samples(NamedTuple):
    """The steps of some rays that need sampling, packed."""

    index: torch.Tensor
    """[n_samples] where in [n_rays, n_steps], flattened."""
    t: torch.Tensor
    """[n_samples] scene units."""
    q: torch.Tensor
    """[n_samples, 3] in the box."""
    full: bool
    """Whether all steps are among them, so that packed and padded are the same."""


class TorchSpace:
    """Where rays need samples: in the box, where it is not free."""

    def __init__(self, free: np.ndarray, device: str) -> None:
        """Load the free cells.

        Args:
            free: As in a Workload.
            device: As torch names it.
        """
        self._cells = torch.tensor(free.shape, device=device)
        self._distance = torch.from_numpy(free.ravel()).to(device) if free.any() else None

    def samples(
        self, origins: torch.Tensor, directions: torch.Tensor, steps: torch.Tensor
    ) -> Samples:
        """Where rays [n_rays, 3] need samples, of those at distances steps [n_steps].

        Args:
            origins: In coordinates in which the box is [-1, 1]^3.
            directions: Likewise, a unit of distance long.
            steps: Evenly spaced.
        """
        at_faces = torch.stack([(-1.0 - origins) / directions, (1.0 - origins) / directions])
        first = torch.searchsorted(steps, at_faces.amin(0).amax(1))
        end = torch.searchsorted(steps, at_faces.amax(0).amin(1), right=True).maximum(first)
        n_rays, n_steps = len(origins), len(steps)
        if self._distance is None:
            ray, k = expand(end - first, first)
            if len(k) == n_rays * n_steps:
                q = torch.addcmul(origins[:, None], steps[:, None], directions[:, None])
                index = torch.arange(len(k), device=k.device)
                return Samples(index, steps.repeat(n_rays), q.view(-1, 3), True)
        else:
            ray, begin = expand((end - first + BLOCK - 1) // BLOCK, first, BLOCK)
            reach = 0.5 * (BLOCK - 1) * (steps[1] - steps[0])
            q = torch.addcmul(origins[ray], (steps[begin] + reach)[:, None], directions[ray])
            in_cells = reach * (directions.abs() * (0.5 * self._cells)).amax(1)
            near = self._distance[self._cell(q)] <= in_cells.ceil()[ray]
            ray, begin = ray[near], begin[near]
            k = begin[:, None] + torch.arange(BLOCK, device=begin.device)
            at = (k < end[ray, None]).view(-1).nonzero()[:, 0]
            ray, k = ray[at // BLOCK], k.view(-1)[at]
        t = steps[k]
        q = torch.addcmul(origins[ray], t[:, None], directions[ray])
        needed = self.needed(q)
        if needed is not None:
            ray, k, t, q = ray[needed], k[needed], t[needed], q[needed]
        return Samples(ray * n_steps + k, t, q, False)

    def needed(self, q: torch.Tensor) -> torch.Tensor | None:
        """Which of q [n, 3] in the box do not lie in free cells; None: all."""
        if self._distance is None:
            return None
        return (self._distance[self._cell(q)] == 0).nonzero().view(-1)

    def _cell(self, q: torch.Tensor) -> torch.Tensor:
        """That of each q [n, 3], or the nearest one of what is outside the box."""
        cell = ((q + 1.0) * (0.5 * self._cells)).long().clamp_(min=0).minimum(self._cells - 1)
        return (cell[:, 0] * self._cells[1] + cell[:, 1]) * self._cells[2] + cell[:, 2]


def expand(
    counts: torch.Tensor, first: torch.Tensor, stride: int = 1
) -> tuple[torch.Tensor, torch.Tensor]:
    """So many entries of each ray: whose they are, and first, first + stride, and so on."""
    ray = torch.repeat_interleave(counts)
    begin = counts.cumsum(0) - counts
    entry = torch.arange(len(ray), device=ray.device) - begin[ray]
    return ray, first[ray] + stride * entry


class TorchScene(TorchSpace):
    """A grid over the box: where rays need samples, and what they read there."""

    def __init__(self, values: np.ndarray, free: np.ndarray, split: int, device: str) -> None:
        """Load the grid.

        Args:
            values: As in a Workload.
            free: Likewise.
            split: Parts into which samples are cut, so that grid_sample runs in parallel.
            device: As torch names it.
        """
        super().__init__(free, device)
        self.values = (
            torch.from_numpy(np.ascontiguousarray(values.transpose(3, 0, 1, 2)))[None]
            .to(device)
            .to(memory_format=torch.channels_last_3d)
        )
        """[1, 4, X, Y, Z] raw density, raw rgb."""
        self._split = split

    def shade(self, q: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Densities [n] and colours [n, 3] at q [n, 3]."""
        n = q.shape[0]
        part = -(-n // self._split)
        q = q.flip(-1)
        if part * self._split != n:
            q = F.pad(q, (0, 0, 0, part * self._split - n))
        raw = F.grid_sample(
            self.values.expand(self._split, -1, -1, -1, -1),
            q.view(self._split, 1, 1, part, 3),
            align_corners=True,
        )
        raw = raw.permute(0, 2, 3, 4, 1).reshape(part * self._split, 4)[:n]
        return F.softplus(raw[:, 0] + DENSITY_SHIFT), torch.sigmoid(raw[:, 1:])


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
    """A workload's training step in torch."""

    def __init__(self, work: Workload, choices: Choices, device: str = "cpu") -> None:
        """Load a workload."""
        self._work = work
        self.choices = choices
        self._scene = TorchScene(work.values, work.free, choices.split, device)
        self.values = self._scene.values.requires_grad_()
        """[1, 4, X, Y, Z] raw density, raw rgb."""
        self._origins, self._directions, self._target_rgb = (
            torch.from_numpy(array).to(device)
            for array in (work.origins, work.directions, work.target_rgb)
        )
        self._background = torch.tensor(work.background, device=device)
        self._gradient = torch.zeros_like(self.values)

    def render(self) -> torch.Tensor:
        """The rays' colours, [n_rays, 3]."""
        work = self._work
        n_rays, n_steps = self._origins.shape[0], work.n_steps
        with torch.no_grad():
            steps = (torch.arange(n_steps, device=self._origins.device) + 0.5) * work.step
            index, t, q, full = self._scene.samples(self._origins, self._directions, steps)
        sigma, rgb = self._scene.shade(q)
        if work.scaled:
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
            ray = index // n_steps
            # In float64: over all rays the sum grows too large for float32.
            depth = F.pad(tau.double().cumsum(0), (1, 0))
            counts = torch.bincount(ray, minlength=n_rays)
            end = counts.cumsum(0)
            begin = depth[end - counts]
            weight = torch.exp((begin[ray] - depth[:-1]).float()) * -torch.expm1(-tau)
            seen = rgb.new_zeros(n_rays, 3).index_add(0, ray, weight[:, None] * rgb)
            passed = torch.exp((begin - depth[end]).float())
        return seen + passed[:, None] * self._background

    def loss(self) -> torch.Tensor:
        """Mean over rays of the squared error, summed over the channels."""
        torch.set_num_threads(self.choices.threads)
        return (self.render() - self._target_rgb).square().sum() / self._work.origins.shape[0]

    def backward(self, loss: torch.Tensor, keep_graph: bool = False) -> None:
        """The loss's gradient, in fresh memory each time, so nothing needs zeroing."""
        torch.set_num_threads(self.choices.threads)
        (self._gradient,) = torch.autograd.grad(loss, self.values, retain_graph=keep_graph)

    def step(self) -> None:
        """Forward, loss and adjoint."""
        self.backward(self.loss())

    def gradient(self) -> np.ndarray:
        """[X, Y, Z, 4]"""
        return self._gradient[0].permute(1, 2, 3, 0).cpu().numpy()

    def rgb(self) -> np.ndarray:
        """[n_rays, 3]"""
        with torch.no_grad():
            return self.render().cpu().numpy()

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


def fastest(work: Workload, threads: int, device: str, rounds: int = 3) -> TorchPipeline:
    """The choices whose step takes least time here, on that many threads."""
    seconds = Stopwatch(device).seconds
    compositings: tuple[Compositing, ...] = ("padded", "segmented")
    candidates = [
        TorchPipeline(work, Choices(compositing=compositing, split=split, threads=threads), device)
        for compositing, split in itertools.product(compositings, sorted({1, threads}))
    ]
    best = [float("inf")] * len(candidates)
    for candidate in candidates:
        candidate.step()
    for _ in range(rounds):
        for i, candidate in enumerate(candidates):
            best[i] = min(best[i], seconds(candidate.step))
    return candidates[int(np.argmin(best))]


def obstacle(device: str) -> str | None:
    """It runs wherever torch is."""
    return None


load = fastest
