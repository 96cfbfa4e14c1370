"""The kernels compile for CUDA: Warp brings the compiler along, no GPU is needed for that."""

from pathlib import Path

import pytest
import warp as wp
from warpnerf_kernels import contraction, gradscale, precision

NAMES = ["interp", "regularize", "occupancy", "camera"]


def compiled(module: wp.Module, folder: Path) -> str:
    wp.compile_aot_module(module, arch=75, module_dir=folder, use_ptx=True)
    return "".join(path.read_text() for path in folder.glob("*.ptx"))


@pytest.mark.parametrize("name", ["float32", "float64"])
def test_every_kernel_compiles_for_cuda(name: str, tmp_path: Path) -> None:
    wp.init()
    render = precision.load(name, "render")
    names = [*NAMES, "adam"] if name == "float32" else NAMES  # it packs what is in float32
    modules = [wp.get_module(precision.load(name, module).__name__) for module in names]
    for folded in (contraction.NONE, contraction.LINF, contraction.L2):
        variant = render.Variant(
            folded, gradscale.CLAMPED, gradscale.JACOBIAN_DENSITY, packed=False
        )
        modules += [
            render.render_forward_kernel(variant).module,
            render.render_backward_kernel(variant).module,
            render.render_train_kernel(variant).module,
        ]
    for number, module in enumerate(modules):
        folder = tmp_path / str(number)
        assert ".entry" in compiled(module, folder)
