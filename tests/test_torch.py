"""The torch operations, as an outsider would check them."""

from typing import Any

import numpy as np
import pytest
import reference
import torch
from expected import assert_close, oracle, oracle_gradient
from problems import N_SEEDS, Problem, make_problem, unit
from torch import Tensor

from warpnerf.checks import InputError
from warpnerf.rendering.render import Steps
from warpnerf.torch import render_rays, scale_gradient


def problem(seed: int, **changes: Any) -> Problem:
    steps = Steps(near=0.07, far=2.9, step=0.11)
    return make_problem(seed, steps=steps, **changes)


def call(
    p: Problem, raw: Tensor, scaling: Any = "none", **changes: Any
) -> tuple[Tensor, Tensor, Tensor]:
    """render_rays on a problem, in raw's type and on its device."""

    def like_raw(values: Any) -> Tensor:
        return torch.tensor(values, dtype=raw.dtype, device=raw.device)

    options: dict[str, Any] = {
        "step": p.steps.step,
        "near": p.steps.near,
        "far": p.steps.far,
        "density_shift": p.density_shift,
        "background": like_raw(p.background),
        "scaling": scaling,
        "content_distance": like_raw(p.content_distance),
    }
    return render_rays(
        raw,
        like_raw(p.origins),
        like_raw(p.directions),
        like_raw(p.box_min),
        like_raw(p.box_max),
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


@pytest.mark.parametrize("scaling", ["none", "quadratic", "clamped"])
def test_render_rays_against_the_oracle(scaling: str, device: str) -> None:
    for seed in range(N_SEEDS):
        content = np.random.default_rng(seed).uniform(0.5, 3.0, size=12)
        p = problem(seed, content_distance=content)
        raw = tensor(p.raw, device).requires_grad_()
        ours, theirs = call(p, raw, scaling), oracle(p, torch.tensor(p.raw))
        assert_close(ours[0].detach().cpu(), theirs.rgb, 1e-12)
        assert_close(ours[1].detach().cpu(), theirs.opacity, 1e-12)
        assert_close(ours[2].detach().cpu(), theirs.depth, 1e-12)
        expected = oracle_gradient(p, scaling)
        assert_close(gradient(p, raw, scaling), expected, 1e-9)
        rounded = gradient(p, raw.detach().float().requires_grad_(), scaling)
        assert rounded.dtype == np.float32
        assert_close(rounded, expected, 1e-5)


def test_gradcheck(device: str) -> None:
    p = problem(2, n_rays=5, size=(3, 2, 4))
    raw = tensor(p.raw, device).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: call(p, x), raw, atol=1e-8, rtol=1e-6)


def test_the_adjoint_of_one_output_alone(device: str) -> None:
    p = problem(3)
    raw = tensor(p.raw, device).requires_grad_()
    at = torch.tensor(p.raw, requires_grad=True)
    for name in ("rgb", "opacity", "depth"):
        index = ("rgb", "opacity", "depth").index(name)
        (ours,) = torch.autograd.grad(call(p, raw)[index].square().sum(), raw)
        (theirs,) = torch.autograd.grad(getattr(oracle(p, at), name).square().sum(), at)
        assert_close(ours.cpu(), theirs, 1e-9)


def test_image_is_the_same_bits_for_every_scaling(device: str) -> None:
    for dtype in (torch.float32, torch.float64):
        p = problem(4, n_rays=100, content_distance=np.array([2.0]))
        raw = tensor(p.raw, device, dtype)
        plain = call(p, raw)
        for scaling in ("quadratic", "clamped"):
            for a, b in zip(call(p, raw, scaling), plain, strict=True):
                assert torch.equal(a, b)


def test_defaults_shapes_and_types(device: str) -> None:
    """Near 0, far where the box ends, a white background."""
    p = problem(5)
    for dtype in (torch.float32, torch.float64):
        raw = tensor(p.raw, device, dtype)
        origins, directions = tensor(p.origins, device), tensor(p.directions, device)
        out = render_rays(
            raw, origins, directions, tuple(p.box_min), list(p.box_max), step=p.steps.step
        )
        assert out.rgb.shape == (12, 3) and out.opacity.shape == out.depth.shape == (12,)
        assert {x.dtype for x in out} == {dtype} and {x.device for x in out} == {raw.device}
        full = make_problem(
            5,
            steps=Steps(near=0.0, far=9.0, step=p.steps.step),
            background=np.ones((1, 3)),
            density_shift=0.0,
        )
        expected = oracle(full, torch.tensor(p.raw))
        tolerance = 1e-12 if dtype == torch.float64 else 1e-5
        for ours, theirs in zip(out, expected[:3], strict=True):
            assert_close(ours.cpu(), theirs, tolerance)


def test_tensors_that_are_not_contiguous(device: str) -> None:
    p = problem(6)
    raw = tensor(p.raw, device)
    expected = gradient(p, raw.clone().requires_grad_())
    strided = raw.permute(2, 3, 0, 1).contiguous().permute(2, 3, 0, 1).requires_grad_()
    assert not strided.is_contiguous()
    assert_close(gradient(p, strided), expected, 1e-13)
    wide = torch.zeros(12, 7, dtype=torch.float64, device=raw.device)
    wide[:, 1:4], wide[:, 4:7] = tensor(p.origins, device), tensor(p.directions, device)
    box = tensor(p.box_min, device), tensor(p.box_max, device)
    views = render_rays(raw, wide[:, 1:4], wide[:, 4:7], *box, step=0.1)
    whole = render_rays(raw, wide[:, 1:4].contiguous(), wide[:, 4:7].contiguous(), *box, step=0.1)
    for a, b in zip(views, whole, strict=True):
        assert torch.equal(a, b)
    # an incoming gradient that is expanded
    leaf = raw.clone().requires_grad_()
    call(p, leaf)[1].sum().backward()
    assert leaf.grad is not None
    ones = torch.ones(12, dtype=torch.float64, device=raw.device)
    (again,) = torch.autograd.grad(call(p, leaf)[1], leaf, ones)
    assert_close(leaf.grad.cpu(), again.cpu(), 1e-13)


def test_raw_in_a_larger_graph_and_twice(device: str) -> None:
    p = problem(7)
    base = tensor(p.raw / 2.0, device).requires_grad_()
    (call(p, 2.0 * base)[0].sum() + call(p, 2.0 * base)[2].sum()).backward()
    at = torch.tensor(p.raw, requires_grad=True)
    theirs = oracle(p, at)
    (expected,) = torch.autograd.grad(theirs.rgb.sum() + theirs.depth.sum(), at)
    assert base.grad is not None
    assert_close(base.grad.cpu(), 2.0 * expected, 1e-9)


def test_no_rays_and_rays_that_miss(device: str) -> None:
    p = problem(8)
    raw = tensor(p.raw, device).requires_grad_()
    empty = torch.empty(0, 3, dtype=torch.float64, device=raw.device)
    out = render_rays(raw, empty, empty, (-1, -1, -1), (1, 1, 1), step=0.1)
    assert [tuple(x.shape) for x in out] == [(0, 3), (0,), (0,)]
    (zero,) = torch.autograd.grad(out.rgb.sum(), raw)
    assert zero.shape == raw.shape and not zero.any()

    away = tensor(unit(p.origins), device)
    out = render_rays(raw, 5.0 * away, away, (-1, -1, -1), (1, 1, 1), step=0.1)
    assert bool((out.rgb == 1.0).all()) and not out.opacity.any() and not out.depth.any()
    (zero,) = torch.autograd.grad(out.rgb.sum() + out.depth.sum(), raw)
    assert not zero.any()


def test_axis_parallel_rays_and_origins_in_the_box(device: str) -> None:
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    rng = np.random.default_rng(9)
    inside = rng.uniform(-0.5, 0.5, size=(6, 3))
    p = problem(9, n_rays=12)
    origins = np.concatenate([inside, inside - 2.0 * axes])
    p = make_problem(
        9, steps=p.steps, origins=origins, directions=np.concatenate([axes, axes]), n_rays=12
    )
    raw = tensor(p.raw, device).requires_grad_()
    assert_close(call(p, raw)[1].detach().cpu(), oracle(p, torch.tensor(p.raw)).opacity, 1e-12)
    assert_close(gradient(p, raw), oracle_gradient(p), 1e-9)


def test_scaling_at_the_camera_and_beyond_content_distance(device: str) -> None:
    p = problem(10)
    raw = tensor(p.raw, device).requires_grad_()
    plain = gradient(p, raw)
    if device == "cpu":
        tiny = make_problem(10, steps=p.steps, content_distance=np.array([0.1]))
        assert np.array_equal(gradient(tiny, raw, "clamped"), plain)  # nearer samples: none
    near = make_problem(10, steps=p.steps, content_distance=np.array([100.0]))
    quadratic = gradient(near, raw, "quadratic")
    assert_close(quadratic, oracle_gradient(near, "quadratic"), 1e-9)
    assert np.abs(quadratic).max() < 1e-3 * np.abs(plain).max()


BAD: dict[str, tuple[dict[str, Any], str]] = {
    "step": ({"step": 0.0}, "step must be"),
    "near": ({"near": -1.0}, "near must be"),
    "nan near": ({"near": float("nan")}, "near must be"),
    "far": ({"far": 0.01}, "far must lie beyond near"),
    "shift": ({"density_shift": float("inf")}, "density_shift must be finite"),
    "scaling": ({"scaling": "cubic"}, "scaling must be one of none, quadratic, clamped"),
    "content": ({"content_distance": 0.0}, "content_distance must be above 0"),
    "nan content": ({"content_distance": float("nan")}, "content_distance must be above 0"),
    "content shape": ({"content_distance": torch.ones(5)}, "a number or \\[n_rays\\]"),
    "background": ({"background": (1.0, 1.0)}, "background must be finite rgb"),
    "background shape": ({"background": torch.ones(5, 3)}, "\\[3\\] or \\[n_rays, 3\\]"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_settings(name: str, device: str) -> None:
    changes, message = BAD[name]
    p = problem(11)
    with pytest.raises(InputError, match=message):
        call(p, tensor(p.raw, device), **changes)


def test_steps_that_float32_does_not_count(device: str) -> None:
    p = problem(11)
    raw = tensor(p.raw, device)
    far_away = {"step": 1e-7, "near": 50.0, "far": 50.0 + 1e-6}
    call(p, raw, **far_away)  # in float64
    with pytest.raises(InputError, match="more than 16777216 steps; use a longer step"):
        call(p, raw.float(), **far_away)


def test_bad_tensors(device: str) -> None:
    p = problem(12)
    raw = tensor(p.raw, device)
    origins, directions = tensor(p.origins, device), tensor(p.directions, device)
    box = (-1, -1, -1), (1, 1, 1)

    def fails(message: str, *arguments: Any) -> None:
        with pytest.raises(InputError, match=message):
            render_rays(*arguments, step=0.1)

    fails("float32 or float64, not torch.float16", raw.half(), origins, directions, *box)
    fails(r"\[X, Y, Z, 4\]", raw[..., :3], origins, directions, *box)
    fails(r"at least two nodes", raw[:1], origins, directions, *box)
    fails(r"origins must be \[n_rays, 3\]", raw, origins[0], directions, *box)
    fails(r"directions must be \[n_rays, 3\]", raw, origins, directions[:, :2], *box)
    fails("equally many, not 12 and 11", raw, origins, directions[1:], *box)
    fails("unit vectors", raw, origins, 2.0 * directions, *box)
    fails("origins must be finite", raw, origins / 0.0, directions, *box)
    fails("box_max must lie above box_min", raw, origins, directions, *box[::-1])
    fails("box_min must be three finite", raw, origins, directions, (0, 0), (1, 1, 1))
    fails("dense tensor", raw.to_sparse(), origins, directions, *box)
    fails("origins must be on the CPU or", raw, origins.to("meta"), directions, *box)


# scale_gradient


class TheirScaler(torch.autograd.Function):
    """The paper's listing, word for word in effect."""

    @staticmethod
    def forward(ctx: Any, colors: Tensor, sigmas: Tensor, ray_dist: Tensor) -> Any:
        ctx.save_for_backward(ray_dist)
        return colors, sigmas, ray_dist

    @staticmethod
    def backward(ctx: Any, grad_colors: Tensor, grad_sigmas: Tensor, grad_dist: Tensor) -> Any:
        (ray_dist,) = ctx.saved_tensors
        scaling = torch.square(ray_dist).clamp(0, 1)
        return grad_colors * scaling, grad_sigmas * scaling, grad_dist


def samples(
    dtype: torch.dtype, device: str, last: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    rng = np.random.default_rng(13)
    tail = (1,) if last else ()
    colors, adj_colors = (tensor(rng.normal(size=(6, 9, 3)), device, dtype) for _ in range(2))
    sigmas, adj_sigmas = (tensor(rng.normal(size=(6, 9, *tail)), device, dtype) for _ in range(2))
    t = tensor(rng.uniform(0.0, 2.0, size=(6, 9, *tail)), device, dtype)
    t[0, 0] = 0.0
    return colors.requires_grad_(), sigmas.requires_grad_(), t, adj_colors, adj_sigmas


FLOATS = [torch.float16, torch.bfloat16, torch.float32, torch.float64]


@pytest.mark.parametrize("dtype", FLOATS, ids=str)
def test_scale_gradient_is_the_papers_operation(dtype: torch.dtype, device: str) -> None:
    colors, sigmas, t, adj_colors, adj_sigmas = samples(dtype, device, last=True)
    out_colors, out_sigmas, out_t = scale_gradient(colors, sigmas, t)
    assert torch.equal(out_colors, colors) and torch.equal(out_sigmas, sigmas)
    assert torch.equal(out_t, t)
    ours = torch.autograd.grad([out_colors, out_sigmas], [colors, sigmas], [adj_colors, adj_sigmas])
    theirs = TheirScaler.apply(colors, sigmas, t)[:2]
    expected = torch.autograd.grad(theirs, [colors, sigmas], [adj_colors, adj_sigmas])
    for a, b in zip(ours, expected, strict=True):
        assert a.dtype == dtype and torch.equal(a, b)
        assert not a[0, 0].any() and float(b.abs().max()) > 0.1
    far = (t >= 1.0).expand_as(adj_colors)
    assert bool(far.any()) and torch.equal(ours[0][far], adj_colors[far])


@pytest.mark.parametrize("last", [False, True])
@pytest.mark.parametrize("scaling", ["none", "quadratic", "clamped"])
@pytest.mark.parametrize("per_ray", [False, True])
def test_scale_gradient_against_the_oracle(
    scaling: Any, last: bool, per_ray: bool, device: str
) -> None:
    colors, sigmas, t, adj_colors, adj_sigmas = samples(torch.float64, device, last)
    content: Any = 1.5
    if per_ray:
        content = torch.linspace(0.5, 3.0, 6, dtype=torch.float64, device=t.device)
        content = content.reshape(6, *(1,) * (t.dim() - 1))
    out = scale_gradient(colors, sigmas, t, content, scaling)
    ours = torch.autograd.grad(out[:2], [colors, sigmas], [adj_colors, adj_sigmas])
    flat = t.reshape(6, 9)
    expected = reference.distance_scale(flat, content.reshape(6) if per_ray else content, scaling)
    assert_close(ours[0].cpu(), (adj_colors * expected[..., None]).cpu(), 1e-14)
    assert_close(ours[1].reshape(6, 9).cpu(), (adj_sigmas.reshape(6, 9) * expected).cpu(), 1e-14)


def test_no_gradient_reaches_the_distances(device: str) -> None:
    colors, sigmas, t, *_ = samples(torch.float64, device, last=True)
    t.requires_grad_()
    for scaling in ("none", "clamped"):
        out = scale_gradient(colors, sigmas, t, scaling=scaling)
        assert not out[2].requires_grad
        total = out[0].sum() + out[1].sum()
        (none,) = torch.autograd.grad(total, t, allow_unused=True)
        assert none is None


def test_scale_gradient_in_a_whole_render(device: str) -> None:
    """Put into the oracle's integration, it gives what render_rays' own adjoint gives."""
    p = problem(14, content_distance=np.array([1.7]))
    at = torch.tensor(p.raw, requires_grad=True)
    plain = oracle(p, at)
    n_steps = plain.t.shape[1]
    points = (
        torch.tensor(p.origins)[:, None] + plain.t[..., None] * torch.tensor(p.directions)[:, None]
    )
    u = reference.grid_coordinates(
        points, torch.tensor(p.box_min), torch.tensor(p.box_max), p.raw.shape, "none", 0.0
    )
    values = reference.trilinear(at, torch.where(plain.kept[..., None], u, 0.0))
    colors, sigmas, t = scale_gradient(
        torch.sigmoid(values[..., 1:]),
        reference.softplus(values[..., 0] + p.density_shift),
        plain.t,
        1.7,
    )
    dt = torch.full((n_steps,), p.steps.step, dtype=torch.float64)
    out = reference.integrate(sigmas, colors, t, dt, torch.tensor(p.background), plain.kept)
    adjoints = [torch.tensor(a) for a in (p.adj_rgb, p.adj_opacity, p.adj_depth)]
    (expected,) = torch.autograd.grad([out.rgb, out.opacity, out.depth], at, adjoints)
    found = gradient(p, tensor(p.raw, device).requires_grad_(), "clamped")
    assert_close(found, expected, 1e-9)


def test_scale_gradient_refuses(device: str) -> None:
    colors, sigmas, t, *_ = samples(torch.float64, device, last=True)
    for arguments, message in [
        ((colors, sigmas, t[:, :4]), "one shape"),
        ((colors[:3], sigmas, t), "colors must be"),
        ((colors, sigmas, t, 0.0), "content_distance must be"),
        ((colors, sigmas, t, torch.tensor([-1.0])), "above 0 everywhere"),
        ((colors, sigmas, t, torch.tensor([1.0, 2.0])), "must broadcast over distances"),
        ((colors, sigmas, t, 1.0, "cubic"), "scaling must be one of"),
    ]:
        with pytest.raises(InputError, match=message):
            scale_gradient(*arguments)
