"""The section of docs/benchmarks.md on several processes, and on scenes in blocks."""

from __future__ import annotations

import numpy as np
from measuring import show
from page_parts import Records, below, place, text

EXCHANGES = {
    "shared": "sum in shared memory",
    "messages": "sum through shared memory",
    "tiles": "exchange by gloo",
    "dense": "exchange by gloo, the whole gradient",
}
"""How, by the name in a record."""


def jobs(records: Records) -> str:
    record, cut = records["processes"], records["blocks"]
    late = record["blocks"][-len(record["blocks"]) // 3 :]
    threads, processes, exchange, sent = (
        float(np.median([block[name] for block in late]))
        for name in ("threads_ms", "processes_ms", "exchange_ms", "exchange_mb")
    )
    reached = "; ".join(
        f"{row['way']} {row['wall']:.0f} s ({row['training']:.0f} s), {row['psnr']:.2f} dB"
        for row in cut["rows"]
    )
    return below(
        text(
            f"""One training of {place(record["scene"])}, {record["steps"]} steps of `fast`: two
            processes of one thread have {show(record["speed"], 2)} of the speed of one process of
            two threads. In the last third of the training an update takes {threads:.0f} ms in
            threads and {processes:.0f} ms in processes, {exchange:.0f} ms of that for {sent:.0f} MB
            that they {EXCHANGES[record["exchange"]]}.""",
            records.source("processes"),
        ),
        text(
            f"""`{cut["scene"]}` in {cut["count"]} blocks of {cut["voxels"]:,} voxels and
            {cut["steps"]} steps each, and in one training of as many voxels and steps as all blocks
            have: time with reading, compiling and saving (that of training as the jobs counted it),
            and PSNR of the test views: {reached}.""",
            records.source("blocks"),
        ),
    )
