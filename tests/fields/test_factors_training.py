"""A field of factors trains, grows, resumes, is regularised, skips free space, and is exported."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import warpnerf as wn
from tests.support.field_trainings import (
    EXPORTS,
    config_of,
    require_exported,
    require_files_hold,
    require_resumes,
    states_of,
)
from tests.support.tiny_trainings import ball
from warpnerf.checks import InputError
from warpnerf.cli.configured import configured
from warpnerf.config import OBJECT_FIELD
from warpnerf.fields.dense import DenseGrid
from warpnerf.fields.factors import AXES, Factors
from warpnerf.fields.lattice import Lattice
from warpnerf.fields.nodes import points_of, values_at
from warpnerf.fields.occupancy import FreeCells
from warpnerf.model.storage_kinds import DENSE, STORAGE_KINDS, Vm
from warpnerf.optim_config import OptimConfig
from warpnerf.runs.run import Run
from warpnerf.runtime.parallel import Workers
from warpnerf.training.optim import OPTIMISERS
from warpnerf.training.plan import resolve
from warpnerf.training.state import TrainingState
from warpnerf.training.trainer import Trainer

CONFIG = config_of(Vm(sparsity=1e-4))


@pytest.fixture(scope="module")
def states() -> list[TrainingState]:
    return states_of(CONFIG, early=100)


def storage_of(state: TrainingState) -> Factors:
    assert isinstance(state.field.storage, Factors)
    return state.field.storage


def test_it_learns(states: list[TrainingState]) -> None:
    begun, trained = states
    assert trained.progress.loss < 0.2
    assert trained.progress.size > begun.progress.size
    for moments in trained.optimiser["planes"].values():
        assert moments.shape == storage_of(trained).planes.shape


def test_it_resumes_with_equal_bits(states: list[TrainingState], tmp_path: Path) -> None:
    require_resumes(states, CONFIG, tmp_path / "state")


def test_auto_is_vm_for_objects_alone(tmp_path: Path) -> None:
    """And its run resumes; with rates of a dense grid it is dense, whatever is shown."""
    auto = replace(CONFIG, field="auto")
    assert resolve(ball(), auto).config == replace(CONFIG, field=OBJECT_FIELD)
    assert resolve(replace(ball(), unbounded=True), auto).config.field == DENSE
    rates = replace(auto, optim=replace(auto.optim, learning_rate_rgb=0.3))
    assert resolve(ball(), rates).config.field == DENSE
    decay = replace(auto, optim=replace(auto.optim, near_decay=0.1))
    assert resolve(ball(), decay).config.field == DENSE
    finest = replace(auto, grid=replace(auto.grid, voxels="auto"))
    for unbounded, voxels in ((False, 300**3), (True, 224**3)):
        assert resolve(replace(ball(), unbounded=unbounded), finest).config.grid.voxels == voxels
    begun = Trainer(ball(), auto).state()
    assert isinstance(storage_of(begun), Factors)
    assert Trainer(ball(), auto, begun).config.field == OBJECT_FIELD
    run = Run(tmp_path / "run")
    run.create(ball(), "ball", 1, ball().content_distance, auto)
    run.save_checkpoint(begun)
    assert run.load_state()[0].config.field == OBJECT_FIELD


def test_auto_stays_what_it_was_when_a_training_began(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever it is in the version that resumes it."""
    auto = replace(CONFIG, field="auto", grid=replace(CONFIG.grid, voxels="auto"))
    monkeypatch.setattr("warpnerf.config.OBJECT_FIELD", Vm(sparsity=1e-4))
    monkeypatch.setattr(Vm, "auto_voxels", 4096)
    begun = Trainer(ball(), auto).state()
    run = Run(tmp_path / "run")
    run.create(ball(), "ball", 1, ball().content_distance, auto)
    run.save_checkpoint(begun)
    monkeypatch.undo()
    assert run.load_state()[0].config == begun.config
    assert Trainer(ball(), auto, begun).config == begun.config
    other = replace(auto, optim=replace(auto.optim, learning_rate_rgb=0.3))
    with pytest.raises(InputError, match=r"rgb is 0\.3, but the training to be resumed has"):
        Trainer(ball(), other, begun)


def test_files_hold_it(states: list[TrainingState], tmp_path: Path) -> None:
    require_files_hold(states[1], CONFIG, tmp_path / "field.safetensors")


@pytest.mark.parametrize("name", EXPORTS)
def test_it_is_exported(states: list[TrainingState], tmp_path: Path, name: str) -> None:
    require_exported(states[1], tmp_path / name)


def by_hand(storage: Factors, nodes: tuple[np.ndarray, ...]) -> np.ndarray:
    """Raw densities [X, Y, Z] at node coordinates along each axis, linear between entries."""
    tensors, size = storage.tensors(), storage.lattice.size
    width = storage.kind.width
    to_density = tensors["decoder"][:, 0].reshape(3, width)
    lines = np.split(tensors["lines"], np.cumsum([size[2], size[1]]))
    raw, begin = 0.0, 0
    for plane, (a, b) in enumerate(AXES):
        c, n = 3 - a - b, size[a] * size[b]
        values = tensors["planes"][begin : begin + n].reshape(size[a], size[b], width)
        begin += n
        on_plane = np.einsum(
            "ai,bj,ijn->abn", hats(nodes[a], size[a]), hats(nodes[b], size[b]), values
        )
        on_line = hats(nodes[c], size[c]) @ lines[plane]
        part = np.einsum("abn,cn,n->abc", on_plane, on_line, to_density[plane])
        raw = raw + np.moveaxis(part, (0, 1, 2), (a, b, c))
    return np.asarray(raw)


def hats(u: np.ndarray, n: int) -> np.ndarray:
    return np.maximum(0.0, 1.0 - np.abs(u[:, None] - np.arange(n)))


def test_densities_at_nodes(states: list[TrainingState], monkeypatch: pytest.MonkeyPatch) -> None:
    storage, workers = storage_of(states[1]), states[1].field.workers
    expected = by_hand(storage, tuple(np.arange(n) for n in storage.lattice.size))
    found = storage.raw_densities(workers)
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())
    x, y, z = storage.lattice.size
    n = 4 if x % 4 else 5  # so that the last slab has fewer
    monkeypatch.setattr("warpnerf.fields.storage.SLAB", n * y * z + 1)
    slabs = list(storage.density_slabs(workers))
    assert [first for first, _ in slabs] == list(range(0, x, n)) and x % n
    joined = np.concatenate([values.numpy()[:, 0] for _, values in slabs])
    assert np.array_equal(joined, found.ravel())


def test_between_nodes_it_is_trilinear(states: list[TrainingState]) -> None:
    """So what nodes tell of a cell is all there is: skipping it is exact."""
    storage, rng = storage_of(states[1]), np.random.default_rng(3)
    raw = by_hand(storage, tuple(np.arange(n) for n in storage.lattice.size))
    u = [np.sort(rng.uniform(0, n - 1, 7)) for n in storage.lattice.size]
    points = np.stack(np.meshgrid(*u, indexing="ij"), axis=-1).reshape(-1, 3)
    expected = by_hand(storage, tuple(u)).ravel()
    np.testing.assert_allclose(values_at(raw, points), expected, atol=1e-9 * np.abs(raw).max())


def test_free_cells_are_those_of_a_dense_grid(
    states: list[TrainingState], monkeypatch: pytest.MonkeyPatch
) -> None:
    field = states[1].field
    storage, lattice, workers = storage_of(states[1]), field.lattice, field.workers
    values = np.zeros((*lattice.size, 4), np.float32)
    values[..., 0] = storage.raw_densities(workers)
    dense = DenseGrid.from_tensors(DENSE, field.model, lattice, {"values": values}, workers.device)
    dense = replace(dense, density_shift=storage.density_shift, density_scale=storage.density_scale)
    monkeypatch.setattr("warpnerf.fields.storage.SLAB", 1)
    march = field.steps.struct()
    cells = (FreeCells.of(one, workers, march, 0.05) for one in (storage, dense))
    found, expected = (one.distance.numpy() for one in cells)
    assert 0 < (found == 0).sum() < found.size
    assert np.array_equal(found, expected)
    assert np.isfinite(points_of(lattice, np.argwhere(values[..., 0] > 0.0))).all()


def test_growth_reads_at_new_places(states: list[TrainingState]) -> None:
    """Of planes and lines, in a box that is tighter on one side."""
    storage, workers = storage_of(states[0]), states[0].field.workers
    old = storage.lattice
    low = old.box_min + np.array([0.1, 0.0, 0.2]) * (old.box_max - old.box_min)
    size = (13, old.size[1] + 3, 9)
    other = storage.resized(workers, Lattice.over(replace(old, box_min=low), size))
    u = [
        np.linspace((low[a] - old.box_min[a]) / old.voxel_size[a], old.size[a] - 1, size[a])
        for a in range(3)
    ]
    expected = by_hand(storage, tuple(u))
    found = other.raw_densities(workers)
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())


def test_growth_carries_moments_over(states: list[TrainingState]) -> None:
    """Those of planes, in 16 bits each, and of lines; the decoder's stay."""
    storage, workers = storage_of(states[0]), states[0].field.workers
    old = storage.lattice
    finer = 2 * old.size[0] - 1, 2 * old.size[1] - 1, 2 * old.size[2] - 1
    other = storage.resized(workers, Lattice.over(old, finer))
    rules, grown = CONFIG.field.rules, {}
    for name, state in states[0].optimiser.items():
        if name in rules:
            grown[name] = OPTIMISERS[rules[name]].resized(name, state, storage, other, workers)
    moments = states[0].optimiser
    x, y, _ = old.size
    first = [m["planes"]["moments"].numpy() for m in (moments, grown)]
    of_xy = first[0][: x * y].reshape(x, y, -1)
    of_grown = first[1][: (2 * x - 1) * (2 * y - 1)].reshape(2 * x - 1, 2 * y - 1, -1)
    mean, square = (decoded(m) for m in (of_xy, of_grown))
    assert np.array_equal(square[0][::2, ::2], mean[0])
    between = 0.5 * (mean[1][:-1] + mean[1][1:])
    np.testing.assert_allclose(square[1][1::2, ::2], between, rtol=5e-3)
    for key in ("mean", "square"):
        lines = [m["lines"][key].numpy().reshape(-1, 16) for m in (moments, grown)]
        n = old.size[2]
        np.testing.assert_allclose(
            lines[1][1 : 2 * n - 1 : 2], 0.5 * (lines[0][: n - 1] + lines[0][1:n]), rtol=1e-5
        )
        assert grown["decoder"][key] is moments["decoder"][key]


def decoded(moments: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Means and squares."""
    mean = (moments & np.uint32(0xFFFF0000)).view(np.float32)
    return mean, ((moments << np.uint32(16)) >> np.uint32(1)).view(np.float32)


def test_regularisers_are_slopes_of_their_sums(states: list[TrainingState]) -> None:
    """At entries that have a gradient, of the sums that the modules' docs state."""
    storage, workers = storage_of(states[0]), Workers("cpu", 2)
    rng, size, width = np.random.default_rng(2), storage.lattice.size, 16
    field, optim = Vm(sparsity=0.3), OptimConfig(tv_density=2e-3, tv_rgb=1e-3, tv_every=2)
    trainer = Trainer(ball(), replace(CONFIG, field=field, optim=optim))
    storage = replace(storage, kind=field)
    trainer.storage = storage
    trainer._regularise_lattice()
    regulariser = trainer.regulariser
    assert regulariser is not None
    gradients = storage.gradients(trainer.model, workers)
    planes = np.where(rng.uniform(size=storage.planes.shape)[:, None] < 0.5, 1.0, 0.0)
    planes = np.repeat(planes, width, axis=1).astype(np.float32)
    lines = np.zeros((2, storage.lines.size), np.float32)
    lines[1] = np.repeat(rng.uniform(size=sum(size)) < 0.5, width)
    gradients.arrays["planes"].assign(planes)
    gradients.arrays["touched"].fill_(1)
    gradients.arrays["lines"].assign(lines)
    regulariser(gradients, 1, 0.0, 4)
    assert np.array_equal(gradients.arrays["planes"].numpy(), planes)  # not due
    regulariser(gradients, 2, 0.0, 4)
    added = gradients.arrays["planes"].numpy() - planes
    expected, begin = np.zeros_like(planes), 0
    weights = np.where(np.arange(width) < 4, 2e-3, 1e-3)
    face = (CONFIG.grid.voxels / np.prod(size)) ** (2 / 3)
    tensors = storage.tensors()
    for a, b in AXES:
        n = size[a] * size[b]
        x = tensors["planes"][begin : begin + n].reshape(size[a], size[b], width)
        slope = np.zeros_like(x)
        for axis in (0, 1):
            step = np.clip(np.diff(x, axis=axis), -1.0, 1.0)
            lower, upper = (((0, 1), (0, 0), (0, 0)), ((1, 0), (0, 0), (0, 0)))
            turn = (lambda pad: (pad[1], pad[0], pad[2])) if axis else (lambda pad: pad)
            slope += np.pad(step, turn(upper)) - np.pad(step, turn(lower))
        slope = 2 * 2 * (face * size[3 - a - b] * weights * slope)
        slope[..., :4] += 2 * 2 * 0.3 / 4 / n * np.sign(x[..., :4])
        expected[begin : begin + n] = slope.reshape(n, width)
        begin += n
    expected *= planes
    np.testing.assert_allclose(added, expected, atol=2e-6 * np.abs(expected).max() + 1e-7)
    of_lines = gradients.arrays["lines"].numpy() - lines
    signs = np.sign(tensors["lines"]) * (lines[1].reshape(-1, width) > 0) * (np.arange(width) < 4)
    counts = np.repeat([size[2], size[1], size[0]], [size[2], size[1], size[0]])[:, None]
    assert (of_lines[1] == 0.0).all()
    np.testing.assert_allclose(
        of_lines[0].reshape(-1, width), 2 * 2 * 0.3 / 4 * signs / counts, rtol=1e-5
    )


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ({"density": 5}, "field.density and field.appearance must be a multiple of 16 together"),
        ({"density": 4, "appearance": 140}, "up to 128, not 4 \\+ 140"),
        ({"density": 0, "appearance": 16}, "field.density must be"),
        ({"learning_rate": 0.0}, "field.learning_rate must be"),
        ({"sparsity": -1.0}, "field.sparsity must be"),
    ],
)
def test_what_no_kernel_is_for_is_refused(numbers: dict[str, float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Vm(**numbers)  # type: ignore[arg-type]


def test_memory_grows_with_the_square() -> None:
    vm, dense = (
        STORAGE_KINDS[name]().training_bytes(wn.PRESETS["fast"].model, (160, 160, 160))
        for name in ("vm", "dense")
    )
    assert vm < dense / 20


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"optim": OptimConfig(learning_rate_density=0.3)}, "optim.learning_rate_density is 0.3"),
        ({"model": wn.Deferred(learning_rate_features=0.3)}, "model.learning_rate_features is 0.3"),
    ],
)
def test_rates_of_what_is_not_stored_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=f"{message}, but a vm field has rates of its own; set"):
        replace(CONFIG, **changes)


def test_a_preset_s_rates_are_left_out_where_another_field_is_chosen() -> None:
    config = configured(wn.PRESETS["dvgo"], {"field": ("vm",), "field.sparsity": ("0.01",)})
    assert config.field == Vm(sparsity=0.01)
    assert config.optim == replace(
        wn.PRESETS["dvgo"].optim,
        learning_rate_density=OptimConfig.learning_rate_density,
        learning_rate_rgb=OptimConfig.learning_rate_rgb,
    )
    again = configured(config, {"field": ("dense",)})
    assert again.field == DENSE
    with pytest.raises(InputError, match="no option of the field dense"):
        configured(wn.PRESETS["fast"], {"field.sparsity": ("0.01",)})
