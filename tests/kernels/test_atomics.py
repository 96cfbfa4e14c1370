"""Additions on CUDA: four numbers by one instruction where there is one. No GPU is needed."""

import re
from pathlib import Path
from types import SimpleNamespace

import pytest
from warpnerf_kernels.base import precision

from tests.kernels.test_cuda import compiled

VECTOR, SCALAR = r"red\.global\.add\.v4\.f32", r"(?:atom|red)(?:\.global)?\.add\.f(?:32|64)"


def instructions(name: str, n_floats: int, arch: int, folder: Path) -> SimpleNamespace:
    """How many additions the transpose of interpolation has, by four and one by one."""
    dense = precision.load(name, "fields.dense")
    kernel = precision.load(name, "launch.probe").probe(dense.dense(n_floats)).read_backward
    code = compiled(kernel.module, folder, arch=arch)
    return SimpleNamespace(
        by_four=len(re.findall(VECTOR, code)), single=len(re.findall(SCALAR, code))
    )


@pytest.mark.ci
@pytest.mark.parametrize(("n_floats", "fours"), [(4, 1), (16, 4)])
def test_a_node_is_added_to_by_four(n_floats: int, fours: int, tmp_path: Path) -> None:
    found = instructions("float32", n_floats, 90, tmp_path)
    assert (found.by_four, found.single) == (8 * fours, 0)


@pytest.mark.ci
def test_older_devices_and_doubles_add_one_by_one(tmp_path: Path) -> None:
    for name, arch in (("float32", 75), ("float64", 90)):
        found = instructions(name, 4, arch, tmp_path / f"{name}_{arch}")
        assert (found.by_four, found.single) == (0, 8 * 4)
