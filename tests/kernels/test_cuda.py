"""The kernels compile for CUDA: Warp brings the compiler along, no GPU is needed for that."""

import ast
from pathlib import Path

import pytest
import warp as wp
from warpnerf_kernels.base import precision

from tests.support import cuda_kernels
from tests.support.cuda_kernels import LONG, ON_CPU, QUICK
from warpnerf.model.interface import Model
from warpnerf.model.models import Deferred
from warpnerf.rendering.structs import variant_of

CASES = QUICK | LONG


def compiled(module: wp.Module, folder: Path, *, arch: int = 75) -> str:
    """PTX for a compute capability times ten."""
    folder.mkdir(exist_ok=True)
    wp.compile_aot_module(module, arch=arch, module_dir=folder, use_ptx=True)
    return "".join(path.read_text() for path in folder.glob("*.ptx"))


def entries(code: str) -> list[str]:
    return [line for line in code.splitlines() if ".entry" in line]


def compile_case(case: str, name: str, folder: Path) -> None:
    """Compile the modules of a case's kernels; each kernel must be in its module's code."""
    wp.init()
    codes: dict[wp.Module, list[str]] = {}
    kernels = CASES[case](name)
    assert kernels
    for kernel in kernels:
        if kernel.module not in codes:
            codes[kernel.module] = entries(compiled(kernel.module, folder / str(len(codes))))
        assert any(kernel.key in entry for entry in codes[kernel.module]), kernel.key


@pytest.mark.ci
@pytest.mark.parametrize("case", QUICK)
def test_kernels_compile_for_cuda(case: str, tmp_path: Path) -> None:
    compile_case(case, "float32", tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("case", LONG)
def test_more_kernels_compile_for_cuda(case: str, tmp_path: Path) -> None:
    compile_case(case, "float32", tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_kernels_in_float64_compile_for_cuda(case: str, tmp_path: Path) -> None:
    compile_case(case, "float64", tmp_path)


@pytest.mark.ci
def test_no_kernel_is_forgotten() -> None:
    """A kernel that no case above has fails here: give it to one."""
    wp.init()
    there = cuda_kernels.all_kernels()
    vectors = {kernel for kernel in there if kernel.startswith(f"{ON_CPU}:")}
    made = {cuda_kernels.identity(kernel) for case in CASES.values() for kernel in case("float32")}
    assert len(vectors) == 3 and len(there) > 30
    assert made == there - vectors


def test_kernels_are_found_where_they_are_written() -> None:
    source = (
        "@wp.kernel\ndef a(): ...\ndef b():\n  if c:\n    @wp.kernel(module='x')\n    def d(): ..."
    )
    assert list(cuda_kernels.written(ast.parse(source))) == ["a", "b.<locals>.d"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "pair",
    [
        pytest.param((Deferred(width=32), Deferred(width=64)), id="units"),
        pytest.param((Deferred(frequencies=0), Deferred(frequencies=2)), id="inputs"),
    ],
)
def test_code_does_not_grow_with_layers(pair: tuple[Model, Model], tmp_path: Path) -> None:
    """Layers that the compiler writes out take it minutes."""
    assembly = precision.load("float32", "launch.assembly")
    sizes = []
    for number, model in enumerate(pair):
        variant = variant_of(model, "float32", "none", "none", "none", packed=False)
        module = assembly.render_forward_kernel(variant).module
        sizes.append(len(compiled(module, tmp_path / str(number))))
    assert sizes[1] < 1.1 * sizes[0]
