"""Losses besides the squared error: values, gradients, scaling, packs, training."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import warpnerf as wn
from tests.kernels.test_heads_scaling import at_one_distance
from tests.seams.ray_losses import WithLosses
from tests.support.expected import assert_close
from tests.support.kernel_runner import Kernels
from tests.support.loss_problems import LOSSES, oracle_minimised, problem_with
from tests.support.model_problems import FEATURES, SH, Stale, name_of, problem_of
from tests.support.problems import N_SEEDS, in_float32, unscaled
from tests.support.small_model import SMALL
from tests.support.tiny_scenes import ring, tiny_scene
from tests.support.tiny_trainings import ball
from warpnerf.checks import InputError
from warpnerf.config import GridConfig, LossConfig, TrainConfig
from warpnerf.model.interface import Model
from warpnerf.model.models import Rgb
from warpnerf.optim_config import OptimConfig
from warpnerf.rendering.losses import PHOTOMETRIC_ONLY, Objective, parts_with
from warpnerf.rendering.structs import variant_of
from warpnerf.scenes.scene import Scene
from warpnerf.training import trainer
from warpnerf.training.train import train
from warpnerf.training.trainer import Trainer

each_loss = pytest.mark.parametrize("name", LOSSES)


@each_loss
def test_values_and_gradients_against_autograd(name: str, kernels64: Kernels) -> None:
    for seed in range(N_SEEDS):
        p = problem_with(LOSSES[name], seed)
        if seed < 6:
            require_the_same(kernels64.both_train(unscaled(p), "clamped"), oracle_minimised(p))
        found = kernels64.both_train(p, "clamped")
        require_the_same(found, oracle_minimised(p, "clamped"))
        plain = kernels64.train(replace(p, objective=PHOTOMETRIC_ONLY), "clamped")
        for ours, without in zip(found, plain, strict=False):  # the loss is there
            assert np.abs(ours - without).max() > 1e-3 * np.abs(without).max()


def require_the_same(found: tuple[Any, Any, Any], expected: tuple[Any, Any, Any]) -> None:
    assert_close(found[0], expected[0], 1e-9)
    assert_close(found[1], expected[1], 1e-7)


def test_distortion_where_colours_are_right(kernels64: Kernels) -> None:
    """What lies behind a sample is then bounded by the loss alone."""
    for seed in range(4):
        p = problem_with(LOSSES["distortion"], seed)
        p = replace(p, target=kernels64.forward(replace(p, objective=PHOTOMETRIC_ONLY)).rgb)
        p = unscaled(p)
        assert_close(kernels64.train(p, "clamped")[1], oracle_minimised(p)[1], 1e-7)


@pytest.mark.parametrize("name", ["huber", "distortion", "entropy", "opacity", "near_clip"])
def test_gradients_against_central_differences(name: str, kernels64: Kernels) -> None:
    """Of the others weights are constants, which differences do not know."""
    h, found, expected = 2e-5, [], []
    for seed in range(N_SEEDS):
        p = unscaled(problem_with(LOSSES[name], seed))
        direction = np.random.default_rng(seed).normal(size=p.raw.shape)
        at = {
            k: kernels64.train(replace(p, raw=p.raw + k * h * direction), "clamped")[0].mean()
            for k in (-2, -1, 1, 2)
        }
        near, far = at[1] - at[-1], at[2] - at[-2]
        if abs(2.0 * near - far) <= 1e-5 * abs(far):  # no ray has come to its end, or to delta
            found.append(np.vdot(direction, kernels64.train(p, "clamped")[1]))
            expected.append((8.0 * near - far) / (12.0 * h))
    assert len(found) >= 12
    assert_close(found, expected, 1e-7)


@pytest.mark.parametrize(
    "model", [Rgb(), FEATURES, pytest.param(SH[3], marks=pytest.mark.slow)], ids=name_of
)
def test_packs_of_each_head_of_samples(model: Model, on_cpu: None) -> None:
    assert_packs(LOSSES["all"], model)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in LOSSES if name != "all"])
def test_packs(name: str, on_cpu: None) -> None:
    assert_packs(LOSSES[name], Rgb())


def test_packs_of_a_head_of_rays(on_cpu: None) -> None:
    assert_packs(replace(LOSSES["all"], sample_colour=0.0), SMALL)


def assert_packs(losses: LossConfig, model: Model) -> None:
    """Sixteen samples at a time in float32, by one worker and by three, kept and recomputed."""
    for seed in range(4):
        p = in_float32(problem_with(losses, seed, model, n_rays=37))
        expected = oracle_minimised(p, "clamped")
        for threads, capacity in ((1, 64), (1, 0), (3, 64)):
            kernels = Stale("float32", "cpu", threads=threads, packed=True)
            found = kernels.both_train(p, "clamped", capacity=capacity)
            assert_close(found[0], expected[0], 1e-5)
            assert_close(found[1], expected[1], 2e-5)
            if found[2].size:
                assert_close(found[2], expected[2], 2e-5)


@pytest.mark.ci
def test_losses_with_a_models_own(kernels64: Kernels, on_cpu: None) -> None:
    """They add up, in packs as well, where the model's comes first."""
    own = WithLosses(near_two=0.3, together=2.0)
    p = in_float32(problem_with(LOSSES["distortion"], 2, own, n_rays=37))
    gradients = [
        kernels64.train(unscaled(replace(p, model=model, objective=objective)), "clamped")[1]
        for model, objective in (
            (own, p.objective),
            (own, PHOTOMETRIC_ONLY),
            (Rgb(), p.objective),
            (Rgb(), PHOTOMETRIC_ONLY),
        )
    ]
    expected = gradients[1] + gradients[2] - gradients[3]
    assert_close(gradients[0], expected, 1e-12)
    assert_close(Stale("float32", "cpu", threads=2, packed=True).train(p)[1], expected, 2e-5)


def test_colours_of_samples_with_an_mlp(kernels64: Kernels) -> None:
    """Those of too little weight have no colour, and do not count."""
    for seed in range(4):
        p = problem_with(LOSSES["sample_colour"], seed, FEATURES)
        found, expected = kernels64.both_train(p, "clamped"), oracle_minimised(p, "clamped")
        for ours, theirs, tolerance in zip(found, expected, (1e-9, 1e-7, 1e-7), strict=True):
            assert_close(ours, theirs, tolerance)


def test_colours_of_samples_reach_no_density(kernels64: Kernels) -> None:
    p = problem_with(LOSSES["sample_colour"], 3)
    ours = kernels64.train(p, "clamped")[1]
    plain = kernels64.train(replace(p, objective=PHOTOMETRIC_ONLY), "clamped")[1]
    assert np.array_equal(ours[..., 0], plain[..., 0])
    assert np.abs(ours[..., 1:] - plain[..., 1:]).max() > 0.01 * np.abs(plain[..., 1:]).max()


def test_a_ray_of_one_sample_by_hand(kernels64: Kernels) -> None:
    """Weight w at t: distortion w^2 h / 3, and the other losses as they are defined."""
    p = replace(at_one_distance(problem_of(Rgb(), 5), near=0.4), density_scale=1.0)
    seen = kernels64.forward(p)
    w, rest = seen.opacity, 1.0 - seen.opacity
    c = (seen.rgb - rest[:, None] * p.background) / w[:, None]
    by_hand = {
        "distortion": 0.7 * w**2 * (0.5 / 2.0 - 0.4 / 1.9) / 3.0,
        "entropy": -0.3 * (rest * np.log(rest) + w * np.log(w)),
        "opacity": -0.3 * np.log(w),
        "sample_colour": 0.4 * w * ((c - p.target) ** 2).sum(axis=1),
    }
    squared = ((seen.rgb - p.target) ** 2).sum(axis=1)
    for name, expected in by_hand.items():
        q = replace(p, objective=Objective(config=LOSSES[name], content_distance=1.5))
        assert_close(kernels64.train(q, "clamped")[0] - squared, expected, 1e-9)


@pytest.mark.parametrize("form", ["float64", "packed"])
def test_the_scaling_multiplies_each_once(form: str, device: str) -> None:
    """Rays of one sample each at t = D / 2 return a quarter; at t = 0, nothing."""
    if form == "packed" and device != "cpu":
        pytest.skip("packs of samples are the CPU's form of the kernels")
    kernels = Stale(form.replace("packed", "float32"), device, packed=form == "packed")
    for name in LOSSES if form == "float64" else ("all",):  # compiled for each
        p = at_one_distance(problem_with(LOSSES[name], 5), near=0.4)
        t = p.steps.near + 0.5 * p.steps.step
        quarter, whole = (
            kernels.train(replace(p, content_distance=np.array([d])), "clamped")
            for d in (2.0 * t, 0.5 * t)
        )
        assert np.array_equal(quarter[0], whole[0])
        assert_close(quarter[1], 0.25 * whole[1], 1e-12 if form == "float64" else 1e-6)
        at_camera = replace(at_one_distance(p, near=0.0), offsets=np.array([0.0]))
        far = unscaled(at_camera)
        far = replace(far, steps=replace(far.steps, near=1e-6))
        assert np.abs(kernels.train(far, "clamped")[1]).max() > 1e-3
        assert not kernels.train(at_camera, "clamped")[1].any()


def test_light_that_is_all_there_or_gone_has_no_entropy(kernels64: Kernels) -> None:
    """Nor a slope, where the logarithm would have no end; nor in float32, in either form."""
    for form in (kernels64, Kernels("float32", "cpu", packed=True)):
        for shift in (-40.0, 40.0):
            p = replace(problem_with(LOSSES["entropy"], 0), density_shift=shift)
            p = replace(p, density_scale=10.0, background=p.target)
            loss, gradient = form.train(p, "clamped")
            squared = form.train(replace(p, objective=PHOTOMETRIC_ONLY), "clamped")
            assert np.abs(loss - squared[0]).max() < 1e-5
            assert np.isfinite(gradient).all()
            assert np.abs(gradient - squared[1]).max() < 1e-5


def test_a_ray_that_meets_hardly_anything_has_a_slope_that_ends(kernels64: Kernels) -> None:
    """That of an opacity of 0.01; where there is nothing opaque left, there is nothing to
    change."""
    for shift in (-9.0, -12.0):
        p = replace(problem_with(LOSSES["opacity"], 0), density_shift=shift)
        assert kernels64.forward(replace(p, objective=PHOTOMETRIC_ONLY)).opacity.max() < 0.01
        loss, gradient = kernels64.train(unscaled(p), "clamped")
        expected = oracle_minimised(p)
        assert_close(loss, expected[0], 1e-9)
        assert_close(gradient, expected[1], 1e-7)
    for form in (kernels64, Kernels("float32", "cpu", packed=True)):
        p = replace(problem_with(LOSSES["opacity"], 0), density_shift=-60.0)
        loss, gradient = form.train(p, "clamped")
        assert np.isfinite(loss).all() and np.abs(gradient).max() < 1e-5


@pytest.mark.parametrize("name", ["none", *LOSSES])
def test_weights_are_no_constants_of_kernels(name: str) -> None:
    losses = LOSSES.get(name, LossConfig())
    fields = vars(losses).keys() - {"photometric"}
    if losses.photometric != "huber":
        fields -= {"huber_delta"}
    changed = {field: 2.0 * getattr(losses, field) for field in fields}
    variants = [
        variant_of(Rgb(), "float32", "none", "clamped", "none", True, config)
        for config in (losses, replace(losses, **changed), LossConfig())
    ]
    assert variants[0] == variants[1] and variants[0] is not None
    assert (variants[0] == variants[2]) == (name == "none")
    assert variants[0].packed


def test_a_loss_on_samples_wants_colours_of_samples() -> None:
    with pytest.raises(InputError, match=r"loss\.sample_colour is above 0, but samples"):
        parts_with(SMALL, "float32", LOSSES["sample_colour"])
    with pytest.raises(InputError, match=r"loss\.sample_colour"):
        Trainer(flat_scene(), config_of(LOSSES["sample_colour"], model="deferred"))


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"distortion": -0.1}, "loss.distortion must be a finite number of at least 0"),
        ({"entropy": float("nan")}, "loss.entropy must be a finite number of at least 0"),
        ({"opacity": -1e-3}, "loss.opacity must be a finite number of at least 0"),
        ({"sample_colour": float("inf")}, "loss.sample_colour must be a finite number"),
        ({"near_clip": -1.0}, "loss.near_clip must be"),
        ({"near_clip": 1.0}, "loss.near_clip needs loss.near_clip_distance"),
        ({"near_clip_distance": 1.0}, "loss.near_clip_distance does nothing while loss.near_clip"),
        ({"huber_delta": 0.2}, "loss.huber_delta is 0.2, but loss.photometric is squared"),
        ({"photometric": "l1"}, "loss.photometric must be one of squared, huber"),
        ({"photometric": "huber", "huber_delta": 0.0}, "loss.huber_delta must be"),
    ],
)
def test_bad_weights_are_refused(given: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match=said):
        LossConfig(**given)


def test_photographs_with_alpha_need_not_be_opaque() -> None:
    scene = ball()
    assert scene.has_alpha
    with pytest.raises(InputError, match=r"loss\.opacity is above 0, but photographs of .* alpha"):
        Trainer(scene, config_of(LOSSES["opacity"]))
    mostly_opaque = replace(scene, unbounded=True)
    for losses in (LOSSES["opacity"], LossConfig(opacity="auto")):
        Trainer(mostly_opaque, config_of(losses, background="auto"))


@pytest.mark.slow  # compiles for seconds
def test_opacity_by_auto_is_that_of_photographs_that_show_something_everywhere() -> None:
    auto, black = LossConfig(opacity="auto"), {"background": "black"}
    for scene, changes, weight in (
        (ball(), {"background": "auto"}, 0.0),
        (flat_scene(), {"background": "auto"}, 1e-3),
        (flat_scene(), black, 0.0),
    ):
        found, given = (
            train(scene, config_of(losses, steps=8, **changes)).field.storage.values.numpy()
            for losses in (auto, LossConfig(opacity=weight))
        )
        assert np.array_equal(found, given)
    with pytest.raises(InputError, match=r"loss\.opacity must be auto or a number, not 'much'"):
        LossConfig(opacity="much")  # type: ignore[arg-type]
    for name in ("entropy", "near_clip"):
        with pytest.raises(InputError, match=f"loss.{name} must be a finite number of at least 0"):
            LossConfig(**{name: "auto"})  # type: ignore[arg-type]


def flat_scene() -> Scene:
    """Light grey, wherever one looks."""
    scene = tiny_scene(ring(5))
    for view in scene.views:
        view.image[...] = 200
    return scene


def config_of(losses: LossConfig, **changes: Any) -> TrainConfig:
    return TrainConfig(
        **{"model": "rgb", "steps": 60, "threads": 2, "background": "black", **changes},
        rays_per_step=200,
        grid=GridConfig(voxels=1000, grow_at=(), alpha_init=0.05),
        optim=OptimConfig(accumulate_at=()),
        loss=losses,
    )


@pytest.mark.ci
@pytest.mark.parametrize("name", ["squared", pytest.param("huber", marks=pytest.mark.slow), "all"])
def test_training(name: str, monkeypatch: pytest.MonkeyPatch, device: str) -> None:
    """The loss falls, and is the same again; PSNR is that of the squared error."""
    monkeypatch.setattr(trainer, "REPORT_EVERY", 1)
    losses = {
        "squared": LossConfig(),
        "huber": LossConfig(photometric="huber", huber_delta=0.01),
        "all": LossConfig(
            photometric="huber",
            distortion=0.01,
            entropy=0.001,
            opacity=0.001,
            sample_colour=0.1,
            near_clip=1e-4,
            near_clip_distance=1.0,
        ),
    }[name]
    runs = []
    for _ in range(2):
        shown: list[wn.Progress] = []
        result = train(flat_scene(), config_of(losses, device=device), on_progress=shown.append)
        runs.append((shown, result.field.storage.values.numpy()))
    (first, values), (again, same) = runs
    assert len(first) == 60
    assert first[-1].loss < 0.3 * first[0].loss
    if device == "cpu":
        assert [p.loss for p in first] == [p.loss for p in again]
        assert np.array_equal(values, same)
    squared = 3.0 * 10.0 ** (-first[-1].psnr / 10.0)
    assert (first[-1].loss == pytest.approx(squared)) == (name == "squared")
