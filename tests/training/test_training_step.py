"""What one step of a training adds to the gradient, against the oracle: the trainer's part in it.

Kernels are held elsewhere; here it is what they get: distances of cameras, the scaling and
its Jacobian, jitter, losses and their numbers, free space, how many rays a mean is taken over.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch
from warpnerf_kernels.optim.total_variation import TV_BLOCK

from tests import reference
from tests.scenes.test_frustum import facing
from tests.support.expected import assert_close
from tests.support.loss_problems import LOSSES, oracle_losses
from tests.support.model_problems import problem_of
from tests.support.problems import Float64, Problem, make_problem
from tests.support.tiny_scenes import picture, ring, tiny_scene
from warpnerf.config import GridConfig, LossConfig, MarchConfig, TrainConfig
from warpnerf.model.models import Deferred, Rgb
from warpnerf.optim_config import OptimConfig
from warpnerf.rendering.losses import Objective
from warpnerf.rendering.steps import Steps
from warpnerf.scenes.scene import Scene
from warpnerf.training import trainer as training
from warpnerf.training.optim import adam_step
from warpnerf.training.trainer import Trainer

pytestmark = pytest.mark.usefixtures("unoptimised")

N_RAYS = 90
DISTANCES = np.array([2.0, 3.1, 4.3, 5.2, 6.4, 9.0])
"""Of six cameras, the last for testing. Some are nearer than what is sampled, some farther."""
ONE_DISTANCE = 3.5
"""That of the scene, which is none of theirs."""
OPTIM = OptimConfig(tv_density=0.0, tv_rgb=0.0, accumulate_at=())
BOUNDED = TrainConfig(
    steps=100,
    rays_per_step=N_RAYS,
    threads=1,
    model=Rgb(),
    content_distance="per-camera",
    background="random",
    grid=GridConfig(voxels=7**3, grow_at=(), alpha_init=0.2),
    optim=OPTIM,
    loss=LossConfig(),
    march=MarchConfig(step_voxels=0.7, near=0.15, transmittance_min=1e-2),
)
CONTRACTED = replace(
    BOUNDED,
    scaling="quadratic",
    jacobian="density",
    # Thin, so that light comes to where steps grow.
    grid=replace(BOUNDED.grid, contraction="linf", border=0.3, alpha_init=0.02),
    march=replace(BOUNDED.march, growth=0.09, far=40.0, jitter=False),
    background=(0.2, 0.7, 0.4),
)


def six_views(unbounded: bool = False) -> Scene:
    """Noise seen from a ring around the box [-1, 1]^3, each camera with a distance of its own."""
    scene = tiny_scene(ring(6))
    return replace(
        scene, unbounded=unbounded, content_distance=ONE_DISTANCE, content_distances=DISTANCES
    )


@dataclass
class Step:
    """One update of a trainer, and what it had before."""

    trainer: Trainer
    gradient: Float64  # [X, Y, Z, n_floats]
    of_weights: Float64  # [n_weights]
    problem: Problem


def take_step(trainer: Trainer, monkeypatch: pytest.MonkeyPatch, n_steps: int = 1) -> Step:
    """Update once, from random values; a float32 trainer, so all in float32's numbers."""
    grid, config = trainer.lattice, trainer.config
    rng = np.random.default_rng(5)
    values = trainer.storage.values  # type: ignore[attr-defined]
    raw = rng.normal(size=values.numpy().shape).astype(np.float32)
    raw[:, 0] += 1.0
    values.assign(raw)
    weights = problem_of(trainer.model, 3).weights.astype(np.float32)
    trainer.weights.assign(weights)
    seen: dict[str, Any] = {}

    def watched(parameters: Any, states: Any, gradients: Any, *rest: Any) -> None:
        seen["nodes"] = gradients.values.numpy().astype(np.float64)
        seen["weights"] = gradients.weights.numpy().sum(axis=0)[: len(weights)]
        adam_step(parameters, states, gradients, *rest)

    monkeypatch.setattr(training, "adam_step", watched)
    done = trainer.steps_done
    trainer.update()
    monkeypatch.setattr(training, "adam_step", adam_step)
    assert trainer.steps_done == done + n_steps
    batch, steps = trainer._sampler.draw(done, n_steps), trainer.march_steps()
    origins = batch.origins.numpy().astype(np.float64)
    return Step(
        trainer,
        seen["nodes"].reshape(*grid.size, -1),
        seen["weights"].astype(np.float64),
        replace(
            make_problem(0),
            raw=raw.reshape(*grid.size, -1).astype(np.float64),
            model=trainer.model,
            weights=weights.astype(np.float64),
            box_min=grid.box_min,
            box_max=grid.box_max,
            contraction=grid.contraction,
            border=config.grid.border if grid.contracted and grid.frustum is None else 0.0,
            frustum=grid.frustum,
            density_shift=np.log(np.expm1(-np.log1p(-config.grid.alpha_init))),
            density_scale=1.0 / grid.voxel_size.min(),
            origins=origins,
            directions=batch.directions.numpy().astype(np.float64),
            offsets=batch.offsets.numpy().astype(np.float64),
            background=batch.background.numpy().astype(np.float64),
            target=batch.target_rgb.numpy().astype(np.float64),
            content_distance=distances_of(origins, trainer.scene),
            free=trainer.free.distance.numpy().reshape(trainer.free.size),
            objective=Objective(
                config=config.loss, content_distance=trainer.scene.content_distance
            ),
            steps=Steps(
                near=config.march.near,
                far=config.march.far or steps.far,
                step=config.march.step_voxels * grid.voxel_size.min(),
                n_linear=steps.n_linear,
                growth=config.march.growth if grid.contracted and grid.frustum is None else 0.0,
                transmittance_min=config.march.transmittance_min,
                in_ndc=grid.frustum is not None,
            ),
        ),
    )


def distances_of(origins: Float64, scene: Scene) -> Float64:
    """The content distance of each ray: that of the camera from which it comes."""
    cameras = np.array([camera.position for camera in scene.training_cameras])
    away = np.linalg.norm(origins[:, None] - cameras, axis=2)
    assert away.min(axis=1).max() < 1e-5
    assert scene.content_distances is not None
    return np.asarray(scene.content_distances[away.argmin(axis=1)])


def assert_as_the_oracle(step: Step, n_batches: float = 1.0, tolerance: float = 5e-5) -> None:
    """Loss, samples, and the gradient of so many means over the rays."""
    p, config = step.problem, step.trainer.config
    raw, weights = (torch.tensor(a, requires_grad=True) for a in (p.raw, p.weights))
    losses = oracle_losses(p, raw, weights, config.scaling, config.jacobian)
    found = torch.autograd.grad(
        n_batches * losses.mean(), (raw, weights), allow_unused=True, materialize_grads=True
    )
    assert_close(step.gradient, found[0], tolerance)
    if p.weights.size:
        assert_close(step.of_weights, found[1], tolerance)
    progress = step.trainer.report()
    assert progress.loss == pytest.approx(float(losses.detach().mean()), rel=1e-5)


def scene_and_config(name: str) -> tuple[Scene, TrainConfig]:
    return {
        "bounded": (six_views(), BOUNDED),
        "without scaling": (six_views(), replace(BOUNDED, scaling="none")),
        "all losses": (six_views(), replace(BOUNDED, loss=losses())),
        "an mlp": (six_views(), replace(BOUNDED, model=Deferred())),
        "contracted": (six_views(unbounded=True), CONTRACTED),
        "ndc": (
            replace(facing(), content_distances=DISTANCES[[0, 1, 2, 3, 4, 4]] + np.arange(6.0)),
            replace(BOUNDED, grid=replace(BOUNDED.grid, voxels=600, contraction="ndc", planes=7)),
        ),
    }[name]


def losses() -> LossConfig:
    return replace(LOSSES["all"], near_clip_distance=2.4)


@pytest.mark.parametrize(
    "name", ["bounded", "without scaling", "all losses", "an mlp", "contracted", "ndc"]
)
def test_one_step_against_the_oracle(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, config = scene_and_config(name)
    step = take_step(Trainer(scene, config), monkeypatch)
    p = step.problem
    assert p.contraction == ("linf" if name == "contracted" else "ndc" if name == "ndc" else "none")
    n_drawn = len(np.unique(p.offsets))
    assert n_drawn == (N_RAYS if config.march.jitter else 1) and (p.offsets < 1.0).all()
    assert config.march.jitter or p.offsets[0] == 0.5
    if config.background == "random":
        assert len(np.unique(p.background[:, 0])) > 0.9 * N_RAYS
    else:
        np.testing.assert_allclose(p.background, [config.background] * N_RAYS, atol=1e-6)
    assert len(np.unique(p.content_distance)) >= 5
    assert_as_the_oracle(step)


def test_steps_that_share_an_update_are_added_up(monkeypatch: pytest.MonkeyPatch) -> None:
    config = replace(BOUNDED, optim=replace(OPTIM, accumulate_at=(0.005, 0.006)))
    trainer = Trainer(six_views(), config)
    trainer.update()
    step = take_step(trainer, monkeypatch, n_steps=4)
    assert step.problem.n_rays == 4 * N_RAYS
    assert_as_the_oracle(step, n_batches=4.0)


@pytest.fixture
def look_at_once(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(training, "FIRST_LOOK", 0)
    yield


@pytest.mark.usefixtures("look_at_once")
def test_rays_that_meet_nothing_count_in_the_mean(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where they are not drawn; and free space has no samples."""
    scene = six_views()
    views = []
    for n, view in enumerate(scene.views):  # wide, so that blocks of pixels see past what is there
        c = view.camera
        size = {"width": 80, "height": 60, "fx": 50.0, "fy": 50.0, "cx": 40.0, "cy": 30.0}
        image = picture(n, width=80, height=60)
        views.append(replace(view, camera=replace(c, **size), image=image))
    config = replace(BOUNDED, rays_per_step=300, grid=replace(BOUNDED.grid, voxels=16**3))
    trainer = Trainer(replace(scene, views=views), config)
    raw = np.full((*trainer.lattice.size, 4), -40.0, np.float32)
    raw[5:9, 6:10, 5:8] = 1.0
    trainer.storage.values.assign(raw.reshape(-1, 4))
    trainer.update()
    step = take_step(trainer, monkeypatch)
    p, progress = step.problem, trainer.report()
    assert 0.05 < progress.seen < 0.9 and p.n_rays == pytest.approx(300 * progress.seen, rel=0.2)
    assert p.free.size > 1 and 0.1 < (p.free > 0).mean() < 0.99
    assert_as_the_oracle(step, n_batches=p.n_rays / 300)


def test_the_seed_decides_weights_and_rays() -> None:
    one, same, other = (
        Trainer(six_views(), replace(BOUNDED, model=Deferred(), seed=seed)) for seed in (1, 1, 2)
    )
    for what in (
        lambda trainer: trainer.weights.numpy(),
        lambda trainer: trainer._sampler.draw(0).directions.numpy(),
    ):
        assert np.array_equal(what(one), what(same)) and not np.array_equal(what(one), what(other))


def test_total_variation_joins_as_strongly_as_it_is_asked_to(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of a grid that will grow: by faces as large, steps of an update, and each run's strength."""
    found = []
    smoothed = replace(OPTIM, tv_density=3e-3, tv_rgb=2e-4, tv_every=3, accumulate_at=(0.005,))
    rough = replace(OPTIM, tv_density=0.0, tv_rgb=0.0, accumulate_at=smoothed.accumulate_at)
    for optim in (rough, smoothed):
        grid = GridConfig(voxels=8 * 9**3, grow_at=(0.7, 0.8, 0.9), alpha_init=0.2)
        trainer = Trainer(six_views(), replace(BOUNDED, grid=grid, optim=optim))
        for _ in range(3):
            trainer.update()
        found += [take_step(trainer, monkeypatch, n_steps=2) for _ in range(2)]
    without, without_next, step, following = found
    np.testing.assert_array_equal(without_next.gradient, following.gradient)  # every third update
    np.testing.assert_array_equal(without.problem.origins, step.problem.origins)
    added = step.gradient - without.gradient
    raw = torch.tensor(step.problem.raw, requires_grad=True)
    n_nodes = np.prod(step.trainer.lattice.size)
    face = (8 * 9**3 / n_nodes) ** (2 / 3)
    assert face > 3.0
    weights = face * 3 * 2**0.5 * torch.tensor([3e-3, *3 * [2e-4]], dtype=torch.float64)
    reference.total_variation(raw, weights).backward()
    assert raw.grad is not None
    strength = step.trainer.regulariser.strength.numpy().repeat(TV_BLOCK)[:n_nodes]
    assert strength.min() < 0.9
    expected = raw.grad.numpy() * strength.reshape(*step.trainer.lattice.size, 1)
    touched = without.gradient.any(axis=3)
    assert touched.mean() > 0.2
    assert_close(added[touched], expected[touched], 1e-4)
