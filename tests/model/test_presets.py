"""Presets train, and those of DVGO are made of what was published."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any, get_args, get_type_hints

import msgspec
import numpy as np
import pytest

import warpnerf as wn
from tests.scenes.test_frustum import facing
from tests.support.tiny_scenes import ring, tiny_scene
from tests.support.tiny_trainings import ball
from warpnerf.cli import train
from warpnerf.config import LossConfig
from warpnerf.config_json import config_from_json, config_to_json, decode
from warpnerf.loss_config import USUAL_LOSSES
from warpnerf.model.models import PerSample, model_of
from warpnerf.model.sampler_kinds import Resampled
from warpnerf.model.storage_kinds import Hash, Vm
from warpnerf.presets import DEFAULT_PRESETS, PRESETS
from warpnerf.scenes.scene import Scene
from warpnerf.training.trainer import Trainer

STEPS = 120


def smaller(name: str, **changes: Any) -> wn.TrainConfig:
    """A preset at a size for tests: what it is made of, on fewer nodes, rays and steps."""
    preset = PRESETS[name]
    values = {
        "steps": STEPS,
        "rays_per_step": 128,
        "time_limit": None,
        "threads": 1,
        "grid": replace(
            preset.grid, voxels=4096, planes=16 if name == "dvgo-llff" else preset.grid.planes
        ),
    }
    return replace(preset, **(values | changes))


def squared_error(field: wn.Field, scene: Scene) -> float:
    """Mean over the training views, of photographs before the field's background."""
    errors = []
    for view in (scene.views[index] for index in scene.splits["train"]):
        image = view.image / 255.0
        alpha = image[..., 3:] if image.shape[2] == 4 else 1.0
        target = image[..., :3] * alpha + np.array(field.background) * (1.0 - alpha)
        errors.append(np.square(field.render(view.camera).rgb - target).mean())
    return float(np.mean(errors))


@pytest.mark.slow  # compiles networks as wide as DVGO's
@pytest.mark.parametrize(
    ("name", "scene"),
    [
        ("fast", ball()),
        ("quality", ball()),
        ("dvgo", ball()),
        ("dvgo-unbounded", tiny_scene(ring(4))),
        ("dvgo-llff", facing()),
        ("tensorf", ball()),
        ("ngp", ball()),
        ("mip360", tiny_scene(ring(4))),
    ],
)
def test_presets_train(name: str, scene: Scene) -> None:
    steps = 400 if name == "tensorf" else STEPS  # TensoRF's rates are low at first
    trainer = Trainer(scene, smaller(name, steps=steps))
    before = squared_error(trainer.field(), scene)
    trainer.run()
    assert trainer.steps_done == steps
    assert squared_error(trainer.field(), scene) < 0.8 * before
    for parameter in trainer.parameters():
        values = parameter.values.numpy()
        assert values.any() and np.isfinite(values).all()


def test_there_is_one_default() -> None:
    assert wn.TrainConfig() == PRESETS["fast"] == wn.TrainConfig(model="deferred")
    assert wn.Deferred() == model_of("deferred") == PRESETS["quality"].model
    assert wn.Deferred() == wn.Deferred(specular=12, width=64)


def test_what_older_files_leave_out_is_what_was_the_default_then() -> None:
    tree = json.loads(json.dumps(config_to_json(wn.TrainConfig())))
    del tree["loss"], tree["average_pixels"], tree["model"]["specular"], tree["model"]["width"]
    then = replace(
        PRESETS["fast"],
        loss=wn.LossConfig(),
        average_pixels=False,
        model=wn.Deferred(specular=4, width=32),
    )
    assert msgspec.convert(config_from_json(tree), wn.TrainConfig, dec_hook=decode) == then
    tree["loss"] = {"distortion": 0.02}
    found = msgspec.convert(config_from_json(tree), wn.TrainConfig, dec_hook=decode)
    assert found.loss == wn.LossConfig(distortion=0.02)


def test_the_command_knows_all() -> None:
    hints = get_type_hints(train.TrainOptions, include_extras=True)
    literal = get_args(hints["preset"])[0]
    assert get_args(literal) == tuple(PRESETS)


def test_there_are_those_of_others_and_the_everyday_ones() -> None:
    assert set(PRESETS) == {*DEFAULT_PRESETS, *PUBLISHED, "tensorf", "ngp", "mip360"}
    for name, preset in PRESETS.items():  # published figures are of photographs as they are
        assert preset.appearance == ("auto" if name in DEFAULT_PRESETS else "none")
        assert preset.average_pixels == (name in DEFAULT_PRESETS)


PUBLISHED: dict[str, dict[str, Any]] = {
    "dvgo": {
        "steps": 20_000,
        "rays": 8192,
        "decay_steps": 20_000,
        "voxels": 160**3,
        "grow_at": (1000, 2000, 3000, 4000),
        "alpha_init": 1e-4,  # theirs: 1e-2 and 1e-4, where a coarse stage has left something
        "threshold": 1e-4,
        "free": 1e-3,
        "features": 12,
        "width": 128,
        "frequencies": 4,
        "distortion": 0.0,
        "total_variation": (0.0, 0.0),
        "tv_before": 20_000,
        "longest_axis": 160,
        "background": "auto",  # white, where photographs have alpha
        "contraction": "auto",
        "planes": None,
    },
    "dvgo-unbounded": {
        "steps": 40_000,
        "rays": 4096,
        "decay_steps": 80_000,
        "voxels": 320**3,
        "grow_at": (2000, 4000, 6000, 8000, 10_000, 12_000, 14_000, 16_000),
        "alpha_init": 1e-4,
        "threshold": 1e-4,
        "features": 12,
        "width": 128,
        "frequencies": 4,
        "distortion": 0.01,
        "total_variation": (1e-6, 1e-7),
        "tv_before": 20_000,
        "longest_axis": 320,
        "background": "random",
        "contraction": "linf",
        "planes": None,
    },
    "dvgo-llff": {
        "steps": 30_000,
        "rays": 4096,
        "decay_steps": 20_000,
        "voxels": 256**3,
        "grow_at": (2000, 4000, 6000, 8000),
        "alpha_init": 1 / 128,
        "threshold": 1e-3,
        "features": 9,
        "width": 64,
        "frequencies": 0,
        "distortion": 0.01,
        "total_variation": (1e-5, 1e-6),
        "tv_before": 30_000,
        "longest_axis": (256**3 / 128 * 4 / 3) ** 0.5,  # of photographs of 4 to 3
        "background": "auto",
        "contraction": "ndc",
        "planes": 128,
    },
}
"""What DVGO's authors publish: default.py, nerf_unbounded_default.py and llff_default.py of their
repository, in their units."""


@pytest.mark.parametrize("name", PUBLISHED)
def test_those_of_dvgo_are_what_is_published(name: str) -> None:
    config, theirs = PRESETS[name], PUBLISHED[name]
    grid, optim, loss, model = config.grid, config.optim, config.loss, config.model
    assert (config.steps, config.rays_per_step, grid.voxels) == (
        theirs["steps"],
        theirs["rays"],
        theirs["voxels"],
    )
    # One step an update, no coarse stage of ours, and a look for free space every 1000 steps.
    assert (config.coarse_steps, config.occupancy_every, config.time_limit) == (0, 1000, None)
    assert optim.accumulate_at == ()
    assert optim.tv_every == 1 or optim.tv_density == optim.tv_rgb == 0.0
    free = theirs.get("free", theirs["threshold"])
    assert (config.background, config.alpha_min) == (theirs["background"], free)
    assert grid.grow_at == pytest.approx([at / config.steps for at in theirs["grow_at"]])
    assert (grid.shift_at_growth, grid.alpha_init) == (1.0, theirs["alpha_init"])
    assert grid.contraction == theirs["contraction"]
    assert theirs["planes"] in (None, grid.planes)
    assert (config.march.step_voxels, config.march.jitter, config.march.near) == (0.5, False, 0.0)
    assert config.march.transmittance_min == 1e-3
    # The optimiser, which they restart as the grid grows; rates fall by ten in so many steps.
    assert (optim.beta1, optim.beta2, optim.epsilon) == (0.9, 0.99, 1e-8)
    assert optim.restart_at_growth
    assert optim.decay == pytest.approx(0.1 ** (config.steps / theirs["decay_steps"]))
    rates = model.learning_rates(optim)
    assert rates[: 1 + theirs["features"]].tolist() == [0.1] * (1 + theirs["features"])
    assert model.learning_rate_mlp == 1e-3
    # An MLP of three layers, whose output is the colour.
    assert isinstance(model, PerSample) and not model.residual
    assert (model.features, model.width, model.hidden_layers, model.frequencies) == (
        theirs["features"],
        theirs["width"],
        2,
        theirs["frequencies"],
    )
    # At most as much as the least weight whose colour counts there.
    assert model.threshold == theirs["threshold"]
    # Weights of losses: their squared error is the mean over three channels.
    assert loss.photometric == "squared"
    assert loss.entropy == pytest.approx(3 * 0.001)
    assert loss.sample_colour == pytest.approx(3 * 0.01)
    assert loss.distortion == pytest.approx(3 * theirs["distortion"])
    assert (loss.opacity, loss.near_clip) == (0.0, 0.0)
    per_pair = 3 / theirs["rays"] * theirs["longest_axis"] / 128 / 6
    expected = [weight * per_pair for weight in theirs["total_variation"]]
    assert [optim.tv_density, optim.tv_rgb] == pytest.approx(expected, rel=0.05)
    assert not any(expected) or optim.tv_until == theirs["tv_before"] / config.steps


def test_losses_and_rates_of_the_everyday_ones_are_those_that_were_chosen() -> None:
    """By docs/decisions/presets.md and losses.md, which have no figures of others."""
    fast, quality = (PRESETS[name] for name in DEFAULT_PRESETS)
    assert fast.loss == quality.loss == USUAL_LOSSES
    assert (
        LossConfig(distortion=0.03, distortion_rise=100.0, entropy=0.001, opacity="auto")
        == USUAL_LOSSES
    )
    assert replace(quality.optim, decay=fast.optim.decay) == fast.optim
    assert (fast.optim.decay, quality.optim.decay) == (0.07, 0.03)
    optim = fast.optim
    assert (optim.learning_rate_density, optim.learning_rate_rgb) == (0.5, 0.2)
    assert (optim.beta1, optim.beta2, optim.epsilon) == (0.9, 0.99, 1e-8)
    assert (optim.tv_density, optim.tv_rgb, optim.tv_every, optim.tv_until) == (3e-9, 3e-10, 8, 1.0)
    assert (fast.scaling, quality.scaling) == ("clamped", "clamped")


def test_that_of_tensorf_is_what_is_published() -> None:
    """lego.txt and opt.py of their repository; presets.py says what is different here."""
    config, theirs = PRESETS["tensorf"], {"steps": 30_000, "rays": 4096, "nodes": 300}
    field, optim, model = config.field, config.optim, config.model
    assert isinstance(field, Vm) and isinstance(model, PerSample)
    assert (config.steps, config.rays_per_step) == (theirs["steps"], theirs["rays"])
    assert config.grid.voxels == theirs["nodes"] ** 3
    assert (field.density, field.appearance, model.features) == (16, 48, 27)
    assert (field.learning_rate, field.learning_rate_decoder) == (0.02, 1e-3)
    assert (model.learning_rate_mlp, model.width, model.hidden_layers, model.frequencies) == (
        1e-3,
        128,
        2,
        2,
    )
    assert not model.residual and model.threshold == config.alpha_min == 1e-4
    assert (optim.beta1, optim.beta2, optim.epsilon, optim.decay) == (0.9, 0.99, 1e-8, 0.1)
    assert optim.restart_at_growth and optim.tv_density == optim.tv_rgb == 0.0
    assert field.sparsity == pytest.approx(3 * 4e-5)
    assert (config.march.step_voxels, config.march.jitter, config.march.near) == (0.5, True, 0.0)
    at = [share * config.steps for share in config.grid.grow_at]
    assert at == pytest.approx([2000, 3000, 4000, 7000])
    assert config.loss == LossConfig()


def test_that_of_instant_ngp_is_what_is_published() -> None:
    """base.json, run.py and testbed_nerf.cu of theirs; presets.py says what is different here."""
    config, theirs = PRESETS["ngp"], {"steps": 35_000, "rays": 4096, "occupancy": 128}
    field, optim, model, march = config.field, config.optim, config.model, config.march
    assert isinstance(field, Hash) and isinstance(model, PerSample)
    assert (config.steps, config.rays_per_step) == (theirs["steps"], theirs["rays"])
    assert (field.levels, field.features, field.table, field.hidden) == (16, 2, 1 << 19, 64)
    assert field.resolutions[0] == 16 and field.resolutions[-1] == 2048
    assert field.resolutions[1] == round(16 * 1.3819)
    assert (1 + model.features, model.width, model.hidden_layers) == (16, 64, 2)
    assert not model.residual
    rates = field.learning_rate, field.learning_rate_decoder, model.learning_rate_mlp
    assert rates == (0.01, 0.01, 0.01)
    assert (optim.beta1, optim.beta2, optim.epsilon, field.epsilon) == (0.9, 0.99, 1e-15, 1e-15)
    at = [20_000, 30_000]  # two falls to a third each, within the steps
    assert optim.decay == pytest.approx(0.33 ** sum(n < theirs["steps"] for n in at))
    assert optim.accumulate_at == config.grid.grow_at == ()
    assert config.grid.voxels == theirs["occupancy"] ** 3
    cells = theirs["occupancy"] - 1
    assert march.step_voxels / cells == pytest.approx(3**0.5 / 1024)  # of an edge
    assert (march.jitter, march.near, march.transmittance_min) == (True, 0.0, 1e-4)
    assert config.alpha_min == 0.01 and config.background == "random"
    assert (config.loss.photometric, config.loss.huber_delta) == ("huber", 0.1)
    assert config.loss == LossConfig(photometric="huber")


def test_that_of_mip360_has_what_is_published_but_for_the_network() -> None:
    """360.gin of multinerf; presets.py says what is different here."""
    config = PRESETS["mip360"]
    assert (config.grid.contraction, config.grid.border, config.march.near) == ("l2", 1.0, 0.0)
    assert isinstance(config.sampler, Resampled) and isinstance(config.field, Hash)
    assert (config.sampler.bins, config.sampler.samples) == (64, 32)
    assert config.sampler.anneal(0.05) == pytest.approx(10 * 0.5 / (9 * 0.5 + 1))
    assert (config.optim.beta1, config.optim.beta2, config.optim.decay) == (0.9, 0.999, 0.01)
    assert config.loss.distortion == pytest.approx(3 * 0.01)
    assert isinstance(config.model, PerSample) and not config.model.residual
    assert (config.model.learning_rate_mlp, config.model.frequencies) == (2e-3, 4)
