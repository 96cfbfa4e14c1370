"""Deferred scatter-add: how gradients of samples get into a field on a CPU with several workers.

Rays cross the field in every direction; adding as they go, threads would race for its entries. So
each worker owns a part, and is the only one to add to it. What its rays have for its own part it
adds at once; a pack of samples that has something for others leaves a record. Once all rays are
through, each worker adds what the others have left for it. schedule.py gives a ray to the worker
that owns most of what it crosses, so that little is left for others. What is added to an entry, and
in which order, depends on nothing but the rays and the number of workers.

Which part is whose, and what a record holds, is the encoding's to say. This is for float32.
"""

from functools import cache
from typing import Any

import warp as wp

from ..base.parts import Encoding
from .barrier import wait_for_all
from .schedule import Chunk

wp.set_module_options({"enable_backward": False})


@cache
def sink_type(encoding: Encoding) -> type:
    """A gradient, and records on their way to it."""

    @wp.struct
    class Sink:
        records: wp.array2d(dtype=encoding.vectors.Record)  # [n_workers, n_packs] by sender
        recipients: wp.array3d(dtype=wp.int32)  # [n_workers, n_workers, n_packs] by sender and
        # receiver: which of the records are for whom
        # How many there are of both, by sender, in rows of whole cache lines, which no two workers
        # share:
        n_records: wp.array2d(dtype=wp.int32)  # [n_workers, row] in the first column
        n_recipients: wp.array2d(dtype=wp.int32)  # [n_workers, row] by receiver
        gradient: encoding.Gradient  # where it all goes
        chunk: Chunk  # whose rays they are from

    return Sink


@wp.func
def clear_records(worker: int, sink: Any):
    """Clear the records that a worker left in the last chunk."""
    sink.n_records[worker, 0] = 0
    for receiver in range(sink.records.shape[0]):
        sink.n_recipients[worker, receiver] = 0


@cache
def record_applier(encoding: Encoding) -> wp.Function:
    """The function that ends a chunk: apply_records(params, worker, sink)."""
    Params, Sink = encoding.Params, sink_type(encoding)
    add_records = encoding.vectors.add_records

    @wp.func
    def apply_records(params: Params, worker: int, sink: Sink):
        """Once the rays of all workers are through, add what is left in records for a worker."""
        n_workers = sink.records.shape[0]
        if n_workers > 1:
            if wait_for_all(sink.chunk.barrier, n_workers):
                for sender in range(n_workers):
                    add_records(params, worker, sender, sink)

    return apply_records
