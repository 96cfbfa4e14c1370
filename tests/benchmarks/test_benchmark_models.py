"""The benchmarks' torch for models with features computes what the oracle does."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests import reference
from tests.support.tiny_trainings import ball

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import field_workload
import throughput
import workload
from candidates import torch_adam, torch_fields, torch_models, torch_nodes, warpnerf_step


def oracle(work: workload.Workload) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Colours, gradients of grid and network, and weights of the samples."""
    raw = torch.from_numpy(work.values).double().requires_grad_()
    parameters = [torch.from_numpy(array).double().requires_grad_() for array in work.network]
    network = reference.Network(parameters[::2], parameters[1::2])
    heads = {
        "sh": reference.ShHead(2),
        "deferred": reference.DeferredHead(network),
        "per_sample": reference.FeaturesHead(network),
        "dvgo": reference.FeaturesHead(network, residual=False),
    }
    out = reference.render(
        raw,
        torch.from_numpy(work.origins).double(),
        torch.from_numpy(work.directions).double(),
        box_min=(-1.0, -1.0, -1.0),
        box_max=(1.0, 1.0, 1.0),
        near=0.0,
        far=work.n_steps * work.step,
        step=work.step,
        n_steps=work.n_steps,
        density_shift=workload.DENSITY_SHIFT,
        background=work.background,
        scaling="clamped" if work.scaled else "none",
        content_distance=work.content_distance,
        head=heads[work.model],
    )
    target = torch.from_numpy(work.target_rgb).double()
    loss = reference.photometric_loss(out.rgb, target)
    of_grid, *of_network = torch.autograd.grad(loss, [raw, *parameters])
    flat = [np.zeros(0), *(gradient.numpy().ravel() for gradient in of_network)]
    rgb, weights = out.rgb.detach().numpy(), out.weights.detach().numpy()
    return rgb, of_grid.numpy(), np.concatenate(flat), weights


@pytest.mark.parametrize("grid", [15, 16])
@pytest.mark.parametrize(("scene", "scaled"), [("dense", True), ("sphere", True), ("dense", False)])
@pytest.mark.parametrize("model", ["sh", "deferred", "per_sample", "dvgo"])
def test_torch_computes_what_the_oracle_does(model, scene, scaled, grid):
    work = workload.make_workload("random", grid, 130, 48, scene=scene, scaled=scaled, model=model)
    rgb, gradient, of_network, weights = oracle(work)
    assert np.abs(gradient).max() > 1e-4
    if model != "sh":
        assert np.abs(of_network).max() > 1e-4
    if scene == "sphere":  # some samples have a colour, some have none
        assert 0.05 < (weights[weights > 0] > 1e-4).mean() < 0.95
    found = torch_models.TorchModels(work, torch_models.Choices())
    for parts, sparse in ((1, False), (3, True)):
        for scattering in ("rows", "pairs"):
            found.choices = torch_models.Choices(parts=parts, scattering=scattering, sparse=sparse)
            found.step()
            found.step()  # a gradient that is not zeroed would show
            assert reference.relative_error(found.rgb(), rgb) < 1e-5
            assert reference.relative_error(found.gradient(), gradient) < 1e-5
            if model != "sh":
                assert reference.relative_error(found.network_gradient(), of_network) < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize(("field", "unbounded"), [("vm", False), ("hash", True)])
def test_torch_reads_fields_as_warpnerf_does(field, unbounded):
    """Also where space is contracted; what differs does not pass."""
    scene = replace(ball(), unbounded=unbounded)
    work = field_workload.late_field(scene, "deferred", field, 250, 2000)
    assert work.trained.lattice.contracted == unbounded
    ours = warpnerf_step.load(work, 1, "cpu")
    ours.step()
    visited = ours.samples_of_rays()
    assert np.array_equal(np.bincount(work.ray_of_sample, minlength=len(visited)), visited)
    theirs = torch_fields.TorchFields(work, torch_fields.FieldChoices(threads=2))
    runs = {("warpnerf", 1): ours, ("torch", 1): theirs}
    for choices in theirs.ways():
        theirs.choices = choices
        found = throughput.check(runs, 1e-4, 1e-4, of_field=True)["torch, 1 threads"]
        assert len(found) == {"vm": 5, "hash": 4}[field]
    theirs._reach *= 1.01
    with pytest.raises(SystemExit, match="torch on 1 threads differs"):
        throughput.check(runs, 1e-4, 1e-4, of_field=True)


@pytest.mark.parametrize("size", [(4, 4, 4), (3, 5, 7), (2, 2, 3)])
def test_pairs_add_what_rows_do(size):
    """Many samples in a cell, and a number of nodes that is odd."""
    generator = torch.Generator().manual_seed(0)
    n_nodes, n = int(np.prod(size)), 200
    cell = [torch.randint(0, s - 1, (n,), generator=generator) for s in size]
    first = (cell[0] * size[1] + cell[1]) * size[2] + cell[2]
    y, x = size[2], size[1] * size[2]
    corners = torch.tensor([0, 1, y, y + 1, x, x + 1, x + y, x + y + 1])
    node = (first[:, None] + corners).int()
    share = torch.rand(n, 8, generator=generator)
    adj_raw = torch.rand(n, 4, generator=generator)
    rows, pairs = torch.zeros(2, n_nodes, 4)
    torch_nodes.add_by_rows(rows, node, share, adj_raw)
    torch_nodes.add_by_pairs(pairs, node, share, adj_raw)
    torch.testing.assert_close(pairs, rows)
    assert bool((rows > 0).all())
    torch_nodes.add_by_pairs(pairs, node[:0], share[:0], adj_raw[:0])
    torch.testing.assert_close(pairs, rows)


@pytest.mark.parametrize(("way", "named"), [("all", False), ("rows", False), ("rows", True)])
def test_adam_leaves_alone_what_no_ray_has_touched(way, named, monkeypatch):
    """The others it updates as torch.optim.Adam does."""
    generator = torch.Generator().manual_seed(0)
    values = torch.rand(50, 4, generator=generator)
    table = torch_nodes.Table(values, torch.arange(8))
    table.touched = torch.arange(25) if named else None
    expected = values.clone().requires_grad_()
    theirs = torch.optim.Adam([expected], lr=0.1, betas=(0.9, 0.99))
    gradient = table.gradient
    monkeypatch.setattr(torch_adam, "PIECE", 4 * 7)  # neither the rows nor all of them at once
    ours = torch_adam.MaskedAdam([table], 0.1)
    ours.way = way
    first = values.clone()
    for _ in range(3):
        gradient[:20, :3] = torch.rand(20, 3, generator=generator) + 0.1
        ours.step()
        expected.grad = gradient.clone()
        theirs.step()
    torch.testing.assert_close(values[:20, :3], expected.detach()[:20, :3])
    assert torch.equal(values[20:], first[20:]) and torch.equal(values[:, 3], first[:, 3])
