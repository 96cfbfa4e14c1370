"""Named models, what each is configured by, and their names in files and in the command.

A new one is a subclass of ``warpnerf.model.interface.Model``; with ``register`` it has a name that
the command and files know.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

import numpy as np

from warpnerf.checked import checked
from warpnerf.checks import (
    InputError,
    require_at_least,
    require_one_of,
    require_positive,
    require_whole,
    said,
)
from warpnerf.model import registry
from warpnerf.model.interface import Load, Model, Rates, loader, uniform_weights
from warpnerf.renamed import warn_renamed


@dataclass(frozen=True, kw_only=True)
class Rgb(Model):
    """Density and diffuse RGB: colour that is the same from all sides."""

    name: ClassVar[str] = "rgb"

    @property
    def n_features(self) -> int:
        """How many raw features a sample has: red, green, blue."""
        return 3

    def parts(self, load: Load) -> Any:
        """The kernels' parts: a head that is a sigmoid of RGB."""
        return load("launch.assembly").Parts(head=load("heads.rgb").rgb())


@checked("model")
@dataclass(frozen=True, kw_only=True)
class SphericalHarmonics(Model):
    """View-dependent colour by spherical harmonics, without an MLP."""

    name: ClassVar[str] = "sh"
    degree: int = 2
    """Of the harmonics, 0 to 3: 1, 4, 9 or 16 for each of red, green and blue."""
    learning_rate_sh: float = 0.05
    """How far an update of one step moves coefficients beyond the first one of a colour; see
    ``OptimConfig.learning_rate_rgb``."""

    def __post_init__(self) -> None:
        """Refuse a configuration for which there are no kernels."""
        require_whole("model.degree", self.degree, 0)
        if self.degree > 3:
            raise InputError(f"model.degree must be 0, 1, 2 or 3, not {said(self.degree)}.")
        require_positive("model.learning_rate_sh", self.learning_rate_sh)
        self.keep_plain()

    @property
    def n_features(self) -> int:
        """How many raw features a sample has: three for each spherical harmonic."""
        return int(3 * (self.degree + 1) ** 2)

    def parts(self, load: Load) -> Any:
        """The kernels' parts: a head that evaluates spherical harmonics."""
        return load("launch.assembly").Parts(
            head=load("heads.sh").sh(self.degree),
        )

    def learning_rates(self, optim: Rates) -> np.ndarray:
        """Learning rates of density and harmonics. The first is a constant of 0.28: its rate moves
        colours as far as rgb's."""
        rates = super().learning_rates(optim)
        rates[1:4] = optim.learning_rate_rgb / 0.2820948
        rates[4 : 1 + self.n_features] = self.learning_rate_sh
        return rates


@dataclass(frozen=True, kw_only=True)
class _WithMlp(Model):
    """What models with an MLP have in common."""

    frequencies: int = 1
    """Octaves of sines and cosines of the direction of view that the MLP sees, 0 to 8."""
    width: int = 32
    """Units of each hidden layer, a multiple of 16 up to 128."""
    hidden_layers: int = 2
    """How many the MLP has, 1 to 3."""
    learning_rate_features: float = 0.2
    """How far an update of one step moves features that the MLP sees; see
    ``OptimConfig.learning_rate_rgb``."""
    learning_rate_mlp: float = 5e-3
    """The same of the MLP's weights."""

    def __post_init__(self) -> None:
        """Refuse a configuration for which there are no kernels."""
        require_whole("model.frequencies", self.frequencies, 0)
        if self.frequencies > 8:
            raise InputError(f"model.frequencies must be at most 8, not {said(self.frequencies)}.")
        require_whole("model.width", self.width, 1)
        if self.width % 16 or self.width > 128:
            raise InputError(
                f"model.width must be a multiple of 16 up to 128, not {self.width}: units of a "
                "layer are worked on sixteen at a time."
            )
        require_whole("model.hidden_layers", self.hidden_layers, 1)
        if self.hidden_layers > 3:
            raise InputError(f"model.hidden_layers must be 1, 2 or 3, not {self.hidden_layers}.")
        require_positive("model.learning_rate_features", self.learning_rate_features)
        require_positive("model.learning_rate_mlp", self.learning_rate_mlp)
        self.keep_plain()

    def multiplications(self) -> int:
        """Of one row of the MLP, from its own inputs to its outputs."""
        layout = self.layout(loader("float32"))
        hidden = (self.hidden_layers - 1) * self.width**2
        return int(layout.n_own * self.width + hidden + 4 * self.width)


@checked("model")
@dataclass(frozen=True, kw_only=True)
class Deferred(_WithMlp):
    """Deferred shading: features composited along the ray, then a view-dependent MLP per ray."""

    name: ClassVar[str] = "deferred"
    width: int = 64
    """Units of each hidden layer, a multiple of 16 up to 128."""
    specular: int = 12
    """Features of a node besides its diffuse colour, 1 to 28."""

    def __post_init__(self) -> None:
        """Refuse a configuration for which there are no kernels."""
        super().__post_init__()
        require_whole("model.specular", self.specular, 1)
        if self.specular > 28:
            raise InputError(f"model.specular must be at most 28, not {said(self.specular)}.")

    @property
    def relative_time(self) -> float:
        """Training time relative to rgb: that of its nodes, and of an MLP once a ray."""
        return super().relative_time + 1e-4 * self.multiplications()

    @property
    def n_features(self) -> int:
        """How many raw features a sample has: diffuse colour, specular features."""
        return 3 + self.specular

    def parts(self, load: Load) -> Any:
        """The kernels' parts: a deferred MLP head, evaluated once a ray."""
        return load("launch.assembly").Parts(
            head=load("heads.deferred").deferred(
                self.n_features, self.frequencies, self.width, self.hidden_layers
            ),
        )

    def layout(self, load: Load) -> Any:
        """The MLP's layout: its inputs are all channels and the viewing direction."""
        return load("heads.deferred").layout_of(
            self.n_features, self.frequencies, self.width, self.hidden_layers
        )

    def first_weights(self, seed: int) -> np.ndarray:
        """Initial MLP weights: uniform; the output layer a tenth of that, so that diffuse colour is
        learned first."""
        return uniform_weights(self.layout(loader("float32")), seed, 0.1)

    def learning_rates(self, optim: Rates) -> np.ndarray:
        """Learning rates of density, of diffuse colour and of specular features."""
        rates = super().learning_rates(optim)
        rates[4 : 1 + self.n_features] = self.learning_rate_features
        return rates


@checked("model")
@dataclass(frozen=True, kw_only=True)
class PerSample(_WithMlp):
    """A view-dependent MLP per sample, on its features and the direction of view, as in DVGO."""

    name: ClassVar[str] = "per_sample"
    by_sample: ClassVar[bool] = True
    features: int = 12
    """Of a node: 1 to 31, at least 4 with the residual."""
    frequencies: int = 4
    """Octaves of sines and cosines of the direction of view that the MLP sees, 0 to 8."""
    residual: bool = True
    """Whether the first three features are colour, to which the MLP adds."""
    threshold: float = 1e-4
    """Samples of no more weight get no colour, [0, 1)."""

    def __post_init__(self) -> None:
        """Refuse a configuration for which there are no kernels."""
        super().__post_init__()
        require_whole("model.features", self.features, 1)
        if self.residual and self.features < 4:
            raise InputError(
                f"model.features must be at least 4 with the residual, not {self.features}: three "
                "are colour, and the MLP sees the others; use more, or residual=false."
            )
        if self.features > 31:
            raise InputError(f"model.features must be at most 31, not {self.features}.")
        require_at_least("model.threshold", self.threshold, 0.0)
        if self.threshold >= 1.0:
            raise InputError(f"model.threshold must be below 1, not {said(self.threshold)}.")

    @property
    def relative_time(self) -> float:
        """Training time relative to rgb: that of its nodes, and of an MLP for each sample."""
        return super().relative_time + 5.5e-4 * self.multiplications()

    @property
    def n_features(self) -> int:
        """How many raw features a sample has: as many as are configured."""
        return self.features

    @property
    def n_floats(self) -> int:
        """Numbers of a sample, padded to at least 8: kernels read the first four of a node lane by
        lane, the others by sample."""
        return max(8, super().n_floats)

    def parts(self, load: Load) -> Any:
        """The kernels' parts: an MLP head, evaluated for each sample."""
        return load("launch.assembly").Parts(
            head=load("heads.per_sample").per_sample(
                self.features,
                self.frequencies,
                self.width,
                self.hidden_layers,
                self.residual,
                float(self.threshold),
            ),
        )

    def layout(self, load: Load) -> Any:
        """The MLP's layout: its inputs are the features that are not colour, and the viewing
        direction."""
        return load("heads.per_sample").layout_of(
            self.features, self.frequencies, self.width, self.hidden_layers, self.residual
        )

    def first_weights(self, seed: int) -> np.ndarray:
        """Initial MLP weights: uniform; with the residual, the output layer a tenth of that."""
        layout = self.layout(loader("float32"))
        return uniform_weights(layout, seed, 0.1 if self.residual else 1.0)

    def learning_rates(self, optim: Rates) -> np.ndarray:
        """Learning rates of density, of colour, and of features that the MLP sees."""
        rates = super().learning_rates(optim)
        begin = 4 if self.residual else 1
        rates[begin : 1 + self.n_features] = self.learning_rate_features
        return rates


MODELS: dict[str, type[Model]] = {
    model.name: model for model in (Rgb, SphericalHarmonics, Deferred, PerSample)
}
"""By name."""

FORMER_NAMES = {"features": "per_sample"}
"""Of models, in files and commands of the version before."""

DEFAULTS_BEFORE: dict[str, dict[str, Any]] = {"deferred": {"specular": 4, "width": 32}}
"""By name, what was the default where a file does not tell."""

AnyModel = TypeVar("AnyModel", bound=type[Model])


def register(model: AnyModel) -> AnyModel:
    """Make a model known by its name, to files and to the command; a decorator.

    Args:
        model: The class. What it is configured by are numbers with defaults.

    Raises:
        ValueError: Another model has that name.
    """
    return registry.add(MODELS, model.name, model, "model")


def current_name(name: str) -> str:
    """The name that a model has now; a DeprecationWarning tells of a former one."""
    if name in MODELS or name not in FORMER_NAMES:
        return name
    warn_renamed(f"the model {name}", FORMER_NAMES[name])
    return FORMER_NAMES[name]


def model_of(name: str) -> Model:
    """The model of a name, as it is configured by default.

    Args:
        name: A key of ``MODELS``, or a former name.

    Returns:
        The model.

    Raises:
        InputError: There is none.
    """
    name = current_name(name)
    require_one_of("model", name, tuple(MODELS))
    return MODELS[name]()


def from_json(tree: Any) -> Model:
    """The model that ``to_json`` wrote, also under its former name.

    Raises:
        ValueError: It is none that this version knows.
    """
    if isinstance(tree, dict) and isinstance(name := tree.get("name"), str):
        tree = tree | {"name": name if name in MODELS else FORMER_NAMES.get(name, name)}
    model = registry.from_json(MODELS, tree, "model", DEFAULTS_BEFORE)
    assert isinstance(model, Model)
    return model
