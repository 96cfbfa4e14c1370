"""What turns features into colour: the four models, from their formulas.

A head says how many features a node has, what channels of a sample are composited, and how a ray's
colour comes from those. `render` does the rest. Weights of networks are [inputs, outputs].
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor


def view_encoding(directions: Tensor, n_frequencies: int) -> Tensor:
    """enc(d) = (d, sin(2^0 d), cos(2^0 d), ..., sin(2^(n-1) d), cos(2^(n-1) d)).

    Args:
        directions: Unit vectors d [..., 3].
        n_frequencies: n >= 0.

    Returns:
        Encodings [..., 3 + 6 n]; each part is a 3-vector.
    """
    parts = [directions]
    for k in range(n_frequencies):
        angle = 2.0**k * directions
        parts += [torch.sin(angle), torch.cos(angle)]
    return torch.cat(parts, dim=-1)


def spherical_harmonics(directions: Tensor, degree: int) -> Tensor:
    """Real spherical harmonics with the Condon-Shortley phase, as polynomials in (x, y, z).

    Of each degree l the orders run from -l to l: Y_k with k = l^2 + l + m.

    Args:
        directions: Unit vectors [..., 3].
        degree: Highest degree, 0 to 3.

    Returns:
        Y [..., (degree + 1)^2], orthonormal over the unit sphere.
    """
    if degree not in (0, 1, 2, 3):
        raise ValueError(f"degree must be 0 to 3, not {degree!r}.")
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z

    def root(share: float) -> float:
        return math.sqrt(share / math.pi)

    basis = [torch.full_like(x, root(1 / 4))]
    if degree >= 1:
        basis += [-root(3 / 4) * y, root(3 / 4) * z, -root(3 / 4) * x]
    if degree >= 2:
        basis += [
            root(15 / 4) * x * y,
            -root(15 / 4) * y * z,
            root(5 / 16) * (2.0 * zz - xx - yy),
            -root(15 / 4) * x * z,
            root(15 / 16) * (xx - yy),
        ]
    if degree >= 3:
        basis += [
            -root(35 / 32) * y * (3.0 * xx - yy),
            root(105 / 4) * x * y * z,
            -root(21 / 32) * y * (4.0 * zz - xx - yy),
            root(7 / 16) * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
            -root(21 / 32) * x * (4.0 * zz - xx - yy),
            root(105 / 16) * z * (xx - yy),
            -root(35 / 32) * x * (xx - 3.0 * yy),
        ]
    return torch.stack(basis, dim=-1)


class Network(NamedTuple):
    """Parameters of a multilayer perceptron of L hidden layers: L + 1 of each."""

    weights: Sequence[Tensor]
    """W_l [inputs, outputs]."""
    biases: Sequence[Tensor]
    """b_l [outputs]."""


def mlp(x: Tensor, network: Network) -> Tensor:
    """y = W_out relu(... relu(W_1 x + b_1) ...) + b_out.

    Args:
        x: Inputs [..., n_inputs].
        network: Of L >= 0 hidden layers.

    Returns:
        Outputs [..., n_outputs], linear.
    """
    last = len(network.weights) - 1
    for layer, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        x = x @ weight + bias
        if layer < last:
            x = torch.where(x > 0.0, x, torch.zeros_like(x))
    return x


def random_network(
    n_inputs: int, n_hidden: int = 2, width: int = 32, n_outputs: int = 3, seed: int = 0
) -> Network:
    """Float64 weights and biases from a normal distribution, outputs of about unit size."""
    generator = torch.Generator().manual_seed(seed)
    sizes = [n_inputs, *[width] * n_hidden, n_outputs]

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    return Network(
        [normal(a, b) * math.sqrt(2.0 / a) for a, b in itertools.pairwise(sizes)],
        [0.3 * normal(b) for b in sizes[1:]],
    )


class Head(Protocol):
    """What is between the features of samples and the colours of rays."""

    @property
    def n_features(self) -> int:
        """F: values 1 to F of a node are its; further ones are not read."""

    def shade(self, features: Tensor, directions: Tensor, weights: Tensor) -> Tensor:
        """What is composited.

        Args:
            features: Interpolated raw features [n_rays, n_steps, F].
            directions: Unit vectors [n_rays, 3].
            weights: w_i [n_rays, n_steps], without gradient.

        Returns:
            Channels of each sample [n_rays, n_steps, C]; the gradient scaling acts on these.
        """

    def color(
        self, composited: Tensor, transmittance: Tensor, directions: Tensor, background: Tensor
    ) -> Tensor:
        """A ray's colour.

        Args:
            composited: sum_i w_i channels_i [n_rays, C].
            transmittance: T_end [n_rays].
            directions: Unit vectors [n_rays, 3].
            background: Colour [3] or [n_rays, 3].

        Returns:
            rgb [n_rays, 3].
        """


class _OverBackground:
    """rgb = sum_i w_i c_i + T_end background."""

    def color(
        self, composited: Tensor, transmittance: Tensor, directions: Tensor, background: Tensor
    ) -> Tensor:
        return composited + transmittance[:, None] * background


@dataclass(frozen=True)
class RgbHead(_OverBackground):
    """`rgb`: c_i = sigmoid(f_i)."""

    n_features: int = 3

    def shade(self, features: Tensor, directions: Tensor, weights: Tensor) -> Tensor:
        return torch.sigmoid(features)


@dataclass(frozen=True)
class ShHead(_OverBackground):
    """`sh`: c_i = sigmoid(sum_k Y_k(d) f[3k : 3k + 3])."""

    degree: int

    @property
    def n_features(self) -> int:
        return 3 * (self.degree + 1) ** 2

    def shade(self, features: Tensor, directions: Tensor, weights: Tensor) -> Tensor:
        basis = spherical_harmonics(directions, self.degree)[:, None, :, None]  # [n_rays, 1, k, 1]
        by_basis = features.unflatten(-1, (-1, 3))  # [n_rays, n_steps, k, 3]
        return torch.sigmoid((basis * by_basis).sum(dim=-2))


@dataclass(frozen=True)
class DeferredHead:
    """`deferred`: what the view changes is added once for a ray, from its composited features.

    g_i = sigmoid(f_i),  G = sum_i w_i g_i,  o = 1 - T_end
    rgb = G[0:3] + o MLP([G, enc(d)]) + T_end background
    """

    network: Network
    """3 + n_specular + 3 + 6 n_frequencies inputs, 3 outputs."""
    n_specular: int = 4
    n_frequencies: int = 1

    @property
    def n_features(self) -> int:
        return 3 + self.n_specular

    def shade(self, features: Tensor, directions: Tensor, weights: Tensor) -> Tensor:
        return torch.sigmoid(features)

    def color(
        self, composited: Tensor, transmittance: Tensor, directions: Tensor, background: Tensor
    ) -> Tensor:
        encoded = view_encoding(directions, self.n_frequencies)
        specular = mlp(torch.cat([composited, encoded], dim=-1), self.network)
        opacity = 1.0 - transmittance
        over = transmittance[:, None] * background
        return composited[:, :3] + opacity[:, None] * specular + over


@dataclass(frozen=True)
class FeaturesHead(_OverBackground):
    """`features`: a network for each sample that has some weight; the others stay without colour.

    c_i = sigmoid(f_i[0:3] + MLP([f_i[3:], enc(d)]))  residual
    c_i = sigmoid(MLP([f_i, enc(d)]))                 otherwise
    c_i = 0 where w_i <= threshold
    Source: Sun et al. 2022 (DVGO), the fine stage.
    """

    network: Network
    """n_features (- 3 where residual) + 3 + 6 n_frequencies inputs, 3 outputs."""
    n_features: int = 12
    n_frequencies: int = 4
    residual: bool = True
    threshold: float = 1e-4

    def shade(self, features: Tensor, directions: Tensor, weights: Tensor) -> Tensor:
        encoded = view_encoding(directions, self.n_frequencies)[:, None, :]
        encoded = encoded.expand(*features.shape[:2], -1)
        if self.residual:
            change = mlp(torch.cat([features[..., 3:], encoded], dim=-1), self.network)
            raw = features[..., :3] + change
        else:
            raw = mlp(torch.cat([features, encoded], dim=-1), self.network)
        seen = (weights > self.threshold)[..., None]
        return torch.where(seen, torch.sigmoid(raw), torch.zeros_like(raw))
