"""A training that is interrupted and resumed ends as one that was not, bit for bit."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import warpnerf as wn
from tests.support.small_model import small
from tests.support.solid_fields import ball_field
from tests.support.tiny_fields import assert_same_state
from tests.support.tiny_scenes import ring, tiny_scene
from tests.support.tiny_trainings import (
    GROWING,
    QUICK,
    STEPS,
    ball,
    large_ball,
    stopped_at,
    tiny_config,
    without_seconds,
)
from tests.support.tiny_trainings import early_growth as early_growth
from warpnerf.checks import InputError
from warpnerf.config import GridConfig, TrainConfig
from warpnerf.model.models import Deferred
from warpnerf.optim_config import OptimConfig
from warpnerf.scenes.scene import Scene
from warpnerf.training import trainer as training
from warpnerf.training.optim import adam_step
from warpnerf.training.state import TrainingState
from warpnerf.training.train import train
from warpnerf.training.trainer import Trainer


@pytest.mark.ci
@pytest.mark.parametrize(
    ("model", "threads", "unbounded"),
    [
        ("deferred", 1, False),
        ("rgb", 3, True),
        pytest.param("deferred", 3, True, marks=pytest.mark.slow),
        pytest.param("per_sample", 3, False, marks=pytest.mark.slow),
    ],
)
def test_resumed_after_any_step_it_ends_the_same(
    tmp_path: Path, model: str, threads: int, unbounded: bool, on_cpu: None
) -> None:
    scene = replace(ball(), unbounded=unbounded)
    config = tiny_config(threads=threads, model=small(model))
    whole = stopped_at(STEPS, tmp_path / "whole", config, scene)
    assert whole.grown == len(GROWING) and 0.02 < whole.progress.occupied < 0.98
    assert unbounded or (whole.field.lattice.box_min > scene.box_min).any()
    for step in range(1, STEPS):
        begun = stopped_at(step, tmp_path / "begun", config, scene)
        assert begun.grown == sum(step > at for at in GROWING)
        resumed = stopped_at(STEPS, tmp_path / "resumed", begun.config, scene, begun)
        assert_same_state(without_seconds(resumed), without_seconds(whole))


@pytest.mark.ci
@pytest.mark.parametrize("grow_at", ["auto", ()])
def test_resumed_it_grows_as_its_kind_of_scene_does(
    grow_at: Any, tmp_path: Path, on_cpu: None
) -> None:
    config = tiny_config(grid=GridConfig(voxels=6000, grow_at=grow_at, alpha_init=0.1))
    whole = stopped_at(STEPS, tmp_path / "whole", config, ball())
    for step in (3, 7, 12):
        begun = stopped_at(step, tmp_path / "begun", config, ball())
        assert begun.config.grid.grow_at == grow_at
        resumed = stopped_at(STEPS, tmp_path / "resumed", begun.config, ball(), begun)
        assert_same_state(without_seconds(resumed), without_seconds(whole))
    assert whole.grown == (4 if grow_at else 0)


@pytest.mark.ci
def test_interrupted_after_every_step_it_ends_the_same(tmp_path: Path, on_cpu: None) -> None:
    """Also with what no checkpoint has."""
    config = tiny_config(optim=replace(tiny_config().optim, near_decay=0.1))
    whole = stopped_at(STEPS, tmp_path / "whole", config, ball())
    state = None
    for step in range(1, STEPS + 1):
        state = stopped_at(step, tmp_path / "state", config, ball(), state)
    assert state is not None
    assert_same_state(without_seconds(state), without_seconds(whole))


def resized_at(config: TrainConfig, scene: Scene) -> list[tuple[int, float, float]]:
    """After which steps the grid was resized, and the shares of nodes and of the box then left."""
    trainer, found = Trainer(scene, config), []
    before = trainer.lattice
    while trainer.fraction < 1.0:
        done = trainer.steps_done
        trainer.update()
        now = trainer.lattice
        if now.size != before.size or not np.array_equal(now.box_min, before.box_min):
            edges = [np.prod(g.box_max - g.box_min) for g in (now, before)]
            nodes = [np.prod(g.size) for g in (now, before)]
            found.append((done, float(nodes[0] / nodes[1]), float(edges[0] / edges[1])))
        before = now
    return found


def test_the_grid_of_an_object_grows_earlier_into_a_tighter_box(on_cpu: None) -> None:
    config = tiny_config(steps=100)  # in which 10 suffice for a ball to show
    grid = replace(config.grid, voxels=24_000, grow_at="auto", alpha_init=0.05)
    config = replace(config, grid=grid)
    found = resized_at(config, ball())
    assert [step for step, _, _ in found] == [10, 20, 30, 40]
    nodes, box = np.array(found)[:, 1:].T
    assert box.prod() < 0.9 and nodes == pytest.approx([2.0] * 4, rel=0.2)
    opaque = [replace(view, image=view.image[..., :3].copy()) for view in ball().views]
    filled = resized_at(config, replace(ball(), views=opaque))
    assert [step for step, _, _ in filled] == [30, 40, 50, 60]
    told = replace(config, grid=replace(config.grid, grow_at=(0.05, 0.601)))
    assert [step for step, _, _ in resized_at(told, ball())] == [5, 61]
    never = replace(config, grid=replace(config.grid, grow_at=()))
    assert resized_at(never, ball()) == []
    with pytest.raises(InputError, match=r"^grid\.grow_at must be auto or shares .*'never'"):
        GridConfig(grow_at="never")  # type: ignore[arg-type]


@pytest.mark.ci
def test_pixels_that_see_nothing_are_left_out_of_bounded_scenes(on_cpu: None) -> None:
    def seen(scene: Scene, **changes: Any) -> tuple[float, float]:
        config = tiny_config(**QUICK, **changes)
        progress = train(scene, config).progress
        return progress.seen, progress.samples_per_ray

    share, samples = seen(large_ball())
    assert 0.1 < share < 0.97
    everywhere, fewer = seen(large_ball(), skip_empty_rays=False)
    assert everywhere == 1.0 and samples > fewer
    assert seen(replace(large_ball(), unbounded=True))[0] == 1.0


def test_resumed_it_draws_from_the_same_pixels(tmp_path: Path, on_cpu: None) -> None:
    config, scene = tiny_config(**QUICK), large_ball()
    whole = stopped_at(60, tmp_path / "whole", config, scene)
    assert whole.progress.seen < 0.97
    for step in (52, 55):
        begun = stopped_at(step, tmp_path / "begun", config, scene)
        assert begun.progress.seen < 1.0
        resumed = stopped_at(60, tmp_path / "resumed", config, scene, begun)
        assert_same_state(without_seconds(resumed), without_seconds(whole))


def test_resumed_with_a_single_cell_it_ends_the_same(tmp_path: Path, on_cpu: None) -> None:
    grid = GridConfig(voxels=30, grow_at=(), alpha_init=0.5)
    config = tiny_config(**QUICK | {"grid": grid, "optim": OptimConfig(accumulate_at=())})
    # Many a ray misses the box.
    scene = replace(large_ball(), box_min=np.full(3, -0.3), box_max=np.full(3, 0.3))
    whole = stopped_at(60, tmp_path / "whole", config, scene)
    for step in (52, 54, 59):
        begun = stopped_at(step, tmp_path / "begun", config, scene)
        assert begun.field.free.size == (1, 1, 1)
        resumed = stopped_at(60, tmp_path / "resumed", config, scene, begun)
        assert_same_state(without_seconds(resumed), without_seconds(whole))


def test_where_the_time_was_spent_before_one_update_is_left(on_cpu: None) -> None:
    trainer = Trainer(ball(), tiny_config(time_limit=0.5), seconds=0.6)
    trainer.run()
    assert trainer.steps_done == 1


def test_total_variation_ends_when_it_is_told_to(tmp_path: Path, on_cpu: None) -> None:
    def values(**changes: Any) -> np.ndarray:
        optim = replace(tiny_config().optim, **changes)
        trainer = Trainer(ball(), tiny_config(optim=optim))
        trainer.run()
        return trainer.storage.values.numpy()

    without = values(tv_density=0.0, tv_rgb=0.0, tv_every=OptimConfig.tv_every)
    assert np.array_equal(values(tv_until=0.0), without)
    half, whole = values(tv_until=0.5), values()
    assert not np.array_equal(half, without) and not np.array_equal(half, whole)


# As DVGO grows; each of the two changes what is trained.
AS_DVGO: dict[str, Any] = {
    "grid": replace(tiny_config().grid, shift_at_growth=1.0),
    "optim": replace(tiny_config().optim, restart_at_growth=True),
}


def test_growth_takes_its_shift_from_densities(on_cpu: None) -> None:
    trainer, plain = (Trainer(ball(), tiny_config(**c)) for c in (AS_DVGO, {}))
    first = plain.storage.density_shift
    for growths, step in enumerate((1, *(at + 1 for at in GROWING))):
        while trainer.steps_done < step:
            trainer.update()
            plain.update()
        assert trainer.storage.density_shift == pytest.approx(first - growths, abs=1e-12)
        assert plain.storage.density_shift == first


def test_growth_lets_the_optimiser_begin_anew(
    monkeypatch: pytest.MonkeyPatch, on_cpu: None
) -> None:
    steps: dict[int, tuple[int, float, bool]] = {}

    def watched(parameters: Any, states: Any, gradients: Any, update: int, *rest: Any) -> None:
        fresh = not any(a.numpy().any() for s in states.values() for a in s.values())
        steps[trainer.steps_done] = update, rest[0], fresh
        adam_step(parameters, states, gradients, update, *rest)

    monkeypatch.setattr(training, "adam_step", watched)
    config = tiny_config(optim=AS_DVGO["optim"])
    trainer = Trainer(ball(), config)
    trainer.run()
    decay = config.optim.decay
    for step, (update, factor, fresh) in steps.items():
        grown = sum(step > at for at in GROWING)
        begun = (0, *GROWING)[grown]
        assert update == step - begun and fresh == (update == 1)
        since = (0.0, *config.grid.grow_at)[grown]
        assert factor == pytest.approx(decay ** ((step - 1) / STEPS - since))
    monkeypatch.setattr(training, "adam_step", adam_step)
    assert len(steps) == STEPS


def test_resumed_after_an_optimiser_that_began_anew(tmp_path: Path, on_cpu: None) -> None:
    config = tiny_config(**AS_DVGO)
    whole = stopped_at(STEPS, tmp_path / "whole", config, ball())
    assert whole.restarted == GROWING[1]
    for step in (6, 7, 8, 13, 14, 17):
        begun = stopped_at(step, tmp_path / "begun", config, ball())
        resumed = stopped_at(STEPS, tmp_path / "resumed", config, ball(), begun)
        assert_same_state(without_seconds(resumed), without_seconds(whole))


def test_train_resumes_too_and_leaves_the_state_alone(tmp_path: Path, on_cpu: None) -> None:
    scene = ball()
    whole = train(scene, tiny_config())
    state = stopped_at(9, tmp_path / "state", tiny_config(), scene)
    for _ in range(2):  # the second would differ had the first worked in the state's own arrays
        result = train(scene, resume=state)
        assert replace(result.progress, seconds=0.0) == replace(whole.progress, seconds=0.0)
        values = result.field.storage.values.numpy()
        np.testing.assert_array_equal(values, whole.field.storage.values.numpy())
        weights = result.field.weights.numpy()
        np.testing.assert_array_equal(weights, whole.field.weights.numpy())


def test_estimates_that_another_machine_rounds_otherwise_change_nothing(
    tmp_path: Path, on_cpu: None
) -> None:
    scene, config = replace(ball(), unbounded=True), tiny_config(model="rgb")
    whole = stopped_at(STEPS, tmp_path / "whole", config, scene)
    begun = stopped_at(5, tmp_path / "begun", config, scene)
    nudged = replace(scene, content_distance=2.0 * (1 + 1e-7), box_max=scene.box_max * (1 + 1e-7))
    resumed = stopped_at(STEPS, tmp_path / "resumed", config, nudged, begun)
    assert_same_state(without_seconds(resumed), without_seconds(whole))


def test_a_finished_training_resumes_to_its_end(tmp_path: Path) -> None:
    state = stopped_at(STEPS, tmp_path / "state", tiny_config(), ball())
    saved: list[TrainingState] = []
    result = train(ball(), resume=state, on_checkpoint=saved.append)
    assert result.progress == state.progress
    np.testing.assert_array_equal(
        result.field.storage.values.numpy(), state.field.storage.values.numpy()
    )
    assert not saved  # nothing new


def test_seconds_before_the_resumption_count(tmp_path: Path) -> None:
    config = tiny_config(time_limit=1000.0)
    state = stopped_at(2, tmp_path / "state", config, ball())
    spent = replace(state, progress=replace(state.progress, seconds=900.0))
    trainer = Trainer(ball(), config, spent)
    assert trainer.fraction == 0.9
    trainer.update()
    assert 900.0 <= trainer.report().seconds < 1000.0


def test_checkpoints_come_when_due_and_at_the_end() -> None:
    for every, steps in ((1e-9, list(range(1, STEPS + 1))), (1e9, [STEPS])):
        saved: list[int] = []
        train(
            ball(),
            tiny_config(checkpoint_every=every),
            on_checkpoint=lambda state, saved=saved: saved.append(state.progress.step),
        )
        assert saved == steps


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"steps": STEPS - 1}, "steps"),
        ({"time_limit": 60.0}, "time_limit"),
        ({"seed": 1}, "seed"),
        ({"scaling": "none"}, "scaling"),
        ({"grid": GridConfig(voxels=6000, grow_at=(0.301,), alpha_init=0.1)}, "grid.grow_at"),
        ({"optim": OptimConfig(decay=0.5)}, "optim.decay"),
        ({"model": "rgb"}, "model"),
        ({"model": Deferred(specular=4, width=16)}, "model.width"),
        ({"optim": replace(tiny_config().optim, accumulate_at=(0.5,))}, "optim.accumulate_at"),
    ],
)
def test_another_configuration_is_refused_by_name(
    tmp_path: Path, changes: dict[str, Any], name: str
) -> None:
    state = stopped_at(1, tmp_path / "state", tiny_config(), ball())
    with pytest.raises(InputError, match=rf"^{name} is "):
        train(ball(), tiny_config(**changes), resume=state)


def test_a_longer_training_follows_its_own_schedule_from_there_on(tmp_path: Path) -> None:
    state = stopped_at(STEPS, tmp_path / "state", tiny_config(), ball())
    assert state.grown == 2
    longer = tiny_config(steps=5 * STEPS)
    trainer = Trainer(ball(), longer, state)
    trainer.run(stop=lambda: trainer.steps_done == STEPS + 10)
    assert trainer.fraction == 0.3 and trainer.schedule.growths(trainer.fraction) == 0
    assert trainer.lattice.size == state.field.lattice.size
    assert trainer.schedule.rate(trainer.fraction, 0, 1) > longer.optim.decay**0.5
    trainer.run()
    assert trainer.steps_done == 5 * STEPS
    assert trainer.lattice.size == state.field.lattice.size


def test_a_training_that_is_done_needs_no_checkpoint() -> None:
    for when_done in (True, False):
        trainer, saved = Trainer(ball(), tiny_config()), []
        how = {"checkpoint_when_done": when_done}
        trainer.run(None, saved.append, lambda trainer=trainer: trainer.steps_done >= 5, **how)
        assert [state.progress.step for state in saved] == [5]  # stopped
        trainer.run(None, saved.append, **how)
        assert len(saved) == (2 if when_done else 1)


def test_what_does_not_decide_the_result_may_change(tmp_path: Path) -> None:
    state = stopped_at(17, tmp_path / "state", tiny_config(), ball())
    changed = tiny_config(threads=2, checkpoint_every=7.0)
    progress = train(ball(), changed, resume=state).progress
    assert progress.step == STEPS


def test_other_photographs_are_refused(tmp_path: Path) -> None:
    state = stopped_at(1, tmp_path / "state", tiny_config(), ball())
    scene = ball()
    scene.views[1].image[3, 4, 0] ^= 1
    with pytest.raises(InputError, match=r"noise.*photographs"):
        train(scene, resume=state)


def test_the_threads_in_use_are_part_of_the_state() -> None:
    trainer = Trainer(ball(), tiny_config(threads=None))
    trainer.update()
    assert trainer.state().config.threads == trainer.workers.count


@pytest.mark.parametrize("where", ["loss", "grid", "weights"])
def test_what_is_not_finite_is_never_saved(where: str) -> None:
    saved: list[int] = []
    trainer = Trainer(ball(), tiny_config(checkpoint_every=1e-9))

    def keep(state: TrainingState) -> None:
        saved.append(state.progress.step)
        if trainer.steps_done == 4 and where == "loss":  # of the batch of step 5
            trainer.storage.values.fill_(math.nan)
        if trainer.steps_done == 4 and where == "weights":
            trainer.weights.fill_(math.nan)

    def spoil() -> bool:  # asked before a checkpoint
        if trainer.steps_done == 5 and where == "grid":
            values = trainer.storage.values.numpy()
            values[0, 2] = math.nan  # a corner, which no ray meets
            trainer.storage.values.assign(values)
        return False

    with pytest.raises(FloatingPointError, match="not finite after step 5"):
        trainer.run(on_checkpoint=keep, stop=spoil)
    assert saved == [1, 2, 3, 4]


def test_what_is_given_in_place_of_a_scene_a_field_or_a_configuration_is_refused() -> None:
    what: Any = wn
    with pytest.raises(InputError, match=r"train: scene must be a Scene, not 'photos'; load_scene"):
        what.train("photos")
    with pytest.raises(InputError, match=r"train: config must be a TrainConfig or None, .*PRESETS"):
        what.train(tiny_scene(ring(4)), "fast")
    for part in ("grid", "march", "optim", "loss"):
        with pytest.raises(InputError, match=rf"{part} must be a \w+Config, not \{{"):
            wn.TrainConfig(**{part: {}})  # type: ignore[arg-type]
    for function in (what.evaluate, what.export):
        with pytest.raises(InputError, match=r"field must be a Field.*, not 'runs/a'; load_field"):
            function("runs/a", tiny_scene(ring(4)))
    with pytest.raises(InputError, match=r"evaluate: scene must be a Scene, not 'photos'"):
        what.evaluate(ball_field(), "photos")
