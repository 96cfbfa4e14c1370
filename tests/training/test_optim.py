"""The host's side of the optimiser."""

from typing import Any

import numpy as np
import pytest
import torch
import warp as wp
from warpnerf_kernels.base.types import vector
from warpnerf_kernels.optim.total_variation import TV_BLOCK

from tests import reference
from warpnerf.fields.dense import DenseGrid
from warpnerf.fields.lattice import Lattice
from warpnerf.fields.parameters import Parameter, head_parameters
from warpnerf.fields.total_variation import TotalVariation
from warpnerf.model.interface import Model
from warpnerf.model.models import Deferred, PerSample, Rgb
from warpnerf.optim_config import OptimConfig
from warpnerf.runtime.parallel import Workers
from warpnerf.training.optim import adam_step, first_states

RGB, DEFERRED = Rgb(), Deferred(specular=2, width=16, hidden_layers=1)


def ones(n_nodes: int) -> wp.array:
    """Strengths of runs of nodes."""
    return wp.full(-(-n_nodes // TV_BLOCK), 1.0, dtype=wp.float32)


def grid_of(values: Any, workers: Workers) -> DenseGrid:
    """A grid [X, Y, Z, n_floats] in the unit box."""
    n_floats = values.shape[3]
    flat = values.reshape(-1, n_floats)
    return DenseGrid(
        values=wp.array(flat, dtype=vector(n_floats), device=workers.device),
        lattice=Lattice(
            size=(values.shape[0], values.shape[1], values.shape[2]),
            box_min=np.zeros(3),
            box_max=np.ones(3),
        ),
    )


def learned(
    model: Model, grid: DenseGrid, config: OptimConfig, workers: Workers
) -> tuple[Parameter, ...]:
    """A grid's values, and the weights that training begins with."""
    first = wp.array(model.first_weights(0), dtype=wp.float32, device=workers.device)
    return grid.parameters(model, config) + head_parameters(model, first)


def variation(
    model: Model,
    grid: DenseGrid,
    config: OptimConfig,
    n_asked: int,
    strength: wp.array,
    workers: Workers,
) -> TotalVariation:
    """The regulariser of a grid, with these strengths."""
    return TotalVariation(
        values=grid.values,
        size=grid.lattice.size,
        weights=model.variation(config),
        strength=strength,
        n_asked=n_asked,
        every=config.tv_every,
        until=config.tv_until,
        workers=workers,
    )


@pytest.mark.parametrize(
    ("model", "weights"),
    [
        (RGB, [3e-2, 2e-3, 2e-3, 2e-3]),
        (DEFERRED, [3e-2, *5 * [2e-3], 0.0, 0.0]),  # two floats are padding
    ],
)
@pytest.mark.parametrize("coarser", [1, 8])
def test_total_variation_counts_the_face_between_two_nodes(
    coarser: int, model: Model, weights: list[float], device: str
) -> None:
    """Of eight times fewer nodes each pair stands for four times the area."""
    size, workers = (4, 5, 3), Workers(device, 2)
    shape = (*size, model.n_floats)
    raw = torch.tensor(np.random.default_rng(0).normal(size=shape), requires_grad=True)
    of_floats = torch.tensor(weights, dtype=torch.float64)
    every, n_steps = 5, 4
    reference.total_variation(raw, coarser ** (2 / 3) * every * n_steps**0.5 * of_floats).backward()
    grid = grid_of(raw.detach().numpy(), workers)
    gradients = grid.gradients(model, workers)
    gradients.values.fill_(1.0)
    gradients.weights.fill_(1.0)
    gradients.touched.fill_(1)
    config = OptimConfig(tv_density=3e-2, tv_rgb=2e-3, tv_every=every)
    smooth = variation(model, grid, config, coarser * 60, ones(60), workers)
    smooth(gradients, 0, 0.0, n_steps)
    added = gradients.values.numpy().reshape(shape) - 1.0
    assert raw.grad is not None
    np.testing.assert_allclose(added, raw.grad.numpy(), atol=1e-6)
    assert (gradients.weights.numpy() == 1.0).all()  # nothing lies next to a weight


@pytest.mark.parametrize("model", [RGB, DEFERRED])
def test_updates_pack_their_launches_once(
    model: Model, monkeypatch: pytest.MonkeyPatch, on_cpu: None
) -> None:
    """And take what they are given: another grid, another rate."""
    workers, strength = Workers("cpu", 2), ones(1000)
    config = OptimConfig(tv_density=1e-2, tv_rgb=1e-3)
    rng = np.random.default_rng(0)
    raw = rng.normal(size=(2, 10, 10, 10, model.n_floats)).astype(np.float32)
    updates = [(0, 1, 1.0), (0, 2, 0.5), (1, 1, 3.0)]  # of which grid, number, factor

    def results(in_one: bool) -> list[np.ndarray]:
        grids = [grid_of(values, workers) for values in raw]
        both = [learned(model, grid, config, workers) for grid in grids]
        states = [first_states(parameters, workers) for parameters in both]
        gradients = grids[0].gradients(model, workers)
        found = []
        for which, number, factor in updates:
            parameters = both[which]
            gradients.values.fill_(1.0)
            gradients.weights.fill_(1.0)
            gradients.touched.fill_(1)
            smooth = variation(model, grids[which], config, 1000, strength, workers)
            smooth(gradients, 0, 0.0, 1)
            found.append(gradients.values.numpy().copy())
            adam_step(parameters, states[which], gradients, number, factor, config, workers)
            found.append(np.concatenate([p.values.numpy().ravel() for p in parameters]))
            if in_one:
                monkeypatch.setattr(wp, "launch", None)  # nothing is packed from now on
            else:
                gradients = grids[0].gradients(model, workers)
        return found

    expected = results(in_one=False)
    # Padding has no variation.
    assert all(np.abs(tv - 1.0).max() > 1e-3 for tv in expected[::2])
    assert np.abs(expected[0] - expected[4]).max() > 1e-3
    for got, wanted in zip(results(in_one=True), expected, strict=True):
        assert np.array_equal(got, wanted)


@pytest.mark.parametrize("device_threads", [1, 3])
def test_weights_are_updated_by_the_sum_of_the_workers_gradients(
    device_threads: int, device: str
) -> None:
    """Against the oracle's Adam; what has no gradient stays, and gradients are zeroed."""
    model = PerSample(width=16, hidden_layers=1, learning_rate_mlp=0.03)
    workers = Workers(device, device_threads)
    grid = grid_of(np.zeros((2, 2, 2, model.n_floats)), workers)
    config = OptimConfig(epsilon=1e-4)
    parameters = learned(model, grid, config, workers)
    states = first_states(parameters, workers)
    gradients = grid.gradients(model, workers)
    values = parameters[1].values.numpy().astype(float)
    n = len(values)
    mean, square = np.zeros(n), np.zeros(n)
    rng = np.random.default_rng(3)
    for update, factor in ((1, 1.0), (2, 0.5), (3, 2.0)):
        given = rng.normal(size=gradients.weights.shape).astype(np.float32)
        still = rng.uniform(size=given.shape[1]) < 0.3
        given[:, still] = 0.0
        gradients.weights.assign(given)
        before = parameters[1].values.numpy().copy()
        adam_step(parameters, states, gradients, update, factor, config, workers)
        total = torch.tensor(given.astype(float).sum(axis=0)[:n])
        rate = torch.tensor(factor * model.learning_rate_mlp, dtype=torch.float64)
        tensors = [torch.tensor(a) for a in (values, mean, square)]
        values, mean, square = (
            t.numpy()
            for t in reference.adam(
                *tensors, total, update, rate, config.beta1, config.beta2, config.epsilon
            )
        )
        found = parameters[1].values.numpy()
        np.testing.assert_array_equal(found[still[:n]], before[still[:n]])
        assert (found != before)[~still[:n]].mean() > 0.99
        np.testing.assert_allclose(found, values, atol=2e-6)
        for name, exact in (("mean", mean), ("square", square)):
            np.testing.assert_allclose(states["weights"][name].numpy(), exact, atol=1e-5)
        assert not gradients.weights.numpy()[:, :n].any()
        assert not grid.values.numpy().any()  # nor has a node moved


def test_each_number_of_a_node_has_its_rate(device: str) -> None:
    """In the first update, Adam moves each entry by its rate, whatever the gradient."""
    model, workers = DEFERRED, Workers(device, 2)
    config = OptimConfig(learning_rate_density=0.4, learning_rate_rgb=0.3, epsilon=1e-9)
    grid = grid_of(np.zeros((2, 3, 2, model.n_floats)), workers)
    parameters = learned(model, grid, config, workers)
    gradients = grid.gradients(model, workers)
    gradients.values.assign(np.random.default_rng(0).uniform(0.5, 2.0, (12, model.n_floats)))
    gradients.touched.fill_(1)
    adam_step(parameters, first_states(parameters, workers), gradients, 1, 0.5, config, workers)
    moved = [-0.2, *3 * [-0.15], *2 * [-0.1], 0.0, 0.0]
    np.testing.assert_allclose(grid.values.numpy(), np.tile(moved, (12, 1)), rtol=1e-5)
