"""Fields that are no dense grids, and intervals: against torch, which the oracle judges."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

jax = pytest.importorskip("jax")
import jax.numpy as jnp  # noqa: E402
import torch  # noqa: E402

from tests.jax_operations.test_jax_operations import call, same_bits  # noqa: E402
from tests.support import torch_calls  # noqa: E402
from tests.support.stored_problems import (  # noqa: E402
    KINDS,
    random_edges,
    random_tensors,
    stored,
)
from tests.support.torch_calls import gradients, leaves, problem, with_edges  # noqa: E402
from warpnerf import jax as wj  # noqa: E402
from warpnerf.checks import InputError  # noqa: E402


@pytest.mark.parametrize(
    ("name", "dtype"),
    [("vm", "float64"), ("hash with a hidden layer", "float64"), ("hash", "float32")],
)
def test_they_are_those_of_torch(name: str, dtype: str) -> None:
    """Bit for bit, gradients too."""
    p, kind = problem(3), KINDS[name]
    tensors, edges = random_tensors(p, kind), random_edges(p)
    given = leaves(tensors, "cpu", getattr(torch, dtype))
    arrays = {key: jnp.asarray(x, dtype) for key, x in tensors.items()}
    like = given["decoder"]
    marched = torch_calls.call(p, stored(kind, given), "clamped", like=like)
    drawn = with_edges(p, stored(kind, given), like, edges, "clamped")

    def march(arrays: Any) -> Any:
        return call(p, stored(kind, arrays), "clamped", arrays["decoder"])

    def draw(arrays: Any) -> Any:
        rays = (jnp.asarray(x, dtype) for x in (p.origins, p.directions))
        return wj.render_intervals(
            stored(kind, arrays),
            *rays,
            (p.box_min, p.box_max),
            jnp.asarray(edges, dtype),
            density_shift=p.density_shift,
            background=jnp.asarray(p.background, dtype),
            scaling="clamped",
            content_distance=jnp.asarray(p.content_distance, dtype),
        )

    for function, theirs in ((march, marched), (draw, drawn)):
        out, pull = jax.vjp(jax.jit(function), arrays)
        for ours, expected in zip(out, theirs, strict=True):
            same_bits(ours, expected)
        adjoints = [jnp.asarray(a, dtype) for a in (p.adj_rgb, p.adj_opacity, p.adj_depth)]
        of_weights = [jnp.zeros_like(x) for x in out[3:]]
        (found,) = pull(type(out)(*adjoints, *of_weights))
        for key, gradient in gradients(p, theirs, given).items():
            assert np.array_equal(found[key], gradient) and np.abs(gradient).max() > 0.0


def test_bad_fields_are_refused() -> None:
    ray, box = jnp.asarray([[0.0, 0.0, 1.0]]), ((-1, -1, -1), (1, 1, 1))
    given = {k: jnp.asarray(v) for k, v in wj.first_tensors("vm", box, (3, 4, 5)).items()}

    def fails(message: str, **changed: Any) -> None:
        field = wj.StoredField("vm", given | changed, (3, 4, 5))
        with pytest.raises(InputError, match=message):
            wj.render_rays(field, ray, ray, box, 0.1)

    lines, named = given["lines"], r"tensors\['lines'\] must be "
    fails(named + r"\[12, 16\] here, not \[11, 16\]", lines=lines[1:])
    fails(named + "float32, as others, not float64", lines=lines.astype("float64"))
    fails(named + "float32 or float64, not float16", lines=lines.astype("float16"))
    fails(named + "an array, not 3", lines=3)


def test_bad_edges_are_refused() -> None:
    ray, box = jnp.asarray([[0.0, 0.0, 1.0]]), ((-1, -1, -1), (1, 1, 1))
    raw, edges = jnp.zeros((3, 3, 3, 4)), jnp.asarray([[0.0, 1.0, 2.0]])

    def drawn(edges: Any) -> Any:
        return wj.render_intervals(raw, ray, ray, box, edges).rgb.sum()

    def weighs(raw: Any) -> Any:
        return wj.render_intervals(raw, ray, ray, box, edges).weights.sum()

    with pytest.raises(InputError, match="rising order"):
        drawn(edges[:, ::-1])
    single = raw.astype("float32")
    with pytest.raises(InputError, match="finite distances"):
        wj.render_intervals(single, ray, ray, box, np.array([[0.0, 1.0, 1e39]]))
    assert not jax.grad(weighs)(raw).any()
    with pytest.raises(Exception, match=r"InputError: edges must be .* in rising order"):
        jax.jit(drawn)(edges[:, ::-1]).block_until_ready()
    with pytest.raises(InputError, match=r"edges must be \[n_rays, n \+ 1\]"):
        drawn(edges[0])
    with pytest.raises(InputError, match="edges is differentiated"):
        jax.grad(drawn)(edges)
