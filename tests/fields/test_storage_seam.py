"""A storage of one's own is one file: it trains, grows, resumes, and is exported and looked at."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp

import warpnerf as wn
from tests.seams.column_storage import Columns, ColumnStorage, encoding
from tests.support.expected import assert_close
from tests.support.field_trainings import config_of, require_resumes, states_of
from tests.support.tiny_scenes import ring
from tests.support.tiny_trainings import ball
from warpnerf.checks import InputError
from warpnerf.config import TrainConfig
from warpnerf.fields.dense import DenseGrid
from warpnerf.fields.nodes import points_of
from warpnerf.fields.occupancy import FreeCells
from warpnerf.fields.storages import STORAGES
from warpnerf.model import storage_kinds
from warpnerf.model.interface import Load, Model, loader
from warpnerf.model.storage_kinds import STORAGE_KINDS
from warpnerf.rendering.field import Field
from warpnerf.rendering.render import TrainingPass
from warpnerf.runtime.parallel import Workers
from warpnerf.training.optim import OPTIMISERS
from warpnerf.training.state import TrainingState
from warpnerf.training.trainer import Trainer
from warpnerf.viewer.painter import Painter, Settings, Subject
from warpnerf.viewer.viewpoint import Viewpoint

CONFIG = replace(config_of("columns"), average_pixels=False)


@pytest.fixture(scope="module")
def states() -> list[TrainingState]:
    return states_of(CONFIG, early=20)


def field_of(states: list[TrainingState]) -> Field:
    return states[-1].field


def test_it_has_a_name() -> None:
    assert STORAGE_KINDS["columns"] is Columns
    assert CONFIG.field == Columns(decay=1e-3)
    known = ", ".join(STORAGE_KINDS)
    assert {"dense", "vm", "hash", "auto", "columns"} <= set(STORAGE_KINDS)
    with pytest.raises(InputError, match=f"field must be one of {known}, not 'rows'"):
        TrainConfig(field="rows")  # type: ignore[arg-type]


def test_all_its_arrays_learn(states: list[TrainingState]) -> None:
    begun, trained = (state.field.storage.tensors() for state in states)
    assert set(trained) == {"values", "row", "matrix"}
    for name in ("row", "matrix"):
        assert np.abs(begun[name][:3] - trained[name][:3]).max() > 1e-3
    assert states[1].progress.loss < 0.5 * states[0].progress.loss
    assert int(states[1].optimiser["matrix"]["steps"].numpy()[0]) == states[1].updates
    # The lattice has grown, and with it the row.
    assert len(trained["row"]) == trained["values"].shape[2] > len(begun["row"])


def test_the_gradient_is_that_of_reading() -> None:
    """Of all arrays, in float64, against central differences."""
    part = encoding(loader("float64"))
    probe = loader("float64")("launch.probe").probe(part)
    real, node = wp.float64, wp.types.vector(4, wp.float64)
    rng, workers = np.random.default_rng(0), Workers("cpu", 1)
    arrays = {
        "values": rng.normal(size=(60, 4)),
        "row": rng.normal(size=(5, 4)),
        "matrix": rng.normal(size=9),
    }
    points = wp.array(rng.uniform(-1.0, 1.0, (30, 3)), dtype=wp.types.vector(3, real))
    slopes = rng.normal(size=(30, 4))

    def params(given: dict[str, np.ndarray]) -> object:
        from warpnerf.fields.lattice import grid_struct

        struct = part.Params()
        values = wp.array(given["values"], dtype=node)
        struct.grid = grid_struct(loader("float64")("fields.dense"), values, (3, 4, 5), 0.0)
        struct.row = wp.array(given["row"], dtype=node)
        struct.matrix = wp.array(given["matrix"], dtype=real)
        return struct

    def value(given: dict[str, np.ndarray]) -> float:
        out = wp.zeros(30, dtype=node)
        workers.launch(probe.read_forward, 30, params(given), points, out)
        return float((out.numpy() * slopes).sum())

    gradient = part.Gradient()
    gradient.values = wp.zeros(60, dtype=node)
    gradient.touched = wp.zeros(15, dtype=wp.uint8)
    gradient.row, gradient.row_touched = wp.zeros(5, dtype=node), wp.zeros(2, dtype=wp.uint8)
    gradient.matrix = wp.zeros((1, 9), dtype=real)
    gradient.weights = wp.zeros((1, 0), dtype=real)
    adj = wp.array(slopes, dtype=node)
    workers.launch(probe.read_backward, 30, params(arrays), points, adj, gradient)
    for name, array in arrays.items():
        direction = rng.normal(size=array.shape)
        ends = (value(arrays | {name: array + h * direction}) for h in (1e-5, -1e-5))
        expected = (next(ends) - next(ends)) / 2e-5
        found = getattr(gradient, name).numpy().reshape(array.shape)
        assert_close([np.vdot(found, direction)], [expected], 1e-7)


def test_it_resumes_with_equal_bits(states: list[TrainingState], tmp_path: Path) -> None:
    require_resumes(states, CONFIG, tmp_path / "state")


def test_the_regulariser_is_added(states: list[TrainingState], tmp_path: Path) -> None:
    config = replace(CONFIG, field=Columns(decay=0.3), steps=20)
    trainer = Trainer(ball(), config)
    trainer.run()
    decayed = trainer.storage.tensors()["row"]
    assert np.abs(decayed).mean() < 0.9 * np.abs(states[0].field.storage.tensors()["row"]).mean()


def test_files_hold_it(
    states: list[TrainingState], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    field, path, read = field_of(states), tmp_path / "field.safetensors", []
    from_tensors = ColumnStorage.from_tensors

    def spied(kind: Any, model: Any, lattice: Any, tensors: Any, device: Any) -> ColumnStorage:
        read.append(list(tensors))
        return from_tensors(kind, model, lattice, tensors, device)

    monkeypatch.setattr(ColumnStorage, "from_tensors", spied)
    wn.save_field(path, field)
    loaded = wn.load_field(path, threads=1)
    assert read == [["values", "row", "matrix"]]  # its own, and not what free cells are in
    assert isinstance(loaded.storage, ColumnStorage) and loaded.storage.kind == Columns()
    camera = ball().cameras[0]
    assert np.array_equal(loaded.render(camera).rgb, field.render(camera).rgb)


def test_a_version_that_does_not_know_it_says_so(
    states: list[TrainingState], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wn.save_field(tmp_path / "field.safetensors", field_of(states))
    monkeypatch.delitem(STORAGE_KINDS, "columns")
    known = ", ".join(STORAGE_KINDS)
    with pytest.raises(InputError, match=f"stored as 'columns', but this version knows {known};"):
        wn.load_field(tmp_path / "field.safetensors")


def test_a_mistake_in_a_storage_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where a training begins."""

    def refused(match: str) -> None:
        with pytest.raises(ValueError, match=match):
            Trainer(ball(), CONFIG)

    right = {"values": "nodes", "row": "nodes", "matrix": "descent"}
    for rules in ({**right, "row": "lines"}, dict(reversed(right.items())), {"values": "nodes"}):
        with monkeypatch.context() as patch:
            patch.setattr(Columns, "rules", rules)
            refused(r"'columns': its storage has the parameters \{'values': 'nodes', 'row': 'nod")
    with monkeypatch.context() as patch:
        patch.delitem(OPTIMISERS, "descent")
        refused("'descent' is no rule of nodes, weights, lines; register it")
    with monkeypatch.context() as patch:
        patch.delitem(STORAGES, "columns")
        refused(f"'columns' is no storage of {', '.join(STORAGES)}; register it")


def test_parts_that_differ_from_call_to_call_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of an encoding, as of any part: kernels made of it would not be found again."""
    monkeypatch.setattr(Columns, "encoding", lambda self, load, model: encoding.__wrapped__(load))
    other = Columns(decay=0.2)
    with pytest.raises(ValueError, match=r"field 'columns': each call makes another part 'encod"):
        storage_kinds.parts_of(wn.Rgb(), "float32", other)


def test_free_cells_are_those_of_what_is_read(states: list[TrainingState]) -> None:
    """Where nodes are read by hand, at their places in the scene."""
    field = field_of(states)
    stored, lattice = field.storage, field.lattice
    raw = stored.raw_densities(field.workers)
    assert isinstance(stored, ColumnStorage)
    tensors = stored.tensors()
    by_hand = tensors["values"][..., 0] + tensors["row"][:, 0]
    np.testing.assert_allclose(raw, by_hand, atol=1e-5)
    dense = replace(
        stored.grid.copied_to(field.workers.device),
        density_shift=stored.density_shift,
        density_scale=stored.density_scale,
    )
    values = dense.values.numpy().reshape(*lattice.size, 4)
    values[..., 0] = by_hand
    dense.values.assign(values.reshape(-1, 4))
    march = field.steps.struct()
    cells = (FreeCells.of(one, field.workers, march, 1e-3) for one in (stored, dense))
    found, expected = (one.distance.numpy() for one in cells)
    assert 0 < (found == 0).sum() < found.size
    assert np.array_equal(found, expected)
    nodes = np.argwhere(raw > 0.0)
    assert np.isfinite(points_of(lattice, nodes)).all()


@pytest.mark.parametrize("name", ["mesh.ply", "points.ply", "volume.npz"])
def test_it_is_exported(states: list[TrainingState], tmp_path: Path, name: str) -> None:
    wn.export(field_of(states), tmp_path / name)
    assert (tmp_path / name).stat().st_size > 1000


def test_it_is_looked_at(states: list[TrainingState]) -> None:
    """In the viewer, whole and cropped."""
    field, viewpoint = field_of(states), Viewpoint(c2w=ring(5)[1][:3], fov=0.9, width=80, height=60)
    low, high = field.lattice.surroundings
    middle = 0.5 * (low + high)
    painter = Painter([Subject(name="columns", field=lambda: field)])
    settings = Settings(near=1.0, far=5.0, within=1.0)
    whole, half = (
        painter.paint(viewpoint, replace(settings, crop=crop), (24, 18))
        for crop in (None, (tuple(low), (float(middle[0]), *high[1:])))
    )
    assert whole.std() > 1.0 and (whole != half).any()


@wp.func
def mark(grid: Any, worker: int):  # type: ignore[no-untyped-def]
    value = grid.values[worker]
    value[1] = 7.0
    grid.values[worker] = value


@dataclass(frozen=True, kw_only=True)
class Marked(storage_kinds.Dense):
    """A dense grid in whose vector form each worker leaves a mark before its first ray."""

    def encoding(self, load: Load, model: Model) -> Any:
        dense = super().encoding(load, model)
        return dense._replace(vectors=dense.vectors._replace(begin=mark))


@pytest.mark.ci
def test_an_encoding_may_begin_before_the_first_ray(on_cpu: None) -> None:
    """Once for each worker, in launches that end in a gradient."""
    config = replace(CONFIG, field=storage_kinds.Dense(), steps=1, threads=2)
    trainer = Trainer(ball(), config)
    assert isinstance(trainer.storage, DenseGrid)
    trainer.update()
    assert (trainer.storage.values.numpy()[:2, 1] != 7.0).all()
    marked = replace(trainer.storage, kind=Marked())
    none = wp.zeros(0, dtype=wp.float32)
    steps, workers = trainer.march_steps(), trainer.workers
    run = TrainingPass(300, trainer.model, marked, none, steps, "none", "none", workers)
    run.run(FreeCells.none(workers), trainer._sampler.draw(0))
    assert (marked.values.numpy()[:2, 1] == 7.0).all()
    assert (marked.values.numpy()[2:, 1] != 7.0).all()
