"""A hash trains, grows, resumes, skips free space, and is kept and exported."""

import ctypes
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

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
from warpnerf.fields.dense import DenseGrid
from warpnerf.fields.hashed import Hashed, level_shapes
from warpnerf.fields.occupancy import FreeCells
from warpnerf.model.interface import loader
from warpnerf.model.models import Deferred
from warpnerf.model.registry import to_json
from warpnerf.model.sampler_kinds import Resampled
from warpnerf.model.storage_kinds import DENSE, STORAGE_KINDS, Hash, from_json
from warpnerf.rendering import adjoint
from warpnerf.training import plan as planning
from warpnerf.training.optim import Update, adam_struct
from warpnerf.training.plan import resolve
from warpnerf.training.state import TrainingState
from warpnerf.training.trainer import Trainer

CONFIG = config_of(Hash(levels=5, coarsest=4, finest=32, table=1 << 10))


@pytest.fixture(scope="module")
def states() -> list[TrainingState]:
    return states_of(CONFIG, early=100)


def storage_of(state: TrainingState) -> Hashed:
    assert isinstance(state.field.storage, Hashed)
    return state.field.storage


def test_it_learns_and_grows_by_levels(states: list[TrainingState]) -> None:
    begun, trained = states
    assert trained.progress.loss < 0.2
    assert trained.progress.size > begun.progress.size
    first, last = (storage_of(state) for state in states)
    assert np.array_equal(first.lattice.box_min, last.lattice.box_min)
    assert (first.n_active, last.n_active) == (4, 5)
    shapes, fresh = level_shapes(CONFIG.field, last.lattice), Trainer(ball(), CONFIG).storage
    of_last = slice(shapes[4].begin, shapes[4].end)
    values = [s.tensors()["values"][of_last] for s in (fresh, first, last)]
    assert np.array_equal(values[0], values[1])  # not read yet
    assert np.abs(values[2] - values[1]).max() > 1e-2


def test_it_resumes_with_equal_bits(states: list[TrainingState], tmp_path: Path) -> None:
    require_resumes(states, CONFIG, tmp_path / "state")


def test_files_hold_it(states: list[TrainingState], tmp_path: Path) -> None:
    require_files_hold(states[1], CONFIG, tmp_path / "field.safetensors")


@pytest.mark.ci
def test_a_hidden_layer_learns_and_is_kept(tmp_path: Path) -> None:
    config = replace(CONFIG, field=replace(CONFIG.field, hidden=16, learning_rate=0.02))
    states = states_of(config, early=100)
    assert states[1].progress.loss < 0.2
    fresh, trained = Trainer(ball(), config).storage.tensors(), storage_of(states[1]).tensors()
    assert list(trained) == ["values", "hidden", "decoder"]
    for name, shape in {"hidden": (20, 16), "decoder": (16, 16)}.items():
        assert trained[name].shape == shape
        assert np.abs(trained[name] - fresh[name])[:, :4].max() > 1e-2
    assert (trained["decoder"][:, 4:] == 0.0).all()  # padding
    assert np.abs(fresh["hidden"]).max() == pytest.approx((6 / 20) ** 0.5, rel=0.05)
    assert np.abs(fresh["decoder"]).max() == pytest.approx((3 / 16) ** 0.5, rel=0.1)
    require_resumes(states, config, tmp_path / "state")
    require_files_hold(states[1], config, tmp_path / "field.safetensors")


def test_files_from_before_there_were_hidden_layers() -> None:
    tree = to_json(CONFIG.field)
    del tree["hidden"]
    assert from_json(tree) == CONFIG.field
    assert list(CONFIG.field.rules) == ["values", "decoder"]


@pytest.mark.parametrize("name", EXPORTS)
def test_it_is_exported(states: list[TrainingState], tmp_path: Path, name: str) -> None:
    require_exported(states[1], tmp_path / name)


def test_free_cells_are_those_of_less_opaque_nodes(states: list[TrainingState]) -> None:
    """Of a dense grid of what is read at the nodes, that counts as empty from 0.4 times as much."""
    field = states[1].field
    storage, lattice, workers = storage_of(states[1]), field.lattice, field.workers
    values = np.zeros((*lattice.size, 4), np.float32)
    values[..., 0] = storage.raw_densities(workers)
    dense = DenseGrid.from_tensors(DENSE, field.model, lattice, {"values": values}, workers.device)
    dense = replace(dense, density_shift=storage.density_shift, density_scale=storage.density_scale)
    march = field.steps.struct()
    found, less, same = (
        FreeCells.of(one, workers, march, opacity).distance.numpy()
        for one, opacity in ((storage, 0.05), (dense, 0.02), (dense, 0.05))
    )
    assert 0 < (found == 0).sum() < found.size
    assert np.array_equal(found, less) and not np.array_equal(found, same)


def test_densities_in_slabs(states: list[TrainingState], monkeypatch: pytest.MonkeyPatch) -> None:
    """As all at once, some planes at a time."""
    storage, workers = storage_of(states[1]), states[1].field.workers
    whole, (x, y, z) = storage.raw_densities(workers), storage.lattice.size
    monkeypatch.setattr("warpnerf.fields.storage.SLAB", 4 * y * z + 1)
    slabs = list(storage.density_slabs(workers))
    assert [first for first, _ in slabs] == list(range(0, x, 4)) and x > 4
    joined = np.concatenate([values.numpy()[:, 0] for _, values in slabs])
    assert np.array_equal(joined, whole.ravel())


def test_adam_has_an_epsilon_of_its_own() -> None:
    trainer = Trainer(ball(), replace(CONFIG, field=replace(CONFIG.field, epsilon=1e-5)))
    update = Update(1, 1.0, CONFIG.optim)
    found = {p.name: adam_struct(update, p.epsilon).epsilon for p in trainer.parameters()}
    assert found == {"values": pytest.approx(1e-5), "decoder": pytest.approx(1e-5)}
    assert adam_struct(update).epsilon == pytest.approx(1e-8)
    trainer.update()
    before = Trainer(ball(), CONFIG)
    before.update()
    moved = [np.abs(t.storage.tensors()["values"]).mean() for t in (trainer, before)]
    assert moved[0] < 0.5 * moved[1]


def test_memory_does_not_grow_with_the_lattice() -> None:
    kind, model = Hash(), Deferred()
    small, large = (kind.training_bytes(model, (n, n, n)) for n in (100, 400))
    assert large - small == 3 * (400**3 - 100**3)
    assert kind.training_bytes(model, (100,) * 3) < 0.05 * DENSE.training_bytes(model, (200,) * 3)


def test_gradients_on_their_way_count() -> None:
    """All samples have some for other threads, where there are several; a dense grid's have few."""
    for kind in (Hash(), Hash(levels=5, features=8)):
        record = kind.encoding(loader("float32"), Deferred()).vectors.Record
        assert kind.sample_bytes == ctypes.sizeof(record.ctype) // 16
    assert planning.RECORD_BYTES == adjoint.RECORDS

    def memory(**changes: Any) -> int:
        return planning.resolve(ball(), replace(CONFIG, **changes)).memory

    one, two, gpu = (memory(**c) for c in ({"threads": 1}, {"threads": 2}, {"device": "cuda"}))
    steps = planning.resolve(ball(), CONFIG).schedule.most_steps_an_update
    samples = CONFIG.rays_per_step * steps * planning.SAMPLES_IN_FOG
    assert two - one == samples * CONFIG.field.sample_bytes > 0 and gpu == one
    many = {"rays_per_step": 1 << 20}
    assert memory(threads=2, **many) - memory(threads=1, **many) == adjoint.RECORDS
    drawn = {"sampler": Resampled(samples=32, bins=64), "threads": 2}
    fewer = memory(**drawn) - memory(**drawn | {"threads": 1})
    assert fewer == samples // planning.SAMPLES_IN_FOG * 48 * CONFIG.field.sample_bytes
    assert memory(field=DENSE, threads=2) == memory(field=DENSE, threads=1)


def test_a_hidden_layer_counts() -> None:
    alone, kind, model = Hash(), Hash(hidden=64), Deferred()
    bytes_of = [k.training_bytes(model, (100,) * 3) for k in (alone, kind)]
    assert bytes_of[1] - bytes_of[0] == 12 * 24 * 64
    assert kind.relative_time - alone.relative_time == pytest.approx(4e-4 * 64 * (24 + 16))


@pytest.mark.parametrize(
    ("numbers", "sentence"),
    [
        ({"levels": 1}, "field.levels must be a whole number of at least 2, not 1."),
        ({"features": 3}, "field.features must be 2, 4 or 8, not 3."),
        ({"levels": 40}, "field.levels times field.features must be at most 128, not 40 x 4"),
        ({"coarsest": 64, "finest": 32}, "field.finest must be a whole number of at least 64"),
        ({"finest": 1 << 16}, "field.finest must be at most 32768, not 65536."),
        ({"table": 1000}, "field.table must be a power of two, up to 16777216, not 1000."),
        ({"hidden": -16}, "field.hidden must be a whole number of at least 0, not -16."),
        ({"hidden": 24}, "field.hidden must be a multiple of 16 up to 128, or 0 for no hidden"),
        ({"hidden": 144}, "field.hidden must be a multiple of 16 up to 128, or 0 for no hidden"),
        ({"epsilon": 0.0}, "field.epsilon must be"),
    ],
)
def test_what_is_refused(numbers: dict[str, int], sentence: str) -> None:
    assert STORAGE_KINDS["hash"] is Hash
    with pytest.raises(InputError, match=sentence.replace(".", r"\.")):
        Hash(**numbers)


def test_nobody_says_that_its_box_becomes_tighter() -> None:
    dense = replace(CONFIG, field=DENSE)
    assert resolve(ball(), dense).voxel_pixels.until == "until training tightens the box"
    assert resolve(ball(), CONFIG).voxel_pixels.until == ""
