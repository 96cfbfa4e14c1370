"""warpnerf.torch.render_rays with the models whose colour depends on the view."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.support.expected import assert_close
from tests.support.model_problems import (
    DEFERRED,
    DEFERRED_SMALL,
    FEATURES,
    FEATURES_SMALL,
    SH,
    layers_of,
    name_of,
    oracle_both,
    oracle_seen,
    problem_of,
    smooth_problems,
)
from tests.support.problems import Problem, in_float32
from warpnerf.checks import InputError
from warpnerf.model.interface import Model
from warpnerf.model.models import Deferred, SphericalHarmonics
from warpnerf.torch import Head, March, render_rays

MODELS = (SH[3], DEFERRED_SMALL, DEFERRED, FEATURES_SMALL, FEATURES)


def problem(model: Model, seed: int, **changes: Any) -> Problem:
    return as_torch_has_it(in_float32(problem_of(model, seed, **changes)))


def as_torch_has_it(p: Problem) -> Problem:
    """Samples in the middle of their steps, and without padding."""
    raw = p.raw.copy()
    raw[..., 1 + p.model.n_features :] = 0.0
    return replace(p, raw=raw, offsets=np.array([0.5]))


def tensors(p: Problem, dtype: torch.dtype, device: str) -> tuple[Tensor, list[Tensor]]:
    """raw without padding, and the head as torch.nn.Linear holds it; all want gradients."""

    def leaf(values: Any) -> Tensor:
        return torch.tensor(values, dtype=dtype, device=device).requires_grad_()

    head = [leaf(layer.T if layer.ndim == 2 else layer) for layer in layers_of(p.model, p.weights)]
    return leaf(p.raw[..., : 1 + p.model.n_features]), head


def call(
    p: Problem, raw: Tensor, head: Iterable[Tensor], scaling: Any = "clamped", **changes: Any
) -> Any:
    def like_raw(values: Any) -> Tensor:
        return torch.tensor(values, dtype=raw.dtype, device=raw.device)

    options: dict[str, Any] = {
        "step": March(p.steps.step, p.steps.near, p.steps.far),
        "density_shift": p.density_shift,
        "background": like_raw(p.background),
        "scaling": scaling,
        "content_distance": like_raw(p.content_distance),
        "head": Head(changes.pop("model", p.model), head),
    }
    corners = tuple(p.box_min), tuple(p.box_max)
    rays = like_raw(p.origins), like_raw(p.directions)
    return render_rays(raw, *rays, corners, **options | changes)


def gradients(p: Problem, raw: Tensor, head: list[Tensor]) -> list[Any]:
    adjoints = [
        torch.tensor(a, dtype=raw.dtype, device=raw.device)
        for a in (p.adj_rgb, p.adj_opacity, p.adj_depth)
    ]
    found = torch.autograd.grad(call(p, raw, head), [raw, *head], adjoints)
    return [gradient.cpu().numpy() for gradient in found]


@pytest.mark.parametrize("model", MODELS, ids=name_of)
def test_against_the_oracle(model: Model, device: str) -> None:
    for p in map(as_torch_has_it, smooth_problems(model, 3)):
        theirs = oracle_seen(p)
        expected_raw, expected_head = oracle_both(p, "clamped")
        for dtype, tolerance in ((torch.float64, 1e-9), (torch.float32, 1e-5)):
            if dtype == torch.float32 and model in (DEFERRED_SMALL, FEATURES_SMALL):
                continue  # no more kernels than it takes
            raw, head = tensors(p, dtype, device)
            ours = call(p, raw, head)
            assert ours.rgb.dtype == dtype
            for a, b in zip(ours, theirs[:3], strict=True):
                assert_close(a.detach().cpu(), b, tolerance)
            of_raw, *of_head = gradients(p, raw, head)
            assert_close(of_raw, expected_raw[..., : raw.shape[3]], tolerance)
            layers = layers_of(model, expected_head)
            for found, expected in zip(of_head, layers, strict=True):
                wanted = expected.T if expected.ndim == 2 else expected
                largest = np.abs(expected_head).max()
                assert found.shape == wanted.shape
                assert np.abs(found - wanted).max() <= tolerance * largest


@pytest.mark.parametrize("model", [DEFERRED_SMALL, FEATURES_SMALL], ids=name_of)
def test_gradcheck(model: Model, device: str) -> None:
    """Of all tensors at once, where all samples lie beyond the content distance."""
    p = problem(model, 3, n_rays=3, size=(2, 3, 2))
    p = replace(p, content_distance=np.array([1e-30]))
    raw, head = tensors(p, torch.float64, device)
    assert torch.autograd.gradcheck(
        lambda raw, *head: tuple(call(p, raw, list(head))), (raw, *head), atol=1e-7, rtol=1e-5
    )


def test_scaling_none_is_the_default(device: str) -> None:
    p = problem(DEFERRED_SMALL, 4)
    raw, head = tensors(p, torch.float64, device)
    (plain,) = torch.autograd.grad(call(p, raw, head, scaling="none").rgb.sum(), raw)
    beyond = replace(p, content_distance=np.array([1e-30]))
    (clamped,) = torch.autograd.grad(call(beyond, raw, head).rgb.sum(), raw)
    assert_close(plain.cpu(), clamped.cpu(), 1e-13)


def test_layers_of_torch_modules_fit(device: str) -> None:
    """parameters() of a Sequential are the head, in their order."""
    p = problem(DEFERRED, 5)
    network = torch.nn.Sequential(
        torch.nn.Linear(7 + 9, 32),
        torch.nn.ReLU(),
        torch.nn.Linear(32, 32),
        torch.nn.ReLU(),
        torch.nn.Linear(32, 3),
    ).to(device=device, dtype=torch.float64)
    raw = tensors(p, torch.float64, device)[0]
    call(p, raw, network.parameters()).rgb.sum().backward()
    weights = np.zeros_like(p.weights)
    for layer, parameter in zip(layers_of(p.model, weights), network.parameters(), strict=True):
        values = parameter.detach().cpu().numpy()
        layer[...] = values.T if values.ndim == 2 else values
    ones = replace(
        p,
        weights=weights,
        adj_rgb=np.ones_like(p.adj_rgb),
        adj_opacity=0.0 * p.adj_opacity,
        adj_depth=0.0 * p.adj_depth,
    )
    expected_raw, expected_head = oracle_both(ones, "clamped")
    assert raw.grad is not None
    assert_close(raw.grad.cpu(), expected_raw[..., :8], 1e-9)
    for layer, parameter in zip(
        layers_of(p.model, expected_head), network.parameters(), strict=True
    ):
        assert parameter.grad is not None
        assert_close(parameter.grad.cpu().numpy(), layer.T if layer.ndim == 2 else layer, 1e-9)


def test_a_model_by_name_is_its_default(device: str) -> None:
    p = problem(Deferred(), 6)
    raw, head = tensors(p, torch.float64, device)
    named, given = (call(p, raw, head, model=model) for model in ("deferred", p.model))
    assert torch.equal(named.rgb, given.rgb)


def refused(device: str, message: str, raw: Any = None, head: Any = None, **changes: Any) -> None:
    """What a problem of a small model becomes with another raw or head; both are functions."""
    p = problem(DEFERRED_SMALL, 7)
    given = tensors(p, torch.float64, device)
    with pytest.raises(InputError, match=message):
        call(
            p,
            raw(given[0]) if raw else given[0],
            head(given[1]) if head else given[1],
            **changes,
        )


def test_heads_of_other_shapes_are_refused(device: str) -> None:
    shapes = r"shapes \[\(16, 7\), \(16,\), \(3, 16\), \(3,\)\], weight and bias of each layer"
    for head in (
        lambda head: [],
        lambda head: head[:-1],
        lambda head: [*head, head[-1]],
        lambda head: [head[0].t(), *head[1:]],
        lambda head: head[::-1],
        lambda head: [head[0][:, :6], *head[1:]],
    ):
        refused(device, shapes, head=head)


def test_heads_that_are_no_tensors_are_refused(device: str) -> None:
    refused(device, r"head\[0\] must be a torch tensor, not float", head=lambda h: [3.0, *h[1:]])
    refused(
        device,
        r"head\[1\] must be floating point",
        head=lambda head: [head[0], head[1].long(), *head[2:]],
    )


def test_heads_of_models_without_one_are_refused(device: str) -> None:
    refused(
        device, "head must be empty: the model rgb has no MLP", lambda r: r[..., :4], model="rgb"
    )
    sh = SphericalHarmonics(degree=0)
    refused(device, "head must be empty: the model sh has no MLP", lambda r: r[..., :4], model=sh)


@pytest.mark.parametrize("model", [None, 5, Deferred])
def test_what_is_no_model_is_refused(model: Any) -> None:
    raw, ray = torch.zeros(2, 2, 2, 4), torch.eye(3)[:1]
    with pytest.raises(InputError, match="model must be a name or a model, not "):
        render_rays(raw, ray, ray, ((-1, -1, -1), (1, 1, 1)), step=0.1, head=Head(model))


def test_raw_of_another_width_is_refused(device: str) -> None:
    refused(device, r"raw must be \[X, Y, Z, 5\]", raw=lambda raw: raw[..., :4])
    refused(device, r"raw must be \[X, Y, Z, 13\]", model="per_sample")
    refused(device, r"raw must be \[X, Y, Z, 28\]", model="sh", head=lambda head: [])
    refused(device, "model must be", model="nerf")
