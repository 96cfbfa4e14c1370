"""All kernels of the package, and those of them that a GPU runs, by what they belong to."""

import ast
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import warp as wp
from warpnerf_kernels.base import precision

from tests.support.loss_problems import LOSSES
from tests.support.small_model import SMALL
from warpnerf.model.interface import Model, loader
from warpnerf.model.models import PerSample, Rgb, SphericalHarmonics
from warpnerf.model.sampler_kinds import CLIPPED, Resampled
from warpnerf.model.spaces import part_of
from warpnerf.model.storage_kinds import Hash, StorageKind, Vm
from warpnerf.rendering.structs import variant_of

PACKAGE = Path(precision.__file__).parents[1]

SHARED = [
    "fields.dense_bound",
    "optim.adam",
    "optim.exposure",
    "optim.factor_terms",
    "optim.near_decay",
    "optim.reduction",
    "sampling.coverage",
    "sampling.occupancy",
    "space.camera",
    "space.reprojection",
]
"""Modules with kernels that are made once, whatever the model."""

ON_CPU = "launch.packed"
"""The module whose kernels walk in vectors: a GPU has those of launch.scalar in their place."""

HIDDEN = Hash(hidden=32)

Made = list[wp.Kernel]


def shared(name: str) -> Made:
    """Of the modules that are compiled as wholes: all of each."""
    modules = [precision.load(name, module) for module in SHARED]
    if name != "float32":  # Adam packs what is in float32
        modules.remove(precision.load(name, "optim.adam"))
    return [k for module in modules for k in vars(module).values() if isinstance(k, wp.Kernel)]


def walks(name: str, *arguments: Any, **others: Any) -> Made:
    """The launches of a variant: forward, backward and training."""
    assembly = precision.load(name, "launch.assembly")
    variant = variant_of(*arguments, packed=False, **others)
    return [
        assembly.render_forward_kernel(variant),
        assembly.render_backward_kernel(variant),
        assembly.render_train_kernel(variant),
    ]


def training(name: str, model: Model, contraction: Any, **others: Any) -> Made:
    """The launch that has all parts of a model, its field and its space in it, and adjoints."""
    return walks(name, model, name, contraction, "clamped", "density", **others)[2:]


def adam(name: str, width: int) -> Made:
    """Of the optimiser, for nodes or entries of so many numbers."""
    if name != "float32":
        return []
    module = precision.load(name, "optim.adam")
    made = [module.adam_kernel(width, decays=decays) for decays in (False, True)]
    return [*made, module.resample_moments_kernel(width)]


def dense(*contractions: Any, model: Model) -> Callable[[str], Made]:
    """What a model with a dense grid needs, in some spaces."""

    def made(name: str) -> Made:
        n, variation = model.n_floats, precision.load(name, "optim.total_variation")
        fields = precision.load(name, "fields.dense")
        kernels = [
            variation.total_variation_forward_kernel(n),
            variation.total_variation_backward_kernel(n),
            fields.resample_kernel(n),
            precision.load(name, "fields.dense_bound").find_highest_kernel(n),
            precision.load(name, "sampling.occupancy").mark_occupied_kernel(
                precision.load(name, "sampling.steps").STEPS, part_of(contractions[0], name)
            ),
            *vars(precision.load(name, "launch.probe").probe(fields.dense(n))).values(),
            *adam(name, n),
        ]
        for contraction in contractions:
            kernels += walks(name, model, name, contraction, "clamped", "density")
        return kernels

    return made


def factors(name: str) -> Made:
    """What reads, grows and regularises factors."""
    fields = precision.load(name, "fields.factors")
    types = precision.load(name, "base.types")
    kernels = [
        *read(name, Vm()),
        fields.node_densities_kernel(16),
        *(fields.resample_kernel(dtype) for dtype in (types.vector(16), types.real)),
        precision.load(name, "optim.factor_terms").plane_terms_kernel(16),
        *adam(name, 16),
    ]
    if name == "float32":
        kernels.append(precision.load(name, "optim.adam").resample_moments_along_kernel(16))
    return kernels


def read(name: str, kind: StorageKind) -> Made:
    """What reads a kind of storage at given points, and adds to it."""
    encoding = kind.encoding(loader(name), SMALL)
    return list(vars(precision.load(name, "launch.probe").probe(encoding)).values())


def hashed(name: str) -> Made:
    """What reads a hash; densities at nodes also through a hidden layer."""
    densities = precision.load(name, "fields.hashed").node_densities_kernel
    kernels = [densities(kind.features, kind.levels, kind.hidden) for kind in (Hash(), HIDDEN)]
    return [*kernels, *read(name, Hash()), *adam(name, Hash().features)]


def proposal(contraction: Any) -> Callable[[str], Made]:
    """What draws intervals from a proposal, and teaches it."""

    def made(name: str) -> Made:
        found = precision.load(name, "launch.propose").proposing(part_of(contraction, name), False)
        return [found.propose_forward, found.propose_backward, found.add_bins, *adam(name, 1)]

    return made


def stored(kind: StorageKind) -> Callable[[str], Made]:
    """Launches through a field that is stored so."""
    return lambda name: [
        *walks(name, SMALL, name, "none", "clamped", "none", stored=kind),
        *read(name, kind),
    ]


def resampled(**others: Any) -> Callable[[str], Made]:
    """Launches through intervals of a proposal, in contracted space."""
    chosen = {"sampler": Resampled(), **others}
    return lambda name: walks(name, SMALL, name, "linf", "clamped", "none", **chosen)


def clipped(name: str) -> Made:
    """Rendering parts of rays."""
    return walks(name, Rgb(), name, "none", "none", "none", sampler=CLIPPED)[:1]


QUICK: dict[str, Callable[[str], Made]] = {
    "shared": shared,
    "rgb": dense("none", model=Rgb()),
    "deferred, contracted, training": lambda name: training(name, SMALL, "linf"),
    "factors": factors,
    "hash": hashed,
    "proposal": proposal("none"),
    "rgb, resampled, training": lambda name: training(name, Rgb(), "none", sampler=Resampled()),
    "rgb, parts of rays": clipped,
    "rgb, all losses": lambda name: training(name, Rgb(), "none", losses=LOSSES["all"]),
}
"""By what they belong to; in float32 seconds each."""

LONG: dict[str, Callable[[str], Made]] = {
    "rgb, ndc": dense("ndc", model=Rgb()),
    "rgb, contracted": dense("linf", "l2", model=Rgb()),
    "sh": dense("none", model=SphericalHarmonics(degree=1)),
    "deferred": dense("linf", model=SMALL),
    "per_sample": dense("none", model=PerSample()),
    "factors, launches": stored(Vm()),
    "hash, launches": stored(Hash()),
    "hash with a hidden layer, launches": stored(HIDDEN),
    "proposal, contracted by linf": proposal("linf"),
    "proposal, contracted by l2": proposal("l2"),
    "proposal, ndc": proposal("ndc"),
    "deferred, resampled": resampled(),
    "factors, resampled": resampled(stored=Vm()),
    "hash, resampled": resampled(stored=HIDDEN),
}
"""Likewise, which take longer."""


def identity(kernel: wp.Kernel) -> str:
    """Module and name of the function that a kernel is made of."""
    function = kernel.func
    return f"{function.__module__.partition('.')[2]}:{function.__qualname__}"


def written(tree: ast.AST, within: str = "") -> Iterator[str]:
    """Qualified names of functions with the decorator wp.kernel."""
    for node in ast.iter_child_nodes(tree):
        if not isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield from written(node, within)
            continue
        for decorator in node.decorator_list:
            called = decorator.func if isinstance(decorator, ast.Call) else decorator
            if ast.unparse(called) == "wp.kernel":
                yield within + node.name
        local = ".<locals>." if isinstance(node, ast.FunctionDef) else "."
        yield from written(node, within + node.name + local)


def all_kernels() -> set[str]:
    """Identities of all kernels that the package has."""
    found = set()
    for path in PACKAGE.rglob("*.py"):
        module = ".".join(path.relative_to(PACKAGE).with_suffix("").parts)
        found |= {f"{module}:{name}" for name in written(ast.parse(path.read_text()))}
    return found
