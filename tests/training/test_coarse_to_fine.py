"""What changes in the course of a training: what pixels are averaged over, and a loss's weight."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from tests.support.tiny_fields import assert_same_state
from tests.support.tiny_trainings import (
    FIRST_LOOK,
    ball,
    large_ball,
    stopped_at,
    tiny_config,
    without_seconds,
)
from tests.support.tiny_trainings import early_growth as early_growth
from warpnerf.checks import InputError
from warpnerf.config import GridConfig, LossConfig
from warpnerf.rendering.losses import Objective
from warpnerf.rendering.rays import PixelSampler
from warpnerf.rendering.render import TrainingPass
from warpnerf.training.growth import averaged_over
from warpnerf.training.plan import resolve
from warpnerf.training.trainer import Trainer

RISING = LossConfig(distortion=0.02, distortion_rise=100.0)


def test_halfway_a_weight_is_what_is_configured() -> None:
    found = [RISING.at(fraction).distortion for fraction in (0.0, 0.25, 0.5, 0.75, 1.0)]
    assert found == pytest.approx([0.002, 0.02 / 10**0.5, 0.02, 0.02 * 10**0.5, 0.2])
    assert RISING.at(0.252) == RISING.at(0.257) != RISING.at(0.26)
    assert RISING.at(0.3).at(0.9) == RISING.at(0.3)
    constant = LossConfig(distortion=0.02, entropy=0.3)
    assert constant.at(0.9) == constant
    assert LossConfig(distortion_rise=100.0).at(0.9).kinds == ()


@pytest.mark.parametrize("rise", [0.0, -1.0, float("nan"), float("inf"), "2"])
def test_a_rise_that_is_none_is_refused(rise: object) -> None:
    with pytest.raises(InputError, match=r"^loss\.distortion_rise must be a "):
        LossConfig(distortion=0.1, distortion_rise=rise)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("distortion", "rise"), [(0.1, 1e7), (0.1, 1e-7), (1e-30, 2.0), (1e30, 2.0)]
)
def test_a_weight_that_floats_do_not_hold_is_refused(distortion: float, rise: float) -> None:
    with pytest.raises(InputError, match=r"^loss\.distortion_rise must lie between 1e-6 and 1e6"):
        LossConfig(distortion=distortion, distortion_rise=rise)
    assert LossConfig(distortion=1e-30).at(0.3).distortion == 1e-30


@pytest.fixture
def minimised(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[float]]:
    """The weight of the distortion loss at each update."""
    weights: list[float] = []
    run = TrainingPass.minimise

    def minimise(self: TrainingPass, objective: Objective) -> None:
        run(self, objective)
        weights.append(self._scene.loss.on_ray.factor)

    monkeypatch.setattr(TrainingPass, "minimise", minimise)
    yield weights


def test_a_loss_gains_weight_from_update_to_update(minimised: list[float], on_cpu: None) -> None:
    trainer = Trainer(ball(), tiny_config(loss=RISING))
    trainer.run()
    assert minimised == pytest.approx([RISING.at(k / 20).distortion for k in range(20)])
    minimised.clear()
    Trainer(ball(), tiny_config(loss=LossConfig(distortion=0.02))).run()
    assert minimised == pytest.approx([0.02] * 20)


@pytest.mark.parametrize("step", [3, 9, 17])
def test_resumed_it_ends_the_same(step: int, tmp_path: Path, on_cpu: None) -> None:
    config = tiny_config(loss=RISING)
    whole = Trainer(large_ball(), config)
    whole.run()
    state = stopped_at(step, tmp_path / "half.npz", config, large_ball())
    resumed = Trainer(large_ball(), config, resume=state)
    resumed.run()
    assert_same_state(without_seconds(resumed.state()), without_seconds(whole.state()))


def test_pixels_are_averaged_until_the_grid_has_grown(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, on_cpu: None
) -> None:
    """Over a square as wide as voxels are against those of the final grid."""
    config = tiny_config()
    plan = resolve(large_ball(), config, looked=True)
    edges = [averaged_over(plan, grown) for grown in range(3)]
    for edge, stage in zip(edges, plan.stages, strict=True):
        assert edge**3 == pytest.approx(plan.stages[-1].nodes / stage.nodes)
    assert edges[0] > edges[1] > edges[2] == 1.0
    drawn: list[float] = []
    draw = PixelSampler.draw

    def noting(self: PixelSampler, *arguments: object) -> object:
        drawn.append(self._source.average)
        return draw(self, *arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(PixelSampler, "draw", noting)
    trainer = Trainer(large_ball(), config)
    trainer.run()
    assert drawn == pytest.approx([edges[0]] * 7 + [edges[1]] * 6 + [edges[2]] * 7)
    assert trainer._grown == 2 and FIRST_LOOK < 7
    state = stopped_at(9, tmp_path / "half.npz", config, large_ball())
    drawn.clear()
    Trainer(large_ball(), config, resume=state).update()
    assert drawn == pytest.approx([edges[1]])
    plan = resolve(large_ball(), tiny_config(average_pixels=False), looked=True)
    assert [averaged_over(plan, grown) for grown in range(3)] == [1.0] * 3


def test_bounded_scenes_without_alpha_are_not_averaged(on_cpu: None) -> None:
    plan = replace(resolve(large_ball(), tiny_config(), looked=True), kind="bounded")
    assert [averaged_over(plan, grown) for grown in range(3)] == [1.0] * 3
    assert averaged_over(replace(plan, kind="unbounded"), 0) > 1.0


def test_no_square_is_wider_than_four_pixels(on_cpu: None) -> None:
    grid = GridConfig(voxels=200_000, grow_at=(0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7), alpha_init=0.1)
    plan = resolve(large_ball(), tiny_config(grid=grid), looked=True)
    assert averaged_over(plan, 0) == 4.0 > averaged_over(plan, 5) > 1.0
