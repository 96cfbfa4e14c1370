"""Memory of launches that begins with what shows where it is read before it is written."""

from typing import Any

import numpy as np
import pytest
from warpnerf_kernels.cpu import schedule

from warpnerf.rendering import adjoint

ROOM = 32 << 17
"""Bytes of records, filled at each launch."""


def leave_sinks_unwritten(monkeypatch: pytest.MonkeyPatch) -> None:
    """Records hold no numbers, and lists of them lead to no one's memory."""
    monkeypatch.setattr(adjoint, "RECORDS", ROOM)
    make_sink = adjoint._make_sink

    def unwritten(variant: Any, n_packs: int, n_workers: int) -> Any:
        made = make_sink(variant, n_packs, n_workers)
        made.records.numpy().view(np.uint8).fill(255)
        for numbers in (made.recipients, made.n_records, made.n_recipients):
            numbers.fill_(1 << 24)
        return made

    monkeypatch.setattr(adjoint, "_make_sink", unwritten)


def leave_chunks_unwritten(monkeypatch: pytest.MonkeyPatch) -> None:
    """Chunks hold what no ray or cell has for a number."""
    make_chunk = adjoint._make_chunk

    def of_nothing(n_rays: int, n_workers: int) -> schedule.Chunk:
        chunk = make_chunk(n_rays, n_workers)
        for name in ("work", "cells", "next", "work_before", "rays_before", "candidates", "rays"):
            getattr(chunk, name).fill_(-(1 << 28))
        return chunk

    monkeypatch.setattr(adjoint, "_make_chunk", of_nothing)
