"""Options that would do nothing are refused, and left out of what older versions have written."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest

import warpnerf as wn
from tests.scenes.test_frustum import facing
from tests.support.tiny_trainings import ball, tiny_config
from warpnerf.cli.configured import configured
from warpnerf.cli.main import main
from warpnerf.config_json import config_from_json, config_to_json, decode
from warpnerf.training import coarse
from warpnerf.training.plan import resolve
from warpnerf.training.trainer import Trainer

WITHOUT_TV = {"tv_density": 0.0, "tv_rgb": 0.0}


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (
            lambda: wn.TrainConfig(optim=wn.OptimConfig(**WITHOUT_TV, tv_until=0.5)),
            "optim.tv_until is 0.5, but optim.tv_density and optim.tv_rgb are 0; .* leave tv_until",
        ),
        (
            lambda: wn.TrainConfig(optim=wn.OptimConfig(**WITHOUT_TV, tv_every=1)),
            "optim.tv_every is 1, but optim.tv_density and optim.tv_rgb are 0; .* leave tv_every",
        ),
        (
            lambda: wn.GridConfig(contraction="linf", planes=32),
            "grid.planes is 32, but grid.contraction is linf, .* leave planes out",
        ),
        (
            lambda: wn.GridConfig(shift_at_growth=1.0, grow_at=()),
            "grid.shift_at_growth is 1, but grid.grow_at is empty; .* leave shift_at_growth out",
        ),
        (
            lambda: wn.TrainConfig(
                grid=wn.GridConfig(grow_at=()), optim=wn.OptimConfig(restart_at_growth=True)
            ),
            "restart_at_growth is true, but grid.grow_at is empty; .* leave restart_at_growth out",
        ),
        (
            lambda: wn.TrainConfig(field=wn.Hash(), optim=wn.OptimConfig(tv_rgb=1e-8)),
            "optim.tv_rgb is 1e-08, but a hash field has no total variation; leave tv_rgb out",
        ),
        (
            lambda: wn.TrainConfig(field=wn.Hash(), optim=wn.OptimConfig(tv_every=1)),
            "optim.tv_every is 1, but a hash field has no total variation; leave tv_every out",
        ),
        (
            lambda: wn.TrainConfig(
                field=wn.Hash(),
                model="rgb",
                sampler="march",
                optim=wn.OptimConfig(epsilon=1e-6),
            ),
            r"optim.epsilon is 1e-06, but .* set field\.epsilon, and leave epsilon out",
        ),
    ],
)
def test_what_would_do_nothing_is_refused(make: Callable[[], object], says: str) -> None:
    with pytest.raises(wn.InputError, match=says):
        make()


def test_what_does_something_is_not() -> None:
    wn.TrainConfig(optim=wn.OptimConfig(tv_density=0.0, tv_until=0.5, tv_every=1))
    wn.TrainConfig(optim=wn.OptimConfig(**WITHOUT_TV))
    sparse = wn.Vm(sparsity=1e-4)
    wn.TrainConfig(field=sparse, optim=wn.OptimConfig(**WITHOUT_TV, tv_until=0.5, tv_every=4))
    wn.GridConfig(contraction="ndc", planes=32)
    wn.TrainConfig(field=wn.Vm(), optim=wn.OptimConfig(tv_rgb=1e-8, tv_every=1))
    # The MLP and the resampler's grid have the optimiser's epsilon.
    epsilon = wn.OptimConfig(epsilon=1e-6)
    wn.TrainConfig(field=wn.Hash(), optim=epsilon, model="deferred")
    wn.TrainConfig(field=wn.Hash(), model="rgb", optim=epsilon, sampler=wn.Resampled())
    wn.GridConfig(planes=32)  # auto: depends on the scene
    wn.TrainConfig(
        grid=wn.GridConfig(shift_at_growth=1.0), optim=wn.OptimConfig(restart_at_growth=True)
    )


def test_planes_are_judged_where_the_scene_is_known() -> None:
    grid = wn.GridConfig(voxels=4000, planes=16)
    with pytest.raises(wn.InputError, match=r"planes is 16, but grid\.contraction is none"):
        Trainer(ball(), tiny_config(grid=grid))
    Trainer(facing(), tiny_config(grid=replace(grid, contraction="ndc")))


def test_a_short_training_takes_over_what_it_has_a_use_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It does not grow, and contracts space where the training itself has planes."""

    class Begun(Exception):
        pass

    def prepare_trainer(scene: wn.Scene, config: wn.TrainConfig, **options: Any) -> None:
        assert config.grid.grow_at == () and config.grid.contraction == "linf"
        assert config.optim.near_decay == 0.0  # what is near is not known yet
        assert config.appearance == "none"
        raise Begun

    monkeypatch.setattr(coarse, "Trainer", prepare_trainer)
    config = tiny_config(
        coarse_steps=60,
        grid=wn.GridConfig(voxels=4000, planes=16, contraction="ndc", shift_at_growth=1.0),
        optim=wn.OptimConfig(restart_at_growth=True, near_decay=0.1),
    )
    with pytest.raises(Begun):
        coarse.extent_by_training(facing(), resolve(facing(), config))


def test_what_an_older_version_wrote_is_read_without_it() -> None:
    config = wn.TrainConfig(
        grid=wn.GridConfig(grow_at=(), contraction="none"), optim=wn.OptimConfig(**WITHOUT_TV)
    )
    tree = json.loads(json.dumps(config_to_json(config)))
    tree["grid"] |= {"planes": 32, "shift_at_growth": 1.0, "border": 0.2}
    tree["march"]["growth"] = 0.1
    tree["optim"] |= {"tv_every": 1, "tv_until": 0.5, "restart_at_growth": True}
    assert read(tree) == config
    config = wn.TrainConfig(field=wn.Hash())
    tree = json.loads(json.dumps(config_to_json(config)))
    tree["optim"] |= {"tv_density": 1e-6, "tv_until": 0.5, "near_decay": 0.1}
    assert read(tree) == config
    config = wn.PRESETS["dvgo-llff"]
    assert read(json.loads(json.dumps(config_to_json(config)))) == config


def read(tree: dict[str, Any]) -> wn.TrainConfig:
    return msgspec.convert(config_from_json(tree), wn.TrainConfig, dec_hook=decode)


def test_a_hash_takes_the_total_variation_of_the_preset_away() -> None:
    preset = wn.PRESETS["dvgo-unbounded"]
    assert preset.optim.tv_every != wn.OptimConfig.tv_every
    optim = configured(preset, {"field": ("hash",)}).optim
    assert optim.tv_every == wn.OptimConfig.tv_every
    assert configured(preset, {"field": ("vm",)}).optim.tv_every == preset.optim.tv_every
    with pytest.raises(wn.InputError, match="a hash field has no total variation"):
        configured(preset, {"field": ("hash",), "optim.tv_every": ("2",)})


def test_another_contraction_takes_the_planes_of_the_preset_away(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The command has no option for them."""
    options = ["--preset", "dvgo-llff", "--contraction", "linf", "--output", str(tmp_path / "run")]
    assert main(["train", str(tmp_path / "none"), *options]) == 2
    assert "does not exist" in capsys.readouterr().err
