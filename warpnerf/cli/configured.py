"""The configuration of a training: a preset's, a file's or a run's, and what options change."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any, get_type_hints

from warpnerf.cli.given import Given, flag_of, with_dotted
from warpnerf.cli.loss_options import loss_values
from warpnerf.cli.model_options import chosen_model
from warpnerf.cli.values import read_value
from warpnerf.config import TrainConfig
from warpnerf.config_json import config_to_json, idle_fields
from warpnerf.model.registry import to_json
from warpnerf.model.sampler_kinds import sampler_of
from warpnerf.model.storage_kinds import StorageKind, storage_of
from warpnerf.optim_config import model_rates

STEPS_OF_TIMED = 10**9
"""Steps of a training that its time limit ends."""

PARTS = ("grid", "march", "optim")
"""Of a configuration, besides model, field, sampler and loss."""


def configured(
    begin: TrainConfig, given: Given, model_options: Sequence[str] = (), loss: Sequence[str] = ()
) -> TrainConfig:
    """A configuration with what options change.

    What would do nothing beside these, such as a preset's planes with another contraction, becomes
    what it is by default.

    Args:
        begin: A preset's, a file's, or that of a run that is resumed.
        given: Words of options by dotted name.
        model_options: What --model-options lists.
        loss: What --loss lists.

    Returns:
        `begin`, changed.

    Raises:
        InputError: An option has a value that does not fit, does nothing, or is given twice.
    """
    kinds = get_type_hints(TrainConfig)
    changed: dict[str, Any] = {
        name: read_value(flag_of(name), kinds[name], words)
        for name, words in given.items()
        if "." not in name and name not in ("model", "field", "sampler")
    }
    of_field = given.get("field", (begin.field.name,))[0]
    stored = begin.field if of_field == begin.field.name else storage_of(of_field)
    model = begin.model
    if stored.own_rates and not begin.field.own_rates:
        model = replace(model, **{n: getattr(type(model), n) for n in model_rates(model)})  # type: ignore[type-var]
    name = given.get("model", (None,))[0]
    changed["model"] = chosen_model(model, name, model_options, given)
    of_sampler = given.get("sampler", (begin.sampler.name,))[0]
    sampler = begin.sampler if of_sampler == begin.sampler.name else sampler_of(of_sampler)
    for part, kind in (("field", stored), ("sampler", sampler)):
        what = f"no option of the {part} {kind.name}; it has"
        changed[part] = replace(kind, **with_dotted({}, part, what, kind, given))  # type: ignore[type-var]
    values = {part: with_dotted({}, part, "none of", getattr(begin, part), given) for part in PARTS}
    losses, what = loss_values(begin.loss, loss), "no option of the loss; it has"
    values["loss"] = with_dotted(losses, "loss", what, begin.loss, given)
    _leave_out_idle(begin, values, changed["field"])
    for part, new in values.items():
        changed[part] = replace(getattr(begin, part), **new)
    return replace(begin, **changed)


def _leave_out_idle(
    begin: TrainConfig, values: dict[str, dict[str, Any]], stored: StorageKind
) -> None:
    """Give fields their defaults that did something in `begin` and no longer do."""
    before = config_to_json(begin)
    after = before | {part: before[part] | new for part, new in values.items()}
    after["field"] = to_json(stored)
    for path in sorted(_idle(after) - _idle(before)):
        part, _, field = path.partition(".")
        defaults = {f.name: f.default for f in fields(getattr(begin, part))}
        values[part].setdefault(field, defaults[field])


def _idle(tree: dict[str, Any]) -> set[str]:
    """Fields that do nothing, by dotted name."""
    idle = idle_fields(tree)
    if tree["loss"]["photometric"] == "squared":
        idle.add("loss.huber_delta")
    if tree["loss"]["near_clip"] == 0.0:
        idle.add("loss.near_clip_distance")
    return idle


def begun_with(config: TrainConfig, given: Given) -> TrainConfig:
    """The same for a training that begins: of steps and time limit, the one that is given ends it.

    Args:
        config: With what is given.
        given: Options by dotted name.
    """
    if "time_limit" in given and "steps" not in given and config.time_limit is not None:
        return replace(config, steps=STEPS_OF_TIMED)
    if "steps" in given and "time_limit" not in given:
        return replace(config, time_limit=None)
    return config
