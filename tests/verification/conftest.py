"""Kernels are launched here a few times, in forms of which each is compiled: so unoptimised."""

import pytest


@pytest.fixture(scope="module", autouse=True)
def _unoptimised(unoptimised: None) -> None:
    pass
