"""Tensors with a header in a file: safetensors, written whole or not at all.

Its metadata hold the header in JSON and the SHA-256 over header and tensors. No pickle.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Collection
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from warpnerf.checks import InputError, way_out
from warpnerf.writing import write_atomically


class DamagedFileError(InputError):
    """A file is not what was written: cut off, altered, or of another kind altogether."""


def write_tensors(path: str | Path, header: dict[str, Any], tensors: dict[str, np.ndarray]) -> None:
    """Write a file, replacing an older one in a single step.

    Args:
        path: Of the file; its folder exists.
        header: In JSON, with its format's name as "format".
        tensors: Of float32, float16, uint32 or uint8.

    Raises:
        OSError: The file cannot be written; an older one is then left as it was.
    """
    text = json.dumps(header, sort_keys=True)
    metadata = {"header": text, "sha256": digest_of(text, tensors)}
    write_atomically(path, *_safetensors(metadata, tensors))


def _safetensors(
    metadata: dict[str, str], tensors: dict[str, np.ndarray]
) -> list[bytes | memoryview]:
    """The pieces of a safetensors file, without the copies of all tensors that ``save`` makes.

    Format: https://github.com/huggingface/safetensors#format. Wide types come first, so that all
    tensors are aligned.
    """
    names = {np.float32: "F32", np.float16: "F16", np.uint32: "U32", np.uint8: "U8"}
    dtypes = {np.dtype(kind): name for kind, name in names.items()}
    table: dict[str, Any] = {"__metadata__": metadata}
    pieces, end = [], 0
    for name, tensor in sorted(tensors.items(), key=lambda item: (-item[1].itemsize, item[0])):
        offsets = [end, end := end + tensor.nbytes]
        table[name] = {
            "dtype": dtypes[tensor.dtype],
            "shape": tensor.shape,
            "data_offsets": offsets,
        }
        pieces.append(np.ascontiguousarray(tensor).reshape(-1).view(np.uint8).data)
    text = json.dumps(table).encode()
    text += b" " * (-len(text) % 8)
    return [len(text).to_bytes(8, "little"), text, *pieces]


def read_tensors(
    path: Path, formats: Collection[str]
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and tensors of a file, checked against the digest.

    Args:
        path: Of the file.
        formats: Names of those that can be read.

    Raises:
        InputError: The file is missing, cannot be read, or has another format.
        DamagedFileError: It is not what ``write_tensors`` wrote.
    """
    from safetensors import SafetensorError, safe_open

    if not path.exists():
        raise InputError(f"{path} does not exist; train first, or name another file.")
    if not path.is_file():  # reading from a pipe would never end
        raise InputError(f"{path} is not a file; name a field or a checkpoint.")
    try:
        path.open("rb").close()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}; {way_out(error)}.") from None
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in sorted(file.keys())}
        with path.open("rb") as file:
            _strict_json(file.read(int.from_bytes(file.read(8), "little")))
    except (SafetensorError, OSError, ValueError, KeyError, TypeError) as error:
        raise DamagedFileError(
            f"{path} is damaged, or nothing that warpnerf wrote: it is not readable as safetensors "
            f"({error}); name another file, or train again."
        ) from None
    try:
        header = _strict_json(metadata.get("header", "{}"))
        kind = header.get("format")
    except (ValueError, RecursionError, AttributeError) as error:
        refuse(path, f"its header is not what was written ({error})")
    if kind not in formats:
        raise InputError(
            f"{path} has format {kind!r}, but this version reads "
            f"{', '.join(map(repr, formats))}; use the version of warpnerf that wrote it, or "
            "train again."
        )
    if metadata.get("sha256") != digest_of(metadata["header"], tensors):
        refuse(path, "its content does not match its SHA-256")
    return header, tensors


def refuse(path: Path, why: str) -> NoReturn:
    """Raise DamagedFileError, with the way out."""
    raise DamagedFileError(f"{path} is damaged: {why}; train again.")


def digest_of(header: str, tensors: dict[str, np.ndarray]) -> str:
    """SHA-256 of a header's text, and of the tensors, their names, types and shapes."""
    digest = hashlib.sha256(header.encode())
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(f"{name}{tensor.dtype}{tensor.shape}".encode())
        digest.update(np.ascontiguousarray(tensor).data)
    return digest.hexdigest()


def _strict_json(text: str | bytes) -> Any:
    """JSON without NaN, infinity and keys given twice, of which other readers take either one."""

    def number(text: str) -> float:
        value = float(text)
        if not math.isfinite(value):
            raise ValueError(f"{text} is not a finite number")
        return value

    return json.loads(text, object_pairs_hook=_distinct, parse_float=number, parse_constant=number)


def _distinct(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    table = dict(pairs)
    if len(table) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"the key {twice!r} is given twice")
    return table
