"""Files that versions before wrote: those of the last one are read, others refused."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import save_file

from tests.runs.test_checkpoint import rewrite
from tests.support.tiny_fields import assert_same_state, tiny_state
from tests.support.tiny_scenes import camera_at, ring
from tests.support.tiny_trainings import (
    GROWING,
    STEPS,
    ball,
    stopped_at,
    tiny_config,
    without_seconds,
)
from tests.support.tiny_trainings import early_growth as early_growth
from warpnerf.checks import InputError
from warpnerf.config import GridConfig, LossConfig, MarchConfig, TrainConfig
from warpnerf.model.models import Rgb
from warpnerf.model.sampler_kinds import MARCHED
from warpnerf.runs.checkpoint import load_checkpoint, load_field, save_checkpoint
from warpnerf.runs.tensor_file import DamagedFileError
from warpnerf.scenes.scene import Scene
from warpnerf.training.plan import OlderPlan, TrainingPlan
from warpnerf.training.state import TrainingState

OLD_FIELD = {
    "background": [0.1, 0.6, 0.9],
    "border": 0.0,
    "box_max": [1.0, 1.0, 1.0],
    "box_min": [-1.0, -1.0, -1.0],
    "contraction": "none",
    "density_scale": 2.0,
    "density_shift": -0.5,
    "format": "warpnerf-field-1",
    "steps": {
        "far": 30.0,
        "growth": 0.0,
        "n_linear": 0,
        "near": 0.1,
        "step": 0.05,
        "transmittance_min": 0.001,
    },
}
"""A field's header as the version before wrote it, which had one model and did not name it."""

OLD_TRAINING = OLD_FIELD | {
    "format": "warpnerf-training-5",
    "training": {
        "config": {
            "alpha_min": 0.01,
            "background": "auto",
            "checkpoint_every": 300.0,
            "content_distance": "auto",
            "device": "cpu",
            "grid": {
                "alpha_init": 0.001,
                "border": 0.2,
                "contraction": "auto",
                "grow_at": [0.3, 0.4, 0.5, 0.6],
                "voxels": 4096000,
            },
            "jacobian": "none",
            "march": {
                "far": None,
                "growth": 0.02,
                "jitter": True,
                "near": 0.0,
                "step_voxels": 1.0,
                "transmittance_min": 0.001,
            },
            "occupancy_every": 100,
            "optim": {
                "accumulate_at": "auto",
                "beta1": 0.9,
                "beta2": 0.99,
                "decay": 0.07,
                "epsilon": 1e-08,
                "learning_rate_density": 0.5,
                "learning_rate_rgb": 0.2,
                "tv_density": 3e-09,
                "tv_every": 8,
                "tv_rgb": 3e-10,
            },
            "rays_per_step": 4096,
            "scaling": "clamped",
            "seed": 0,
            "steps": 4000,
            "threads": 1,
            "time_limit": None,
        },
        "content_distance": 0.6666666666666666,
        "grown": 2,
        "progress": {
            "fraction": 0.25,
            "loss": 0.1,
            "occupied": 0.75,
            "psnr": 10.0,
            "samples_per_ray": 12.5,
            "seconds": 0.3333333333333333,
            "size": [5, 6, 7],
            "step": 5,
        },
        "reach": 3.141592653589793,
        "scene_digest": "of a scene",
        "updates": 5,
    },
}
"""And a training's."""


def write_old(path: Path, header: dict[str, Any], **tensors: np.ndarray) -> None:
    """A file as the version before wrote it, whose digest is the SHA-256 over all of it."""
    text = json.dumps(header, sort_keys=True)
    digest = hashlib.sha256(text.encode())
    for name in sorted(tensors):
        digest.update(f"{name}{tensors[name].dtype}{tensors[name].shape}".encode())
        digest.update(tensors[name].tobytes())
    save_file(tensors, path, metadata={"header": text, "sha256": digest.hexdigest()})


def test_files_of_the_version_before_hold_the_model_rgb(tmp_path: Path) -> None:
    """Values and moments, bit for bit, and a configuration to continue with."""
    # All rays were drawn then, of single pixels, nothing settled, a thinner medium was not free
    # space, steps outside the box were shorter, all grids grew late, and boxes were the scene's.
    then = {
        "sampler": MARCHED,
        "skip_empty_rays": False,
        "appearance": "none",
        "average_pixels": False,
        "settle_at": None,
        "alpha_min": 0.01,
        "march": MarchConfig(growth=0.02),
        "grid": GridConfig(grow_at=(0.3, 0.4, 0.5, 0.6), box="scene", border=0.2),
    }
    expected = as_older(
        tiny_state(5, TrainConfig(threads=1, model="rgb", loss=LossConfig(), **then))
    )
    expected = replace(expected, plan=replace(expected.plan, content_distances=None))
    grid, free = expected.field.storage, expected.field.free
    values = grid.values.numpy().reshape(5, 6, 7, 4)
    moments = expected.optimiser["values"]["moments"].numpy().reshape(5, 6, 7, 4)
    distance = free.distance.numpy().reshape(free.size)
    path = tmp_path / "old.safetensors"
    write_old(path, OLD_TRAINING, values=values, moments=moments, free_distance=distance)
    back = load_checkpoint(path)
    assert_same_state(back, expected)
    assert back.config.model == Rgb()
    camera = camera_at(ring(3)[1])
    seen = expected.field.render(camera).rgb
    np.testing.assert_array_equal(load_field(path, threads=1).render(camera).rgb, seen)
    write_old(path, OLD_FIELD, values=values, free_distance=distance)
    field = load_field(path, threads=1)
    assert field.model == Rgb()
    np.testing.assert_array_equal(field.storage.values.numpy(), grid.values.numpy())
    np.testing.assert_array_equal(field.render(camera).rgb, seen)


@pytest.mark.parametrize(
    ("header", "names"),
    [
        (OLD_TRAINING, ("values", "free_distance")),
        (OLD_TRAINING, ("values", "free_distance", "values.moments", "moments")),
        (OLD_FIELD, ("values", "free_distance", "moments")),
    ],
)
def test_tensors_that_the_version_before_did_not_write_are_refused(
    header: dict[str, Any], names: tuple[str, ...], tmp_path: Path
) -> None:
    state = tiny_state(5, TrainConfig(threads=1, model="rgb"))
    given = {
        "values": state.field.storage.values.numpy().reshape(5, 6, 7, 4),
        "free_distance": state.field.free.distance.numpy().reshape(state.field.free.size),
        "moments": state.optimiser["values"]["moments"].numpy().reshape(5, 6, 7, 4),
        "values.moments": state.optimiser["values"]["moments"].numpy(),
    }
    path = tmp_path / "old.safetensors"
    write_old(path, header, **{name: given[name] for name in names})
    with pytest.raises(DamagedFileError, match=r"old\.safetensors is damaged"):
        load_field(path, threads=1)


@pytest.mark.parametrize("kind", ["warpnerf-training-4", "warpnerf-training-1", "warpnerf-field-0"])
def test_formats_before_that_are_refused_in_one_sentence(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "old.safetensors"
    write_old(path, OLD_TRAINING | {"format": kind}, values=np.zeros((5, 6, 7, 4), np.float32))
    for load in (load_field, load_checkpoint):
        with pytest.raises(InputError) as caught:
            load(path)
        said = str(caught.value)
        assert said.startswith(f"{path} has format {kind!r}, but this version reads ")
        assert said.endswith("or train again.") and "\n" not in said
        assert not isinstance(caught.value, DamagedFileError)


def as_older(state: TrainingState) -> TrainingState:
    """The same with what files held of its plan up to format 7."""
    plan, config = state.plan, state.config
    assert isinstance(plan, TrainingPlan)
    alike = set(plan.content_distances) == {plan.content_distance}
    older = OlderPlan(
        config=config,
        content_distance=plan.content_distance,
        content_distances=None if alike else plan.content_distances,
        reach=plan.reach,
    )
    return replace(state, plan=older)


def in_folded_space() -> Scene:
    return replace(ball(), unbounded=True)


@pytest.mark.ci
@pytest.mark.parametrize("scene", [ball, in_folded_space])
@pytest.mark.parametrize("content_distance", ["auto", 1.5])
def test_a_training_without_a_plan_goes_on_as_it_would_have(
    content_distance: Any, scene: Callable[[], Scene], tmp_path: Path, on_cpu: None
) -> None:
    path, config = (
        tmp_path / "begun",
        tiny_config(model="rgb", content_distance=content_distance, sampler=MARCHED),
    )
    whole = stopped_at(STEPS, tmp_path / "whole", config, scene())
    for step in (3, GROWING[0] + 2):
        state = stopped_at(step, path, config, scene())
        save_checkpoint(path, as_older(state))
        with safe_open(path, framework="numpy") as file:
            header = json.loads(file.metadata()["header"])
        assert header["format"] == "warpnerf-training-7"
        assert header["training"].keys() == {*OLD_TRAINING["training"], *ADDED_SINCE}
        begun = load_checkpoint(path)
        assert isinstance(begun.plan, OlderPlan)
        resumed = stopped_at(STEPS, tmp_path / "resumed", config, scene(), begun)
        assert isinstance(resumed.plan, TrainingPlan)
        assert_same_state(without_seconds(resumed), without_seconds(whole))


ADDED_SINCE = ("content_distances", "restarted")
"""To a training's header, from format 5 to 7."""


@pytest.mark.ci
@pytest.mark.parametrize(
    "step", [GROWING[0], pytest.param(GROWING[0] + 1, marks=pytest.mark.slow), GROWING[1] + 1]
)
def test_growths_that_were_counted_with_a_tighter_box(
    step: int, tmp_path: Path, on_cpu: None
) -> None:
    """As format 6 counted them for objects; they continue as if they had been counted as now."""
    path, scene, config = tmp_path / "begun", ball(), tiny_config(sampler=MARCHED)
    state = stopped_at(step, path, config, scene)
    for counted in (state.grown + 1, state.grown):
        save_checkpoint(path, as_older(replace(state, grown=counted)))
        rewrite(path, lambda text: text.replace("training-7", "training-6"))
        begun = load_checkpoint(path)
        assert begun.grown == state.grown
    whole = stopped_at(STEPS, tmp_path / "whole", config, scene)
    resumed = stopped_at(STEPS, tmp_path / "resumed", begun.config, scene, begun)
    assert_same_state(without_seconds(resumed), without_seconds(whole))
    save_checkpoint(path, as_older(replace(state, grown=4)))
    rewrite(path, lambda text: text.replace("training-7", "training-6"))
    with pytest.raises(DamagedFileError, match="cannot have grown 4 times"):
        load_checkpoint(path)
