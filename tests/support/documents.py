"""Code blocks of the documents, and stand-ins for packages that their examples use."""

from __future__ import annotations

import importlib.util
import re
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
DOCUMENTS = ("README.md", *sorted(f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md")))

FENCED = re.compile(r"^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
INDENTED = re.compile(r"(?:\A|(?<=\n\n))(?:    \S.*\n)+(?=\n|\Z)")
INLINE = re.compile(r"`(warpnerf [^`]+)`")


@dataclass(frozen=True)
class Block:
    """A code block of a document."""

    language: str
    """As behind the fence; sh for indented blocks."""
    text: str
    section: str
    """The heading above."""


def blocks(document: str) -> list[Block]:
    """All code blocks of a document, in order."""
    text = (ROOT / document).read_text()
    found = [(at.start(), at[1], at[2]) for at in FENCED.finditer(text)]
    outside = FENCED.sub(lambda at: re.sub(r"[^\n]", "", at[0]), text)  # as many lines
    found += [
        (_offset(text, outside, at.start()), "sh", re.sub("^    ", "", at[0], flags=re.MULTILINE))
        for at in INDENTED.finditer(outside)
    ]
    return [Block(language, code, _heading(text[:at])) for at, language, code in sorted(found)]


def _offset(text: str, outside: str, at: int) -> int:
    """Where a line of the text without fences lies in the text."""
    return len("".join(text.splitlines(keepends=True)[: outside[:at].count("\n")]))


def _heading(before: str) -> str:
    return (re.findall(r"^#+ (.+)$", before, re.MULTILINE) or [""])[-1]


def lines_of_shell(text: str) -> list[str]:
    """Commands of a shell block, without comments; lines that end in a backslash are joined."""
    joined = re.sub(r"\\\n\s*", " ", text)
    bare = (re.sub(r"(?:^|\s+)# .*", "", line).strip() for line in joined.splitlines())
    return [command.strip() for line in bare for command in line.split(" && ") if command.strip()]


def inline_commands(document: str) -> Iterator[str]:
    """`warpnerf ...` in running text, on one line or over the end of one."""
    text = FENCED.sub("", (ROOT / document).read_text())
    for found in INLINE.finditer(text):
        yield " ".join(found[1].split())


# --- Stand-ins, with the signatures of the versions that the documents name ----------------------


class FieldHeadNames(Enum):
    """Of nerfstudio 1.1.5."""

    RGB = "rgb"
    DENSITY = "density"
    NORMALS = "normals"


def nerfacc_rendering(
    t_starts: Any,
    t_ends: Any,
    ray_indices: Any = None,
    n_rays: int | None = None,
    rgb_sigma_fn: Callable[..., Any] | None = None,
    rgb_alpha_fn: Callable[..., Any] | None = None,
    render_bkgd: Any = None,
) -> tuple[Any, Any, Any, dict[str, Any]]:
    """Of nerfacc 0.5.3: packed samples, composited in a loop over rays."""
    import torch

    assert rgb_sigma_fn is not None and n_rays is not None
    rgbs, sigmas = rgb_sigma_fn(t_starts, t_ends, ray_indices)
    assert rgbs.shape == (*t_starts.shape, 3) and sigmas.shape == t_starts.shape
    colors, opacities, depths = [], [], []
    for ray in range(n_rays):
        own = ray_indices == ray
        optical = (sigmas * (t_ends - t_starts))[own]
        weights = torch.exp(optical - torch.cumsum(optical, 0)) * (1.0 - torch.exp(-optical))
        colors.append(weights @ rgbs[own])
        opacities.append(weights.sum()[None])
        depths.append((weights * (t_starts + t_ends)[own] / 2.0).sum()[None])
    return torch.stack(colors), torch.stack(opacities), torch.stack(depths), {}


def gsplat_rasterization(
    means: Any,
    quats: Any,
    scales: Any,
    opacities: Any,
    colors: Any,
    viewmats: Any,
    Ks: Any,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
) -> tuple[Any, Any, dict[str, Any]]:
    """Of gsplat 1.5.3: centres are drawn as single pixels, whose colours add up."""
    import torch

    n, c = len(means), len(viewmats)
    assert means.shape == scales.shape == colors.shape == (n, 3)
    assert quats.shape == (n, 4) and opacities.shape == (n,)
    assert viewmats.shape == (c, 4, 4) and Ks.shape == (c, 3, 3)
    seen = means @ viewmats[0, :3, :3].T + viewmats[0, :3, 3]
    pixels = seen @ Ks[0].T
    u, v = (pixels[:, k] / pixels[:, 2] for k in (0, 1))
    inside = (seen[:, 2] > near_plane) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    at = (v[inside].long() * width + u[inside].long(),)
    alpha = torch.zeros(width * height).index_put(at, opacities[inside], accumulate=True)
    rgb = torch.zeros(width * height, 3).index_put(
        at, opacities[inside, None] * colors[inside], accumulate=True
    )
    return rgb.reshape(c, height, width, 3), alpha.reshape(c, height, width, 1), {}


class Testbed:
    """Of instant-ngp's pyngp: white pictures after the first frame."""

    __test__ = False  # it is none of pytest's
    nerf_matrices: list[np.ndarray]

    def __init__(self, mode: str) -> None:
        self.training_step, self.shall_train = 0, False
        self.nerf_matrices = []

    def load_training_data(self, path: str) -> None:
        assert (Path(path) / "transforms.json").is_file()

    def reload_network_from_file(self, path: str = "") -> None: ...

    def frame(self) -> bool:
        self.training_step += 1
        return True

    def set_nerf_camera_matrix(self, matrix: np.ndarray) -> None:
        assert matrix.shape == (3, 4)
        self.nerf_matrices.append(matrix)

    def render(self, width: int, height: int, spp: int = 1, linear: bool = True) -> np.ndarray:
        return np.ones((height, width, 4), np.float32)


def tiny_cuda_network(
    n_input_dims: int,
    n_output_dims: int,
    encoding_config: dict[str, Any],
    network_config: dict[str, Any],
    seed: int = 1337,
) -> Any:
    """Of tinycudann 2.0: a linear layer, in half precision."""
    import torch

    class Half(torch.nn.Linear):
        def forward(self, x: Any) -> Any:
            return super().forward(x).half()

    assert encoding_config["otype"] == "HashGrid" and network_config["otype"] == "FullyFusedMLP"
    return Half(n_input_dims, n_output_dims)


def module(name: str, **contents: Any) -> ModuleType:
    made = ModuleType(name)
    made.__dict__.update(contents)
    return made


def stand_in(patch: pytest.MonkeyPatch) -> None:
    """Make packages importable that are not installed here."""
    modules = [
        module("nerfacc", rendering=nerfacc_rendering),
        module("gsplat", rasterization=gsplat_rasterization),
        module("pyngp", Testbed=Testbed, TestbedMode=module("TestbedMode", Nerf="Nerf")),
        module("tinycudann", NetworkWithInputEncoding=tiny_cuda_network),
    ]
    nerfacto = module("nerfstudio.models.nerfacto", scale_gradients_by_distance_squared=None)
    modules += [
        module("nerfstudio"),
        module("nerfstudio.field_components"),
        module("nerfstudio.field_components.field_heads", FieldHeadNames=FieldHeadNames),
        module("nerfstudio.models", nerfacto=nerfacto),
        nerfacto,
    ]
    tops = {made.__name__.partition(".")[0] for made in modules}
    missing = {top for top in tops if importlib.util.find_spec(top) is None}
    for made in modules:
        if made.__name__.partition(".")[0] in missing:
            patch.setitem(sys.modules, made.__name__, made)
