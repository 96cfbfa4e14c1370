"""Eager torch for factors (TensoRF's VM decomposition) and hashes (Instant-NGP's), late in
trainings.

Where samples lie is given: those that warpnerf visits, where they lie in the field, and how long
their steps are. So torch does not march, skip what is free, or find where a ray ends.

Entries are read in one of two ways, whichever is faster:

    modules   grid_sample for planes and lines, as TensoRF's code has it; of a hash, all entries
              around a sample at once, and their weighted sum; autograd
    rows      embedding_bag over the entries around, and gradients added in place to a table that
              stays: torch_nodes.py

On the CPU grid_sample runs in parallel over a batch only, so samples may be cut into a batch of as
many parts as there are threads, which shares the planes.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
import torch.nn.functional as F
from field_workload import FieldWorkload
from measuring import Stopwatch
from warpnerf_kernels.fields.hashed_packs import PRIME_X, PRIME_Y
from workload import Workload

from candidates.torch_models import Choices, Part, TorchModels
from candidates.torch_nodes import Interpolate, Table
from warpnerf.fields.factors import AXES, Factors
from warpnerf.fields.hashed import ROW_ALIGNED, Hashed, level_shapes

Reading = Literal["modules", "rows"]


@dataclass(frozen=True, kw_only=True)
class FieldChoices(Choices):
    """What can be done in more than one way."""

    reading: Reading = "rows"
    """How entries are read."""
    split: int = 1
    """Into how many parts grid_sample's samples are cut."""

    @property
    def words(self) -> str:
        """What of it is no number."""
        return f"read by {self.reading}" + (f" in {self.split}" if self.split > 1 else "")


class TorchFields(TorchModels):
    """A training pass of a field with a decoder."""

    def _load_field(self, work: Workload, device: str) -> None:
        assert isinstance(work, FieldWorkload)
        storage = work.trained
        self._samples = [
            torch.from_numpy(array).to(device)
            for array in (work.positions_in_field, work.distances, work.lengths, work.ray_of_sample)
        ]
        counts = torch.bincount(self._samples[3], minlength=len(work.origins))
        self._end = F.pad(counts.cumsum(0), (1, 0)).tolist()
        tensors = {name: torch.from_numpy(array) for name, array in storage.tensors().items()}
        decoder = tensors["decoder"][:, : storage.n_decoded]  # without columns of padding
        if isinstance(storage, Hashed):  # nor rows of levels that are not read
            decoder = decoder[: storage.n_active * storage.kind.features]
        self._decoder = decoder.contiguous().requires_grad_()
        self._reach = 1.0 + storage.lattice.border
        if isinstance(storage, Factors):
            self._load_factors(storage, tensors)
        else:
            assert isinstance(storage, Hashed)
            self._load_hash(storage, tensors)

    def _load_factors(self, storage: Factors, tensors: dict[str, torch.Tensor]) -> None:
        size = storage.lattice.size
        planes = tensors["planes"].split([size[a] * size[b] for a, b in AXES])
        lines = tensors["lines"].split([size[2], size[1], size[0]])
        self._size = size
        none = torch.zeros(1, dtype=torch.long)
        self.tables = [Table(table.clone(), none) for table in (*planes, *lines)]
        # [1, width, rows, columns] each, over the same memory.
        shapes = [(size[a], size[b]) for a, b in AXES] + [(size[c], 1) for c in (2, 1, 0)]
        self._images = [
            table.values.view(1, *shape, -1).permute(0, 3, 1, 2).requires_grad_()
            for table, shape in zip(self.tables, shapes, strict=True)
        ]

    def _load_hash(self, storage: Hashed, tensors: dict[str, torch.Tensor]) -> None:
        table = Table(tensors["values"].clone(), torch.zeros(1, dtype=torch.long))
        self.tables, self._images = [table], [table.values.view_as(table.values).requires_grad_()]
        levels = level_shapes(storage.kind, storage.lattice)[: storage.n_active]
        self._cells = torch.tensor(np.array([level.edges for level in levels])).float()
        sizes = torch.tensor([level.size for level in levels])
        self._last = sizes - 2
        self._begin = torch.tensor([level.begin for level in levels])[:, None]
        self._is_hashed = torch.tensor([level.is_hashed for level in levels])[:, None]
        self._strides = sizes[:, 1:]
        self._mask = storage.kind.table - ROW_ALIGNED

    @property
    def weights(self) -> list[torch.Tensor]:
        """What all rays share."""
        return [*self.network, self._decoder]

    def ways(self) -> list[Choices]:
        """What may be fastest, on as many threads."""
        threads = self.choices.threads
        splits = sorted({1, threads}) if len(self._images) > 1 else [1]
        readings: list[tuple[Reading, int]] = [("rows", 1), *(("modules", n) for n in splits)]
        return [
            FieldChoices(threads=threads, parts=parts, reading=reading, split=split)
            for parts, (reading, split) in itertools.product((4, 16), readings)
        ]

    def step(self) -> None:
        """Forward, loss and adjoint, part after part."""
        for image in self._images:
            image.grad = None
        super().step()
        for table, image in zip(self.tables, self._images, strict=True):
            if image.grad is not None:
                rows = image.grad.permute(0, 2, 3, 1) if image.ndim == 4 else image.grad
                table.gradient = rows.reshape(table.values.shape)

    @torch.no_grad()
    def _part(self, part: slice) -> Part:
        work = self._work
        some = slice(self._end[part.start], self._end[part.stop])
        c, t, length, ray = (array[some] for array in self._samples)
        ray = ray - part.start
        n_rays = part.stop - part.start
        first, width, index = self._slots(ray, n_rays)
        factor = (t / work.content_distance).square_().clamp_(max=1.0)
        return Part(
            index=index,
            width=width,
            ray=ray,
            first=first,
            place=(c,),
            length=length * work.density_scale,
            factor=factor if work.scaled else torch.ones_like(factor),
            directions=self._rays[1][part],
            density=None,
        )

    def _read(self, part: Part) -> tuple[torch.Tensor, torch.Tensor]:
        """Raw densities [n_samples] and all raw values [n_samples, n_values]."""
        shares = part.place[0] / self._reach
        read = self._read_hash if len(self._images) == 1 else self._read_factors
        raw = read(shares) @ self._decoder
        return raw[:, 0], raw

    def _read_factors(self, c: torch.Tensor) -> torch.Tensor:
        """Products of planes and lines at c [n, 3] in [-1, 1]: [n, 3 width]."""
        products = []
        for n, (a, b) in enumerate(AXES):
            axis = 3 - a - b
            if self._reading == "rows":
                plane, line = self._of_rows(n, c[:, [a, b]]), self._of_rows(3 + n, c[:, [axis]])
                products.append(plane * line)
                continue
            on_line = torch.stack([torch.zeros_like(c[:, axis]), c[:, axis]], dim=1)
            plane, line = self._sampled(n, c[:, [b, a]]), self._sampled(3 + n, on_line)
            products.append((plane * line).t())
        return torch.cat(products, dim=1)

    @property
    def _reading(self) -> Reading:
        return self.choices.reading if isinstance(self.choices, FieldChoices) else "rows"

    def _sampled(self, n: int, at: torch.Tensor) -> torch.Tensor:
        """A plane or a line at positions [n, 2], columns first: [width, n]."""
        split = self.choices.split if isinstance(self.choices, FieldChoices) else 1
        count = len(at)
        part = -(-count // split)
        at = F.pad(at, (0, 0, 0, part * split - count)).view(split, part, 1, 2)
        image = self._images[n].expand(split, -1, -1, -1)
        found = F.grid_sample(image, at, align_corners=True)  # [split, width, part, 1]
        return found.permute(1, 0, 2, 3).reshape(image.shape[1], -1)[:, :count]

    def _of_rows(self, n: int, c: torch.Tensor) -> torch.Tensor:
        """The same at c, rows first: [n, width]."""
        axes = (*AXES, (2,), (1,), (0,))[n]
        with torch.no_grad():
            node, share = torch.zeros(len(c), 1, dtype=torch.int32), torch.ones(len(c), 1)
            for i, axis in enumerate(axes):
                u = (c[:, i] + 1.0) * (0.5 * (self._size[axis] - 1))
                low = u.int().clamp_(max=self._size[axis] - 2)
                up = (u - low)[:, None]
                node = (node[:, :, None] * self._size[axis] + low[:, None, None]).flatten(1)
                node = torch.stack([node, node + 1], dim=2).flatten(1)
                share = torch.stack([share * (1.0 - up), share * up], dim=2).flatten(1)
        return Interpolate.apply(self._on, self.tables[n], node, share, "rows", None)

    def _read_hash(self, c: torch.Tensor) -> torch.Tensor:
        """Entries of all levels at c [n, 3] in [-1, 1]: [n, levels width]."""
        with torch.no_grad():
            u = (0.5 * (c + 1.0))[:, None] * self._cells  # [n, levels, 3]
            low = u.long().clamp_(min=0).minimum(self._last)
            share = (u - low)[..., None]
            x, y, z = torch.cat([1.0 - share, share], dim=3).unbind(2)  # [n, levels, 2]
            i, j, k = (low[..., None] + torch.tensor([0, 1])).unbind(2)
            i, j = i[..., :, None], j[..., None, :]
            hashed = (i * PRIME_X ^ j * PRIME_Y) & self._mask
            own = (i * self._strides[:, :1, None] + j) * self._strides[:, 1:, None]
            row = torch.where(self._is_hashed[..., None], hashed, own) + self._begin[..., None]
            entry = row[..., None] + k[:, :, None, None]  # [n, levels, 2, 2, 2]
            share = x[..., :, None, None] * y[..., None, :, None] * z[..., None, None, :]
            entry, share = entry.flatten(2), share.flatten(2)
        n = len(c)
        if self._reading == "rows":
            entry, share = entry.view(-1, 8).int(), share.view(-1, 8)
            args = (self._on, self.tables[0], entry, share, "rows", None)
            return Interpolate.apply(*args).view(n, -1)
        return (F.embedding(entry, self._images[0]) * share[..., None]).sum(2).flatten(1)

    def gradients(self) -> dict[str, np.ndarray]:
        """Of each array, entry by entry."""
        assert isinstance(self._work, FieldWorkload)
        decoder = self._decoder.grad
        assert decoder is not None
        full = self._work.trained.tensors()["decoder"]
        of_decoder = np.zeros_like(full)
        of_decoder[: len(decoder), : decoder.shape[1]] = decoder.numpy()
        entries = [table.gradient.numpy() for table in self.tables]
        if len(entries) == 1:
            return {"values": entries[0], "decoder": of_decoder}
        planes, lines = np.concatenate(entries[:3]), np.concatenate(entries[3:])
        return {"planes": planes, "lines": lines, "decoder": of_decoder}


def load(work: Workload, threads: int, device: str) -> TorchFields:
    """Read in the way whose step takes least time here, on that many threads."""
    seconds = Stopwatch(device).seconds
    found = TorchFields(work, FieldChoices(threads=threads), device)
    spent: dict[Choices, float] = {}
    found.step()
    for choices in found.ways():  # steps so long that one of each tells
        found.choices = choices
        spent[choices] = seconds(found.step)
    found.choices = min(spent, key=lambda choices: spent[choices])
    return found


def obstacle(device: str) -> str | None:
    """Where samples lie, and what they read, is in memory of the CPU."""
    return None if device == "cpu" else "reads fields on the CPU only"
