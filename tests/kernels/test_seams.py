"""One part is one file: models with parts of their own, the package as it is."""

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import warp as wp
from torch.nn.functional import smooth_l1_loss
from warpnerf_kernels.base.parts import INFINITELY_FAR

from tests.kernels.test_render import early, masked
from tests.reference import distortion_loss
from tests.scenes.test_space import VOXELS, by_differences, observations
from tests.seams.given_distances import AtDistances
from tests.seams.grey import Grey
from tests.seams.ray_losses import WithLosses
from tests.seams.sample_losses import SmoothFeatures, SmoothRgb
from tests.seams.smooth_space import Smooth
from tests.support import probe_kernels
from tests.support.expected import assert_close, directional_differences, oracle
from tests.support.kernel_runner import Kernels
from tests.support.model_problems import problem_of
from tests.support.problems import (
    N_SEEDS,
    Problem,
    in_float32,
    in_frustum,
    make_problem,
    unbounded,
    unscaled,
)
from tests.support.small_model import SQUARED
from tests.support.tiny_scenes import ring, tiny_scene
from warpnerf.checks import InputError
from warpnerf.config import GridConfig, LossConfig, TrainConfig
from warpnerf.model.interface import Model
from warpnerf.model.models import model_of
from warpnerf.model.spaces import SPACES, Linf, normalised, register
from warpnerf.model.storage_kinds import parts_of
from warpnerf.optim_config import OptimConfig
from warpnerf.rendering.losses import Objective, parts_with
from warpnerf.runs.checkpoint import load_field, save_field
from warpnerf.runtime.parallel import Workers
from warpnerf.scenes.extent.space import Space
from warpnerf.scenes.scene import Scene
from warpnerf.training import trainer
from warpnerf.training.train import train

EDGES = tuple(np.concatenate([np.linspace(0.05, 1.5, 13), 1.5 * 1.07 ** np.arange(1, 12)]).tolist())
MODELS: dict[str, Model] = {
    "head": Grey(),
    "loss": WithLosses(near_two=0.3),
    "loss with sums": WithLosses(together=2.0),
    "two losses": WithLosses(near_two=0.3, together=2.0),
    "loss on samples": SmoothRgb(),
    "sampler": AtDistances(edges=EDGES),
}
SUMMED = {"loss", "loss with sums"}
"""Those of two losses."""
each_seam = pytest.mark.parametrize("model", MODELS.values(), ids=MODELS.keys())


def problem(model: Model, seed: int) -> Problem:
    p = make_problem(seed, model=model, offsets=np.random.default_rng(seed).uniform(size=12))
    return early(masked(p, seed)) if seed % 2 else p


def loss_and_gradient(kernels: Kernels, p: Problem) -> tuple[Any, Any]:
    """Loss and gradient without a scaling."""
    return kernels.train(unscaled(p), "clamped")


def loss_of(kernels: Kernels, p: Problem) -> float:
    return float(loss_and_gradient(kernels, p)[0].mean())


@each_seam
def test_gradient_against_central_differences(model: Model, kernels64: Kernels) -> None:
    problems = [problem(model, seed) for seed in range(4)]
    require_gradients_of_differences(problems, kernels64, colours=isinstance(model, SmoothRgb))


def require_gradients_of_differences(
    problems: list[Problem], kernels64: Kernels, colours: bool = False
) -> None:
    """In random directions; of colours only, where weights count as constants."""
    h = 2e-5
    for seed, p in enumerate(problems):
        gradient = loss_and_gradient(kernels64, p)[1]
        rng = np.random.default_rng(seed)
        found, expected = [], []
        for _ in range(12):
            direction = rng.normal(size=p.raw.shape)
            if colours:
                direction[..., 0] = 0.0
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


@pytest.mark.ci
@pytest.mark.parametrize(
    "model",
    [
        pytest.param(m, id=name, marks=pytest.mark.slow if name in SUMMED else ())
        for name, m in MODELS.items()
    ],
)
def test_gradient_on_the_cpu(model: Model, kernels64: Kernels) -> None:
    """In float32, by the form and the workers that training takes, against float64."""
    require_gradients_in_float32([problem(model, seed) for seed in range(4)], kernels64)


def require_gradients_in_float32(problems: list[Problem], kernels64: Kernels) -> None:
    kernels = Kernels("float32", "cpu", threads=3, packed=True)
    for p in map(in_float32, problems):
        exact, found = kernels64.train(p, "clamped"), kernels.train(p, "clamped")
        assert_close(found[0], exact[0], 1e-5)
        assert_close(found[1], exact[1], 2e-5)


@pytest.mark.parametrize("name", ["loss", "loss with sums", "two losses", "loss on samples"])
def test_losses_have_the_vector_form(name: str) -> None:
    assert parts_of(MODELS[name], "float32").have_packs


def test_losses_add_up(kernels64: Kernels) -> None:
    p = problem(MODELS["two losses"], 0)
    plain = replace(p, model=model_of("rgb"))
    alone = [replace(p, model=MODELS[name]) for name in ("loss", "loss with sums")]
    errors = [loss_and_gradient(kernels64, q)[0] for q in (plain, *alone, p)]
    extra = [error - errors[0] for error in errors[1:]]
    assert all((e > 0.0).sum() > 5 for e in extra)
    assert_close(extra[2], extra[0] + extra[1], 1e-12)


def test_values_of_the_losses(kernels64: Kernels) -> None:
    """One ray along z, by hand, from the weights that differences of depth and opacity give."""
    for name, by_hand in (("loss", near_two), ("loss with sums", apart)):
        p = problem(MODELS[name], 0)
        p = replace(p, offsets=np.array([0.5]))
        plain = replace(p, model=model_of("rgb"))
        found = loss_and_gradient(kernels64, p)[0] - loss_and_gradient(kernels64, plain)[0]
        assert_close(found, [by_hand(*weights_of(kernels64, p, n)) for n in range(12)], 1e-9)


def test_value_of_the_loss_on_samples(kernels64: Kernels) -> None:
    """By the oracle's weights and colours; it reaches no density."""
    for seed in range(4):
        p = problem(MODELS["loss on samples"], seed)
        plain = replace(p, model=model_of("rgb"))
        seen = oracle(plain, torch.tensor(p.raw))
        target = torch.tensor(p.target)[:, None].expand_as(seen.colors)
        of_samples = smooth_l1_loss(seen.colors, target, reduction="none", beta=0.3).sum(dim=2)
        expected = 0.5 * (seen.weights * of_samples).sum(dim=1)
        (found, gradient), (without, other) = (
            loss_and_gradient(kernels64, p),
            loss_and_gradient(kernels64, plain),
        )
        assert expected.max() > 0.01
        assert_close(found - without, expected, 1e-9)
        assert np.array_equal(gradient[..., 0], other[..., 0])
        assert np.abs(gradient - other).max() > 0.01 * np.abs(other).max()


@pytest.mark.slow  # compiles for seconds
def test_loss_on_samples_that_an_mlp_colours(kernels64: Kernels) -> None:
    """Only some have a colour, in either form."""
    problems = [problem_of(SmoothFeatures(threshold=0.02), seed) for seed in range(2)]
    require_gradients_of_differences(problems, kernels64, colours=True)
    require_gradients_in_float32(problems, kernels64)


def test_a_model_has_one_loss_on_samples() -> None:
    with pytest.raises(InputError, match=r"sample_colour is above 0, but the model smooth-rgb has"):
        parts_with(SmoothRgb(), "float32", LossConfig(sample_colour=0.1))


@pytest.mark.ci
def test_losses_in_a_frustum_are_those_of_distances_in_the_scene(kernels64: Kernels) -> None:
    """Weights of the oracle, its distances, and lengths of steps by differences of these."""
    packs = Kernels("float32", "cpu", packed=True)
    for seed in range(N_SEEDS):
        plain = in_frustum(problem(model_of("rgb"), seed), seed)
        p = replace(
            plain, objective=Objective(config=LossConfig(distortion=0.7), content_distance=1.3)
        )
        seen, h = oracle(plain, torch.tensor(p.raw)), 1e-4
        later, sooner = (
            oracle(replace(plain, offsets=p.offsets + d), torch.tensor(p.raw)).t for d in (h, -h)
        )
        dt = torch.where(seen.kept, (later - sooner) / (2.0 * h), 0.0)
        expected = 0.7 * distortion_loss(seen.weights, seen.t, dt, 1.3)
        found = loss_and_gradient(kernels64, p)[0] - loss_and_gradient(kernels64, plain)[0]
        assert_close(found, expected, 1e-6)
        exact, rounded = loss_and_gradient(kernels64, in_float32(p)), packs.train(in_float32(p))
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
            assert_close([np.vdot(direction, loss_and_gradient(kernels64, p)[1])], by, 1e-7)


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
        assert_close(
            loss_and_gradient(kernels64, listed)[1], loss_and_gradient(kernels64, plain)[1], 1e-11
        )


def flat_scene() -> Scene:
    """Light grey, wherever one looks."""
    scene = tiny_scene(ring(5))
    for view in scene.views:
        view.image[...] = 200
    return scene


@pytest.mark.ci
@pytest.mark.parametrize("name", ["head", "two losses", "loss on samples", "sampler"])
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
        loss=SQUARED,
        steps=60,
        rays_per_step=200,
        threads=2,
        background="black",
        grid=GridConfig(voxels=1000, grow_at=(), alpha_init=0.05),
        optim=OptimConfig(accumulate_at=()),
    )
    result = train(flat_scene(), config, on_progress=lambda p: losses.append(p.loss))
    assert len(losses) == 60
    assert losses[-1] < 0.1 * losses[0]
    camera = flat_scene().views[-1].camera
    assert np.isfinite(result.field.render(camera).rgb).all()


SMOOTH = Space(
    box_min=np.array([-1.0, -0.5, -2.0]),
    box_max=np.array([0.5, 1.5, 1.0]),
    contraction="smooth",
    border=0.4,
)


def test_a_space_is_the_same_for_kernels_and_host(kernels64: Kernels) -> None:
    """Where points lie and the determinant there, and the inverse and the Jacobian of the host."""
    kind, box, seen = SPACES["smooth"], kernels64.types.Box(), observations(spread=1.8)
    box.border, points = SMOOTH.border, seen.positions
    c = kernels64.zeros(len(points), kernels64.types.vec3)
    det, out, beyond = (kernels64.zeros(len(points)) for _ in range(3))
    kernels64.workers.launch(
        probe_kernels.contract_points_of(kernels64, "smooth"),
        len(points),
        kernels64.array(normalised(SMOOTH, points), kernels64.types.vec3),
        box,
        c,
        det,
        out,
        beyond,
    )
    n = np.abs(normalised(SMOOTH, points)).max(axis=1)
    assert_close(out.numpy(), np.where(n > 1.0, n, 0.0), 1e-12)
    assert (beyond.numpy() == INFINITELY_FAR).all()
    there = kind.contracted(SMOOTH, points)
    assert 20 < (np.abs(there) <= 1.0).all(axis=1).sum() < len(points) - 20
    assert_close(c.numpy(), there, 1e-13)
    np.testing.assert_allclose(kind.expanded(SMOOTH, there), points, rtol=1e-9)
    half, h = 0.5 * (SMOOTH.box_max - SMOOTH.box_min), 1e-6

    def f(points: np.ndarray) -> np.ndarray:
        return kind.contracted(SMOOTH, points) * half

    jacobian = [(f(points + h * axis) - f(points - h * axis)) / (2 * h) for axis in np.eye(3)]
    by = np.abs(np.linalg.det(np.stack(jacobian, axis=-1)))
    np.testing.assert_allclose(det.numpy(), by, rtol=1e-6)
    widths = SMOOTH.voxel_widths(seen, VOXELS, 0.3)
    np.testing.assert_allclose(widths, by_differences(SMOOTH, seen, f, 0.3), rtol=1e-5)


@pytest.mark.ci
def test_gradients_in_another_space(kernels64: Kernels) -> None:
    problems = [unbounded(problem(model_of("rgb"), seed), "smooth", 0.4) for seed in range(4)]
    linf = [replace(p, contraction="linf") for p in problems]
    assert not Kernels("float32", "cpu", packed=True).variant(problems[0]).packed
    assert Kernels("float32", "cpu", packed=True).variant(linf[0]).packed
    require_gradients_of_differences(problems, kernels64)
    require_gradients_in_float32(problems, kernels64)
    for p, other in zip(problems, linf, strict=True):
        assert (
            np.abs(
                loss_and_gradient(kernels64, p)[1] - loss_and_gradient(kernels64, other)[1]
            ).max()
            > 1e-4
        )


@pytest.mark.slow
def test_training_in_another_space(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By its name: it learns, and files hold it; who does not know it is told."""
    monkeypatch.setattr(trainer, "REPORT_EVERY", 1)
    monkeypatch.setattr(trainer, "FIRST_LOOK", 50)  # for free space
    losses: list[float] = []
    grid = GridConfig(voxels=1000, grow_at=(0.7,), alpha_init=0.05, contraction="smooth")
    config = TrainConfig(
        model="rgb",
        loss=SQUARED,
        steps=70,
        rays_per_step=200,
        threads=1,
        background="black",
        coarse_steps=0,
        grid=grid,
        optim=OptimConfig(accumulate_at=()),
    )
    scene = replace(flat_scene(), unbounded=True)
    field = train(scene, config, on_progress=lambda p: losses.append(p.loss)).field
    assert losses[-1] < 0.1 * losses[0]
    assert field.lattice.contracted and field.free.size == (5, 5, 5)
    path, camera = tmp_path / "field.safetensors", scene.views[-1].camera
    save_field(path, field)
    loaded = load_field(path)
    assert loaded.lattice.contraction == "smooth"
    assert np.array_equal(loaded.render(camera).rgb, field.render(camera).rgb)
    lattice = replace(loaded.lattice, contraction="linf")
    storage = replace(loaded.storage, lattice=lattice)
    other = replace(loaded, storage=storage).render(camera)
    assert not np.array_equal(other.rgb, field.render(camera).rgb)
    monkeypatch.delitem(SPACES, "smooth")
    with pytest.raises(InputError, match=r"in the space 'smooth', but .* none, linf, l2, ndc; reg"):
        load_field(path)
    with pytest.raises(
        InputError, match=r"grid\.contraction must be one of auto, none, .*'smooth'"
    ):
        replace(grid)


def test_names_of_spaces_are_given_once() -> None:
    assert register(Smooth) is Smooth
    for taken in ("linf", "smooth", "auto"):
        with pytest.raises(ValueError, match=f"{taken}' is the name of another"):
            register(type("Other", (Linf,), {"name": taken}))


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
