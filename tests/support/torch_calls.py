"""render_rays on problems, in a tensor's type and on its device."""

from typing import Any

import pytest
import torch
from torch import Tensor

from tests.support.problems import Problem, make_problem
from warpnerf.rendering.steps import Steps
from warpnerf.torch import March, RenderedRays, render_intervals, render_rays


def problem(seed: int, **changes: Any) -> Problem:
    steps = Steps(near=0.07, far=2.9, step=0.11)
    return make_problem(seed, steps=steps, **changes)


def call(
    p: Problem, raw: Any, scaling: Any = "none", like: Tensor | None = None, **changes: Any
) -> RenderedRays:
    """render_rays on a problem, in the type of raw, or of another tensor, and on its device."""
    given: Tensor = raw if like is None else like

    def like_raw(values: Any) -> Tensor:
        return torch.tensor(values, dtype=given.dtype, device=given.device)

    march = {name: changes.pop(name) for name in ("step", "near", "far") if name in changes}
    options: dict[str, Any] = {
        "step": March(p.steps.step, p.steps.near, p.steps.far)._replace(**march),
        "density_shift": p.density_shift,
        "background": like_raw(p.background),
        "scaling": scaling,
        "content_distance": like_raw(p.content_distance),
    }
    return render_rays(
        raw,
        like_raw(p.origins),
        like_raw(p.directions),
        (like_raw(p.box_min), like_raw(p.box_max)),
        **options | changes,
    )


def gradient(p: Problem, raw: Tensor, scaling: str = "none") -> Any:
    out = call(p, raw, scaling)
    adjoints = [
        torch.tensor(a, dtype=raw.dtype, device=raw.device)
        for a in (p.adj_rgb, p.adj_opacity, p.adj_depth)
    ]
    return torch.autograd.grad(out, raw, adjoints)[0].cpu().numpy()


def torch_device(device: str) -> str:
    if device == "cpu":
        return device
    if not torch.cuda.is_available():
        pytest.skip("this torch has no CUDA")
    return device


def tensor(values: Any, device: str, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.tensor(values, dtype=dtype, device=torch_device(device))


def leaves(
    tensors: dict[str, Any], device: str, dtype: torch.dtype = torch.float64
) -> dict[str, torch.Tensor]:
    return {
        name: torch.tensor(x, dtype=dtype, device=torch_device(device)).requires_grad_()
        for name, x in tensors.items()
    }


def gradients(p: Problem, out: Any, given: dict[str, torch.Tensor]) -> dict[str, Any]:
    like = next(iter(given.values()))
    adjoints = [
        torch.tensor(a, dtype=like.dtype, device=like.device)
        for a in (p.adj_rgb, p.adj_opacity, p.adj_depth)
    ]
    found = torch.autograd.grad(out[:3], [*given.values()], adjoints)
    return {name: x.cpu().numpy() for name, x in zip(given, found, strict=True)}


def with_edges(
    p: Problem, raw: Any, like: torch.Tensor, edges: Any, scaling: Any, **options: Any
) -> Any:
    """render_intervals of a problem."""

    def like_raw(values: Any) -> torch.Tensor:
        return torch.tensor(values, dtype=like.dtype, device=like.device)

    return render_intervals(
        raw,
        like_raw(p.origins),
        like_raw(p.directions),
        (p.box_min, p.box_max),
        like_raw(edges),
        density_shift=p.density_shift,
        background=like_raw(p.background),
        scaling=scaling,
        content_distance=like_raw(p.content_distance),
        **options,
    )
