"""The losses of a configuration, put together with a model's parts, and their numbers."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache, reduce
from typing import Any

from warpnerf.checks import InputError
from warpnerf.config import LossConfig
from warpnerf.model.interface import Model, loader
from warpnerf.model.sampler_kinds import MARCHED, SamplerKind
from warpnerf.model.storage_kinds import DENSE, StorageKind, parts_of

ON_RAY = {
    "distortion": "DISTORTION",
    "entropy": "ENTROPY",
    "opacity": "OPACITY",
    "near_clip": "NEAR_CLIP",
}
"""Fields of LossConfig that weigh a loss on the ray: modules in volume.losses, and what they call
it."""


@dataclass(frozen=True, kw_only=True)
class Objective:
    """What a training launch minimises."""

    config: LossConfig = field(default_factory=LossConfig)
    """Which losses, and their weights."""
    content_distance: float = 1.0
    """Unit of distances in the distortion loss, scene units."""


PHOTOMETRIC_ONLY = Objective()
"""The squared error, and what loss the model itself has."""


def parts_with(
    model: Model,
    precision: str,
    config: LossConfig,
    stored: StorageKind = DENSE,
    sampler: SamplerKind = MARCHED,
) -> Any:
    """A model's parts with the losses of a configuration.

    Args:
        model: Which one.
        precision: float32 or float64.
        config: Which losses. Their weights change nothing but whether they are there.
        stored: What the field's raw values are stored in.
        sampler: Where samples lie.

    Returns:
        ``warpnerf_kernels.launch.assembly.Parts``.

    Raises:
        InputError: The model has no colours of samples, on which there is to be a loss, or has a
            loss on them of its own.
    """
    return _parts_with(model, precision, config.kinds, stored, sampler)


def loss_struct(model: Model, precision: str, objective: Objective) -> Any:
    """The numbers of the losses, as kernels take them.

    Args:
        model: Which one.
        precision: float32 or float64.
        objective: What is minimised.

    Returns:
        A kernel's Loss.
    """
    load, config = loader(precision), objective.config
    losses = parts_with(model, precision, config).losses
    values = load("volume.render_params").loss_type(losses)()
    if config.photometric == "huber":
        values.photometric.delta = config.huber_delta
    own = parts_of(model, precision).losses
    if own.on_samples is not losses.on_samples:
        values.on_samples.factor = config.sample_colour
    else:
        values.on_samples = model.sample_loss_params(load)
    found = [(own.on_ray, model.loss_params(load))]
    for name in config.kinds:
        if name not in ON_RAY:
            continue
        loss = _loss(precision, name)
        params = loss.Params()
        params.factor = getattr(config, name)
        if name == "distortion":
            params.unit = objective.content_distance
        if name == "near_clip":
            params.distance = config.near_clip_distance
        found.append((loss, params))
    values.on_ray = _joined(precision, found)[1]
    return values


def _loss(precision: str, name: str) -> Any:
    return getattr(loader(precision)(f"volume.losses.{name}"), ON_RAY[name])


@cache
def _parts_with(
    model: Model,
    precision: str,
    kinds: tuple[str, ...],
    stored: StorageKind,
    sampler: SamplerKind,
) -> Any:
    load, parts = loader(precision), parts_of(model, precision, stored)
    parts = parts._replace(sampler=sampler.part(load, parts.sampler))
    losses = parts.losses
    if "huber" in kinds:
        losses = losses._replace(photometric=load("volume.loss").HUBER)
    if "sample_colour" in kinds:
        if not parts.have_colours_of_samples:
            raise InputError(
                f"loss.sample_colour is above 0, but samples of the model {model.name} have no "
                "colours of their own; set it to 0, or use another model, such as features."
            )
        if losses.on_samples is not load("volume.sample_loss").NO_SAMPLE_LOSS:
            raise InputError(
                f"loss.sample_colour is above 0, but the model {model.name} has another loss on "
                "samples; set it to 0, or use another model."
            )
        losses = losses._replace(on_samples=load("volume.losses.sample_colour").SAMPLE_COLOUR)
    on_ray = [_loss(precision, name) for name in kinds if name in ON_RAY]
    found = [(loss, None) for loss in (losses.on_ray, *on_ray)]
    return parts._replace(losses=losses._replace(on_ray=_joined(precision, found)[0]))


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
