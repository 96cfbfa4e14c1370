"""`warpnerf train --config FILE`: a training that begins with the configuration of another."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

from warpnerf.checks import InputError
from warpnerf.cli.given import near_to
from warpnerf.config_json import config_to_json
from warpnerf.runs.config import RunConfig, read_run_config
from warpnerf.scenes.files import read_json


def run_to_repeat(path: Path) -> RunConfig:
    """What the config.json of a run says, to begin another with.

    Args:
        path: Of the file.

    Returns:
        It, with the scene's path as this process may open it.

    Raises:
        InputError: It cannot be read, is no configuration, or has fields that nothing reads.
    """
    config = read_run_config(path)
    known = list(_names(config_to_json(config.train)))
    for name in _names(read_json(path, dict)["train"]):
        if name not in known:
            raise InputError(
                f"{path}: train.{name} is no field of a training{near_to(name, known)}; correct or "
                "remove it."
            )
    if config.scene.startswith("builtin:"):
        return config
    return msgspec.structs.replace(config, scene=str(path.parent / config.scene))


def _names(tree: dict[str, Any]) -> Iterator[str]:
    """Dotted names of the fields of a configuration in JSON, of parts as well."""
    for name, value in tree.items():
        yield name
        if isinstance(value, dict):
            yield from (f"{name}.{inner}" for inner in value)
