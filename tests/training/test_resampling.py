"""Trainings that resample: what is decided, learned, kept in files, and refused."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import warp as wp

from tests.model.test_config_options import words
from tests.runs.test_checkpoint import rewrite
from tests.scenes.test_frustum import facing
from tests.seams.given_distances import AtDistances
from tests.support.small_model import SMALL, SQUARED
from tests.support.tiny_fields import assert_same_state
from tests.support.tiny_trainings import (  # noqa: F401 (a fixture)
    NO_GROWTH,
    STEPS,
    ball,
    early_growth,
    large_ball,
    stopped_at,
    tiny_config,
    without_seconds,
)
from warpnerf.checks import InputError
from warpnerf.cli.configured import configured
from warpnerf.config import MarchConfig, TrainConfig
from warpnerf.config_json import config_from_json, config_to_json, decode
from warpnerf.evaluation.evaluate import evaluate
from warpnerf.model.sampler_kinds import AUTO_SAMPLER, MARCHED, Resampled
from warpnerf.model.spaces import SPACES
from warpnerf.optim_config import OptimConfig
from warpnerf.rendering import field as rendering
from warpnerf.rendering.proposal import unit_of
from warpnerf.runs.checkpoint import load_field, save_field
from warpnerf.training.growth import require_room
from warpnerf.training.plan import resolve
from warpnerf.training.train import train
from warpnerf.training.trainer import Trainer

DRAWN = Resampled(samples=20, bins=32, voxels=1000, anneal_until=0.3, update_every=2)


def config(**changes: Any) -> TrainConfig:
    return replace(tiny_config(), sampler=DRAWN, **changes)


def learned(trainer: Trainer) -> np.ndarray:
    """All that is learned, as one row of numbers."""
    return np.concatenate([p.values.numpy().ravel() for p in trainer.parameters()])


@pytest.mark.ci
@pytest.mark.parametrize("threads", [1, 2, 3])
def test_the_same_seed_gives_the_same_bits(threads: int, on_cpu: None) -> None:
    found = []
    for _ in range(2):
        trainer = Trainer(ball(), config(threads=threads))
        trainer.run()
        assert trainer.proposal is not None and trainer.proposal.grid.values.numpy().any()
        found.append(learned(trainer))
    np.testing.assert_array_equal(found[0], found[1])


@pytest.mark.ci
@pytest.mark.parametrize("step", [pytest.param(3, marks=pytest.mark.slow), 7, 14])
def test_a_training_goes_on_with_equal_bits(step: int, tmp_path: Path, on_cpu: None) -> None:
    """Before, at and after a growth, which makes box and proposal tighter."""
    begun = config()
    whole = stopped_at(STEPS, tmp_path / "whole", begun, ball())
    half = stopped_at(step, tmp_path / "half", begun, ball())
    gone_on = stopped_at(STEPS, tmp_path / "on", begun, ball(), half)
    assert_same_state(without_seconds(gone_on), without_seconds(whole))
    proposals = [state.field.proposal for state in (whole, gone_on)]
    assert all(p is not None and p.kind == DRAWN for p in proposals)
    values = [p.grid.values.numpy() for p in proposals if p is not None]
    np.testing.assert_array_equal(values[0], values[1])
    moments = [state.optimiser["proposal"]["moments"].numpy() for state in (whole, gone_on)]
    assert moments[0].any()
    np.testing.assert_array_equal(moments[0], moments[1])


@pytest.mark.ci
def test_a_proposal_grows_into_the_box_of_its_field(on_cpu: None) -> None:
    trainer = Trainer(ball(), config())
    first = trainer.proposal
    assert first is not None
    trainer.run()
    grown = trainer.proposal
    assert grown is not None
    for corner in ("box_min", "box_max"):
        ours, theirs = (
            getattr(lattice, corner) for lattice in (grown.grid.lattice, trainer.lattice)
        )
        np.testing.assert_array_equal(ours, theirs)
    assert not np.array_equal(first.grid.lattice.box_min, grown.grid.lattice.box_min)


def test_the_proposal_learns_to_bound(on_cpu: None) -> None:
    """What intervals weigh above their bins becomes less, once the field no longer changes."""
    trainer = Trainer(large_ball(), config(grid=NO_GROWTH))
    trainer.run()
    resampling = trainer._resampling
    assert resampling is not None
    batch, losses = trainer._draw(1), []
    for update in range(30):
        resampling.propose(trainer.free, batch, 1.0)
        trainer._pass.run(trainer.free, batch, 1, 1.0)
        resampling.learn(batch, 1.0, 0, 1.0)
        losses.append(float(resampling._proposer.loss.numpy()[: batch.count].mean()))
        resampling.step(trainer.optimiser, trainer._updates + update, 0.2, trainer.config.optim)
    assert losses[0] > 1e-5
    assert np.mean(losses[-5:]) < 0.5 * losses[0]


def test_a_proposal_learns_every_few_updates_once_it_is_not_flattened() -> None:
    kind = Resampled(anneal_until=0.1, update_every=5)
    assert [kind.is_due(update, 0.05) for update in range(6)] == [True] * 6
    assert [kind.is_due(update, 0.1) for update in range(6)] == [True, *[False] * 4, True]
    assert kind.anneal(0.1) == kind.anneal(1.0) == 1.0
    assert kind.anneal(0.05) == pytest.approx(10.0 * 0.5 / (9.0 * 0.5 + 1.0))
    assert 0.0 < kind.anneal(0.0) < kind.anneal(0.01) < kind.anneal(0.05)


@pytest.mark.ci
def test_a_field_comes_back_with_its_proposal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, on_cpu: None
) -> None:
    scene = ball()
    field = train(scene, config()).field
    save_field(tmp_path / "field", field)
    back = load_field(tmp_path / "field", threads=1)
    camera = scene.views[3].camera
    seen = field.render(camera)
    for ours, theirs in ((seen, back.render(camera)), (seen, field.render(camera))):
        np.testing.assert_array_equal(ours.rgb, theirs.rgb)
        np.testing.assert_array_equal(ours.depth, theirs.depth)
    marched = replace(field, proposal=None).render(camera)
    assert np.abs(seen.rgb - marched.rgb).max() > 0.0 and seen.opacity.max() > 0.3
    monkeypatch.setattr(rendering, "PROPOSED", 100)  # several times, the last one shorter
    np.testing.assert_array_equal(field.render(camera).rgb, seen.rgb)
    assert np.isfinite(evaluate(field, scene).mean["psnr"])


def test_files_with_half_a_proposal_are_refused(tmp_path: Path, on_cpu: None) -> None:
    field = train(ball(), config(steps=2)).field
    for number, (old, new) in enumerate(
        [
            ('"unit": 2.0', '"unit": 0.0'),
            ('"bins": 32', '"bins": 33'),
            ('"name": "resampled"', '"name": "march"'),
        ]
    ):
        path = tmp_path / f"field-{number}"
        save_field(path, field)

        def changed(text: str, old: str = old, new: str = new) -> str:
            assert old in text, (old, text)
            return text.replace(old, new)

        rewrite(path, changed)
        with pytest.raises(InputError, match=r"damaged|cannot|proposal|header"):
            load_field(path)
    assert field.proposal is not None
    size = field.proposal.grid.lattice.size
    for values in (np.full((*size, 1), np.nan), np.zeros((*size, 4)), np.zeros((3, 3, 3, 1))):
        save_field(tmp_path / "whole", field)
        rewrite(tmp_path / "whole", proposal=values.astype(np.float32))
        with pytest.raises(InputError, match="proposal that nothing can be drawn from"):
            load_field(tmp_path / "whole")


def test_bins_are_equally_long_near_cameras_unless_there_is_a_near_plane() -> None:
    assert unit_of(0.0, 3.0) == 3.0 and unit_of(0.2, 3.0) == 0.0
    trainer = Trainer(ball(), config(march=MarchConfig(near=0.3)))
    assert trainer.proposal is not None and trainer.proposal.unit == 0.0
    trainer.update()
    assert np.isfinite(trainer.report().loss)


def test_options_and_files_name_it() -> None:
    begin = TrainConfig()
    assert begin.sampler == AUTO_SAMPLER
    found = configured(begin, words(sampler="resampled", sampler__samples="48"))
    assert found.sampler == Resampled(samples=48)
    again = configured(found, words(sampler__bins="128"))
    assert again.sampler == Resampled(samples=48, bins=128)
    assert config_to_json(again)["sampler"]["name"] == "resampled"
    assert TrainConfig(sampler="resampled").sampler == Resampled()  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("config", "space", "drawn"),
    [
        (TrainConfig(), "linf", True),
        (TrainConfig(), "l2", True),
        (TrainConfig(), "none", False),
        (TrainConfig(), "ndc", False),
        (TrainConfig(march=MarchConfig(step_voxels=0.5)), "linf", False),
        (TrainConfig(march=MarchConfig(growth=0.05)), "linf", False),
        (TrainConfig(march=MarchConfig(near=0.5)), "linf", True),
        (TrainConfig(sampler=MARCHED), "linf", False),
        (TrainConfig(sampler=Resampled()), "none", True),
    ],
)
def test_auto_resamples_where_space_is_contracted(
    config: TrainConfig, space: str, drawn: bool
) -> None:
    found = config.sampler_in(SPACES[space])
    assert found == (Resampled() if drawn else MARCHED)


def test_a_models_own_sampler_is_not_replaced() -> None:
    config = TrainConfig(model=AtDistances(edges=(0.5, 1.0, 2.0)))
    assert config.sampler_in(SPACES["linf"]) == MARCHED


def test_configurations_before_it_were_marched() -> None:
    tree = json.loads(json.dumps(config_to_json(TrainConfig())))
    del tree["sampler"]
    config = msgspec.convert(config_from_json(tree), TrainConfig, dec_hook=decode)
    assert config.sampler == MARCHED


def test_numbers_of_other_types_are_kept_as_plain_ones() -> None:
    """Files are written of them, and read as the same."""
    numbers: dict[str, Any] = {"samples": np.int64(20), "bins": np.int32(32), "anneal_until": 0}
    kind = Resampled(**numbers)
    assert kind == Resampled(samples=20, bins=32, anneal_until=0.0)
    config = TrainConfig(sampler=kind)
    tree = json.loads(json.dumps(config_to_json(config)))
    assert msgspec.convert(config_from_json(tree), TrainConfig, dec_hook=decode) == config


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (
            words(sampler="stratified"),
            "sampler must be one of auto, march, resampled, not 'stratified'.",
        ),
        (words(sampler__samples="48"), "no option of the sampler auto"),
        (words(sampler="resampled", sampler__bins="40"), "must be a multiple of 16"),
        (words(sampler="resampled", sampler__samples="1"), "a whole number of at least 2"),
        (words(sampler="resampled", sampler__anneal_until="1"), "must lie in [0, 1)"),
    ],
)
def test_what_does_not_fit_is_refused(given: Any, said: str) -> None:
    with pytest.raises(InputError, match=re.escape(said)):
        configured(TrainConfig(), given)


def test_no_resampling_in_normalised_device_coordinates() -> None:
    begun = TrainConfig(sampler=DRAWN, model=SMALL, loss=SQUARED)
    assert resolve(facing(), replace(begun, sampler=MARCHED)).space.frustum is not None
    with pytest.raises(InputError, match="draws distances in the scene"):
        resolve(facing(), begun)


def test_a_plan_counts_its_memory() -> None:
    scene = ball()
    plans = [resolve(scene, replace(tiny_config(), sampler=s)) for s in (MARCHED, DRAWN)]
    more = plans[1].memory - plans[0].memory
    assert more == DRAWN.training_bytes(300) > 1000 * 12


def test_what_needs_too_much_memory_is_named() -> None:
    scene, cpu = ball(), wp.get_device("cpu")
    large = replace(tiny_config(), sampler=replace(DRAWN, voxels=10**11))
    with pytest.raises(InputError, match=r"^rays_per_step: .* or fewer voxels of the sampler"):
        require_room(resolve(scene, large), cpu)
    many = replace(tiny_config(), rays_per_step=2**31 - 1)
    with pytest.raises(InputError, match=r"^rays_per_step: of the .* needs, the rays of an update"):
        require_room(resolve(scene, many), cpu)
    together = replace(many, optim=OptimConfig(accumulate_at=(0.5,)))
    with pytest.raises(InputError, match=r"up to 2 steps .* together below 2\^31"):
        resolve(scene, together)
