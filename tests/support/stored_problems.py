"""Fields that are no dense grids, as operations of frameworks render them, and the oracle's."""

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from tests import reference
from tests.reference import factors, hashed
from tests.reference.render import softplus
from tests.support.problems import Float64, Problem
from warpnerf.fields.hashed import level_shapes
from warpnerf.fields.lattice import Lattice
from warpnerf.model.storage_kinds import Hash, StorageKind, Vm
from warpnerf.rendering.arguments import StoredField
from warpnerf.rendering.stored import first_tensors

SIZE = (4, 6, 5)
VM = Vm(density=4, appearance=12)
HASH = Hash(levels=4, features=2, coarsest=3, finest=40, table=64)
HIDDEN = replace(HASH, hidden=16)
KINDS: dict[str, StorageKind] = {"vm": VM, "hash": HASH, "hash with a hidden layer": HIDDEN}
RGB = reference.RgbHead()


def size_of(kind: StorageKind) -> tuple[int, int, int] | None:
    return SIZE if isinstance(kind, Vm) else None


def random_tensors(p: Problem, kind: StorageKind, seed: int = 0) -> dict[str, Float64]:
    """In float32's numbers, with raw values of about 1."""
    rng = np.random.default_rng(seed)
    first = first_tensors(kind, (p.box_min, p.box_max), size_of(kind))
    found = {name: rng.normal(size=array.shape) for name, array in first.items()}
    if "hidden" in found:
        found["hidden"] *= np.sqrt(2.0 / len(found["hidden"]))
    found["decoder"] *= 1.5 / np.sqrt(len(found["decoder"]))
    found["decoder"][:, 4:] = 0.0  # padding
    return {name: x.astype(np.float32).astype(np.float64) for name, x in found.items()}


def stored(kind: StorageKind, tensors: dict[str, Any]) -> StoredField:
    return StoredField(kind, tensors, size_of(kind))


def random_edges(p: Problem, n: int = 21, seed: int = 1) -> Float64:
    """[n_rays, n + 1] from 0 on, of which some lie behind the box; one interval is empty."""
    edges = np.sort(np.random.default_rng(seed).uniform(0.0, 4.0, (p.n_rays, n + 1)), axis=1)
    edges[:, 0], edges[:, 4] = 0.0, edges[:, 3]
    return edges.astype(np.float32).astype(np.float64)


def oracle(
    p: Problem,
    kind: StorageKind,
    tensors: dict[str, torch.Tensor],
    scaling: str,
    edges: Float64 | None = None,
) -> reference.Rendering:
    """What rays of a problem see of a field, in steps or in intervals."""
    if edges is None:
        count = int((p.steps.far - p.steps.near) / p.steps.step) + 2
        edges = np.tile(p.steps.near + p.steps.step * np.arange(count + 1), (p.n_rays, 1))
        far = p.steps.far
    else:
        far = np.inf
    t, dt = torch.tensor(0.5 * (edges[:, 1:] + edges[:, :-1])), torch.tensor(np.diff(edges))
    origins, directions = torch.tensor(p.origins), torch.tensor(p.directions)
    points = origins[:, None] + t[..., None] * directions[:, None]
    low, high = torch.tensor(p.box_min), torch.tensor(p.box_max)
    shares = (points - low) / (high - low)
    valid = ((shares >= 0.0) & (shares <= 1.0)).all(dim=-1) & (t < far)
    raw = _raw_values(p, kind, tensors, shares[valid])
    values = torch.zeros(*valid.shape, 4, dtype=torch.float64).masked_scatter(
        valid[..., None], raw[:, :4]
    )
    sigma = softplus(values[..., 0] + p.density_shift)
    colors = RGB.shade(values[..., 1:], directions, sigma)
    content = torch.tensor(p.content_distance).expand(p.n_rays)
    one = torch.ones_like(t)
    scale = reference.distance_scale(t, content, scaling, one, "none")
    sigma, colors = reference.GradientScaler.apply(sigma, colors, scale)
    background = torch.tensor(p.background).expand(p.n_rays, 3)
    return reference.integrate(sigma, colors, t, dt, background, valid)


def _raw_values(
    p: Problem, kind: StorageKind, tensors: dict[str, torch.Tensor], shares: torch.Tensor
) -> torch.Tensor:
    if isinstance(kind, Vm):
        sizes = [SIZE[a] * SIZE[b] for a, b in factors.PLANES]
        planes = [
            part.reshape(SIZE[a], SIZE[b], kind.width)
            for (a, b), part in zip(factors.PLANES, tensors["planes"].split(sizes), strict=True)
        ]
        lines = list(tensors["lines"].split([SIZE[2], SIZE[1], SIZE[0]]))
        u = shares * (torch.tensor(SIZE, dtype=torch.float64) - 1)
        return factors.raw_values(planes, lines, tensors["decoder"], u)
    assert isinstance(kind, Hash)
    lattice = Lattice(box_min=p.box_min, box_max=p.box_max, size=(2, 2, 2))
    shapes, edges = level_shapes(kind, lattice), p.box_max - p.box_min
    tables = [tensors["values"][shape.begin : shape.end] for shape in shapes]
    matrices = [tensors[name] for name in ("hidden", "decoder") if name in tensors]
    cells = [tuple(n * edges / edges.max()) for n in kind.resolutions]
    return hashed.raw_values(tables, cells, kind.table, matrices, shares)


def oracle_gradients(
    p: Problem,
    kind: StorageKind,
    tensors: dict[str, Float64],
    scaling: str,
    edges: Float64 | None = None,
) -> dict[str, Float64]:
    """Of the problem's loss, by the name of the tensor."""
    leaves = {name: torch.tensor(x, requires_grad=True) for name, x in tensors.items()}
    out = oracle(p, kind, leaves, scaling, edges)
    adjoints = [torch.tensor(a) for a in (p.adj_rgb, p.adj_opacity, p.adj_depth)]
    found = torch.autograd.grad([out.rgb, out.opacity, out.depth], [*leaves.values()], adjoints)
    return {name: x.numpy() for name, x in zip(leaves, found, strict=True)}
