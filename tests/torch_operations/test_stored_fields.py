"""render_rays of fields that are no dense grids, and render_intervals, against the oracle."""

from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import pytest
import torch

from tests.support.expected import assert_close
from tests.support.field_trainings import config_of
from tests.support.model_problems import FEATURES_SMALL
from tests.support.problems import Problem
from tests.support.stored_problems import (
    HASH,
    HIDDEN,
    KINDS,
    SIZE,
    VM,
    oracle,
    oracle_gradients,
    random_edges,
    random_tensors,
    stored,
)
from tests.support.tiny_trainings import ball
from tests.support.torch_calls import (
    call,
    gradients,
    leaves,
    problem,
    torch_device,
    with_edges,
)
from warpnerf.checks import InputError
from warpnerf.config import GridConfig
from warpnerf.model.interface import loader
from warpnerf.model.storage_kinds import AUTO_FIELD, DENSE, StorageKind, Vm
from warpnerf.rendering.rays import camera_rays
from warpnerf.torch import Head, March, StoredField, first_tensors, render_intervals, render_rays
from warpnerf.torch.launches import Constants
from warpnerf.training.trainer import Trainer

BOX = (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)
RAY = torch.tensor([[0.1, 0.2, -2.0]]), torch.tensor([[0.0, 0.0, 1.0]])


def varied(seed: int) -> Problem:
    return problem(seed, content_distance=np.random.default_rng(seed).uniform(0.5, 3.0, size=12))


def require_oracle(p: Problem, kind: StorageKind, device: str, edges: Any = None) -> None:
    """In both precisions."""
    tensors = random_tensors(p, kind)
    expected = oracle(p, kind, {k: torch.tensor(v) for k, v in tensors.items()}, "none", edges)
    slopes = oracle_gradients(p, kind, tensors, "clamped", edges)
    for dtype, tolerance in ((torch.float64, 1e-9), (torch.float32, 3e-5)):
        given = leaves(tensors, device, dtype)
        field, like = stored(kind, given), given["decoder"]
        if edges is None:
            out: Any = call(p, field, "clamped", like=like)
        else:
            out = with_edges(p, field, like, edges, "clamped")
            assert_close(out.weights.cpu(), expected.weights, tolerance)
        assert {x.dtype for x in out} == {dtype}
        for ours, theirs in zip(out, expected[:3], strict=False):
            assert_close(ours.detach().cpu(), theirs, tolerance)
        for name, found in gradients(p, out, given).items():
            assert_close(found, slopes[name], tolerance)


@pytest.mark.parametrize("name", KINDS)
def test_stored_fields_against_the_oracle(name: str, device: str) -> None:
    require_oracle(varied(3), KINDS[name], device)


@pytest.mark.parametrize("name", ["vm", "hash"])
def test_intervals_of_stored_fields_against_the_oracle(name: str, device: str) -> None:
    p = varied(4)
    require_oracle(p, KINDS[name], device, random_edges(p))


def test_gradcheck(device: str) -> None:
    p = problem(2, n_rays=4)
    given = leaves(random_tensors(p, VM), device)

    def seen(*tensors: torch.Tensor) -> Any:
        named = dict(zip(given, tensors, strict=True))
        return tuple(call(p, stored(VM, named), like=named["decoder"]))

    assert torch.autograd.gradcheck(
        seen, tuple(given.values()), atol=1e-8, rtol=1e-6, fast_mode=True
    )


def test_intervals_that_are_steps_are_steps(device: str) -> None:
    """Of a dense grid: the same numbers as a march."""
    p = varied(5)
    raw = torch.tensor(p.raw, device=torch_device(device)).requires_grad_()
    n = int((p.steps.far - p.steps.near) / p.steps.step)
    edges = np.tile(p.steps.near + p.steps.step * np.arange(n + 1), (12, 1))
    marched = call(p, raw, "clamped", far=p.steps.near + n * p.steps.step)
    found = with_edges(p, raw, raw, edges, "clamped")
    for ours, theirs in zip(found[:3], marched, strict=True):
        assert_close(ours.detach().cpu(), theirs.detach().cpu(), 1e-12)
    slopes = [gradients(p, out, {"raw": raw})["raw"] for out in (found, marched)]
    assert_close(*slopes, 1e-12)
    assert not found.weights.requires_grad
    assert_close(found.weights.sum(dim=1).cpu(), found.opacity.detach().cpu(), 1e-12)


@pytest.mark.parametrize("name", KINDS)
def test_it_learns_from_its_first_tensors(name: str) -> None:
    """As the documentation has it: Adam on all tensors, until rays see what they should."""
    kind = KINDS[name]
    size = SIZE if name == "vm" else None
    tensors = {
        key: torch.tensor(x, requires_grad=True)
        for key, x in first_tensors(kind, BOX, size, seed=1).items()
    }
    origins = torch.tensor([[x, y, -2.0] for x in (-0.5, 0.0, 0.5) for y in (-0.5, 0.5)])
    directions = torch.tensor([[0.0, 0.0, 1.0]]).expand(6, 3)
    target = torch.linspace(0.1, 0.9, 18).reshape(6, 3)
    adam, losses = torch.optim.Adam(tensors.values(), 0.03), []
    for _ in range(60):
        rays = render_rays(
            StoredField(kind, tensors, size),
            *(origins, directions, BOX),
            step=0.1,
            scaling="clamped",
            content_distance=2.0,
        )
        loss = (rays.rgb - target).square().mean()
        adam.zero_grad()
        loss.backward()
        adam.step()
        losses.append(loss.item())
    assert losses[-1] < 0.1 * losses[0]


def test_first_tensors_are_those_of_a_training() -> None:
    """The same seed, the same numbers; by name or configured."""
    ours, same, other = (
        first_tensors(kind, BOX, SIZE, seed=seed) for kind, seed in (("vm", 3), (VM, 3), ("vm", 4))
    )
    assert list(ours) == ["planes", "lines", "decoder"]
    assert all(x.dtype == np.float32 for x in ours.values())
    assert all(np.array_equal(ours[name], same[name]) for name in ours)
    assert not np.array_equal(ours["planes"], other["planes"])
    assert first_tensors("vm", BOX, SIZE, head="deferred")["decoder"].shape == (48, 16)
    assert list(first_tensors("hash", BOX)) == ["values", "decoder"]


@pytest.mark.ci
@pytest.mark.parametrize("kind", [VM, replace(HASH, coarsest=4, finest=16)])
def test_tensors_of_a_training_are_seen_as_its_field_is(kind: StorageKind) -> None:
    """But for what is next to nothing, which a field skips."""
    config = replace(config_of(kind), steps=40, grid=GridConfig(voxels=1000, grow_at=()))
    trainer = Trainer(ball(), config)
    trainer.run()
    field, camera = trainer.field(), ball().cameras[0]
    storage, lattice = field.storage, field.lattice
    origins, directions = (x.numpy() for x in camera_rays(camera, field.workers))
    expected = field.render_rays(origins, directions)
    tensors = {name: torch.tensor(x) for name, x in storage.tensors().items()}
    size = lattice.size if kind == VM else None
    unit = storage.density_scale  # lengths are multiples of 1 / that
    lengths = (unit * x for x in (field.steps.step, field.steps.near, field.steps.far))
    seen = render_rays(
        StoredField(kind, tensors, size),
        *(torch.tensor(x, dtype=torch.float32) for x in (unit * origins, directions)),
        (unit * lattice.box_min, unit * lattice.box_max),
        March(*lengths),
        density_shift=storage.density_shift,
        background=field.background,
    )
    assert expected.opacity.max() > 0.5
    np.testing.assert_allclose(seen.rgb, expected.rgb, atol=2e-3)


def refused(match: str, kind: Any = "vm", size: Any = SIZE, **changed: Any) -> None:
    tensors = {k: torch.tensor(v) for k, v in first_tensors("vm", BOX, SIZE).items()}
    tensors = {k: v for k, v in (tensors | changed).items() if v is not None}
    with pytest.raises(InputError, match=match):
        render_rays(StoredField(kind, tensors, size), *RAY, BOX, step=0.1)


class Unregistered(Vm):
    name: ClassVar[str] = "unregistered"


def test_bad_fields_are_refused() -> None:
    refused(r"kind must be one of vm, hash.*, not 'tensorf'", kind="tensorf")
    refused(r"kind must be one of vm, hash.*, not 'dense'", kind="dense")
    for kind in (AUTO_FIELD, DENSE, Unregistered(), Vm, 5, None):
        refused(r"kind must be vm or hash.*, or one configured, as warpnerf.Vm", kind=kind)
    refused("size must be three whole numbers, nodes along each axis for the vm", size=None)
    refused("size must be three whole numbers", size=(4, 5.5, 6))
    refused("size must be two nodes or more", size=(1, 6, 5))
    refused("size must be two nodes or more", size=(np.int64(2**22),) * 3)
    refused("tensors of a hash must be values, decoder, by name", kind="hash", size=None)
    refused("tensors of a vm must be planes, lines, decoder", lines=None)
    lines, named = torch.zeros(15, 16), r"tensors\['lines'\] must be "
    refused(named + r"\[15, 16\] here, not \[14, 16\]", lines=lines[1:])
    refused(named + "torch.float32, as others, not torch.float64", lines=lines.double())
    refused(named + "float32 or float64", lines=lines.half())
    refused(named + "a torch tensor, not float", lines=3.0)
    for nameless in (None, [lines], lines):
        with pytest.raises(InputError, match="tensors of a field must be a dictionary of them"):
            render_rays(StoredField("vm", nameless, SIZE), *RAY, BOX, step=0.1)  # type: ignore[arg-type]


BAD_BOXES: dict[str, tuple[Any, str]] = {
    "reversed": (BOX[::-1], "box_max must lie above box_min"),
    "text": (("low", BOX[1]), "box_min must be three finite numbers"),
    "two": (((0, 0), BOX[1]), "box_min must be three finite numbers within 1e"),
    "too large": (((-1e300,) * 3, (1e300,) * 3), "box_min must be three finite numbers within 1e"),
    "too small": (((0, 0, 0), (5e-324,) * 3), "the box's edge along x must lie between 1e-12"),
    "one corner": (BOX[:1], "box must be its lower and its upper corner"),
}


@pytest.mark.parametrize("name", BAD_BOXES)
def test_bad_boxes_are_refused(name: str) -> None:
    box, message = BAD_BOXES[name]
    given = {k: torch.tensor(v) for k, v in first_tensors("hash", BOX).items()}
    with pytest.raises(InputError, match=message):
        first_tensors("hash", box)
    with pytest.raises(InputError, match=message):
        render_rays(StoredField("hash", given), *RAY, box, step=0.1)


def test_bad_first_tensors_are_refused() -> None:
    with pytest.raises(InputError, match=r"size must be left out, not .*: a hash has levels"):
        first_tensors("hash", BOX, SIZE)
    with pytest.raises(InputError, match="kind must be one of vm, hash"):
        first_tensors("nerf", BOX, SIZE)
    with pytest.raises(InputError, match="seed must be"):
        first_tensors("vm", BOX, SIZE, seed=-1)
    with pytest.raises(InputError, match="model must be"):
        first_tensors("vm", BOX, SIZE, head="nerf")


def test_other_forms_of_the_same() -> None:
    """A box of tensors, tensors in a module, and a head whose layers iterate once."""
    corners = tuple(torch.tensor(x) for x in BOX)
    network = torch.nn.Sequential(torch.nn.Linear(24, 64), torch.nn.Linear(64, 64))
    once = Head("deferred", iter([*network.parameters(), torch.zeros(3, 64), torch.zeros(3)]))
    given = first_tensors("vm", corners, SIZE, head=once)  # type: ignore[arg-type]
    module = torch.nn.ParameterDict({k: torch.tensor(v) for k, v in given.items()})
    field = StoredField("vm", module, SIZE)  # type: ignore[arg-type]
    render_rays(field, *RAY, BOX, 0.1, head=once).rgb.sum().backward()
    assert all(tensor.grad is not None for tensor in module.values())
    with pytest.raises(InputError, match="what iterates once, as parameters"):
        render_rays(field, *RAY, BOX, 0.1, head=once)


def test_a_head_has_gradients_beside_the_field() -> None:
    """Of a hash with a hidden layer, whose samples an MLP shades."""
    model, p = FEATURES_SMALL, problem(6, n_rays=3)
    n_inputs = model.layout(loader("float64")).n_inputs
    rng = np.random.default_rng(6)
    first = first_tensors(HIDDEN, (p.box_min, p.box_max), head=model)
    given = leaves({name: rng.normal(size=x.shape) / 4.0 for name, x in first.items()}, "cpu")
    layers = [
        torch.tensor(rng.normal(size=size) / 2.0, requires_grad=True)
        for size in ((16, n_inputs), (16,), (3, 16), (3,))
    ]

    def seen(*tensors: torch.Tensor) -> Any:
        named = dict(zip(given, tensors, strict=False))
        head = Head(model, tensors[len(given) :])
        return tuple(call(p, stored(HIDDEN, named), like=tensors[0], head=head))

    inputs = (*given.values(), *layers)
    assert torch.autograd.gradcheck(seen, inputs, atol=1e-7, rtol=1e-5, fast_mode=True)


@pytest.mark.parametrize("name", Constants._fields)
def test_what_changes_in_place_is_noticed(name: str) -> None:
    """Before the way back, which reads it again."""
    p = problem(7, n_rays=4)
    given = {
        field: torch.tensor(getattr(p, field))
        for field in ("origins", "directions", "background", "content_distance")
    }
    given["edges"] = torch.tensor(random_edges(p))
    raw = torch.tensor(p.raw, requires_grad=True)
    out = render_intervals(raw, box=(p.box_min, p.box_max), **given)
    given[name].mul_(0.5)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        out.rgb.sum().backward()


def test_no_rays(device: str) -> None:
    given = leaves(first_tensors("vm", BOX, SIZE), device)
    none = torch.zeros(0, 3, dtype=torch.float64, device=torch_device(device))
    edges = none.new_zeros(0, 5)
    out = render_intervals(StoredField("vm", given, SIZE), none, none, BOX, edges)
    assert [tuple(x.shape) for x in out] == [(0, 3), (0,), (0,), (0, 4)]
    found = torch.autograd.grad(out.rgb.sum(), [*given.values()])
    assert not any(x.any() for x in found)


def test_bad_edges_are_refused() -> None:
    raw = torch.zeros(3, 3, 3, 4)

    def fails(match: str, edges: Any) -> None:
        with pytest.raises(InputError, match=match):
            render_intervals(raw, *RAY, BOX, edges)

    fails("edges must be a torch tensor, not list", [[0.0, 1.0, 2.0]])
    fails(r"edges must be \[n_rays, n \+ 1\]", torch.arange(5.0))
    fails(r"edges must be \[n_rays, n \+ 1\]", torch.arange(6.0).reshape(2, 3))
    fails("from 2 to 1024, of 1 rays", torch.arange(2.0)[None])
    fails("finite distances of 0 or above, in rising order", torch.tensor([[0.0, 2.0, 1.0]]))
    fails("finite distances of 0 or above, in rising order", torch.tensor([[-1.0, 2.0, 3.0]]))
    fails("finite distances", torch.tensor([[0.0, 2.0, float("inf")]]))
    fails("finite distances", torch.tensor([[0.0, 2.0, 1e39]], dtype=torch.float64))
    fails("edges requires grad", torch.tensor([[0.0, 1.0, 2.0]], requires_grad=True))
