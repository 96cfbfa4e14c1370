"""From a share of the training on, less is sampled: surfaces then stand where they will stay."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.tiny_fields import assert_same_state
from tests.support.tiny_trainings import (
    NO_GROWTH,
    QUICK,
    ball,
    large_ball,
    stopped_at,
    tiny_config,
    without_seconds,
)
from tests.support.tiny_trainings import early_growth as early_growth
from warpnerf.config import GridConfig, MarchConfig
from warpnerf.fields.occupancy import FreeCells
from warpnerf.model.storage_kinds import Dense, Hash
from warpnerf.optim_config import OptimConfig
from warpnerf.training.trainer import Trainer


def test_once_it_has_settled_less_is_sampled(on_cpu: None) -> None:
    """Cells without their neighbours, and rays up to 1 % of the light."""

    def trained(settle_at: float | None, **changes: Any) -> Trainer:
        config = tiny_config(**QUICK | {"settle_at": settle_at} | changes)
        trainer = Trainer(large_ball(), config)
        trainer.run()
        return trainer

    def ends(trainer: Trainer) -> float:
        return trainer.field().steps.transmittance_min

    never, settled = trained(None), trained(0.5)
    assert settled.free.share() < 0.9 * never.free.share()
    assert settled.report().samples_per_ray < 0.9 * never.report().samples_per_ray
    assert ends(never) == 1e-3 and ends(settled) == 1e-2
    configured = trained(0.5, march=MarchConfig(transmittance_min=1e-4))
    assert ends(configured) == 1e-4
    assert configured.free.share() < 0.9 * never.free.share()
    growing = GridConfig(voxels=20_000, grow_at=(0.7,), alpha_init=0.1)
    trainer = Trainer(large_ball(), tiny_config(**QUICK | {"settle_at": 0.5, "grid": growing}))
    while ends(trainer) == 1e-3:
        assert trainer.fraction <= 0.7
        trainer.update()
    assert trainer.steps_done == 43 and trainer._grown == 1


def test_short_trainings_do_not_settle(monkeypatch: pytest.MonkeyPatch, on_cpu: None) -> None:
    monkeypatch.setattr("warpnerf.training.free_space.FIRST_SETTLED", 60)
    trainer = Trainer(large_ball(), tiny_config(**QUICK, settle_at=0.5))
    trainer.run()
    assert trainer.field().steps.transmittance_min == 1e-3


@pytest.mark.ci
def test_a_hash_is_judged_with_its_neighbours(on_cpu: None) -> None:
    """There may be more between its nodes than at them."""
    hashed = Hash(levels=2, coarsest=4, finest=16, features=2, table=256)
    margins: list[int] = []
    find = FreeCells.of

    def finding(*arguments: Any) -> FreeCells:
        margins.append(arguments[-1])
        return find(*arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FreeCells, "of", staticmethod(finding))
        for field in (Dense(), hashed):
            optim = OptimConfig(accumulate_at=())
            Trainer(ball(), tiny_config(field=field, optim=optim, grid=NO_GROWTH)).run()
    n = len(margins) // 2
    assert 0 in margins[:n] and margins[n:] == [1] * n


def test_settled_it_is_resumed_as_it_was(tmp_path: Path, on_cpu: None) -> None:
    """Until then a training is that of one that never settles."""
    settles, never = (tiny_config(**QUICK, settle_at=at) for at in (0.5, None))
    state, other = (
        stopped_at(30, tmp_path / "state", how, large_ball()) for how in (settles, never)
    )
    values, others = (one.field.storage.tensors()["values"] for one in (state, other))
    np.testing.assert_array_equal(values, others)
    grows = GridConfig(voxels=20_000, grow_at=(0.3, 0.5), alpha_init=0.1)
    for config in (settles, replace(settles, grid=grows)):
        whole = stopped_at(60, tmp_path / "whole", config, large_ball())
        for step in (29, 30, 31, 58):
            begun = stopped_at(step, tmp_path / "begun", config, large_ball())
            steps = Trainer(large_ball(), config, begun).field().steps
            assert steps.transmittance_min == (1e-3 if step <= 30 else 1e-2)
            resumed = stopped_at(60, tmp_path / "resumed", config, large_ball(), begun)
            assert_same_state(without_seconds(resumed), without_seconds(whole))
