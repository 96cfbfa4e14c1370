"""JAX has float64 while a test runs, and kernels are compiled as for the torch operations."""

from collections.abc import Iterator

import pytest

from tests.support.compiling import launch_unoptimised

jax = pytest.importorskip("jax")


@pytest.fixture(autouse=True)
def _float64_and_unoptimised(monkeypatch: pytest.MonkeyPatch, on_cpu: None) -> Iterator[None]:
    launch_unoptimised(monkeypatch)
    before = jax.config.jax_enable_x64
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", before)
