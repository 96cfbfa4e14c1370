"""Memory that another process can open, and only while it is shared."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from warpnerf.runtime.shared_memory import opened, share

if sys.platform != "linux":
    pytest.skip("Linux has such memory", allow_module_level=True)


def test_memory_is_opened_by_its_own_place_alone() -> None:
    with share(8192) as (memory, place), share(8192) as (_, other):
        assert memory is not None and place is not None and other is not None
        again = opened(place, 8192)
        assert again is not None
        again[8000] = 7
        assert memory[8000] == 7 and memory[0] == 0
        assert opened(other._replace(target=place.target), 8192) is None
        assert opened(place._replace(path=Path("/proc/self/fd/999999")), 8192) is None
        assert opened(place, 16384) is None and opened(None, 8192) is None
    assert opened(place, 8192) is None
    again[1] = 3
    assert memory[1] == 3


def test_a_system_without_such_memory_has_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "memfd_create")
    with share(8192) as found:
        assert found == (None, None)
