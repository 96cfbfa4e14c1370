"""A cache of the visibility on disk: computed by the first export of a run, read by later ones."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from warpnerf.checks import InputError
from warpnerf.exporting import visibility as computed
from warpnerf.exporting.visibility import Visibility
from warpnerf.rendering.field import Field
from warpnerf.runs.checkpoint import field_header, field_tensors
from warpnerf.runs.tensor_file import digest_of, read_tensors, write_tensors
from warpnerf.scenes.scene import View

FORMAT = "warpnerf-visibility-1"


def cached_visibility(
    field: Field,
    views: Sequence[View],
    file: Path | None,
    on_camera: Callable[[int], None] | None = None,
) -> Visibility:
    """Compute the visibility of a field's nodes, or read it from its cache.

    The cache holds the very numbers, and is used where the digest of the field, of the cameras, of
    the masks and of the number of rays is that of the cache.

    Args:
        field: What is looked at.
        views: From where, at least one.
        file: The cache, written where it is missing or of something else; None: there is none. A
            link, a pipe, and a place that cannot be written to, is left alone.
        on_camera: Called with the number of cameras that are done.

    Returns:
        What they see.
    """
    file = None if file is None else Path(file)
    if file is None or file.is_symlink() or (file.exists() and not file.is_file()):
        return computed.visibility(field, views, on_camera)
    digest = _digest(field, views)
    kept = _read(file, digest, field.lattice.size)
    if kept is None:
        kept = computed.visibility(field, views, on_camera)
        with suppress(OSError):  # it only saves time
            write_tensors(file, {"format": FORMAT, "of": digest}, _sparse(kept))
    elif on_camera is not None:
        on_camera(len(views))
    return kept


def _digest(field: Field, views: Sequence[View]) -> str:
    """SHA-256 of all that the visibility depends on."""
    digest = hashlib.sha256(f"{computed.MAX_RAYS} {field.workers.device}".encode())
    header = json.dumps(field_header(field), sort_keys=True)
    digest.update(digest_of(header, field_tensors(field)).encode())
    for view in views:
        for name, value in sorted(vars(view.camera).items()):
            digest.update(f"{name} {np.asarray(value).tolist()}".encode())
        digest.update(b"" if view.mask is None else np.packbits(view.mask).tobytes())
    return digest.hexdigest()


def _sparse(visibility: Visibility) -> dict[str, np.ndarray]:
    """Only the nodes that any light comes from."""
    there = (visibility.light != 0.0) | (visibility.colour != 0.0).any(axis=-1)
    return {
        "nodes": np.packbits(there),
        "light": visibility.light[there],
        "colour": visibility.colour[there],
    }


def _read(file: Path, digest: str, size: tuple[int, int, int]) -> Visibility | None:
    """The visibility in a file; None where it is missing, damaged or of something else."""
    try:
        header, tensors = read_tensors(file, (FORMAT,))
    except InputError:
        return None
    if header.get("of") != digest:
        return None
    n_nodes = int(np.prod(size))
    light, colour = np.zeros(size, np.float32), np.zeros((*size, 3), np.float32)
    try:
        there = np.unpackbits(tensors["nodes"], count=n_nodes).astype(bool).reshape(size)
        light[there], colour[there] = tensors["light"], tensors["colour"]
    except (KeyError, ValueError, IndexError, TypeError):  # not as they were written here
        return None
    return Visibility(light=light, colour=colour)
