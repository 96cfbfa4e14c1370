"""Models besides rgb: the configurations under test, and their problems put to the oracle."""

import itertools
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tests import reference
from tests.support.expected import RGB, oracle
from tests.support.kernel_runner import Kernels
from tests.support.problems import Float64, Problem, in_float32, make_problem
from warpnerf.model.interface import Model, n_weights
from warpnerf.model.models import Deferred, PerSample, Rgb, SphericalHarmonics

SH = tuple(SphericalHarmonics(degree=degree) for degree in range(4))
DEFERRED = Deferred(specular=4, width=32, hidden_layers=2, frequencies=1)
DEFERRED_SMALL = Deferred(specular=1, width=16, hidden_layers=1, frequencies=0)
DEFERRED_LARGE = Deferred(specular=20, width=48, hidden_layers=3, frequencies=4)
FEATURES = PerSample(threshold=0.02)  # 12 of them, three colour; 32 wide, 2 layers, 4 frequencies
FEATURES_SMALL = PerSample(
    features=5, residual=False, threshold=0.0, width=16, hidden_layers=1, frequencies=0
)
FEATURES_LARGE = PerSample(
    features=31, residual=True, threshold=0.01, width=48, hidden_layers=3, frequencies=1
)


def name_of(model: Model) -> str:
    """For test ids."""
    numbers = [str(value) for value in vars(model).values() if not isinstance(value, float)]
    return "-".join([model.name, *numbers])


def problem_of(model: Model, seed: int, n_rays: int = 13, **changes: Any) -> Problem:
    """Random values in all of a node's numbers and all weights, those of the padding as well.

    Weights are such that neither does a layer fade nor all units of it see the same side of ReLU.
    """
    p = make_problem(seed, n_rays=n_rays, **changes)
    rng = np.random.default_rng(seed)
    raw = rng.normal(size=(*p.raw.shape[:3], model.n_floats))
    p = replace(p, model=model, raw=raw, offsets=rng.uniform(size=n_rays))
    weights = rng.normal(size=n_weights(model))
    for layer in layers_of(model, weights):
        layer *= 1.4 / np.sqrt(len(layer)) if layer.ndim == 2 else 0.3
    return replace(p, weights=weights, content_distance=rng.uniform(0.5, 3.0, size=n_rays))


def sizes_of(model: Model) -> list[int]:
    """Inputs of the model's MLP, units of each hidden layer, outputs; none without an MLP."""
    if not isinstance(model, Deferred | PerSample):
        return []
    if isinstance(model, Deferred):
        own = 3 + model.specular
    else:
        own = model.features - 3 if model.residual else model.features
    return [own + 3 + 6 * model.frequencies, *[model.width] * model.hidden_layers, 3]


def layers_of(model: Model, flat: Any) -> list[Any]:
    """Weights [inputs, outputs] and biases [outputs] of each layer, in turn, as views of the flat
    array that kernels take, where the output layer has a fourth column that nothing reads."""
    layers, begin = [], 0
    for n_in, n_out in itertools.pairwise(sizes_of(model)):
        columns = n_out if n_out != 3 else 4
        weights = flat[begin : begin + n_in * columns].reshape(n_in, columns)
        begin += n_in * columns
        layers += [weights[:, :n_out], flat[begin : begin + n_out]]
        begin += columns
    assert begin == len(flat)
    return layers


def head_of(model: Model, weights: Tensor) -> reference.Head:
    """The oracle's head, of weights that may want a gradient."""
    if isinstance(model, Rgb):
        return RGB
    if isinstance(model, SphericalHarmonics):
        return reference.ShHead(model.degree)
    layers = layers_of(model, weights)
    network = reference.Network(layers[::2], layers[1::2])
    if isinstance(model, Deferred):
        return reference.DeferredHead(network, model.specular, model.frequencies)
    assert isinstance(model, PerSample)
    return reference.FeaturesHead(
        network, model.features, model.frequencies, model.residual, model.threshold
    )


def oracle_seen(p: Problem) -> reference.Rendering:
    """What rays see."""
    return oracle(p, torch.tensor(p.raw), head=head_of(p.model, torch.tensor(p.weights)))


def oracle_both(
    p: Problem, scaling: str = "none", jacobian: str = "none"
) -> tuple[Float64, Float64]:
    """What Kernels.both_backward must return."""
    raw, weights = (torch.tensor(a, requires_grad=True) for a in (p.raw, p.weights))
    out = oracle(p, raw, scaling, jacobian, head_of(p.model, weights))
    adjoints = [torch.tensor(a) for a in (p.adj_rgb, p.adj_opacity, p.adj_depth)]
    return _gradients([out.rgb, out.opacity, out.depth], raw, weights, adjoints)


def oracle_train_both(
    p: Problem, scaling: str = "none", jacobian: str = "none"
) -> tuple[Float64, Float64, Float64]:
    """What Kernels.both_train must return."""
    raw, weights = (torch.tensor(a, requires_grad=True) for a in (p.raw, p.weights))
    out = oracle(p, raw, scaling, jacobian, head_of(p.model, weights))
    target = torch.tensor(p.target)
    error = ((out.rgb - target) ** 2).sum(-1).detach().numpy()
    return error, *_gradients([reference.photometric_loss(out.rgb, target)], raw, weights)


def _gradients(
    outputs: list[Tensor], raw: Tensor, weights: Tensor, adjoints: list[Tensor] | None = None
) -> tuple[Float64, Float64]:
    of_raw, of_weights = torch.autograd.grad(
        outputs, (raw, weights), adjoints, allow_unused=True, materialize_grads=True
    )
    return of_raw.numpy(), of_weights.numpy()


def smooth_problems(model: Model, n: int, first: int = 0, **changes: Any) -> Iterator[Problem]:
    """Problems in float32's numbers whose gradients are not at a kink.

    Where a unit of the MLP is next to 0, or a sample's weight next to the threshold, rounding
    decides what flows back. There the oracle's own gradient jumps if weights move a little.
    """
    found = 0
    for seed in range(first, first + 10 * n):
        p = in_float32(problem_of(model, seed, **changes))
        rng = np.random.default_rng(seed)
        here = oracle_train_both(p)[1:]
        moved = []
        for _ in range(3):
            raw = p.raw + 2e-6 * rng.normal(size=p.raw.shape)
            weights = p.weights + 2e-6 * rng.normal(size=p.weights.shape)
            moved += [oracle_train_both(replace(p, raw=raw, weights=weights))[1:]]
        jumps = [
            np.abs(there[k] - here[k]).max() / np.abs(here[k]).max()
            for there in moved
            for k in range(2)
            if here[k].size
        ]
        if max(jumps) < 5e-5:
            found += 1
            yield p
        if found == n:
            return
    raise AssertionError("too many kinks")


class Stale(Kernels):
    """Kernels whose scratch begins with what shows where it is read before it is written."""

    def scratch(self, variant: Any, capacity: int, workers: Any = None) -> Any:
        scratch = super().scratch(variant, capacity, workers)
        if variant.packed:
            for array in (scratch.packs, scratch.rows):
                array.numpy().view(np.uint8).fill(255)  # not a number
        return scratch
