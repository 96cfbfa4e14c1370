"""Storages by the name of their kind.

A new one is a kind (``warpnerf.model.storage_kinds``) and a subclass of
``warpnerf.fields.storage.Storage``; both are registered under one name.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from warpnerf.fields.dense import DenseGrid
from warpnerf.fields.factors import Factors
from warpnerf.fields.hashed import Hashed
from warpnerf.fields.storage import Storage
from warpnerf.model import registry
from warpnerf.model.storage_kinds import Dense, Hash, StorageKind, Vm

STORAGES: dict[str, type[Storage]] = {
    Dense.name: DenseGrid,
    Vm.name: Factors,
    Hash.name: Hashed,
}
"""By name."""

AnyStorage = TypeVar("AnyStorage", bound=type[Storage])


def register(kind: type[StorageKind]) -> Callable[[AnyStorage], AnyStorage]:
    """Make a class the storage of a kind; a decorator.

    Args:
        kind: Which one.

    Raises:
        ValueError: It has another one.
    """

    return lambda storage: registry.add(STORAGES, kind.name, storage, "storage")


def class_of(kind: StorageKind) -> type[Storage]:
    """The storage of a kind.

    Raises:
        ValueError: None is registered for it.
    """
    found: type[Storage] = registry.find(STORAGES, kind.name, "storage")
    return found
