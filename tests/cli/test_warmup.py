"""What is compiled ahead is what trainings use."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from tests.scenes.test_frustum import facing
from tests.support.small_model import SMALL, SQUARED
from tests.training.test_determinism import small_scene
from warpnerf.config import GridConfig, TrainConfig
from warpnerf.model.interface import Model
from warpnerf.model.models import Deferred, PerSample, Rgb
from warpnerf.model.spaces import SPACES
from warpnerf.optim_config import OptimConfig
from warpnerf.presets import DEFAULT_PRESETS, PRESETS
from warpnerf.runtime import kernel_cache
from warpnerf.runtime.parallel import Workers
from warpnerf.training.trainer import Trainer
from warpnerf.training.warmup import rendering_kernels, training_kernels, warm_up


@pytest.mark.ci
@pytest.mark.parametrize(
    ("contraction", "scaling", "model"),
    [
        ("none", "none", Rgb()),
        ("none", "clamped", SMALL),
        ("linf", "clamped", Rgb()),
        ("ndc", "clamped", Rgb()),
        pytest.param("none", "clamped", PerSample(), marks=pytest.mark.slow),
    ],
)
def test_a_training_loads_no_other_kernels(
    contraction: Any, scaling: Any, model: Model, device: str
) -> None:
    config = TrainConfig(
        steps=202,
        rays_per_step=64,
        scaling=scaling,
        device=device,
        model=model,
        loss=SQUARED,
        grid=GridConfig(voxels=600, grow_at=(0.5,), contraction=contraction),
        optim=OptimConfig(accumulate_at=()),
    )
    scene = facing() if contraction == "ndc" else small_scene()
    trainer = Trainer(scene, config)
    assert not trainer.workers._loaded  # a scene is described before anything is compiled
    where = trainer.workers.device
    drawn = config.sampler_in(SPACES[contraction])
    given = contraction, scaling, "none", where, config.loss
    needed = training_kernels(model, *given, sampler=drawn, exposes=True)
    trainer.update()
    assert trainer.workers._loaded == set(needed)
    trainer.run()
    assert trainer.lattice.size != Trainer(scene, config).lattice.size
    modules = {kernel.module for kernel in needed}
    assert {kernel.module for kernel in trainer.workers._loaded} == modules
    trainer.field().render(scene.cameras[0])
    rendered = rendering_kernels(model, contraction, where, sampler=drawn)
    modules |= {kernel.module for kernel in rendered}
    assert {kernel.module for kernel in trainer.workers._loaded} == modules


def test_warm_up_covers_the_presets(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel_cache, "load", lambda kernel, device: None)
    shown: list[Any] = []
    found = warm_up("cpu", shown.append, [PRESETS["fast"]])
    assert sorted(shown, key=found.index) == found
    names = [kernel.name for kernel in found]
    assert len(set(names)) == len(names)
    for scaling in ("none", "quadratic", "clamped"):
        assert f"render train, scaling {scaling}, distortion, entropy" in names  # objects
        for space in ("", ", contracted space", ", in NDC"):
            kinds = "distortion, entropy, opacity"
            assert f"render train{space}, scaling {scaling}, {kinds}" in names
    assert {"render forward", "render forward, contracted space", "adam step"} < set(names)


@pytest.mark.parametrize(
    "configs",
    [
        pytest.param(
            [TrainConfig(model=Rgb(), loss=SQUARED, grid=GridConfig(contraction="none"))], id="rgb"
        ),
        pytest.param(
            [PRESETS[name] for name in DEFAULT_PRESETS], id="presets", marks=pytest.mark.slow
        ),
    ],
)
def test_it_is_done_once(configs: list[TrainConfig], device: str) -> None:
    names = [kernel.name for kernel in warm_up(device, configs=configs)]
    again = warm_up(device, configs=configs)
    assert [kernel.name for kernel in again] == names
    assert not any(kernel.compiled for kernel in again)


def test_kernels_of_a_second_model_say_of_which(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel_cache, "load", lambda kernel, device: None)
    fast = PRESETS["fast"]
    configs = [fast, replace(fast, model=Deferred(specular=3, width=48))]
    names = [kernel.name for kernel in warm_up("cpu", configs=configs)]
    assert {"render forward", "render forward, deferred width=48 specular=3"} < set(names)


def test_unless_told_the_presets_are_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    loaded: list[Any] = []
    monkeypatch.setattr(kernel_cache, "load", lambda kernel, device: loaded.append(kernel.module))
    warm_up("cpu")
    where = Workers("cpu", 1).device
    for config in (PRESETS[name] for name in DEFAULT_PRESETS):
        for space, kind in (("ndc", "unbounded"), ("none", "bounded"), ("none", "object")):
            losses = config.losses_for(kind)
            for kernel in training_kernels(config.model, space, "clamped", "none", where, losses):
                assert kernel.module in loaded
