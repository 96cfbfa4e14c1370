"""The kernels compile for CUDA: Warp brings the compiler along, no GPU is needed for that."""

from pathlib import Path

import pytest
import warp as wp
from drive_losses import LOSSES
from warpnerf_kernels.base import precision

from warpnerf.model.interface import Model
from warpnerf.model.models import Deferred, Features, Rgb, SphericalHarmonics
from warpnerf.rendering.render import variant_of

SHARED = ["sampling.occupancy", "space.camera"]
"""Modules of the kernels that all models share."""


def compiled(module: wp.Module, folder: Path) -> str:
    wp.compile_aot_module(module, arch=75, module_dir=folder, use_ptx=True)
    return "".join(path.read_text() for path in folder.glob("*.ptx"))


@pytest.mark.parametrize("name", ["float32", pytest.param("float64", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("model", "contractions"),
    [
        pytest.param(Rgb(), ("none", "ndc"), id="rgb"),
        pytest.param(Rgb(), ("linf", "l2"), id="rgb, folded", marks=pytest.mark.slow),
        pytest.param(SphericalHarmonics(degree=1), ("none",), id="sh", marks=pytest.mark.slow),
        pytest.param(Deferred(), ("linf",), id="deferred"),
        pytest.param(Features(), ("none",), id="features", marks=pytest.mark.slow),
    ],
)
def test_every_kernel_compiles_for_cuda(
    model: Model, contractions: tuple[str, ...], name: str, tmp_path: Path
) -> None:
    wp.init()
    assembly = precision.load(name, "launch.assembly")
    n, variation = model.n_floats, precision.load(name, "optim.total_variation")
    kernels = [
        variation.total_variation_forward_kernel(n),
        variation.total_variation_backward_kernel(n),
        precision.load(name, "fields.dense").resample_kernel(n),
        precision.load(name, "fields.dense_bound").find_highest_kernel(n),
        precision.load(name, "sampling.occupancy").mark_occupied_kernel(
            precision.load(name, "sampling.steps").STEPS
        ),
        precision.load(name, "launch.probe").probe(n).read_forward,
        precision.load(name, "launch.probe").probe(n).read_backward,
    ]
    if name == "float32":  # it packs what is in float32
        adam = precision.load(name, "optim.adam")
        kernels += [adam.adam_kernel(n), adam.resample_moments_kernel(n), adam.adam_weights]
    for contraction in contractions:
        variant = variant_of(model, name, contraction, "clamped", "density", packed=False)  # type: ignore[arg-type]
        kernels += [
            assembly.render_forward_kernel(variant),
            assembly.render_backward_kernel(variant),
            assembly.render_train_kernel(variant),
        ]
    if isinstance(model, Rgb):
        losses = LOSSES["all"]
        variant = variant_of(model, name, "none", "clamped", "none", packed=False, losses=losses)
        kernels.append(assembly.render_train_kernel(variant))
    modules = [kernel.module for kernel in kernels]
    if isinstance(model, Rgb):
        modules += [wp.get_module(precision.load(name, module).__name__) for module in SHARED]
    for number, module in enumerate(modules):
        assert ".entry" in compiled(module, tmp_path / str(number))


def test_code_does_not_grow_with_layers(tmp_path: Path) -> None:
    """Layers that the compiler writes out take it minutes."""
    assembly = precision.load("float32", "launch.assembly")
    sizes = []
    for width in (32, 64):
        model = Deferred(width=width)
        variant = variant_of(model, "float32", "none", "none", "none", packed=False)
        module = assembly.render_forward_kernel(variant).module
        sizes.append(len(compiled(module, tmp_path / str(width))))
    assert sizes[1] < 1.1 * sizes[0]
