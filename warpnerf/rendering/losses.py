"""The losses of a configuration, put together with a model's parts, and their numbers."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache, reduce
from typing import Any

from warpnerf.checks import InputError
from warpnerf.config import LossConfig
from warpnerf.model.interface import Model, loader, parts_of

ON_RAY = {
    "distortion": "DISTORTION",
    "entropy": "ENTROPY",
    "opacity": "OPACITY",
    "near_clip": "NEAR_CLIP",
}
"""Fields of LossConfig that weigh a loss on the ray: modules in volume.losses, and what they call
it."""


@dataclass(frozen=True, kw_only=True)
class Minimised:
    """What a training launch minimises."""

    config: LossConfig = field(default_factory=LossConfig)
    """Which losses, and their weights."""
    content_distance: float = 1.0
    """Unit of distances in the distortion loss, scene units."""


PLAIN = Minimised()
"""The squared error, and what loss the model itself has."""


def parts_with(model: Model, precision: str, config: LossConfig) -> Any:
    """A model's parts with the losses of a configuration.

    Args:
        model: Which one.
        precision: float32 or float64.
        config: Which losses. Their weights change nothing but whether they are there.

    Returns:
        ``warpnerf_kernels.launch.assembly.Parts``.

    Raises:
        InputError: The model has no colours of samples, on which there is to be a loss.
    """
    return _parts_with(model, precision, config.kinds)


def loss_struct(model: Model, precision: str, minimised: Minimised) -> Any:
    """The numbers of the losses, as kernels take them.

    Args:
        model: Which one.
        precision: float32 or float64.
        minimised: What is minimised.

    Returns:
        A kernel's Loss.
    """
    load, config = loader(precision), minimised.config
    losses = parts_with(model, precision, config).losses
    values = load("volume.scene").loss_type(losses)()
    if config.photometric == "huber":
        values.photometric.delta = config.huber_delta
    values.on_samples = config.sample_colour
    own = parts_of(model, precision).losses.on_ray
    found = [(own, model.loss_params(load))]
    for name in config.kinds:
        if name not in ON_RAY:
            continue
        loss = _loss(precision, name)
        params = loss.Params()
        params.factor = getattr(config, name)
        if name == "distortion":
            params.unit = minimised.content_distance
        if name == "near_clip":
            params.distance = config.near_clip_distance
        found.append((loss, params))
    values.on_ray = _joined(precision, found)[1]
    return values


def _loss(precision: str, name: str) -> Any:
    return getattr(loader(precision)(f"volume.losses.{name}"), ON_RAY[name])


@cache
def _parts_with(model: Model, precision: str, kinds: tuple[str, ...]) -> Any:
    load, parts = loader(precision), parts_of(model, precision)
    losses = parts.losses
    if "huber" in kinds:
        losses = losses._replace(photometric=load("volume.loss").HUBER)
    if (on_samples := "sample_colour" in kinds) and not parts.have_colours_of_samples:
        raise InputError(
            f"loss.sample_colour is above 0, but samples of the model {model.name} have no colours "
            "of their own; set it to 0, or use another model, such as features."
        )
    on_ray = [_loss(precision, name) for name in kinds if name in ON_RAY]
    found = [(loss, None) for loss in (losses.on_ray, *on_ray)]
    losses = losses._replace(
        on_ray=_joined(precision, found)[0], on_samples=losses.on_samples or on_samples
    )
    return parts._replace(losses=losses)


def _joined(precision: str, found: list[tuple[Any, Any]]) -> tuple[Any, Any]:
    """Losses on the ray as one, and their parameters; those that are none fall out."""
    module = loader(precision)("volume.ray_loss")

    def join(a: tuple[Any, Any], b: tuple[Any, Any]) -> tuple[Any, Any]:
        if a[0] is module.NONE:
            return b
        both = module.sum_of(a[0], b[0])
        if a[1] is None:
            return both, None
        params = both.Params()
        params.a, params.b = a[1], b[1]
        return both, params

    return reduce(join, found)
