"""torch.compile for models with more features than a colour: sh, deferred, features.

Samples are packed by eager torch, as in torch_models.py; from there on compiled functions read the
grid, and take loss, gradient and scattering in one. The gradient between nodes read and nodes
written is torch.func's, whose graph the compiler sees whole; reading and scattering are by hand.
The numbers of samples are fixed, so it compiles once for each workload.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import torch
import torch.nn.functional as F
from workload import DENSITY_SHIFT, MODELS, Workload

from candidates.torch_compiled import obstacle as obstacle
from candidates.torch_models import (
    Choices,
    Part,
    TorchModels,
    perceptron,
    spherical_harmonics,
    view_encoding,
)


def scale(x: torch.Tensor, factor: torch.Tensor) -> torch.Tensor:
    """x, whose gradient is multiplied by a factor."""
    return x * factor + (x * (1.0 - factor)).detach()


class CompiledModels(TorchModels):
    """A workload's training step in compiled torch."""

    def __init__(self, work: Workload, threads: int, device: str) -> None:
        """Load a workload."""
        super().__init__(work, Choices(threads=threads), device)
        torch._dynamo.config.recompile_limit = 256
        compile_it = partial(torch.compile, dynamic=False, fullgraph=True)
        self.network = [array.detach() for array in self.network]
        self._read_densities = compile_it(self._densities_of)
        self._train = compile_it(self._train_features if self._is_features else self._train_all)
        self._gradient, self._seen_rgb = torch.empty(0), torch.empty(0)
        self._adj_network: tuple[torch.Tensor, ...] = ()

    @property
    def _is_features(self) -> bool:
        return self._work.model == "per_sample"

    @torch.no_grad()
    def step(self) -> None:
        """Forward, loss and adjoint."""
        torch.set_num_threads(self.choices.threads)
        part = self._part(slice(0, len(self._work.origins)))
        node = part.place[0].long()
        if self._is_features:
            density, weight = self._read_densities(node, part)
            seen = (weight > MODELS["per_sample"].threshold).nonzero()[:, 0]
            found = self._train(node, part, density, seen)
        else:
            found = self._train(node, part)
        self._gradient, self._seen_rgb, self._adj_network = found

    def rgb(self) -> np.ndarray:
        """[n_rays, 3]"""
        return self._seen_rgb.cpu().numpy()

    def network_gradient(self) -> np.ndarray:
        """[n_parameters], weights and biases in turn."""
        parts = [np.zeros(0, np.float32)]
        return np.concatenate(parts + [adj.cpu().numpy().ravel() for adj in self._adj_network])

    def gradient(self) -> np.ndarray:
        """[X, Y, Z, n_values]"""
        return self._gradient.cpu().numpy().reshape(self._work.values.shape)

    def _gather(
        self, values: torch.Tensor, node: torch.Tensor, share: torch.Tensor
    ) -> torch.Tensor:
        return sum(share[:, i, None] * values[node[:, i]] for i in range(8))

    def _scatter(
        self, out: torch.Tensor, node: torch.Tensor, share: torch.Tensor, adj: torch.Tensor
    ) -> torch.Tensor:
        for i in range(8):
            out = out.index_add(0, node[:, i], share[:, i, None] * adj)
        return out

    def _composited(self, density: torch.Tensor, part: Part) -> tuple[torch.Tensor, torch.Tensor]:
        """Weights [n_samples] and light that passes [n_rays]."""
        sigma = scale(F.softplus(density + DENSITY_SHIFT), part.factor)
        n_rays, width = len(part.directions), part.width
        tau = sigma.new_zeros(n_rays * width).index_copy(0, part.index, sigma * self._work.step)
        tau = tau.view(n_rays, width)
        depth = tau.cumsum(1)
        weight = torch.exp(tau - depth) * -torch.expm1(-tau)
        return weight.view(-1)[part.index], torch.exp(-depth[:, -1])

    def _sums(self, values: torch.Tensor, ray: torch.Tensor, n_rays: int) -> torch.Tensor:
        return values.new_zeros(n_rays, values.shape[1]).index_add(0, ray, values)

    def _densities_of(self, node: torch.Tensor, part: Part) -> tuple[torch.Tensor, torch.Tensor]:
        assert self._densities is not None
        density = self._gather(self._densities.values, node, part.place[1])[:, 0]
        return density, self._composited(density, part)[0]

    def _loss(self, rgb: torch.Tensor) -> torch.Tensor:
        return (rgb - self._rays[2]).square().sum() / len(rgb)

    def _differentiated(
        self, loss: Callable[..., tuple[torch.Tensor, torch.Tensor]], *inputs: torch.Tensor
    ) -> tuple[tuple[torch.Tensor, ...], torch.Tensor]:
        argnums = tuple(range(len(inputs)))
        return torch.func.grad(loss, argnums=argnums, has_aux=True)(*inputs)

    def _train_all(
        self, node: torch.Tensor, part: Part
    ) -> tuple[torch.Tensor, torch.Tensor, tuple[torch.Tensor, ...]]:
        """All that models do that have a colour for every sample."""
        n_rays = len(part.directions)

        def loss(raw: torch.Tensor, *network: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            weight, passed = self._composited(raw[:, 0], part)
            if self._work.model == "sh":
                basis = spherical_harmonics(part.directions)[part.ray]
                color = torch.sigmoid((raw[:, 1:28].view(-1, 9, 3) * basis[:, :, None]).sum(1))
                color = scale(color, part.factor[:, None])
                seen = self._sums(weight[:, None] * color, part.ray, n_rays)
            else:
                channels = scale(torch.sigmoid(raw[:, 1:]), part.factor[:, None])
                features = self._sums(weight[:, None] * channels, part.ray, n_rays)
                encoded = view_encoding(part.directions, MODELS["deferred"].n_frequencies)
                specular = perceptron(torch.cat([features, encoded], dim=1), list(network))
                seen = features[:, :3] + (1.0 - passed)[:, None] * specular
            seen = seen + passed[:, None] * self._background
            return self._loss(seen), seen

        raw = self._gather(self._nodes.values, node, part.place[1])
        (adj_raw, *adj_network), seen = self._differentiated(loss, raw, *self.network)
        gradient = self._scatter(torch.zeros_like(self._nodes.values), node, part.place[1], adj_raw)
        return gradient, seen, tuple(adj_network)

    def _train_features(
        self, node: torch.Tensor, part: Part, density: torch.Tensor, chosen: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, tuple[torch.Tensor, ...]]:
        """All that follows once it is known which samples have a colour."""
        n_rays = len(part.directions)
        ray, factor = part.ray[chosen], part.factor[chosen]

        def loss(
            density: torch.Tensor, raw: torch.Tensor, *network: torch.Tensor
        ) -> tuple[torch.Tensor, torch.Tensor]:
            weight, passed = self._composited(density, part)
            encoded = view_encoding(part.directions, MODELS["per_sample"].n_frequencies)
            weights, bias = network[:2]
            of_ray = torch.addmm(bias, encoded, weights[9:])
            hidden = torch.relu(raw[:, 4:13] @ weights[:9] + of_ray[ray])
            color = torch.sigmoid(raw[:, 1:4] + perceptron(hidden, list(network[2:])))
            color = scale(color, factor[:, None])
            seen = self._sums(weight[chosen][:, None] * color, ray, n_rays)
            seen = seen + passed[:, None] * self._background
            return self._loss(seen), seen

        near, share = node[chosen], part.place[1][chosen]
        raw = self._gather(self._nodes.values, near, share)
        (adj_density, adj_raw, *adj_network), seen = self._differentiated(
            loss, density, raw, *self.network
        )
        gradient = self._scatter(torch.zeros_like(self._nodes.values), near, share, adj_raw)
        assert self._densities is not None
        of_density = torch.zeros_like(self._densities.values)
        of_density = self._scatter(of_density, node, part.place[1], adj_density[:, None])
        gradient = torch.cat([of_density, gradient[:, 1:]], dim=1)
        return gradient, seen, tuple(adj_network)


load = CompiledModels
