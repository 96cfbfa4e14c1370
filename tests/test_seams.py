"""One part is one file: models with parts of their own, the package as it is."""

import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
import warp as wp
from drive import Kernels
from expected import assert_close, directional_differences, oracle
from problems import N_SEEDS, Problem, in_float32, in_frustum, make_problem
from seams.constant_features import OneColour
from seams.given_distances import AtDistances
from seams.grey import Grey
from seams.ray_losses import WithLosses
from test_kernel_render import early, masked
from tiny_scenes import ring, tiny_scene

from warpnerf.config import GridConfig, OptimConfig, TrainConfig
from warpnerf.model.interface import Model, parts_of
from warpnerf.model.models import model_of
from warpnerf.runtime.parallel import Workers
from warpnerf.scenes.scene import Scene
from warpnerf.training import trainer
from warpnerf.training.train import train

EDGES = tuple(np.concatenate([np.linspace(0.05, 1.5, 13), 1.5 * 1.07 ** np.arange(1, 12)]).tolist())
MODELS: dict[str, Model] = {
    "encoding": OneColour(),
    "head": Grey(),
    "loss": WithLosses(near_two=0.3),
    "loss with sums": WithLosses(together=2.0),
    "two losses": WithLosses(near_two=0.3, together=2.0),
    "sampler": AtDistances(edges=EDGES),
}
each_seam = pytest.mark.parametrize("model", MODELS.values(), ids=MODELS.keys())


def problem(model: Model, seed: int) -> Problem:
    p = make_problem(seed, model=model, offsets=np.random.default_rng(seed).uniform(size=12))
    return early(masked(p, seed)) if seed % 2 else p


def loss_of(kernels: Kernels, p: Problem) -> float:
    return float(kernels.train(p)[0].mean())


@each_seam
def test_gradient_against_central_differences(model: Model, kernels64: Kernels) -> None:
    h = 2e-5
    for seed in range(4):
        p = problem(model, seed)
        gradient = kernels64.train(p)[1]
        rng = np.random.default_rng(seed)
        found, expected = [], []
        for _ in range(12):
            direction = rng.normal(size=p.raw.shape)
            direction[0, 0, 0] *= 5.0  # where the encoding's features are
            at = {
                k: loss_of(kernels64, replace(p, raw=p.raw + k * h * direction))
                for k in (-2, -1, 1, 2)
            }
            near, far = at[1] - at[-1], at[2] - at[-2]
            if abs(2.0 * near - far) <= 1e-5 * abs(far):  # no ray has come to its end
                found.append(np.vdot(direction, gradient))
                expected.append((8.0 * near - far) / (12.0 * h))
        assert len(found) >= 6
        assert_close(found, expected, 1e-7)


@each_seam
def test_gradient_on_the_cpu(model: Model, kernels64: Kernels) -> None:
    """In float32, by the form and the workers that training takes, against float64."""
    kernels = Kernels("float32", "cpu", threads=3, packed=True)
    for seed in range(4):
        p = in_float32(problem(model, seed))
        exact, found = kernels64.train(p, "clamped"), kernels.train(p, "clamped")
        assert_close(found[0], exact[0], 1e-5)
        assert_close(found[1], exact[1], 2e-5)


@pytest.mark.parametrize("name", ["loss", "loss with sums", "two losses"])
def test_losses_have_the_vector_form(name: str) -> None:
    assert parts_of(MODELS[name], "float32").have_packs


def test_losses_add_up(kernels64: Kernels) -> None:
    p = problem(MODELS["two losses"], 0)
    plain = replace(p, model=model_of("rgb"))
    alone = [replace(p, model=MODELS[name]) for name in ("loss", "loss with sums")]
    errors = [kernels64.train(q)[0] for q in (plain, *alone, p)]
    extra = [error - errors[0] for error in errors[1:]]
    assert all((e > 0.0).sum() > 5 for e in extra)
    assert_close(extra[2], extra[0] + extra[1], 1e-12)


def test_values_of_the_losses(kernels64: Kernels) -> None:
    """One ray along z, by hand, from the weights that differences of depth and opacity give."""
    for name, by_hand in (("loss", near_two), ("loss with sums", apart)):
        p = problem(MODELS[name], 0)
        p = replace(p, offsets=np.array([0.5]))
        found = kernels64.train(p)[0] - kernels64.train(replace(p, model=model_of("rgb")))[0]
        assert_close(found, [by_hand(*weights_of(kernels64, p, n)) for n in range(12)], 1e-9)


def test_losses_in_a_frustum_are_those_of_distances_in_the_scene(kernels64: Kernels) -> None:
    """Weights of the oracle, its distances, and lengths of steps by differences of these."""
    packs = Kernels("float32", "cpu", packed=True)
    for seed in range(N_SEEDS):
        p = in_frustum(problem(MODELS["loss with sums"], seed), seed)
        plain = replace(p, model=model_of("rgb"))
        seen, h = oracle(plain, torch.tensor(p.raw)), 1e-4
        later, sooner = (
            oracle(replace(plain, offsets=p.offsets + d), torch.tensor(p.raw)).t for d in (h, -h)
        )
        dt = torch.where(seen.kept, (later - sooner) / (2.0 * h), 0.0).numpy()
        t = torch.where(seen.kept, seen.t, 0.0).numpy()
        expected = [apart(*ray) for ray in zip(seen.weights.numpy(), t, dt, strict=True)]
        found = kernels64.train(p)[0] - kernels64.train(plain)[0]
        assert_close(found, expected, 1e-6)
        exact, rounded = kernels64.train(in_float32(p)), packs.train(in_float32(p))
        assert_close(rounded[0], exact[0], 5e-5)
        assert_close(rounded[1], exact[1], 5e-5)
        direction = np.random.default_rng(seed).normal(size=p.raw.shape)
        if seed % 2 == 0:  # no ray comes to its end
            by = directional_differences(
                lambda raw, p=p: loss_of(kernels64, replace(p, raw=raw)),
                p.raw,
                direction[None],
                h=2e-5,
            )
            assert_close([np.vdot(direction, kernels64.train(p)[1])], by, 1e-7)


def weights_of(kernels: Kernels, p: Problem, ray: int) -> tuple[Any, Any, float]:
    """Weights, distances and the length of steps of a ray, found by ending it ever later."""
    step = p.steps.step
    ends = p.steps.near + step * np.arange(1, 40)
    one = replace(
        p,
        origins=np.repeat(p.origins[[ray]], len(ends), axis=0),
        directions=np.repeat(p.directions[[ray]], len(ends), axis=0),
        background=p.background[[ray]],
    )
    opacity = []
    for n, end in enumerate(ends):
        far = min(end, p.steps.far)
        cut = replace(one, steps=replace(p.steps, far=far))
        opacity.append(kernels.forward(cut).opacity[n])
    return np.diff(opacity, prepend=0.0), ends - 0.5 * step, step


def near_two(weights: Any, t: Any, dt: float) -> float:
    return 0.3 * float((weights * (t - 2.0) ** 2).sum())


def apart(weights: Any, t: Any, dt: float) -> float:
    pairs = (t[:, None] - t) ** 2 * weights[:, None] * weights
    return 2.0 * float(pairs.sum())


def test_given_distances_of_equal_steps_are_those_of_the_march(kernels64: Kernels) -> None:
    for seed in range(4):
        p = replace(problem(model_of("rgb"), seed), content_distance=np.array([1.0]))
        n = int(np.ceil((p.steps.far - p.steps.near) / p.steps.step))
        edges = tuple(p.steps.near + p.steps.step * np.arange(n + 1))
        listed = replace(p, model=AtDistances(edges=edges))
        plain = replace(p, steps=replace(p.steps, far=edges[-1]))
        assert_close(kernels64.forward(listed).rgb, kernels64.forward(plain).rgb, 1e-12)
        assert_close(kernels64.train(listed)[1], kernels64.train(plain)[1], 1e-11)


def flat_scene() -> Scene:
    """Light grey, wherever one looks."""
    scene = tiny_scene(ring(5))
    for view in scene.views:
        view.image[...] = 200
    return scene


@pytest.mark.parametrize("name", ["encoding", "head", "two losses", "sampler"])
def test_training(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trainer, "REPORT_EVERY", 1)
    model: Any = MODELS[name]
    if name == "head":
        model = "grey"  # which is registered
    if name == "two losses":  # that let some colour be learned
        model = WithLosses(near_two=0.003, together=0.01)
    if name == "sampler":
        model = AtDistances(edges=tuple(np.linspace(1.0, 5.0, 41).tolist()))
    losses: list[float] = []
    config = TrainConfig(
        model=model,
        steps=60,
        rays_per_step=200,
        threads=2,
        background="black",
        grid=GridConfig(voxels=1000, grow_at=(), alpha_init=0.05),
        optim=OptimConfig(accumulate_at=()),
    )
    result = train(flat_scene(), config, on_progress=lambda p: losses.append(p.loss))
    assert len(losses) == 60
    assert losses[-1] < 0.2 * losses[0]
    camera = flat_scene().views[-1].camera
    assert np.isfinite(result.field.render(camera).rgb).all()


def test_mistakes_in_a_part_are_shown_as_they_are() -> None:
    """They are no damage to the cache of compiled kernels, which stays in use."""

    @wp.kernel(module="unique", enable_backward=False)
    def mistaken(first: int, out: wp.array(dtype=float)):
        out[first + wp.tid()] = wp.no_such_function(1.0)

    folder = wp.config.kernel_cache_dir
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(Exception, match="no_such_function"):
            Workers("cpu", 1).launch(mistaken, 1, wp.zeros(1, device="cpu"))
    assert wp.config.kernel_cache_dir == folder
