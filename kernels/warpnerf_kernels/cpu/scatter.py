"""Deferred scatter: how gradients of samples get into a field on a CPU with several workers.

Rays cross the field in every direction; adding as they go, threads would race for its entries. So
each worker owns a part, and is the only one to add to it. What its rays have for its own part it
adds at once; a pack of samples that has something for others leaves a record. Once all rays are
through, each worker adds what the others have left for it. That is the less, the more of a ray goes
through the part of the worker that has it, for which schedule.py cares. What is added to an entry,
and in which order, depends on nothing but the rays and the number of workers.

Which part is whose, and what a record holds, is the encoding's to say. This is for float32.
"""

from functools import cache
from typing import Any

import warp as wp

from ..base.parts import Encoding
from ..base.types import gradient_type
from .barrier import meet
from .schedule import Chunk

wp.set_module_options({"enable_backward": False})


@cache
def deferred_type(encoding: Encoding) -> type:
    """A gradient, and records on their way to it."""

    @wp.struct
    class Deferred:
        records: wp.array2d(dtype=encoding.Record)  # [n_workers, n_packs] by sender
        addressed: wp.array3d(dtype=wp.int32)  # [n_workers, n_workers, n_packs] by sender and
        # receiver: which of the records are for whom
        # How many there are of both, by sender, in rows of whole cache lines, which no two workers
        # share:
        n_records: wp.array2d(dtype=wp.int32)  # [n_workers, row] in the first column
        n_addressed: wp.array2d(dtype=wp.int32)  # [n_workers, row] by receiver
        gradient: gradient_type(encoding.n_floats)  # where it all goes
        chunk: Chunk  # whose rays they are from

    return Deferred


@wp.func
def leave_none(worker: int, deferred: Any):
    """Forget what a worker left in the last chunk."""
    deferred.n_records[worker, 0] = 0
    for receiver in range(deferred.records.shape[0]):
        deferred.n_addressed[worker, receiver] = 0


@cache
def delivery(encoding: Encoding) -> wp.Function:
    """The function that ends a chunk: deliver(params, worker, deferred)."""
    Params, Deferred = encoding.Params, deferred_type(encoding)
    add_records = encoding.add_records

    @wp.func
    def deliver(params: Params, worker: int, deferred: Deferred):
        """Once the rays of all workers are through, add what is left in records for a worker."""
        n_workers = deferred.records.shape[0]
        if n_workers > 1:
            if meet(deferred.chunk.barrier, n_workers):
                for sender in range(n_workers):
                    add_records(params, worker, sender, deferred)

    return deliver
