"""The interface of radiance models: the kernels' parts, and what of them is trained and how.

A model is a frozen value. It names the parts that ``warpnerf_kernels.launch.assembly`` puts
together. ``warpnerf.model.models`` has those of the package.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import cache
from types import ModuleType
from typing import Any, ClassVar, Protocol

import numpy as np

from warpnerf.model import registry

Load = Callable[[str], ModuleType]
"""A module of the kernels, by its name in the package, in some precision."""


class Rates(Protocol):
    """Learning rates and total variation weights, as ``warpnerf.optim_config.OptimConfig`` has
    them."""

    @property
    def learning_rate_density(self) -> float: ...  # noqa: D102
    @property
    def learning_rate_rgb(self) -> float: ...  # noqa: D102
    @property
    def tv_density(self) -> float: ...  # noqa: D102
    @property
    def tv_rgb(self) -> float: ...  # noqa: D102


class Model(ABC):
    """A radiance model: what is read at a sample, and how that becomes colour."""

    name: ClassVar[str]
    """What the command and files call it."""
    by_sample: ClassVar[bool] = False
    """Whether the head works on samples and not on lanes, and wants raw values so."""
    learning_rate_mlp: float = 0.0
    """Of the weights of the head's MLP, where it has one."""

    @property
    def relative_time(self) -> float:
        """Training time of a step relative to the model rgb, about.

        That is what its nodes cost, by benchmarks/models.py; a model with an MLP adds it.
        """
        return 0.72 + 0.07 * self.n_floats

    def keep_plain(self) -> None:
        """Convert NumPy scalars in the fields of a frozen dataclass to plain int, float or bool.

        So what files hold of it is read back as the same. For ``__post_init__``.

        Raises:
            InputError: A field is given something of another type than its default is.
        """
        registry.keep_plain(self, "model")

    @property
    @abstractmethod
    def n_features(self) -> int:
        """How many raw features a sample has, besides its raw density."""

    @property
    def n_floats(self) -> int:
        """Numbers of a sample: density, features, and padding to a power of two, at least 4."""
        return max(4, 1 << self.n_features.bit_length())

    @abstractmethod
    def parts(self, load: Load) -> Any:
        """The kernels' parts: head, sampler and losses; the encoding is its storage's.

        Args:
            load: The kernels' modules, in the precision that is wanted.

        Returns:
            ``warpnerf_kernels.launch.assembly.Parts``.
        """

    def layout(self, load: Load) -> Any:
        """The shape of the head's MLP.

        Args:
            load: The kernels' modules.

        Returns:
            ``warpnerf_kernels.networks.mlp.Layout``; None: the head has no MLP.
        """
        return None

    def march(self, load: Load, steps: Any, device: Any) -> Any:
        """The sampler's parameters, from ``warpnerf.rendering.steps.Steps``.

        Args:
            load: The kernels' modules.
            steps: What is configured.
            device: The ``warp.Device`` where arrays among the parameters have to lie.

        Returns:
            The struct ``Params`` of the model's sampler.
        """
        return steps.struct(load("sampling.steps"))

    def loss_params(self, load: Load) -> Any:
        """The numbers of the loss on the ray that the model itself has, if it has one.

        Args:
            load: The kernels' modules.

        Returns:
            The struct ``Params`` of that loss.
        """
        return self.parts(load).losses.on_ray.Params()

    def sample_loss_params(self, load: Load) -> Any:
        """The numbers of the loss on samples that the model itself has, if it has one.

        Args:
            load: The kernels' modules.

        Returns:
            The struct ``Params`` of that loss.
        """
        return self.parts(load).losses.on_samples.Params()

    def most_steps(self, steps: Any, length: float) -> int:
        """The most samples that ray marching takes along a ray: workers make room for as many.

        Args:
            steps: What is configured, ``warpnerf.rendering.steps.Steps``.
            length: Of the ray's way through the box, in its coordinates; infinite where space is
                contracted.

        Returns:
            That, or more.
        """
        return int(steps.most(length))

    def first_weights(self, seed: int) -> np.ndarray:
        """The MLP's weights before the first step.

        Args:
            seed: Of what is random.

        Returns:
            [n_weights] float32, as ``layout`` orders them; none without an MLP.
        """
        layout = self.layout(loader("float32"))
        return np.zeros(0, np.float32) if layout is None else uniform_weights(layout, seed, 1.0)

    def learning_rates(self, optim: Rates) -> np.ndarray:
        """Initial learning rates of the numbers that are read at a sample: about how far an update
        moves each.

        Args:
            optim: What is configured for all models.

        Returns:
            [n_floats]; 0 for padding.
        """
        rates = np.zeros(self.n_floats)
        rates[0] = optim.learning_rate_density
        rates[1 : 1 + self.n_features] = optim.learning_rate_rgb
        return rates

    def variation(self, optim: Rates) -> np.ndarray:
        """Total variation weights of the numbers that are read at a sample.

        Args:
            optim: What is configured for all models.

        Returns:
            [n_floats] weights; 0 for padding.
        """
        weights = np.zeros(self.n_floats)
        weights[0] = optim.tv_density
        weights[1 : 1 + self.n_features] = optim.tv_rgb
        return weights


def n_weights(model: Model) -> int:
    """The number of MLP weights in a model's head; 0 without an MLP."""
    layout = model.layout(loader("float32"))
    return 0 if layout is None else int(layout.n_weights)


@cache
def loader(precision: str) -> Load:
    """Load kernel modules in float32 or float64; the same object each time, so a key for caches.

    Args:
        precision: float32 or float64.
    """

    def load(module: str) -> ModuleType:
        from warpnerf_kernels.base import precision as precisions

        return precisions.load(precision, module)

    return load


def uniform_weights(layout: Any, seed: int, of_output: float) -> np.ndarray:
    """Uniform initial MLP weights within +-1 / sqrt(inputs of the layer), the output's that times a
    factor.

    So are hidden biases; the output's are 0. That is how torch.nn.Linear begins, and DVGO.
    """
    rng = np.random.default_rng(seed)
    weights = np.zeros(layout.n_weights, np.float32)

    def fill(begin: int, end: int, n_inputs: int) -> None:
        limit = 1.0 / np.sqrt(n_inputs)
        weights[begin:end] = rng.uniform(-limit, limit, end - begin)

    fill(0, layout.at_hidden, layout.n_inputs)
    fill(layout.at_hidden, layout.at_output, layout.width)
    last = weights[layout.at_output :].reshape(-1, 4)
    limit = of_output / np.sqrt(layout.width)
    last[:-1, :3] = rng.uniform(-limit, limit, (layout.width, 3))
    return weights
