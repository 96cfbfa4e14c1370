"""A training's configuration as JSON, in config.json and checkpoints, of this version or older."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from warpnerf.config import TrainConfig
from warpnerf.model import models, sampler_kinds, storage_kinds
from warpnerf.model.interface import Model
from warpnerf.model.registry import to_json
from warpnerf.model.sampler_kinds import SamplerKind
from warpnerf.model.spaces import SPACES
from warpnerf.model.storage_kinds import STORAGE_KINDS, StorageKind
from warpnerf.optim_config import OPTIM_RATES, OPTIM_VARIATION, OptimConfig


def config_to_json(config: TrainConfig) -> dict[str, Any]:
    """All fields, those of model, storage and sampler with their names."""
    named = {name: to_json(getattr(config, name)) for name in ("model", "field", "sampler")}
    return asdict(config) | named


def decode(kind: type, tree: Any) -> Any:
    """For msgspec: a model, storage or sampler where one is wanted (its argument ``dec_hook``)."""
    if kind is Model:
        return models.from_json(tree)
    if kind is StorageKind:
        return storage_kinds.from_json(tree)
    if kind is SamplerKind:
        return sampler_kinds.from_json(tree)
    raise TypeError(f"{kind} is not read from JSON")


def config_from_json(tree: dict[str, Any]) -> dict[str, Any]:
    """What to decode as a TrainConfig: fields of later versions are as what was there before them.

    Where no model is named, there was only one, rgb, and all rays were drawn; where no losses are,
    there was the squared error alone; where no appearance or average_pixels is, photographs were
    taken as they are; where no settle_at is, nothing settled; where no sampler is, rays were
    marched; where no box is, it was the scene's. Options that did nothing beside the others are
    left out: they are refused now.
    """
    if isinstance(grid := tree.get("grid"), dict):
        tree = tree | {"grid": {"box": "scene"} | grid}
    before = {
        "model": {"name": "rgb"},
        "sampler": {"name": "march"},
        "skip_empty_rays": False,
        "appearance": "none",
        "average_pixels": False,
        "settle_at": None,
        "loss": {},
    }
    return _without_idle(before | tree)


def _without_idle(tree: dict[str, Any]) -> dict[str, Any]:
    """Without what ``TrainConfig`` refuses because it does nothing."""
    if not (isinstance(tree.get("grid"), dict) and isinstance(tree.get("optim"), dict)):
        return tree  # not what was written, or all by default
    idle = idle_fields(tree)
    kept = {
        part: {name: value for name, value in fields.items() if f"{part}.{name}" not in idle}
        for part, fields in tree.items()
        if isinstance(fields, dict)
    }
    return tree | kept


def idle_fields(tree: dict[str, Any]) -> set[str]:
    """Fields that do nothing beside the others, whatever they are, by dotted name.

    Args:
        tree: A configuration as ``config_to_json`` gives it, or one from a file.
    """
    parts = {name: value for name, value in tree.items() if isinstance(value, dict)}
    grid, optim = parts.get("grid", {}), parts.get("optim", {})
    idle = set()
    name = grid.get("contraction")
    space = SPACES.get(name) if isinstance(name, str) else None
    if space is not None and not space.has_frustum:
        idle.add("grid.planes")
    if space is not None and not space.contracts:
        idle |= {"grid.border", "march.growth"}
    if grid.get("grow_at") in ([], ()):
        idle |= {"grid.shift_at_growth", "optim.restart_at_growth"}
    name = parts.get("field", {}).get("name")
    stored = STORAGE_KINDS.get(name) if isinstance(name, str) else None
    if stored is not None and stored.own_rates:
        idle |= {f"optim.{name}" for name in OPTIM_RATES}
    if stored is not None and not stored.owns_densities:
        idle.add("optim.near_decay")
    if stored is not None and not stored.smoothed:
        idle |= {f"optim.{name}" for name in OPTIM_VARIATION}
    defaults = {"tv_density": OptimConfig.tv_density, "tv_rgb": OptimConfig.tv_rgb}
    sparse = parts.get("field", {}).get("sparsity", 0.0)
    if not any([sparse, *((defaults | optim)[weight] for weight in defaults)]):
        idle |= {"optim.tv_until", "optim.tv_every"}
    return idle
