"""The torch operations, as an outsider would check them."""

from typing import Any

import numpy as np
import pytest
import torch

from tests.support.expected import assert_close, oracle, oracle_gradient
from tests.support.problems import N_SEEDS, make_problem, unit
from tests.support.torch_calls import call, gradient, problem, tensor
from warpnerf.checks import InputError
from warpnerf.rendering.steps import Steps
from warpnerf.torch import Head, March, render_rays


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
            raw, origins, directions, (tuple(p.box_min), list(p.box_max)), p.steps.step
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
    views = render_rays(raw, wide[:, 1:4], wide[:, 4:7], box, step=0.1)
    whole = render_rays(raw, wide[:, 1:4].contiguous(), wide[:, 4:7].contiguous(), box, step=0.1)
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
    out = render_rays(raw, empty, empty, ((-1, -1, -1), (1, 1, 1)), step=0.1)
    assert [tuple(x.shape) for x in out] == [(0, 3), (0,), (0,)]
    (zero,) = torch.autograd.grad(out.rgb.sum(), raw)
    assert zero.shape == raw.shape and not zero.any()

    away = tensor(unit(p.origins), device)
    out = render_rays(raw, 5.0 * away, away, ((-1, -1, -1), (1, 1, 1)), step=0.1)
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
    "far of text": ({"far": "x"}, "far must lie beyond near"),
    "layers of a number": ({"head": Head("rgb", 5)}, "head.layers must be a list of arrays, not 5"),
    "no layers": ({"head": Head("rgb", None)}, "head.layers must be a list of arrays, not None"),
    "shift of several": ({"density_shift": torch.ones(3)}, "density_shift must be a finite number"),
    "scalings": ({"scaling": np.array(["none", "quadratic"])}, "scaling must be one of none"),
    "shift": ({"density_shift": float("inf")}, "density_shift must be a finite number"),
    "content distance of text": (
        {"content_distance": "far"},
        "content_distance must be a tensor or numbers, not 'far'",
    ),
    "background of nothing": ({"background": None}, "background must be a tensor or numbers"),
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

    fails("float32 or float64, not torch.float16", raw.half(), origins, directions, box)
    fails(r"\[X, Y, Z, 4\]", raw[..., :3], origins, directions, box)
    fails(r"at least two nodes", raw[:1], origins, directions, box)
    fails(r"origins must be \[n_rays, 3\]", raw, origins[0], directions, box)
    fails(r"directions must be \[n_rays, 3\]", raw, origins, directions[:, :2], box)
    fails("equally many, not 12 and 11", raw, origins, directions[1:], box)
    fails("unit vectors", raw, origins, 2.0 * directions, box)
    fails("origins must be finite", raw, origins / 0.0, directions, box)
    fails("box_max must lie above box_min", raw, origins, directions, box[::-1])
    fails("box must be its lower and its upper corner", raw, origins, directions, box[0])
    fails("box_min must be three finite", raw, origins, directions, ((0, 0), (1, 1, 1)))
    fails("dense tensor", raw.to_sparse(), origins, directions, box)
    fails("origins must be on the CPU or", raw, origins.to("meta"), directions, box)


def test_the_old_spelling_warns_and_gives_the_same(device: str) -> None:
    p = problem(12)
    raw, corners = tensor(p.raw, device), (tuple(p.box_min), tuple(p.box_max))
    rays = tensor(p.origins, device), tensor(p.directions, device)
    plain = render_rays(raw, *rays, corners, 0.1)
    near = render_rays(raw, *rays, corners, March(0.1, near=1.5, far=4.0), head=Head("rgb"))
    assert not torch.equal(plain.rgb, near.rgb)
    for expected, given, options in (
        (plain, corners, {}),
        (plain, (), {"box_min": corners[0], "box_max": corners[1]}),
        (plain, corners[:1], {"box_max": corners[1]}),
        (near, corners, {"near": 1.5, "far": 4.0, "model": "rgb", "head": ()}),
    ):
        with pytest.warns(DeprecationWarning, match="box_max, box_min.*only until warpnerf 0.2"):
            found = render_rays(raw, *rays, *given, step=0.1, **options)
        assert torch.equal(found.rgb, expected.rgb)
    with pytest.raises(TypeError, match="use March"):
        render_rays(raw, *rays, corners, 0.1, near=1.5)


def test_what_has_no_gradient_is_refused_where_one_is_asked_for(device: str) -> None:
    p = problem(16)
    raw = tensor(p.raw, device).requires_grad_()
    given = {
        "origins": tensor(p.origins, device),
        "directions": tensor(p.directions, device),
        "background": tensor(p.background, device),
        "content_distance": tensor(p.content_distance, device),
    }
    box = tensor(p.box_min, device), tensor(p.box_max, device)
    expected = render_rays(raw, box=box, step=0.1, **given)
    for number, name in enumerate(("box_min", "box_max")):
        corners = [corner.clone().requires_grad_(number == i) for i, corner in enumerate(box)]
        with pytest.raises(InputError, match=f"{name} requires grad, but .*call its detach"):
            render_rays(raw, box=corners, step=0.1, **given)
    for name, value in given.items():
        asked = given | {name: value.clone().requires_grad_()}
        with pytest.raises(InputError, match=f"{name} requires grad, but .*call its detach"):
            render_rays(raw, box=box, step=0.1, **asked)
        with torch.no_grad():
            found = render_rays(raw, box=box, step=0.1, **asked)
        assert torch.equal(found.rgb, expected.rgb)


def test_a_background_that_is_trained(device: str) -> None:
    """As the docstring says: what lies behind is added outside."""
    p = problem(17)
    raw = tensor(p.raw, device)
    behind = tensor(p.background, device).requires_grad_()
    expected = call(p, raw).rgb
    plain = call(p, raw, background=(0.0, 0.0, 0.0))
    found = plain.rgb + (1.0 - plain.opacity)[:, None] * behind
    assert_close(found.detach().cpu(), expected.cpu(), 1e-12)
    (ours,) = torch.autograd.grad(found.sum(), behind)
    assert_close(ours.sum().cpu(), 3.0 * (1.0 - plain.opacity).sum().cpu(), 1e-12)
