"""A training's plan: resolved once, without Warp, written and read, and gone by."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import warpnerf as wn
from tests.project.test_init import in_fresh_python
from tests.scenes.test_frustum import facing
from tests.support.tiny_fields import assert_same_state
from tests.support.tiny_scenes import ring, tiny_scene, write_transforms
from tests.support.tiny_trainings import (
    GROWING,
    STEPS,
    ball,
    stopped_at,
    tiny_config,
    without_seconds,
)
from tests.support.tiny_trainings import early_growth as early_growth
from warpnerf import grid_config, optim_config
from warpnerf.checks import InputError
from warpnerf.cli.inspect import InspectOptions, inspect_command
from warpnerf.fields import training_memory
from warpnerf.runs.checkpoint import load_checkpoint
from warpnerf.scenes.scene import Scene
from warpnerf.training import plan as planning
from warpnerf.training import trainer as training
from warpnerf.training.optim import adam_step
from warpnerf.training.peers import ALONE, Peers
from warpnerf.training.plan import TrainingPlan, resolve
from warpnerf.training.plan_json import plan_from_json, plan_to_json
from warpnerf.training.trainer import Trainer


def contracted() -> Scene:
    return replace(ball(), unbounded=True)


def in_ndc() -> wn.TrainConfig:
    return tiny_config(grid=wn.GridConfig(voxels=4000, contraction="ndc", planes=16))


PLANS: dict[str, Callable[[], TrainingPlan]] = {
    "object": lambda: resolve(ball(), tiny_config()),
    "contracted": lambda: resolve(contracted(), tiny_config(time_limit=1.0 / 3.0)),
    "ndc": lambda: resolve(facing(), in_ndc()),
    "to look first": lambda: resolve(
        contracted(), wn.TrainConfig(content_distance="per-camera", model="rgb", background="white")
    ),
}


def test_planning_does_not_load_warp() -> None:
    code = (
        "import sys, warpnerf as wn; from warpnerf.training.plan import resolve;"
        "from warpnerf.training.plan_json import plan_to_json;"
        "plan_to_json(resolve(wn.load_scene('builtin:room-sparse', downscale=16),"
        "wn.TrainConfig(threads=1)));"
        "print(sorted({'warp', 'torch', 'warpnerf_kernels'} & set(sys.modules)))"
    )
    assert in_fresh_python(code) == "[]"


@pytest.mark.parametrize("name", PLANS)
def test_it_comes_back_bit_for_bit(name: str) -> None:
    plan = PLANS[name]()
    text = json.dumps(plan_to_json(plan), allow_nan=False)
    back = plan_from_json(json.loads(text))
    assert json.dumps(plan_to_json(back)) == text
    for one, other in ((back.space.box_max, plan.space.box_max), (back.stages, plan.stages)):
        np.testing.assert_array_equal(np.asarray(one, object), np.asarray(other, object))
    assert (back.config, back.losses, back.schedule) == (plan.config, plan.losses, plan.schedule)
    assert (back.kind, back.looks_first) == (plan.kind, plan.looks_first)
    assert (back.space.frustum is None) == (plan.space.frustum is None) == (name != "ndc")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda tree: None, "no plan"),
        (lambda tree: tree | {"kind": "indoors"}, "kind"),
        (lambda tree: tree | {"content_distances": [0.0]}, "plan.content_distances"),
        (lambda tree: tree | {"stages": tree["stages"][1:]}, "one more than growths, not 2 for 2"),
        (lambda tree: tree | {"losses": tree["losses"] | {"opacity": "auto"}}, "opacity"),
        (lambda tree: tree | {"space": tree["space"] | {"box_min": [0.0, 1.0]}}, "box_min"),
        (lambda tree: tree | {"space": tree["space"] | {"box_min": ["a"] * 3}}, "box_min"),
        (lambda tree: {name: tree[name] for name in tree if name != "reach"}, "reach"),
        (lambda tree: tree | {"config": tree["config"] | {"seed": -1}}, "seed"),
    ],
)
def test_what_is_no_plan_is_refused(change: Callable[[Any], Any], says: str) -> None:
    tree = json.loads(json.dumps(plan_to_json(PLANS["object"]())))
    with pytest.raises(InputError, match=r"^this is no plan of a training: .*; write one") as error:
        plan_from_json(change(tree))
    assert says in str(error.value)


def test_it_says_what_is_trained() -> None:
    config = wn.TrainConfig(grid=wn.GridConfig(voxels=64_000), time_limit=60.0)
    plan = resolve(ball(), config)
    assert (plan.kind, plan.config.time_limit, plan.looks_first) == ("object", 60.0, False)
    assert plan.background == (1.0, 1.0, 1.0) and not plan.random_background
    assert plan.losses == replace(config.loss, opacity=0.0)
    assert plan.schedule.grow_at == grid_config.GROW_AT["object"]
    assert plan.schedule.accumulate_at == optim_config.ACCUMULATE_AT["object"]
    assert plan.schedule.decay == config.optim.decay
    assert [stage.begins for stage in plan.stages] == [0.0, *plan.schedule.grow_at]
    assert [stage.nodes for stage in plan.stages] == [4000, 8000, 16_000, 32_000, 64_000]
    edges = plan.space.box_max - plan.space.box_min
    for stage in plan.stages:
        assert math.prod(stage.size) == pytest.approx(stage.nodes, rel=0.25)
        assert stage.steps.step == pytest.approx(float((edges / (np.array(stage.size) - 1)).min()))
    views = sum(18 * 24 * 4 for _ in ball().views)
    nodes = math.prod(plan.stages[-1].size)
    of_rays = 4096 * plan.schedule.most_steps_an_update * planning.RAY_BYTES
    assert plan.memory == 12 * 16 * nodes + views + of_rays + planning.PROCESS_BYTES
    blind = resolve(ball(), tiny_config(background="random"))
    assert blind.random_background and blind.background == (1.0, 1.0, 1.0)


@pytest.mark.ci
@pytest.mark.parametrize(("scene", "config"), [(contracted, tiny_config), (facing, in_ndc)])
def test_a_training_does_what_its_plan_says(
    scene: Callable[[], Scene], config: Callable[[], wn.TrainConfig], on_cpu: None
) -> None:
    plan = resolve(scene(), replace(config(), coarse_steps=0))
    trainer = Trainer(scene(), plan)
    passed = set()
    while trainer.fraction < 1.0:
        trainer.update()
        stage = plan.stages[trainer._grown]
        passed.add(stage.begins)
        steps = replace(trainer.march_steps(), transmittance_min=stage.steps.transmittance_min)
        assert trainer.lattice.size == stage.size and steps == stage.steps
    assert passed == {stage.begins for stage in plan.stages}


def test_it_is_resolved_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, on_cpu: None) -> None:
    asked: list[str] = []

    def counted(owner: Any, name: str) -> None:
        function = getattr(owner, name)

        def count(*arguments: Any, **options: Any) -> Any:
            asked.append(name)
            return function(*arguments, **options)

        monkeypatch.setattr(owner, name, count)

    names = ("resolve_space", "content_distances", "reach")
    for owner, name in zip((planning, planning, planning.extent), names, strict=True):
        counted(owner, name)
    for owner, name in ((wn.GridConfig, "grows_at"), (wn.OptimConfig, "accumulates_at")):
        counted(owner, name)
    counted(wn.TrainConfig, "losses_for")
    plan = resolve(contracted(), tiny_config())
    assert {name: asked.count(name) for name in names} == dict.fromkeys(names, 1)
    del asked[:]
    begun = stopped_at(GROWING[0] + 1, tmp_path / "begun", plan, contracted())
    stopped_at(STEPS, tmp_path / "whole", plan.config, contracted(), begun)
    assert not asked


def test_a_resumed_training_goes_by_the_plan_that_it_began_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, on_cpu: None
) -> None:
    """Also where a later version decides otherwise what is auto."""
    own = wn.GridConfig(voxels=6000, alpha_init=0.1)
    config = tiny_config(grid=own, optim=wn.OptimConfig(), background="auto")
    whole = stopped_at(STEPS, tmp_path / "whole", config, ball())
    begun = stopped_at(6, tmp_path / "begun", config, ball())
    monkeypatch.setitem(grid_config.GROW_AT, "object", (0.9,))
    monkeypatch.setitem(optim_config.ACCUMULATE_AT, "object", ())
    monkeypatch.setitem(planning._COLOURS, "white", (0.5, 0.5, 0.5))
    assert isinstance(whole.plan, TrainingPlan)
    goes_by = Trainer(ball(), config, begun).plan
    assert plan_to_json(goes_by) == plan_to_json(whole.plan)
    resumed = stopped_at(STEPS, tmp_path / "resumed", config, ball(), begun)
    assert_same_state(without_seconds(resumed), without_seconds(whole))
    assert isinstance(resumed.plan, TrainingPlan)
    assert plan_to_json(resumed.plan) == plan_to_json(whole.plan)
    again = stopped_at(STEPS, tmp_path / "again", config, ball())
    assert again.field.lattice.size != whole.field.lattice.size


def test_a_plan_that_was_read_trains_to_the_same_bits(tmp_path: Path, on_cpu: None) -> None:
    plan = resolve(ball(), tiny_config())
    read = plan_from_json(json.loads(json.dumps(plan_to_json(plan))))
    states = [stopped_at(STEPS, tmp_path / "a", how, ball()) for how in (tiny_config(), read)]
    assert_same_state(*map(without_seconds, states))
    held = load_checkpoint(tmp_path / "a").plan
    assert isinstance(held, TrainingPlan) and plan_to_json(held) == plan_to_json(plan)


def test_a_plan_of_another_scene_is_refused() -> None:
    with pytest.raises(InputError, match=r"has 3 content distances, but tiny 5 training views; "):
        Trainer(tiny_scene(ring(6)), resolve(ball(), tiny_config()))


def test_a_plan_that_waits_for_a_short_training_is_refused() -> None:
    plan = PLANS["to look first"]()
    assert plan.looks_first and set(plan.content_distances) == {plan.content_distance}
    with pytest.raises(InputError, match=r"waits for a short one .* give it to training\.coarse"):
        Trainer(contracted(), plan)
    with pytest.raises(InputError, match="no short training has found"):
        resolve(contracted(), plan.config, looked=True)


def test_a_training_needs_room_for_its_last_grid_also_when_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, on_cpu: None
) -> None:
    begun = stopped_at(2, tmp_path / "begun", tiny_config(), ball())
    monkeypatch.setattr(
        training_memory, "usable_memory", lambda: 100_000
    )  # enough for the first grid
    for resume in (None, begun):
        with pytest.raises(InputError, match=r"^grid\.voxels: of the .* a grid of .* nodes of"):
            Trainer(ball(), tiny_config(), resume)


class Adding(Peers):
    """Another one, whose gradients a function adds."""

    def __init__(self, change: Callable[[Any], None]) -> None:
        self.change = change

    def add(self, accumulated: Any, workers: Any) -> None:
        self.change(accumulated[0][0])


def test_gradients_are_reduced_before_they_are_regularised(
    monkeypatch: pytest.MonkeyPatch, on_cpu: None
) -> None:
    """What several processes will add up there; one has nothing to add."""
    seen: dict[str, list[np.ndarray]] = {}

    def double(gradients: Any) -> None:
        gradients.values.assign(2.0 * gradients.values.numpy())
        gradients.weights.assign(2.0 * gradients.weights.numpy())

    def counted(gradients: Any) -> None:
        counts.append(float(np.abs(gradients.values.numpy()).sum()))

    for name, peers in (("kept", ALONE), ("doubled", Adding(double))):
        found = seen[name] = []

        def watched(parameters: Any, states: Any, gradients: Any, *rest: Any, to: Any) -> None:
            to += [gradients.values.numpy().copy(), gradients.weights.numpy().sum(axis=0)]
            adam_step(parameters, states, gradients, *rest)

        monkeypatch.setattr(training, "adam_step", lambda *a, found=found: watched(*a, to=found))
        optim = wn.OptimConfig(tv_density=0.0, tv_rgb=0.0, accumulate_at=())
        Trainer(ball(), tiny_config(optim=optim), peers=peers).update()
    monkeypatch.setattr(training, "adam_step", adam_step)
    for kept, doubled in zip(seen["kept"], seen["doubled"], strict=True):
        np.testing.assert_array_equal(doubled, 2.0 * kept)
        assert np.abs(kept).max() > 0.0

    # Total variation is added to what the reduction has left: nowhere, where that is nothing.
    def cleared(gradients: Any) -> None:
        gradients.values.zero_()

    trainer = Trainer(ball(), tiny_config(), peers=Adding(cleared))
    before = trainer.storage.tensors()["values"].copy()
    trainer.storage.values.assign(  # type: ignore[attr-defined]
        np.random.default_rng(0).normal(size=trainer.storage.values.numpy().shape)  # type: ignore[attr-defined]
    )
    given = trainer.storage.tensors()["values"].copy()
    assert (given != before).any()
    trainer.update()
    np.testing.assert_array_equal(trainer.storage.tensors()["values"], given)

    counts: list[float] = []
    plain, counting = (
        Trainer(ball(), tiny_config()),
        Trainer(ball(), tiny_config(), peers=Adding(counted)),
    )
    for trainer in (plain, counting):
        trainer.run()
    assert len(counts) == STEPS and min(counts) > 0.0
    assert_same_state(without_seconds(plain.state()), without_seconds(counting.state()))


def test_what_inspect_writes_is_what_train_would_run(tmp_path: Path) -> None:
    write_transforms(tmp_path / "scene", 6)
    file = tmp_path / "facts.json"
    given = {"march.near": ("0.25",), "content_distance": ("1.5",), "grid.voxels": ("8000",)}
    options = InspectOptions(scene=str(tmp_path / "scene"), json=file)
    assert inspect_command(options, given) == 0
    plans = json.loads(file.read_text())["plans"]
    assert plans.keys() == {"fast", "quality"}
    scene = wn.load_scene(tmp_path / "scene")
    for name, tree in plans.items():
        config = wn.PRESETS[name]
        config = replace(
            config,
            content_distance=1.5,
            grid=replace(config.grid, voxels=8000),
            march=replace(config.march, near=0.25),
        )
        expected = plan_to_json(resolve(scene, config))
        assert tree == json.loads(json.dumps(expected))
        assert plan_from_json(tree).config == config.for_kind(scene.kind)
