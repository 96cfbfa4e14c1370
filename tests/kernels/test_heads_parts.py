"""What heads are made of, in float64: harmonics, the encoded direction, and linear transposes."""

from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import warp as wp
from warpnerf_kernels.base import precision

from tests import reference
from tests.support.kernel_runner import Kernels
from tests.support.problems import unit

N_COEFFICIENTS = 48
FREQUENCIES = (0, 1, 4)


@cache
def probes(name: str) -> SimpleNamespace:
    """Kernels around single functions, in one precision."""
    types, sh = precision.load(name, "base.types"), precision.load(name, "heads.sh")
    view = precision.load(name, "heads.view")
    real, vec3 = types.real, types.vec3
    harmonics = sh.basis(3)
    decode, adj_decode = sh.decode, sh.adj_decode
    Params, Basis = types.Nothing, types.vector(16)
    Raw, Gradient = types.vector(64), types.gradient_type(64)
    encode_0, encode_1, encode_4 = (view.encoding(n) for n in FREQUENCIES)
    Encoded_0, Encoded_1, Encoded_4 = (types.vector(view.n_encoded(n)) for n in FREQUENCIES)

    @wp.kernel(module="unique", enable_backward=False)
    def look(
        first: int,
        directions: wp.array(dtype=vec3),
        out_basis: wp.array(dtype=Basis),
        out_0: wp.array(dtype=Encoded_0),
        out_1: wp.array(dtype=Encoded_1),
        out_4: wp.array(dtype=Encoded_4),
    ):
        n = first + wp.tid()
        out_basis[n] = harmonics(Params(), directions[n])
        out_0[n] = encode_0(directions[n])
        out_1[n] = encode_1(directions[n])
        out_4[n] = encode_4(directions[n])

    @wp.kernel(module="unique", enable_backward=False)
    def colour(
        first: int,
        views: wp.array(dtype=Basis),
        raw: wp.array(dtype=Raw),
        adj_logits: wp.array(dtype=vec3),
        gradient: Gradient,
        out_channels: wp.array(dtype=vec3),
        out_adj_raw: wp.array(dtype=Raw),
    ):
        n = first + wp.tid()
        out_channels[n] = decode(Params(), views[n], raw[n])
        # where the sigmoid is 1/2 its slope is 1/4
        half = vec3(real(0.5), real(0.5), real(0.5))
        adj_raw, _adj_view = adj_decode(
            Params(), views[n], raw[n], half, real(4.0) * adj_logits[n], gradient
        )
        out_adj_raw[n] = adj_raw

    return SimpleNamespace(look=look, colour=colour, Basis=Basis, Raw=Raw, Gradient=Gradient)


def directions(n: int = 60) -> Any:
    """Unit vectors, the axes among them."""
    rng = np.random.default_rng(0)
    return unit(np.concatenate([np.eye(3), -np.eye(3), rng.normal(size=(n, 3))]))


@pytest.mark.parametrize(("name", "tolerance"), [("float64", 1e-14), ("float32", 4e-6)])
def test_harmonics_and_encoded_directions(name: str, tolerance: float, device: str) -> None:
    kernels, made = Kernels(name, device), probes(name)
    d = directions()
    sizes = [3 + 6 * n for n in FREQUENCIES]
    out = [kernels.zeros(len(d), kernels.types.vector(n)) for n in (16, *sizes)]
    kernels.workers.launch(made.look, len(d), kernels.array(d, kernels.types.vec3), *out)
    exact = torch.tensor(d)
    expected = [
        reference.spherical_harmonics(exact, 3),
        *(reference.view_encoding(exact, n) for n in FREQUENCIES),
    ]
    for found, wanted in zip(out, expected, strict=True):
        np.testing.assert_allclose(found.numpy(), wanted.numpy(), atol=tolerance, rtol=0)


def test_harmonics_before_the_sigmoid_are_linear(kernels64: Kernels) -> None:
    """<A x, y> = <x, A^T y> for each sample, and A x is the oracle's sum."""
    made, rng, d = probes("float64"), np.random.default_rng(1), directions()
    basis = reference.spherical_harmonics(torch.tensor(d), 3).numpy()
    raw, y = rng.normal(size=(len(d), 64)), rng.normal(size=(len(d), 3))
    vec3 = kernels64.types.vec3
    channels, adj_raw = kernels64.zeros(len(d), vec3), kernels64.zeros(len(d), made.Raw)
    kernels64.workers.launch(
        made.colour,
        len(d),
        kernels64.array(basis, made.Basis),
        kernels64.array(raw, made.Raw),
        kernels64.array(y, vec3),
        made.Gradient(),
        channels,
        adj_raw,
    )
    logits = -np.log(1.0 / channels.numpy() - 1.0)
    coefficients = raw[:, 1 : 1 + N_COEFFICIENTS].reshape(-1, 16, 3)
    np.testing.assert_allclose(logits, np.einsum("nk,nkc->nc", basis, coefficients), rtol=1e-9)
    back = adj_raw.numpy()
    assert not back[:, 0].any() and not back[:, 1 + N_COEFFICIENTS :].any()
    forward, backward = (logits * y).sum(-1), (raw * back).sum(-1)
    assert np.abs(forward).max() > 1.0
    np.testing.assert_allclose(backward, forward, atol=1e-9 * np.abs(forward).max())
