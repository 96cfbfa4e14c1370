"""Kernels are launched here a few times, in forms of which each is compiled: so unoptimised."""

import pytest

from tests.support.compiling import launch_unoptimised


@pytest.fixture(autouse=True)
def _unoptimised(monkeypatch: pytest.MonkeyPatch) -> None:
    launch_unoptimised(monkeypatch)
