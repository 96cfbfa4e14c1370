"""Named models: which parts they are made of, and their configuration.

A model is a frozen value. It names the parts that ``warpnerf_kernels.launch.assembly`` puts
together, and says what of them is trained and how. A new one is a subclass of ``Model``, and with
``register`` a name that the command and files know.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from functools import cache, partial
from types import ModuleType
from typing import Any, ClassVar, Protocol, TypeVar

import numpy as np

from warpnerf.checks import InputError, require_at_least, require_one_of, require_whole

Load = Callable[[str], ModuleType]
"""A module of the kernels, by its name in the package, in some precision."""


class Rates(Protocol):
    """What ``warpnerf.config.OptimConfig`` says of learning rates and total variation."""

    @property
    def learning_rate_density(self) -> float: ...  # noqa: D102
    @property
    def learning_rate_rgb(self) -> float: ...  # noqa: D102
    @property
    def learning_rate_sh(self) -> float: ...  # noqa: D102
    @property
    def learning_rate_features(self) -> float: ...  # noqa: D102
    @property
    def tv_density(self) -> float: ...  # noqa: D102
    @property
    def tv_rgb(self) -> float: ...  # noqa: D102


class Model:
    """What a field stores, and how that becomes colour."""

    name: ClassVar[str]
    """By which the command and files know it."""
    relative_time: ClassVar[float] = 1.0
    """How long a step of training takes as it is configured by default, about; rgb's is 1."""

    @property
    def n_features(self) -> int:
        """Raw features of a node, besides its raw density."""
        raise NotImplementedError

    @property
    def n_floats(self) -> int:
        """Numbers of a node: density, features, and padding to a power of two, at least 4."""
        return max(4, 1 << self.n_features.bit_length())

    def parts(self, load: Load) -> Any:
        """The ``warpnerf_kernels.launch.assembly.Parts``."""
        raise NotImplementedError

    def layout(self, load: Load) -> Any:
        """The ``warpnerf_kernels.heads.mlp.Layout`` of the head's MLP; None: it has none."""
        return None

    def march(self, load: Load, steps: Any, device: Any) -> Any:
        """The sampler's parameters, from ``warpnerf.rendering.render.Steps``.

        Args:
            load: The kernels' modules.
            steps: What is configured.
            device: The ``warp.Device`` where arrays among the parameters have to lie.
        """
        return steps.struct(load("sampling.steps"))

    def first_weights(self, seed: int) -> np.ndarray:
        """The MLP's weights before the first step, [n_weights] float32; none without an MLP."""
        layout = self.layout(partial(_device_code, "float32"))
        return np.zeros(0, np.float32) if layout is None else _uniform(layout, seed, 1.0)

    def learning_rates(self, optim: Rates) -> np.ndarray:
        """Of each number of a node, [n_floats]; 0 for padding."""
        rates = np.zeros(self.n_floats)
        rates[0] = optim.learning_rate_density
        rates[1 : 1 + self.n_features] = optim.learning_rate_rgb
        return rates

    def variation(self, optim: Rates) -> np.ndarray:
        """Weights of total variation of each number of a node, [n_floats]; 0 for padding."""
        weights = np.zeros(self.n_floats)
        weights[0] = optim.tv_density
        weights[1 : 1 + self.n_features] = optim.tv_rgb
        return weights


@dataclass(frozen=True, kw_only=True)
class Rgb(Model):
    """Density and r, g, b: colour that is the same from all sides."""

    name: ClassVar[str] = "rgb"

    @property
    def n_features(self) -> int:
        """Red, green, blue."""
        return 3

    def parts(self, load: Load) -> Any:
        """A dense grid, and a sigmoid."""
        return load("launch.assembly").Parts(
            encoding=load("fields.dense").dense(self.n_floats), head=load("heads.rgb").rgb()
        )


@dataclass(frozen=True, kw_only=True)
class SphericalHarmonics(Model):
    """Colour by spherical harmonics of the direction of view, without an MLP."""

    name: ClassVar[str] = "sh"
    relative_time: ClassVar[float] = 2.5
    degree: int = 2
    """Of the harmonics, 0 to 3: 1, 4, 9 or 16 for each of red, green and blue."""

    def __post_init__(self) -> None:
        """Refuse what has no kernels."""
        require_whole("model.degree", self.degree, 0)
        if self.degree > 3:
            raise InputError(f"model.degree must be 0, 1, 2 or 3, not {self.degree}.")

    @property
    def n_features(self) -> int:
        """Three for each harmonic."""
        return int(3 * (self.degree + 1) ** 2)

    def parts(self, load: Load) -> Any:
        """A dense grid, and the harmonics."""
        return load("launch.assembly").Parts(
            encoding=load("fields.dense").dense(self.n_floats),
            head=load("heads.sh").sh(self.degree),
        )

    def learning_rates(self, optim: Rates) -> np.ndarray:
        """The first harmonic is a constant of 0.28: its rate moves colours as far as rgb's."""
        rates = super().learning_rates(optim)
        rates[1:4] = optim.learning_rate_rgb / 0.2820948
        rates[4 : 1 + self.n_features] = optim.learning_rate_sh
        return rates


@dataclass(frozen=True, kw_only=True)
class _WithMlp(Model):
    """What models with an MLP have in common."""

    frequencies: int = 1
    """Octaves of sines and cosines of the direction of view that the MLP sees, 0 to 8."""
    width: int = 32
    """Units of each hidden layer, a multiple of 16 up to 128."""
    hidden_layers: int = 2
    """Of the MLP, 1 to 3."""

    def __post_init__(self) -> None:
        """Refuse what has no kernels."""
        require_whole("model.frequencies", self.frequencies, 0)
        if self.frequencies > 8:
            raise InputError(f"model.frequencies must be at most 8, not {self.frequencies}.")
        require_whole("model.width", self.width, 1)
        if self.width % 16 or self.width > 128:
            raise InputError(
                f"model.width must be a multiple of 16 up to 128, not {self.width}: units of a "
                "layer are worked on sixteen at a time."
            )
        require_whole("model.hidden_layers", self.hidden_layers, 1)
        if self.hidden_layers > 3:
            raise InputError(f"model.hidden_layers must be 1, 2 or 3, not {self.hidden_layers}.")


@dataclass(frozen=True, kw_only=True)
class Deferred(_WithMlp):
    """Features added up along the ray, and one small MLP a ray that sees the direction of view."""

    name: ClassVar[str] = "deferred"
    relative_time: ClassVar[float] = 1.5
    specular: int = 4
    """Features of a node besides its diffuse colour, 1 to 28."""

    def __post_init__(self) -> None:
        """Refuse what has no kernels."""
        super().__post_init__()
        require_whole("model.specular", self.specular, 1)
        if self.specular > 28:
            raise InputError(f"model.specular must be at most 28, not {self.specular}.")

    @property
    def n_features(self) -> int:
        """Diffuse colour, specular features."""
        return 3 + self.specular

    def parts(self, load: Load) -> Any:
        """A dense grid, and a head of rays."""
        return load("launch.assembly").Parts(
            encoding=load("fields.dense").dense(self.n_floats),
            head=load("heads.deferred").deferred(
                self.n_features, self.frequencies, self.width, self.hidden_layers
            ),
        )

    def layout(self, load: Load) -> Any:
        """It sees all channels and the direction."""
        return load("heads.deferred").layout_of(
            self.n_features, self.frequencies, self.width, self.hidden_layers
        )

    def first_weights(self, seed: int) -> np.ndarray:
        """The output begins small, so that diffuse colour is learned first."""
        return _uniform(self.layout(partial(_device_code, "float32")), seed, 0.1)

    def learning_rates(self, optim: Rates) -> np.ndarray:
        """Specular features have a rate of their own."""
        rates = super().learning_rates(optim)
        rates[4 : 1 + self.n_features] = optim.learning_rate_features
        return rates


@dataclass(frozen=True, kw_only=True)
class Features(_WithMlp):
    """Features of each sample and the direction of view through an MLP, as in DVGO."""

    name: ClassVar[str] = "features"
    relative_time: ClassVar[float] = 2.5
    features: int = 12
    """Of a node, up to 31."""
    frequencies: int = 4
    """Octaves of sines and cosines of the direction of view that the MLP sees, 0 to 8."""
    residual: bool = True
    """Whether the first three features are colour, to which the MLP adds."""
    threshold: float = 1e-4
    """Samples of no more weight get no colour, [0, 1)."""

    def __post_init__(self) -> None:
        """Refuse what has no kernels."""
        super().__post_init__()
        require_whole("model.features", self.features, 1)
        if self.residual and self.features < 4:
            raise InputError(
                f"model.features must be at least 4 with the residual, not {self.features}: three "
                "are colour, and the MLP sees the others; use more, or residual = False."
            )
        if self.features > 31:
            raise InputError(f"model.features must be at most 31, not {self.features}.")
        require_at_least("model.threshold", self.threshold, 0.0)
        if self.threshold >= 1.0:
            raise InputError(f"model.threshold must be below 1, not {self.threshold}.")

    @property
    def n_features(self) -> int:
        """As configured."""
        return self.features

    def parts(self, load: Load) -> Any:
        """A dense grid, and a head of samples."""
        return load("launch.assembly").Parts(
            encoding=load("fields.dense").dense(self.n_floats),
            head=load("heads.features").features(
                self.features,
                self.frequencies,
                self.width,
                self.hidden_layers,
                self.residual,
                float(self.threshold),
            ),
        )

    def layout(self, load: Load) -> Any:
        """It sees features, or those that are not colour, and the direction."""
        return load("heads.features").layout_of(
            self.features, self.frequencies, self.width, self.hidden_layers, self.residual
        )

    def first_weights(self, seed: int) -> np.ndarray:
        """With the residual, the output begins small."""
        layout = self.layout(partial(_device_code, "float32"))
        return _uniform(layout, seed, 0.1 if self.residual else 1.0)

    def learning_rates(self, optim: Rates) -> np.ndarray:
        """Features that the MLP sees have a rate of their own."""
        rates = super().learning_rates(optim)
        begin = 4 if self.residual else 1
        rates[begin : 1 + self.n_features] = optim.learning_rate_features
        return rates


MODELS: dict[str, type[Model]] = {
    model.name: model for model in (Rgb, SphericalHarmonics, Deferred, Features)
}
"""By name."""

AnyModel = TypeVar("AnyModel", bound=type[Model])


def register(model: AnyModel) -> AnyModel:
    """Make a model known by its name; a decorator."""
    MODELS[model.name] = model
    return model


def model_of(name: str) -> Model:
    """The model of a name, as it is configured by default.

    Raises:
        InputError: There is none.
    """
    require_one_of("model", name, tuple(MODELS))
    return MODELS[name]()


def configured(name: str, options: Sequence[str]) -> Model:
    """The model of a name, changed by options such as "width=64".

    Args:
        name: Of the model.
        options: A field and its value each.

    Raises:
        InputError: There is no such model or field, or the value does not fit.
    """
    model = model_of(name)
    known = {f.name: getattr(model, f.name) for f in fields(model)}  # type: ignore[arg-type]
    given: dict[str, Any] = {}
    for option in options:
        field, equals, text = option.partition("=")
        if not equals or field not in known:
            listed = ", ".join(f"{key}={value}" for key, value in known.items()) or "none"
            raise InputError(
                f"--model-options: {option!r} is no option of the model {name}; it has {listed}."
            )
        given[field] = _parsed(field, text, type(known[field]))
    return type(model)(**given)


def _parsed(field: str, text: str, kind: type) -> Any:
    words = {"true": True, "false": False}
    try:
        return words[text.lower()] if kind is bool else kind(text)
    except (ValueError, KeyError):
        wanted = {bool: "true or false", int: "a whole number", float: "a number"}[kind]
        raise InputError(f"--model-options: {field} must be {wanted}, not {text!r}.") from None


def to_json(model: Model) -> dict[str, Any]:
    """Name and configuration."""
    return {"name": model.name, **asdict(model)}  # type: ignore[call-overload]


def from_json(tree: Any) -> Model:
    """The model that ``to_json`` wrote.

    Raises:
        ValueError: It is none that this version knows.
    """
    if not isinstance(tree, dict) or tree.get("name") not in MODELS:
        raise ValueError(f"{tree!r} is no model of {', '.join(MODELS)}")
    kind = MODELS[tree["name"]]
    given = {name: value for name, value in tree.items() if name != "name"}
    types = {f.name: type(f.default) for f in fields(kind)}  # type: ignore[arg-type]
    for name, value in given.items():
        if name not in types or type(value) is not types[name]:
            raise ValueError(f"{name!r} of the model {kind.name} cannot be {value!r}")
    return kind(**given)


def n_weights(model: Model) -> int:
    """Weights of a model's head; 0 without an MLP."""
    layout = model.layout(partial(_device_code, "float32"))
    return 0 if layout is None else int(layout.n_weights)


def decode(kind: type, tree: Any) -> Any:
    """For msgspec: a model where one is wanted (its argument ``dec_hook``)."""
    if kind is not Model:
        raise NotImplementedError
    return from_json(tree)


@cache
def parts_of(model: Model, precision: str) -> Any:
    """A model's parts in float32 or float64."""
    return model.parts(partial(_device_code, precision))


def _device_code(precision: str, module: str) -> ModuleType:
    from warpnerf_kernels.base.precision import load

    return load(precision, module)


def _uniform(layout: Any, seed: int, of_output: float) -> np.ndarray:
    """Weights between +-1 / sqrt(inputs of their layer), the output's that times a factor.

    Hidden biases likewise, the output's are 0: torch.nn.Linear's beginning, and DVGO's.
    """
    rng = np.random.default_rng(seed)
    weights = np.zeros(layout.n_weights, np.float32)

    def fill(begin: int, end: int, n_inputs: int) -> None:
        limit = 1.0 / np.sqrt(n_inputs)
        weights[begin:end] = rng.uniform(-limit, limit, end - begin)

    fill(0, layout.hidden, layout.n_inputs)
    fill(layout.hidden, layout.output, layout.width)
    last = weights[layout.output :].reshape(-1, 4)
    limit = of_output / np.sqrt(layout.width)
    last[:-1, :3] = rng.uniform(-limit, limit, (layout.width, 3))
    return weights
