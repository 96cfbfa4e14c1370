"""A training's plan as JSON: what ``inspect --json`` writes, and checkpoints hold."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import msgspec
import numpy as np

from warpnerf.checks import InputError
from warpnerf.config_json import config_from_json, config_to_json
from warpnerf.config_json import decode as decode_kind
from warpnerf.training.plan import TrainingPlan


def plan_to_json(plan: TrainingPlan) -> dict[str, Any]:
    """All fields, in plain numbers, texts and lists; ``plan_from_json`` gives every bit back."""
    tree: dict[str, Any] = _plain(asdict(plan))
    return tree | {"config": config_to_json(plan.config)}


def plan_from_json(tree: Any) -> TrainingPlan:
    """The plan that ``plan_to_json`` wrote, of this version or older.

    Raises:
        InputError: It is none.
    """
    try:
        tree = prepared(tree) if isinstance(tree, dict) else tree
        return msgspec.convert(tree, TrainingPlan, dec_hook=decode)
    except (msgspec.ValidationError, TypeError) as error:
        raise InputError(
            f"this is no plan of a training: {error}; write one by plan_to_json."
        ) from error


def prepared(tree: dict[str, Any]) -> dict[str, Any]:
    """What to decode as a plan, or as a part of one: its configuration may be of an older version.

    Args:
        tree: Of JSON; its field config, if there is one, is prepared.
    """
    if isinstance(config := tree.get("config"), dict):
        return tree | {"config": config_from_json(config)}
    return tree


def decode(kind: type, tree: Any) -> Any:
    """For msgspec: an array or a model where one is wanted (its argument ``dec_hook``)."""
    if kind is not np.ndarray:
        return decode_kind(kind, tree)
    array = np.array(tree)
    if array.dtype.kind not in "fi" or array.shape not in ((3,), (2, 3), (3, 3)):
        raise ValueError("an array of a plan must hold points [3]")
    return array.astype(np.float64)


def _plain(value: Any) -> Any:
    """Arrays and tuples as lists."""
    if isinstance(value, dict):
        return {name: _plain(part) for name, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(part) for part in value]
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value
