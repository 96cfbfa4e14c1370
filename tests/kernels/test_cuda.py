"""The kernels compile for CUDA: Warp brings the compiler along, no GPU is needed for that."""

from pathlib import Path
from typing import Any

import pytest
import warp as wp
from warpnerf_kernels.base import precision

from tests.support.loss_problems import LOSSES
from tests.support.small_model import SMALL
from warpnerf.model.interface import Model, loader
from warpnerf.model.models import Deferred, PerSample, Rgb, SphericalHarmonics
from warpnerf.model.spaces import part_of
from warpnerf.model.storage_kinds import Vm
from warpnerf.rendering.structs import variant_of

SHARED = [
    "optim.exposure",
    "optim.near_decay",
    "optim.reduction",
    "sampling.occupancy",
    "space.camera",
    "space.reprojection",
]
"""Modules of the kernels that all models share."""


def compiled(module: wp.Module, folder: Path, *, arch: int = 75) -> str:
    """PTX for a compute capability times ten."""
    folder.mkdir(exist_ok=True)
    wp.compile_aot_module(module, arch=arch, module_dir=folder, use_ptx=True)
    return "".join(path.read_text() for path in folder.glob("*.ptx"))


@pytest.mark.ci
@pytest.mark.parametrize("name", ["float32", pytest.param("float64", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("model", "contractions"),
    [
        pytest.param(Rgb(), ("none",), id="rgb"),
        pytest.param(Rgb(), ("ndc",), id="rgb, ndc", marks=pytest.mark.slow),
        pytest.param(Rgb(), ("linf", "l2"), id="rgb, contracted", marks=pytest.mark.slow),
        pytest.param(SphericalHarmonics(degree=1), ("none",), id="sh", marks=pytest.mark.slow),
        pytest.param(SMALL, ("linf",), id="deferred", marks=pytest.mark.slow),
        pytest.param(PerSample(), ("none",), id="features", marks=pytest.mark.slow),
    ],
)
def test_every_kernel_compiles_for_cuda(
    model: Model, contractions: tuple[str, ...], name: str, tmp_path: Path
) -> None:
    wp.init()
    assembly = precision.load(name, "launch.assembly")
    n, variation = model.n_floats, precision.load(name, "optim.total_variation")
    dense = precision.load(name, "fields.dense")
    kernels = [
        variation.total_variation_forward_kernel(n),
        variation.total_variation_backward_kernel(n),
        dense.resample_kernel(n),
        precision.load(name, "fields.dense_bound").find_highest_kernel(n),
        precision.load(name, "sampling.occupancy").mark_occupied_kernel(
            precision.load(name, "sampling.steps").STEPS, part_of(contractions[0], name)
        ),
        *vars(precision.load(name, "launch.probe").probe(dense.dense(n))).values(),
    ]
    if name == "float32":  # it packs what is in float32
        adam = precision.load(name, "optim.adam")
        kernels += [adam.adam_kernel(n, decays=decays) for decays in (False, True)]
        kernels += [adam.resample_moments_kernel(n), adam.adam_weights]
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


@pytest.mark.ci
@pytest.mark.parametrize(
    ("model", "contraction"),
    [(SMALL, "linf"), pytest.param(Rgb(), "ndc", marks=pytest.mark.slow)],
)
def test_a_training_compiles_for_cuda(model: Model, contraction: Any, tmp_path: Path) -> None:
    """The launch that has all parts of a model and its space in it, and their adjoints."""
    variant = variant_of(model, "float32", contraction, "clamped", "density", packed=False)
    assembly = precision.load("float32", "launch.assembly")
    assert ".entry" in compiled(assembly.render_train_kernel(variant).module, tmp_path)


@pytest.mark.slow  # compiles for seconds
@pytest.mark.parametrize("name", ["float32", "float64"])
def test_factors_compile_for_cuda(name: str, tmp_path: Path) -> None:
    wp.init()
    factors = precision.load(name, "fields.factors")
    terms = precision.load(name, "optim.factor_terms")
    types, part = precision.load(name, "base.types"), Vm().encoding(loader(name), SMALL)
    kernels = [
        *vars(precision.load(name, "launch.probe").probe(part)).values(),
        factors.node_densities_kernel(16),
        *(factors.resample_kernel(dtype) for dtype in (types.vector(16), types.real)),
        terms.plane_terms_kernel(16),
        terms.line_terms,
    ]
    if name == "float32":
        kernels.append(precision.load(name, "optim.adam").resample_moments_along_kernel(16))
    variant = variant_of(SMALL, name, "none", "clamped", "none", packed=False, stored=Vm())  # type: ignore[arg-type]
    assembly = precision.load(name, "launch.assembly")
    kernels += [assembly.render_forward_kernel(variant), assembly.render_train_kernel(variant)]
    for number, kernel in enumerate(kernels):
        assert ".entry" in compiled(kernel.module, tmp_path / str(number))


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
