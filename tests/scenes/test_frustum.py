"""Grids in the frustum of a forward-facing capture: where it lies, what it holds and refuses."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from warpnerf_kernels.space import ndc

import warpnerf as wn
from tests.support.small_model import SQUARED
from tests.support.solid_fields import FRUSTUM, ball_field, camera_at
from tests.support.tiny_scenes import camera_at as tiny_camera
from tests.support.tiny_scenes import look_at, picture
from warpnerf.checks import InputError
from warpnerf.exporting.export import export
from warpnerf.exporting.splats import splats_of
from warpnerf.exporting.surface import extract_surface
from warpnerf.exporting.visibility import visibility
from warpnerf.exporting.volume import volume_of
from warpnerf.fields.nodes import cells_within, nodes_of, points_of
from warpnerf.rendering.field import Field
from warpnerf.rendering.rays import camera_rays
from warpnerf.runs.checkpoint import load_checkpoint, load_field, save_checkpoint, save_field
from warpnerf.runtime.parallel import Workers
from warpnerf.scenes.extent.frustum import FARTHEST, contraction_of, fit_frustum
from warpnerf.scenes.scene import Scene, View
from warpnerf.training.trainer import Trainer

PLACES = [(x, 0.1 * x * z - 4.0, z) for x in (-0.6, 0.0, 0.7) for z in (-0.4, 0.5)]


def facing(bounds: tuple[float, float] | None = (2.5, 9.0), turned: float = 0.0) -> Scene:
    """Six cameras beside each other that look along y, one of them turned by so many degrees."""
    views = []
    for n, (x, y, z) in enumerate(PLACES):
        angle = math.radians(turned if n == 2 else 4.0 * n - 8.0)
        target = (x + math.sin(angle), y + math.cos(angle), z)
        camera = tiny_camera(look_at((x, y, z), target), k1=0.05)
        views.append(View(name=f"{n}.png", camera=camera, image=picture(n)))
    return Scene(
        name="facing",
        views=views,
        splits={"train": tuple(range(6)), "test": (0,)},
        box_min=np.full(3, -1.0),
        box_max=np.full(3, 1.0),
        unbounded=True,
        content_distance=4.0,
        bounds=None if bounds is None else np.array([bounds] * 6),
    )


def config(**changes: object) -> wn.TrainConfig:
    values = {
        "steps": 40,
        "rays_per_step": 64,
        "model": "rgb",
        "loss": SQUARED,
        "threads": 1,
        "grid": wn.GridConfig(voxels=4000, planes=16, contraction="ndc"),
    }
    return wn.TrainConfig(**(values | changes))  # type: ignore[arg-type]


def test_coordinates_and_back() -> None:
    points = FRUSTUM.origin + np.random.default_rng(0).uniform(-2.0, 2.0, (50, 3)) + [0, 4, 0]
    e = FRUSTUM.to_ndc(points)
    np.testing.assert_allclose(FRUSTUM.to_scene(e), points, atol=1e-12)
    ahead = FRUSTUM.origin + np.array([0.3, 3.0, -0.6])  # right, forward, down
    np.testing.assert_allclose(FRUSTUM.to_ndc(ahead), [0.1, 0.2, 0.6], atol=1e-12)
    assert np.isnan(FRUSTUM.to_ndc(FRUSTUM.origin - [0.0, 1.0, 0.0])).all()
    assert not np.isfinite(FRUSTUM.to_scene(np.array([0.1, 0.1, FRUSTUM.depth]))).any()


def test_all_that_cameras_see_lies_in_the_box() -> None:
    scene = facing()
    frustum, (low, high) = fit_frustum(scene, 16, 4000)
    assert np.linalg.det(frustum.axes) == pytest.approx(1.0)
    assert frustum.axes[1] @ [0.0, 0.0, -1.0] > 0.99  # z is up
    assert frustum.axes[2] @ [0.0, 1.0, 0.0] > 0.99
    workers, size = Workers("cpu", 1), high - low
    for camera in scene.cameras:
        origins, directions = (a.numpy().astype(float) for a in camera_rays(camera, workers))
        begin = frustum.depths(origins)
        for w in (frustum.near, 3.0 * frustum.near, FARTHEST * frustum.near):
            t = (w - begin) / (directions @ frustum.axes[2])
            assert (t > 0.0).all()
            e = frustum.to_ndc(origins + t[:, None] * directions)
            assert (e > low - 1e-4).all() and (e < high + 1e-4).all()
    assert np.prod(size / size[2] * 15) == pytest.approx(4000, rel=0.1)  # cubes, 16 planes
    tight = fit_frustum(replace(scene, splits={"train": (1, 4), "test": (0,)}), 16, 4000)[1]
    assert (tight[1] - tight[0])[:2].prod() < size[:2].prod()


def test_kernels_end_where_the_box_does() -> None:
    assert ndc.FARTHEST == FARTHEST


def test_the_near_plane_lies_before_the_nearest_content() -> None:
    scene = facing()
    frustum = fit_frustum(scene, 16, 4000)[0]
    bound = np.array([c.position + 2.5 * c.forward for c in scene.cameras])
    nearest = frustum.depths(bound).min()
    assert 0.5 * nearest < frustum.near < nearest
    assert fit_frustum(facing((5.0, 9.0)), 16, 4000)[0].near > 1.8 * frustum.near
    points = fit_frustum(replace(facing(None), near_content=3.0), 16, 4000)[0]
    assert 0.5 * 3.0 < points.near < 3.0
    assert 0.0 < fit_frustum(facing(None), 16, 4000)[0].near < 0.5 * 4.0  # of its distance


@pytest.mark.parametrize(
    ("scene", "says"),
    [
        (facing(turned=60.0), "2.png looks (4[6-9]|5[0-5]) degrees away from the mean"),
        (facing((9.0, 2.5)), "bounds of 0.png, .* must be two depths above 0, the nearer first"),
        (facing((0.0, 2.5)), "not 0 and 2.5"),
        (facing((-1.0, 2.5)), "not -1 and 2.5"),
        (facing((1.0, math.inf)), "not 1 and inf"),
        (facing((1e-4, 2.5)), "nearest lies .* behind the middle of facing's"),
    ],
)
def test_what_is_not_forward_facing_is_refused(scene: Scene, says: str) -> None:
    with pytest.raises(InputError, match=says):
        wn.train(scene, config())


def test_cameras_to_all_sides_are_refused() -> None:
    views = [
        View(
            name=f"{n}.png", camera=tiny_camera(look_at((x, 0, 0), (2 * x, 0, 0))), image=picture(n)
        )
        for n, x in enumerate((1.0, -1.0))
    ]
    scene = replace(facing(), views=views, splits={"train": (0, 1)}, bounds=None)
    with pytest.raises(InputError, match="look to all sides"):
        wn.train(scene, config())


@pytest.mark.parametrize(
    ("scene", "changes", "chosen"),
    [
        (facing(), {}, "ndc"),
        (facing(bounds=None), {}, "linf"),
        (facing(turned=40.0), {}, "linf"),
        (facing(), {"jacobian": "density"}, "linf"),
        (replace(facing(), unbounded=False), {}, "none"),
        (facing(), {"grid": wn.GridConfig(contraction="l2")}, "l2"),
    ],
    ids=["bounds", "no bounds", "one looks away", "jacobian", "bounded", "asked"],
)
def test_captures_with_bounds_that_face_forward_are_trained_in_a_frustum(
    scene: Scene, changes: dict[str, object], chosen: str
) -> None:
    assert contraction_of(scene, config(**({"grid": wn.GridConfig()} | changes))) == chosen


def test_bounds_that_make_no_sense_are_refused_before_anything_is_decided() -> None:
    auto = config(grid=wn.GridConfig())
    with pytest.raises(InputError, match=r"bounds of 0\.png, .* must be two depths"):
        contraction_of(facing((9.0, 2.5)), auto)
    assert contraction_of(facing((9.0, 2.5), turned=50.0), auto) == "linf"


@pytest.mark.parametrize(("march", "says"), [({"near": 1e6}, "near"), ({"far": 1e-3}, "far")])
def test_clip_distances_that_leave_nothing_are_refused(march: dict[str, float], says: str) -> None:
    with pytest.raises(InputError, match=f"march.{says} is .*frustum"):
        Trainer(facing(), config(march=wn.MarchConfig(**march)))


def test_no_term_of_the_jacobian() -> None:
    with pytest.raises(InputError, match=r"jacobian must be none with grid\.contraction ndc"):
        config(jacobian="density")


@pytest.mark.parametrize(
    ("changes", "here"),
    [
        ({"grid": wn.GridConfig(contraction="none")}, "clamped and grid.contraction none"),
        ({"grid": wn.GridConfig(contraction="linf"), "scaling": "none"}, "none and .* linf"),
    ],
)
def test_a_term_of_the_jacobian_that_does_nothing_is_refused(
    changes: dict[str, Any], here: str
) -> None:
    with pytest.raises(InputError, match=f"jacobian paper does nothing .*{here}"):
        Trainer(facing(), config(jacobian="paper", **changes))


@pytest.mark.ci
def test_training_and_going_on(tmp_path: Path) -> None:
    """It learns and grows; the same bits after an interruption; files hold the frustum."""
    scene = facing()
    grid = wn.GridConfig(voxels=4000, planes=16, contraction="ndc", grow_at=(0.8,))
    long = config(steps=300, grid=grid)
    trainer = Trainer(scene, long)
    while trainer.steps_done < 220:
        trainer.update()
    save_checkpoint(tmp_path / "state", trainer.state())
    whole = Trainer(scene, long)
    whole.run()
    assert math.prod(whole.lattice.size) > 1.5 * math.prod(trainer.lattice.size)
    error = whole.report().loss
    assert error < 0.7 * Trainer(scene, config(steps=1)).run().loss
    resumed = Trainer(scene, long, load_checkpoint(tmp_path / "state"))
    resumed.run()
    assert np.array_equal(resumed.storage.values.numpy(), whole.storage.values.numpy())
    save_field(tmp_path / "field", whole.field())
    loaded = load_field(tmp_path / "field", threads=1)
    assert loaded.lattice.frustum is not None and loaded.steps.in_ndc
    camera = scene.cameras[1]
    assert np.array_equal(loaded.render(camera).rgb, whole.field().render(camera).rgb)


def with_lattice(field: Field, **changes: Any) -> Field:
    """The same field with another lattice."""
    lattice = replace(field.lattice, **changes)
    return replace(field, storage=replace(field.storage, lattice=lattice))


def test_a_field_without_its_frustum_is_refused(tmp_path: Path) -> None:
    field = ball_field(contraction="ndc")
    for wrong in (
        with_lattice(field, frustum=None),
        replace(field, steps=replace(field.steps, in_ndc=False)),
        with_lattice(field, contraction="none"),
        with_lattice(field, frustum=replace(FRUSTUM, axes=np.ones((3, 3)))),
        with_lattice(field, frustum=replace(FRUSTUM, near=0.0)),
    ):
        save_field(tmp_path / "field", wrong)
        with pytest.raises(InputError, match="values that cannot be rendered"):
            load_field(tmp_path / "field")


CENTRE = np.array([0.1, -0.05, 0.15])


def test_depth_and_clip_distances_are_in_scene_units() -> None:
    """A red and green ball of 0.6 around CENTRE, seen from 2.5 units before it."""
    field = ball_field(contraction="ndc")
    origin, along = CENTRE - [0.0, 2.5, 0.0], np.array([[0.0, 1.0, 0.0]])
    seen = field.render_rays(origin[None], along)
    assert seen.opacity[0] > 0.99
    assert seen.depth[0] / seen.opacity[0] == pytest.approx(1.9, abs=0.1)
    for steps, opaque in (
        (replace(field.steps, far=1.8), False),
        (replace(field.steps, far=2.1), True),
        (replace(field.steps, near=2.9), True),
        (replace(field.steps, near=3.3), False),
    ):
        opacity = replace(field, steps=steps).render_rays(origin[None], along).opacity[0]
        assert opacity > 0.9 if opaque else opacity < 0.1
    back = field.render_rays((CENTRE - [[0.0, -2.5, 0.0]]), -along)  # from behind
    assert back.depth[0] / back.opacity[0] == pytest.approx(1.9, abs=0.2)
    assert field.render_rays(origin[None], -along).opacity[0] == 0.0
    assert field.render_rays((CENTRE - [0.0, 50.0, 0.0])[None], along).depth[0] == pytest.approx(
        49.4, abs=0.2
    )


def test_node_coordinates_are_those_that_kernels_read() -> None:
    field = ball_field(contraction="ndc")
    nodes = np.random.default_rng(0).uniform(0.0, 40.0, (20, 3))
    points = points_of(field.lattice, nodes)
    np.testing.assert_allclose(nodes_of(field.lattice, points), nodes, atol=1e-9)
    behind = nodes_of(field.lattice, FRUSTUM.origin[None] - [0.0, 1.0, 0.0])
    assert ((behind < 0.0) | (behind > 48.0)).any()


@pytest.mark.ci
def test_surfaces_and_splats_come_out_in_scene_units(tmp_path: Path) -> None:
    field = ball_field(contraction="ndc")
    made = extract_surface(field, level=20.0 * math.log(2.0))
    radii = np.linalg.norm(made.points - CENTRE, axis=1)
    assert np.abs(radii - 0.6).max() < 0.05
    a, b, c = made.points.astype(float)[made.faces].transpose(1, 0, 2)
    volume = np.einsum("ni,ni->", a, np.cross(b, c)) / 6.0
    assert volume == pytest.approx(4.0 / 3.0 * np.pi * 0.6**3, rel=0.05)  # faces look outward
    outward = (made.points - CENTRE) / radii[:, None]
    assert np.mean((outward * made.normals).sum(axis=1)) > 0.95
    red = made.rgb[:, 0] > made.rgb[:, 1]
    clear = np.abs(made.points[:, 0] - CENTRE[0]) > 0.1
    assert np.mean(red[clear] == (made.points[clear, 0] > CENTRE[0])) > 0.95
    half = extract_surface(field, level=20.0 * math.log(2.0), crop=((0.1, -2, -2), (2, 2, 2)))
    assert (half.points[:, 0] >= 0.1).all() and len(half.points) > 0.3 * len(made.points)
    splats = splats_of(field, visibility(field, [camera_at((0.1, -2.6, 0.15))]))
    assert np.median(np.linalg.norm(splats.centres - CENTRE, axis=1)) == pytest.approx(
        0.6, abs=0.06
    )
    assert np.median(splats.opacity) > 0.3
    with pytest.raises(InputError, match="a volume has voxels of one size"):
        volume_of(field)
    with pytest.raises(InputError, match="a volume has voxels of one size"):
        export(field, tmp_path / "ball.npz")
    assert not list(tmp_path.iterdir())


def test_a_box_of_the_scene_crops_its_cells() -> None:
    field = ball_field(contraction="ndc")
    low, high = np.array([0.1, -3.0, -3.0]), np.array([3.0, 3.0, 3.0])
    cropped = replace(
        field,
        free=field.free.cropped(
            field.lattice, cells_within(field.lattice, low, high), field.workers
        ),
    )
    along = np.array([[0.0, 1.0, 0.0]] * 2)
    origins = CENTRE - [[0.3, 2.5, 0.0], [-0.3, 2.5, 0.0]]
    assert (field.render_rays(origins, along).opacity > 0.9).all()
    opacity = cropped.render_rays(origins, along).opacity
    assert opacity[0] == 0.0 and opacity[1] > 0.9
    corners = field.lattice.surroundings
    assert (corners[0] < CENTRE - 0.6).all() and (corners[1] > CENTRE + 0.6).all()
