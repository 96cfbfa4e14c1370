"""What a training begins with in a given box: its grid, its steps, how far it looks."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.support.tiny_scenes import picture, ring, tiny_scene
from warpnerf.checks import InputError
from warpnerf.config import GridConfig, MarchConfig, TrainConfig
from warpnerf.optim_config import OptimConfig
from warpnerf.scenes.extent.space_plan import resolve_space
from warpnerf.scenes.scene import Scene
from warpnerf.training import extent
from warpnerf.training import trainer as training
from warpnerf.training.trainer import Trainer

pytestmark = pytest.mark.usefixtures("unoptimised")

BOX = np.array([-1.0, -0.7, -0.5]), np.array([1.4, 0.8, 0.6])
CONFIG = TrainConfig(
    steps=100,
    rays_per_step=64,
    threads=1,
    model="rgb",
    grid=GridConfig(voxels=4000, grow_at=(0.5, 0.6), alpha_init=0.02),
    march=MarchConfig(step_voxels=0.8, near=0.25, transmittance_min=3e-3),
    optim=OptimConfig(accumulate_at=()),
)


def config_for(unbounded: bool) -> TrainConfig:
    """CONFIG, with border and growth where space is contracted."""
    if not unbounded:
        return CONFIG
    return replace(
        CONFIG,
        grid=replace(CONFIG.grid, border=0.3),
        march=replace(CONFIG.march, growth=0.07),
    )


def scene_in_box(unbounded: bool) -> Scene:
    scene = tiny_scene(ring(6, radius=2.0))
    return replace(scene, box_min=BOX[0], box_max=BOX[1], unbounded=unbounded)


@pytest.mark.parametrize("unbounded", [False, True])
def test_the_first_grid_is_empty_but_for_the_density_that_is_asked_for(unbounded: bool) -> None:
    grid = Trainer(scene_in_box(unbounded), config_for(unbounded)).storage
    np.testing.assert_array_equal([grid.lattice.box_min, grid.lattice.box_max], BOX)
    assert not grid.values.numpy().any()
    assert grid.lattice.border == (0.3 if unbounded else 0.0)
    assert math.prod(grid.lattice.size) == pytest.approx(1000, rel=0.3)  # it doubles twice
    edges = BOX[1] - BOX[0]
    edge = (np.prod(edges) / 4000) ** (1 / 3) * (1.3 if unbounded else 1.0)
    # Over an edge of the final grid, raw densities of 0 are as opaque as alpha_init says.
    sigma = grid.density_scale * math.log1p(math.exp(grid.density_shift))
    assert 1.0 / grid.density_scale == pytest.approx(edge, rel=0.1)
    assert 1.0 - math.exp(-sigma / grid.density_scale) == pytest.approx(0.02)


@pytest.mark.parametrize("far", [None, 5.0])
@pytest.mark.parametrize("unbounded", [False, True])
def test_steps_are_as_long_as_they_are_asked_to_be(unbounded: bool, far: float | None) -> None:
    scene = scene_in_box(unbounded)
    config = config_for(unbounded)
    trainer = Trainer(scene, replace(config, march=replace(config.march, far=far)))
    steps = trainer.march_steps()
    assert steps.step == pytest.approx(0.8 * trainer.lattice.voxel_size.min())
    assert (steps.near, steps.transmittance_min, steps.in_ndc) == (0.25, 3e-3, False)
    assert steps.growth == (0.07 if unbounded else 0.0)
    cameras = np.array([camera.position for camera in scene.training_cameras])
    away = np.linalg.norm(cameras - np.mean(BOX, axis=0), axis=1).max()
    farthest = away + 0.5 * np.linalg.norm(BOX[1] - BOX[0])  # the end of a ball around the box
    end = farthest - 0.25  # up to there all are of one length
    if unbounded:
        assert end <= steps.n_linear * steps.step < end + steps.step
    else:
        assert steps.n_linear == 0
    # Half the longest edge of the box is 1.2.
    everything = 0.25 + 64.0 * 1.2 + farthest if unbounded else 1e30
    assert steps.far == pytest.approx(everything if far is None else far)


def test_near_and_far_that_leave_no_sample_are_refused() -> None:
    """Compared with the farthest corner for near, the nearest camera for far."""
    scene = scene_in_box(unbounded=False)
    cameras = np.array([camera.position for camera in scene.training_cameras])
    outside = np.maximum(0.0, np.maximum(BOX[0] - cameras, cameras - BOX[1]))
    across = np.maximum(np.abs(BOX[0] - cameras), np.abs(BOX[1] - cameras))
    begin = np.linalg.norm(outside, axis=1).min()
    end = np.linalg.norm(across, axis=1).max()
    space = resolve_space(scene, CONFIG)
    for march in (MarchConfig(near=0.999 * end), MarchConfig(far=1.001 * begin)):
        extent.require_samples(scene, space, march)
    with pytest.raises(InputError, match=r"^march\.near is .* use a smaller --near\.$"):
        extent.require_samples(scene, space, MarchConfig(near=1.001 * end))
    with pytest.raises(InputError, match=r"^march\.far is .* use a larger one\.$"):
        extent.require_samples(scene, space, MarchConfig(far=0.999 * begin))
    around = replace(scene, unbounded=True)  # where there is something at any distance
    extent.require_samples(around, resolve_space(around, CONFIG), MarchConfig(far=0.999 * begin))


@pytest.mark.parametrize("unbounded", [False, True])
def test_steps_of_which_no_kernel_would_come_to_an_end_are_refused(unbounded: bool) -> None:
    """By the box, of 2 or 3 units across, and by the reach; in grids of a hundredth of a unit."""
    scene, config = scene_in_box(unbounded), config_for(unbounded)
    space = resolve_space(scene, config)
    across = float(np.linalg.norm(BOX[1] - BOX[0]))
    edge = float(space.voxel_edges((9, 9, 9)).min())
    least = across / (edge * 2**16)
    for share, far_away in ((1.01, 9.0), (0.99, 9.0), (1.01, 0.99 * 2**8 * across)):
        march = replace(config.march, step_voxels=share * least)
        if share > 1.0:
            extent.march_steps(march, space, (9, 9, 9), far_away)
            continue
        with pytest.raises(InputError, match=r"^march\.step_voxels .* 65536 steps; use a longer"):
            extent.march_steps(march, space, (9, 9, 9), far_away)
    march = replace(config.march, step_voxels=1.01 * least)
    with pytest.raises(InputError, match=r"^march\.step_voxels .* 16777216 steps; use a longer"):
        extent.march_steps(march, space, (9, 9, 9), 1.02 * 2**8 * across)
    for step_voxels in (1e-320, 5e-324):
        with pytest.raises(InputError, match="is too short"):
            Trainer(scene, replace(config, march=replace(config.march, step_voxels=step_voxels)))
    with pytest.raises(InputError, match=r"^march\.near is 1e\+308"):
        Trainer(scene, replace(config, march=replace(config.march, near=1e308)))


def with_alpha(scene: Scene) -> Scene:
    views = [replace(view, image=picture(n, channels=4)) for n, view in enumerate(scene.views)]
    return replace(scene, views=views)


@pytest.mark.parametrize(
    ("background", "shown", "shown_with_alpha"),
    [
        ("auto", (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)),
        ("white", (1.0, 1.0, 1.0), (1.0, 1.0, 1.0)),
        ("black", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        ("random", (1.0, 1.0, 1.0), (1.0, 1.0, 1.0)),
        ((0.2, 0.4, 0.6), (0.2, 0.4, 0.6), (0.2, 0.4, 0.6)),
    ],
)
def test_what_is_behind_the_scene_is_what_is_asked_for(
    background: object, shown: tuple[float, ...], shown_with_alpha: tuple[float, ...]
) -> None:
    """Random colours are for training; a field is shown before white then."""
    scene = scene_in_box(unbounded=False)
    for photographs, expected in ((scene, shown), (with_alpha(scene), shown_with_alpha)):
        trainer = Trainer(photographs, replace(CONFIG, background=background))
        assert trainer.field().background == expected
        drawn = trainer._sampler.draw(0).background.numpy()
        if background == "random":
            assert len(np.unique(drawn)) > 0.9 * drawn.size
        else:
            np.testing.assert_allclose(drawn, [expected] * len(drawn), atol=1e-6)


@pytest.mark.ci
def test_in_folded_space_all_pixels_are_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where the box holds next to nothing: rays see what is behind it."""
    monkeypatch.setattr(training, "FIRST_LOOK", 0)
    shares = []
    for unbounded in (True, False):
        scene = scene_in_box(unbounded)
        size = {"width": 80, "height": 60, "fx": 50.0, "fy": 50.0, "cx": 40.0, "cy": 30.0}
        views = [
            replace(
                view,
                camera=replace(view.camera, **size),
                image=picture(n, width=80, height=60),
            )
            for n, view in enumerate(scene.views)
        ]
        trainer = Trainer(replace(scene, views=views), CONFIG)
        middle = np.array(trainer.lattice.size) // 2
        raw = np.full((*trainer.lattice.size, 4), -60.0, np.float32)
        raw[tuple(slice(m - 1, m + 1) for m in middle)] = 3.0
        trainer.storage.values.assign(raw.reshape(-1, 4))
        trainer.update()
        assert trainer.report().occupied < 0.8
        shares.append(trainer.report().seen)
        assert trainer._sampler.draw(1).count == round(64 * shares[-1])
    assert shares[0] == 1.0 and shares[1] < 0.9


@pytest.mark.parametrize(("border", "growth"), [(0.2, 0.1), (0.5, 0.04), (1.0, 0.02), (0.05, 0.1)])
def test_steps_grow_as_the_border_says_unless_they_are_told(border: float, growth: float) -> None:
    march = MarchConfig(near=0.25)
    config = replace(CONFIG, march=march, grid=replace(CONFIG.grid, border=border))
    assert Trainer(scene_in_box(True), config).march_steps().growth == pytest.approx(growth)
    told = replace(config, march=replace(march, growth=0.03))
    assert Trainer(scene_in_box(True), told).march_steps().growth == 0.03
