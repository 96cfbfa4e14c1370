"""JAX has float64 while a test runs, and kernels are compiled as for the torch operations."""

from collections.abc import Iterator

import pytest

jax = pytest.importorskip("jax")


@pytest.fixture(autouse=True)
def _float64_and_unoptimised(unoptimised: None, on_cpu: None) -> Iterator[None]:
    before = jax.config.jax_enable_x64
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", before)
