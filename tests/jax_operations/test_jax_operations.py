"""The JAX operations against those of torch, which the oracle judges, and against the oracle."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest

jax = pytest.importorskip("jax")
import jax.numpy as jnp  # noqa: E402
import torch  # noqa: E402

from tests.support import torch_calls  # noqa: E402
from tests.support.expected import assert_close, oracle, oracle_gradient  # noqa: E402
from tests.support.model_problems import DEFERRED_SMALL  # noqa: E402
from tests.support.problems import Problem  # noqa: E402
from tests.support.torch_calls import problem  # noqa: E402
from tests.torch_operations import test_torch_models  # noqa: E402
from warpnerf import jax as wj  # noqa: E402
from warpnerf import torch as wt  # noqa: E402
from warpnerf.checks import InputError  # noqa: E402

FLOATS = ["float16", "bfloat16", "float32", "float64"]


def same_bits(ours: Any, theirs: Any) -> None:
    """An array of JAX and a tensor of torch."""
    theirs = theirs.detach()
    assert str(theirs.dtype) == f"torch.{ours.dtype}" and tuple(theirs.shape) == ours.shape
    assert np.array_equal(np.asarray(ours, np.float64), theirs.double().numpy())


# --- The scaling --------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize("scaling", ["none", "quadratic", "clamped"])
def test_scale_gradient_is_that_of_torch(scaling: Any, dtype: str) -> None:
    rng = np.random.default_rng(13)
    shapes = {"colors": (6, 9, 3), "sigmas": (6, 9), "t": (6, 9)}
    given = {name: rng.uniform(0.0, 2.0, shape) for name, shape in shapes.items()}
    adjoints = [rng.normal(size=shape) for shape in shapes.values()]
    content = rng.uniform(0.5, 1.5, (6, 1))

    tensors = [torch.tensor(x, dtype=getattr(torch, dtype)) for x in (*given.values(), content)]
    leaves = [x.requires_grad_() for x in tensors[:3]]
    seen = wt.scale_gradient(*leaves, tensors[3], scaling)
    of_torch = [torch.tensor(a, dtype=tensors[0].dtype) for a in adjoints]
    expected = torch.autograd.grad(seen, leaves, of_torch)

    arrays = [jnp.asarray(x, dtype) for x in (*given.values(), content)]
    out, pull = jax.vjp(lambda *x: wj.scale_gradient(*x, arrays[3], scaling), *arrays[:3])
    pulling = tuple(jnp.asarray(a, dtype) for a in adjoints)
    for ours, theirs in zip(out, seen, strict=True):
        same_bits(ours, theirs)
    for found in (pull(pulling), jax.jit(pull)(pulling)):
        for ours, theirs in zip(found, expected, strict=True):
            # XLA divides by multiplying by the reciprocal.
            rounding = 4.0 * float(jnp.finfo(dtype).eps)
            wanted = theirs.double().numpy()
            assert ours.dtype == dtype
            np.testing.assert_allclose(np.asarray(ours, np.float64), wanted, rounding)
    assert scaling == "none" or not np.array_equal(
        found[0], np.asarray(adjoints[0], found[0].dtype)
    )


def test_scale_gradient_under_vmap() -> None:
    """A ray at a time, with its own content distance: as all rays at once."""
    rng = np.random.default_rng(14)
    colors, sigmas, t = (jnp.asarray(rng.uniform(0, 2, s)) for s in ((5, 7, 3), (5, 7), (5, 7)))
    content = jnp.asarray(rng.uniform(0.5, 1.5, 5))

    def loss(colors: Any, sigmas: Any, t: Any, content: Any) -> Any:
        colors, sigmas, t = wj.scale_gradient(colors, sigmas, t, content)
        return jnp.sum(colors**2) + jnp.sum(sigmas**2 * t)

    of_all = jax.grad(loss, (0, 1, 2))(colors, sigmas, t, content[:, None])
    of_each = jax.vmap(jax.grad(loss, (0, 1, 2)))(colors, sigmas, t, content)
    for ours, theirs in zip(of_each, of_all, strict=True):
        assert np.array_equal(ours, theirs)


# --- Rendering ----------------------------------------------------------------------------------


def call(
    p: Problem, raw: Any, scaling: Any = "none", like: Any = None, **changes: Any
) -> wj.RenderedRays:
    """render_rays on a problem, in the type of raw, or of another array."""
    dtype = (raw if like is None else like).dtype
    options: dict[str, Any] = {
        "density_shift": p.density_shift,
        "background": jnp.asarray(p.background, dtype),
        "scaling": scaling,
        "content_distance": jnp.asarray(p.content_distance, dtype),
    }
    rays = jnp.asarray(p.origins, dtype), jnp.asarray(p.directions, dtype)
    box = p.box_min.astype(dtype), p.box_max.astype(dtype)
    march = wj.March(p.steps.step, p.steps.near, p.steps.far)
    return wj.render_rays(raw, *rays, box, march, **options | changes)


def pulled(p: Problem, function: Callable[..., Any], *at: Any) -> tuple[Any, Any]:
    """What a function sees, and its gradients."""
    adjoints = (p.adj_rgb, p.adj_opacity, p.adj_depth)
    out, pull = jax.vjp(function, *at)
    return out, pull(wj.RenderedRays(*(jnp.asarray(a, at[0].dtype) for a in adjoints)))


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_render_rays_against_torch_and_the_oracle(dtype: str) -> None:
    tolerance = 1e-12 if dtype == "float64" else 1e-6
    for seed, scaling in enumerate(("none", "quadratic", "clamped")):
        content = np.random.default_rng(seed).uniform(0.5, 3.0, size=12)
        p = problem(seed, content_distance=content)
        leaf = torch.tensor(p.raw, dtype=getattr(torch, dtype), requires_grad=True)
        theirs = torch_calls.call(p, leaf, scaling)
        expected = torch_calls.gradient(p, leaf, scaling)
        function = partial(call, p, scaling=scaling)
        for rendering in (function, jax.jit(function)):
            out, (gradient,) = pulled(p, rendering, jnp.asarray(p.raw, dtype))
            same_bits(out.rgb, theirs.rgb)
            same_bits(out.depth, theirs.depth)
            same_bits(out.opacity, theirs.opacity)
            assert gradient.dtype == dtype and np.array_equal(gradient, expected)
        if dtype == "float64":
            truth = oracle(p, torch.tensor(p.raw))
            assert_close(np.asarray(out.rgb), truth.rgb, tolerance)
            assert_close(np.asarray(gradient), oracle_gradient(p, scaling), 1e-9)
        else:
            exact = torch_calls.call(p, torch.tensor(p.raw), scaling)
            assert_close(np.asarray(out.rgb), exact.rgb, tolerance)


def test_layers_have_gradients() -> None:
    """Those of torch, bit for bit."""
    p = test_torch_models.problem(DEFERRED_SMALL, 3)
    raw, head = test_torch_models.tensors(p, torch.float64, "cpu")
    expected = test_torch_models.gradients(p, raw, head)

    def rendering(raw: Any, *layers: Any) -> wj.RenderedRays:
        return call(p, raw, "clamped", head=wj.Head(p.model, layers))

    arrays = [jnp.asarray(x.detach().numpy()) for x in (raw, *head)]
    _, found = pulled(p, jax.jit(rendering), *arrays)
    for ours, theirs in zip(found, expected, strict=True):
        assert np.array_equal(ours, theirs) and np.abs(theirs).max() > 0.0


def test_vmap_over_grids_and_over_rays() -> None:
    p = problem(4)
    raw = jnp.asarray(p.raw)
    several = jnp.stack([raw, 2.0 * raw])

    def loss(raw: Any, **changes: Any) -> Any:
        out = call(p, raw, **changes)
        return jnp.sum(out.rgb**2) + jnp.sum(out.depth)

    found = jax.vmap(jax.grad(loss))(several)
    for ours, at in zip(found, several, strict=True):
        assert np.array_equal(ours, jax.grad(loss)(at))

    backgrounds = jnp.asarray(np.random.default_rng(4).uniform(size=(2, 3)))
    seen = jax.vmap(lambda rgb: call(p, raw, background=rgb).rgb)(backgrounds)
    for ours, rgb in zip(seen, backgrounds, strict=True):
        assert np.array_equal(ours, call(p, raw, background=rgb).rgb)


def test_no_rays() -> None:
    raw, empty = jnp.zeros((3, 3, 3, 4)), jnp.zeros((0, 3))
    box = (-1, -1, -1), (1, 1, 1)
    gradient = jax.grad(lambda raw: wj.render_rays(raw, empty, empty, box, 0.1).rgb.sum())(raw)
    assert gradient.shape == raw.shape and not gradient.any()


@pytest.mark.parametrize("name", ["origins", "directions", "background", "content_distance"])
def test_what_has_no_gradient_is_refused(name: str) -> None:
    p = problem(5)
    given = {
        field: jnp.asarray(getattr(p, field))
        for field in ("origins", "directions", "background", "content_distance")
    }
    box = p.box_min, p.box_max

    def loss(x: Any) -> Any:
        return wj.render_rays(jnp.asarray(p.raw), box=box, step=0.1, **given | {name: x}).rgb.sum()

    for gradient in (jax.grad(loss), jax.grad(jax.jit(loss))):
        with pytest.raises(InputError, match=f"{name} is differentiated, but .*stop_gradient"):
            gradient(given[name])


def test_bad_input_is_refused() -> None:
    p = problem(6)
    raw, ray = jnp.asarray(p.raw), jnp.asarray([[0.0, 0.0, 1.0]])
    box = (-1, -1, -1), (1, 1, 1)

    def fails(message: str, *arguments: Any, **options: Any) -> None:
        with pytest.raises(InputError, match=message):
            wj.render_rays(*arguments, **{"step": 0.1} | options)

    fails("raw must be an array, not 3", 3, ray, ray, box)
    fails("float32 or float64, not float16", raw.astype("float16"), ray, ray, box)
    fails(r"raw must be \[X, Y, Z, 4\]", raw[..., :3], ray, ray, box)
    fails("equally many, not 1 and 2", raw, ray, jnp.concatenate([ray, ray]), box)
    fails("unit vectors", raw, ray, 2.0 * ray, box)
    fails("origins must be finite", raw, ray / 0.0, ray, box)
    fails("step 1e-10 is too short", raw, ray, ray, box, step=1e-10)
    fails("box_max must lie above box_min", raw, ray, ray, box[::-1])
    fails("background must be an array or numbers", raw, ray, ray, box, background=None)
    fails("background must be finite rgb", raw, ray, ray, box, background=(1.0, 1.0))
    fails("content_distance must be above 0.*not 0", raw, ray, ray, box, content_distance=0)
    single, large = raw.astype("float32"), (1e300, 0.0, 0.0)
    fails("background must be finite rgb", single, ray, ray, box, background=large)
    fails("content_distance must be above 0", single, ray, ray, box, content_distance=1e-320)
    fails("far must lie beyond near", raw, ray, ray, box, step=wj.March(0.5, far="x"))
    fails("head.layers must be a list", raw, ray, ray, box, head=wj.Head("rgb", 5))
    several = np.array(["none", "quadratic"])
    fails("scaling must be one of none", raw, ray, ray, box, scaling=several)
    fails("density_shift must be a finite number", raw, ray, ray, box, density_shift=jnp.ones(3))
    wj.render_rays(raw, ray, ray, box, np.array(0.5), density_shift=np.array(0.5))
    fails("head must be empty", raw, ray, ray, box, head=wj.Head("rgb", [ray]))
    with pytest.raises(InputError, match="box_min is traced, but a box is compiled in"):
        jax.jit(lambda low: wj.render_rays(raw, ray, ray, (low, box[1]), 0.1).rgb)(ray[0])
    with pytest.raises(Exception, match="InputError: directions must be unit vectors"):
        jax.jit(lambda d: wj.render_rays(raw, ray, d, box, 0.1).rgb)(2.0 * ray).block_until_ready()

    colors, sigmas = jnp.ones((4, 3)), jnp.ones(4)
    for arguments, message in [
        ((colors, sigmas, sigmas[:3]), "one shape"),
        ((colors[:3], sigmas, sigmas), "colors must be"),
        ((colors, sigmas, sigmas, 0.0), "content_distance must be"),
        ((colors, sigmas, sigmas, -sigmas), "above 0 everywhere"),
        ((colors, sigmas, sigmas, jnp.ones(3)), "must broadcast over distances"),
        ((colors, sigmas, sigmas, 1.0, "cubic"), "scaling must be one of"),
    ]:
        with pytest.raises(InputError, match=message):
            wj.scale_gradient(*arguments)
    with pytest.raises(InputError, match="content_distance is differentiated"):
        jax.grad(lambda d: wj.scale_gradient(colors, sigmas, sigmas, d)[0].sum())(sigmas)
