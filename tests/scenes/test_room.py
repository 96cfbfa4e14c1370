"""The built-in scenes: their pictures, their true depth, and the cameras in the room."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from warpnerf.scenes.builtin import raytrace, room, room_textures
from warpnerf.scenes.builtin.solids import Ball, Box, Cylinder, Room
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.formats.load import load_scene
from warpnerf.scenes.scene import Scene, View


@pytest.fixture(scope="module")
def dense() -> Scene:
    return load_scene("builtin:room")


@pytest.fixture(scope="module")
def sparse() -> Scene:
    return load_scene("builtin:room-sparse")


@pytest.fixture(params=["dense", "sparse"])
def scene(request: pytest.FixtureRequest) -> Scene:
    found: Scene = request.getfixturevalue(request.param)
    return found


@pytest.fixture(scope="module")
def solids() -> tuple[Box, ...]:
    return room._tracer().solids


def pixel_rays(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Origins and unit directions [H * W, 3] through pixel centres, written again on purpose."""
    v, u = np.mgrid[: camera.height, : camera.width]
    local = np.stack(
        [
            (u + 0.5 - camera.cx) / camera.fx,
            -(v + 0.5 - camera.cy) / camera.fy,
            np.full(u.shape, -1.0),
        ],
        axis=-1,
    ).reshape(-1, 3)
    directions = np.einsum("ij,nj->ni", camera.c2w[:, :3], local)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return np.broadcast_to(camera.c2w[:, 3], directions.shape), directions


def points_of(view: View) -> np.ndarray:
    """What each pixel sees, [H * W, 3]."""
    origins, directions = pixel_rays(view.camera)
    assert view.depth is not None
    return origins + directions * view.depth.reshape(-1, 1)


def box_distance(points: np.ndarray, lo: np.ndarray, hi: np.ndarray) -> np.ndarray:
    q = np.maximum(lo - points, points - hi)
    return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)


def clearance(points: np.ndarray, solids: tuple[Box, ...]) -> np.ndarray:
    """Signed distance [n] from points [n, 3] to the nearest surface: an oracle without rays."""
    distances = []
    for solid in solids:
        lo, hi = np.array(solid.lo), np.array(solid.hi)
        centre, radius = (lo + hi) / 2, (hi - lo)[0] / 2
        if isinstance(solid, Room):
            distances.append(-box_distance(points, lo, hi))
        elif isinstance(solid, Ball):
            distances.append(np.linalg.norm(points - centre, axis=1) - radius)
        elif isinstance(solid, Cylinder):
            side = np.linalg.norm((points - centre)[:, :2], axis=1) - radius
            cap = np.abs(points - centre)[:, 2] - (hi - lo)[2] / 2
            outside = np.hypot(np.maximum(side, 0), np.maximum(cap, 0))
            distances.append(outside + np.minimum(np.maximum(side, cap), 0))
        else:
            distances.append(box_distance(points, lo, hi))
    return np.min(distances, axis=0)


@pytest.mark.ci
@pytest.mark.parametrize(
    ("kind", "called", "first", "n_train"),
    [
        ("dense", "builtin:room", "train_000.png", 120),
        ("sparse", "builtin:room-sparse", "train_00.png", 30),
    ],
)
def test_the_scene_is_complete(
    request: pytest.FixtureRequest, kind: str, called: str, first: str, n_train: int
) -> None:
    scene: Scene = request.getfixturevalue(kind)
    names = [view.name for view in scene.views]
    assert names == sorted(set(names)) and {first, "test_00.png"} <= set(names)
    train, test = scene.splits["train"], scene.splits["test"]
    assert (len(train), len(test)) == (n_train, 10)
    assert sorted((*train, *test)) == list(range(n_train + 10))
    assert all(names[index].startswith("train_") for index in train)
    assert np.allclose(scene.box_min, [-2.05, -2.55, -0.05])
    assert np.allclose(scene.box_max, [2.05, 2.55, 2.65])
    assert scene.name == called and not scene.unbounded and len(scene.notes) == 1
    depths = np.stack([scene.views[index].depth for index in train])
    assert scene.content_distance == pytest.approx(np.median(depths))


def test_the_sparse_scene_is_a_part_of_the_other(dense: Scene, sparse: Scene) -> None:
    for a, b in zip(sparse.views, dense.views, strict=False):
        assert a.depth is not None and b.depth is not None
        np.testing.assert_array_equal(a.camera.c2w, b.camera.c2w)
        np.testing.assert_array_equal(a.image, b.image)
        np.testing.assert_array_equal(a.depth, b.depth)


def test_the_sparse_scene_is_that_of_the_records(sparse: Scene) -> None:
    """It was called builtin:room when most figures in benchmarks/results were measured."""
    assert sparse.content_distance == pytest.approx(2.1522862911, rel=1e-6)
    places = np.array([camera.position for camera in sparse.cameras])
    assert places.mean(axis=0) == pytest.approx([0.21175, -0.05375, 1.185], abs=1e-4)
    brightness = np.mean([view.image.mean() for view in sparse.views])
    assert brightness == pytest.approx(110.21, abs=0.01)


def seen_by(scene: Scene, points: np.ndarray, within: float) -> np.ndarray:
    """By how many training views points [n, 3] are seen: none hidden more than ``within`` deep."""
    times = np.zeros(len(points), int)
    for index in scene.splits["train"]:
        camera, depth = scene.views[index].camera, scene.views[index].depth
        assert depth is not None
        local = (points - camera.position) @ camera.c2w[:, :3]
        with np.errstate(divide="ignore", invalid="ignore"):
            u = camera.fx * local[:, 0] / -local[:, 2] + camera.cx
            v = -camera.fy * local[:, 1] / -local[:, 2] + camera.cy
        inside = (local[:, 2] < 0) & (u >= 0) & (u < 160) & (v >= 0) & (v < 120)
        i, j = (np.where(inside, at, 0).astype(int) for at in (v, u))
        times += inside & (np.linalg.norm(local, axis=1) < depth[i, j] + within)
    return times


def test_of_what_test_views_see_the_dense_scene_shows_nearly_all(
    dense: Scene, sparse: Scene
) -> None:
    """The share of a test view's pixels that fewer than three training views see."""

    def worst(scene: Scene) -> float:
        seen = (points_of(scene.views[index])[::5] for index in scene.splits["test"])
        return max(float(np.mean(seen_by(scene, points, 0.05) < 3)) for points in seen)

    assert worst(dense) < 0.01
    assert worst(sparse) > 0.2


def test_the_dense_scene_looks_through_the_space_before_test_views(
    dense: Scene, sparse: Scene
) -> None:
    """Near a camera, what no training view looks through fills with fog."""

    def fewest(scene: Scene) -> float:
        """Median over a view's rays of how many training views look through, 0.4 m from it."""
        rays = (pixel_rays(scene.views[index].camera) for index in scene.splits["test"])
        near = ((origins + 0.4 * directions)[::50] for origins, directions in rays)
        return min(float(np.median(seen_by(scene, points, -0.5))) for points in near)

    assert fewest(dense) >= 15
    assert fewest(sparse) <= 3


def test_images_show_something(scene: Scene) -> None:
    for view in scene.views:
        assert view.image.shape == (120, 160, 3) and view.image.dtype == np.uint8
        assert view.depth is not None and view.depth.shape == (120, 160)
        assert view.depth.dtype == np.float32 and np.isfinite(view.depth).all()
        assert view.image.std(axis=(0, 1)).min() > 15, view.name
        assert 50 < view.image.mean() < 200, view.name
        assert np.mean(view.image == 255) < 0.1 and np.mean(view.image == 0) < 0.1, view.name
        # Fine structure: neighbours differ, yet are no noise.
        steps = np.abs(np.diff(view.image.astype(float), axis=1)).mean()
        assert 1.0 < steps < 0.6 * view.image.std(), view.name


@pytest.mark.slow  # builds all of the room twice
def test_building_twice_gives_the_same() -> None:
    first = room.room_scene(downscale=5)
    room._tracer.cache_clear()
    room_textures._noise_table.cache_clear()
    second = room.room_scene(downscale=5)
    assert first.content_distance == second.content_distance
    for a, b in zip(first.views, second.views, strict=True):
        assert a.depth is not None and b.depth is not None
        assert np.array_equal(a.image, b.image) and np.array_equal(a.depth, b.depth)
        assert np.array_equal(a.camera.c2w, b.camera.c2w)


def test_views_do_not_depend_on_the_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    scenes = []
    for threads in (1, 3):
        monkeypatch.setattr(raytrace, "usable_cores", lambda threads=threads: threads)
        scenes.append(room.room_scene(downscale=5, sparse=True))
    for a, b, camera in zip(*(scene.views for scene in scenes), scenes[0].cameras, strict=True):
        image, depth = room.photograph(camera, samples=4)
        for view in (a, b):
            assert np.array_equal(view.image, image) and np.array_equal(view.depth, depth)


def test_remainders_are_those_of_numpy() -> None:
    x = np.random.default_rng(0).normal(0, 30, 10_000).astype(np.float32)
    x[:3] = -1.0, 0.0, 2.0
    np.testing.assert_array_equal(room_textures._part(x), np.mod(x, 1))
    np.testing.assert_array_equal(room_textures._odd(x), np.floor(x) % 2)


def test_depth_is_the_first_hit_through_pixel_centres(scene: Scene) -> None:
    for view in scene.views[::6]:
        assert view.depth is not None
        distance = room.first_hit(*pixel_rays(view.camera))
        assert np.allclose(view.depth.ravel(), distance, rtol=1e-6, atol=0)


def test_first_hit_against_a_distance_field(solids: tuple[Box, ...], scene: Scene) -> None:
    rng = np.random.default_rng(0)
    origins = scene.views[0].camera.position + np.zeros((4000, 3))
    origins[::2] = scene.views[30].camera.position
    directions = rng.normal(size=origins.shape)
    directions[:3] = np.eye(3)  # along the axes: one over zero
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    t = room.first_hit(origins, directions)
    assert t.dtype == np.float64
    assert np.abs(clearance(origins + t[:, None] * directions, solids)).max() < 1e-9
    share = rng.uniform(0, 0.999999, size=(25, len(t), 1))
    between = origins + share * t[:, None] * directions
    assert clearance(between.reshape(-1, 3), solids).min() > 0
    beyond = origins + (t[:, None] + 1e-4) * directions
    grazing = clearance(beyond, solids) > 0  # beyond a thin edge
    assert grazing.mean() < 0.02
    assert np.all(room.first_hit(beyond[~grazing], directions[~grazing]) == 0)


@pytest.mark.parametrize(
    ("origin", "direction", "distance"),
    [
        ((0.5, 0.0, 1.5), (0, 0, -1), 1.5 - 0.012),  # the rug
        ((1.2, 1.8, 1.0), (0, 0, 1), 1.6),  # the ceiling
        ((1.2, -1.5, 1.0), (1, 0, 0), 0.8),  # the wall
        ((1.76, -0.55, 1.5), (0, 0, -1), 1.5 - 0.87),  # the globe
        ((-0.45, 0.05, 1.0), (0, 0, 1), 0.97),  # the pendant's lower cap
        ((0.8, -1.0, 0.45), (0, 1, 0), 0.35),  # the stool's rim
        ((-1.8, 0.0, 0.5), (0, 0, 1), 0.0),  # from inside the sofa
        ((3.0, 0.0, 1.0), (-1, 0, 0), 0.0),  # from outside the room
    ],
)
def test_first_hit_where_it_is_known(
    origin: tuple[float, ...], direction: tuple[float, ...], distance: float
) -> None:
    found = room.first_hit(np.array([origin]), np.array([direction], float))
    assert found == pytest.approx([distance], abs=1e-12)


def test_first_hit_refuses_directions_that_are_not_of_unit_length() -> None:
    with pytest.raises(ValueError, match="unit"):
        room.first_hit(np.array([[0.0, 0.0, 1.5]]), np.array([[0.0, 0.0, 2.0]]))


def test_cameras_are_upright_and_clear_of_everything(scene: Scene, solids: tuple[Box, ...]) -> None:
    for camera in scene.cameras:
        rotation = camera.c2w[:, :3]
        assert np.allclose(rotation.T @ rotation, np.eye(3)) and np.linalg.det(rotation) > 0
        assert rotation[2, 1] > 0.6, "up"
        assert abs(rotation[2, 0]) < 0.1, "right is level"
        field = 2 * np.degrees(np.arctan(camera.width / 2 / camera.fx))
        assert field == pytest.approx(65.0) and camera.fx == camera.fy
    positions = np.array([camera.position for camera in scene.cameras])
    assert clearance(positions, solids).min() > 0.2


def test_images_are_upright(scene: Scene) -> None:
    """Ceiling, walls and sky are above and light; the wooden floor is below and brown."""
    level = [view for view in scene.views if view.camera.forward[2] > -0.35]
    assert len(level) > 20
    for view in level:  # the others look down on things that stand on the floor
        z = points_of(view)[:, 2].reshape(120, 160)
        assert z[:60].mean() > z[60:].mean() + 0.1, view.name
    blue = np.mean([view.image[..., 2] for view in level], axis=(0, 2))
    assert blue[:40].mean() > blue[80:].mean() + 20


def test_near_and_far_things_are_seen(scene: Scene) -> None:
    depths = np.stack([scene.views[index].depth for index in scene.splits["train"]])
    nearest = depths.min(axis=(1, 2))
    assert nearest.min() > 0.2 and np.sum(nearest < 0.5) >= 8
    assert np.mean(depths < 0.5) > 0.015 and np.mean(depths > 3.0) > 0.2
    crate = np.array([0.385, -1.565, 0.52])
    away = [np.linalg.norm(camera.position - crate) for camera in scene.training_cameras]
    assert min(away) < 0.6 and max(away) > 3.0


def test_every_wall_is_seen_by_training_views(scene: Scene) -> None:
    points = np.concatenate([points_of(scene.views[index]) for index in scene.splits["train"]])
    for axis in range(3):
        for wall in (room.ROOM_MIN[axis], room.ROOM_MAX[axis]):
            assert np.mean(np.abs(points[:, axis] - wall) < 1e-4) > 0.01, (axis, wall)


def reprojected(scene: Scene, turn: tuple[int, int] = (1, 1)) -> Iterator[np.ndarray]:
    """Colour differences [n] between two views of the same points, for several pairs of views.

    turn -1 reads the rows or columns of both images backwards.
    """
    count = len(scene.views)
    for first in range(0, count, 2):
        a, b = scene.views[first], scene.views[(first + 3) % count]
        points = points_of(a)
        local = (points - b.camera.position) @ b.camera.c2w[:, :3]
        ahead = -local[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            u = b.camera.fx * local[:, 0] / ahead + b.camera.cx
            v = -b.camera.fy * local[:, 1] / ahead + b.camera.cy
        inside = (ahead > 0) & (u >= 1) & (u < 159) & (v >= 1) & (v < 119)
        i, j = v[inside].astype(int), u[inside].astype(int)
        assert b.depth is not None
        distance = np.linalg.norm(local[inside], axis=1)
        seen = np.abs(b.depth[i, j] / distance - 1) < 0.02
        image_a, image_b = (view.image[:: turn[0], :: turn[1]].astype(float) for view in (a, b))
        difference = image_a.reshape(-1, 3)[inside][seen] - image_b[i, j][seen]
        yield np.abs(difference).mean(axis=1)


def test_points_have_the_same_colour_in_all_views(scene: Scene) -> None:
    difference = np.concatenate(list(reprojected(scene)))
    assert difference.size > 30_000
    assert np.median(difference) < 6 and np.mean(difference < 30) > 0.85
    for turn in ((-1, 1), (1, -1), (-1, -1)):
        turned = np.concatenate(list(reprojected(scene, turn)))
        assert np.median(turned) > 4 * np.median(difference), turn


@pytest.mark.parametrize("downscale", [2, 8])
def test_downscaled(sparse: Scene, downscale: int) -> None:
    small = room.room_scene(downscale=downscale, sparse=True)
    assert small.content_distance == pytest.approx(sparse.content_distance, rel=0.02)
    for view, whole in list(zip(small.views, sparse.views, strict=True))[::5]:
        camera = view.camera
        assert (camera.width, camera.height) == (160 // downscale, 120 // downscale)
        assert camera.fx == pytest.approx(whole.camera.fx / downscale)
        assert view.image.shape == (camera.height, camera.width, 3)
        assert view.depth is not None
        assert np.allclose(view.depth.ravel(), room.first_hit(*pixel_rays(camera)), rtol=1e-6)
        blocks = whole.image.reshape(camera.height, downscale, camera.width, downscale, 3)
        assert np.abs(blocks.mean(axis=(1, 3)) - view.image).mean() < 5


def test_downscale_crops_what_fills_no_pixel() -> None:
    camera = room.room_scene(downscale=7, sparse=True).cameras[0]
    assert (camera.width, camera.height) == (22, 17)
    assert camera.fx == camera.fy and camera.cx == pytest.approx(80 / 7)


@pytest.mark.parametrize("downscale", [0, -1, 121, 1.5])
def test_impossible_downscale_is_refused(downscale: int) -> None:
    with pytest.raises(ValueError, match="downscale"):
        room.room_scene(downscale=downscale)


def test_photographed_anew_it_looks_the_same() -> None:
    scene = room.room_scene(4, sparse=True)
    assert scene.photograph is not None
    for view in (scene.views[0], scene.views[33]):
        np.testing.assert_array_equal(scene.photograph(view.camera), view.image)
    camera = scene.views[0].camera
    for place in ((0.45, -1.5, 0.2), (0.0, 9.0, 1.0)):  # in the crate, outside
        c2w = camera.c2w.copy()
        c2w[:, 3] = place
        assert scene.photograph(replace(camera, c2w=c2w)) is None


def test_a_photograph_is_what_the_scene_is_made_of() -> None:
    scene = room.room_scene(downscale=8, sparse=True)
    view = scene.views[4]
    rgb, depth = room.photograph(view.camera, 4)
    np.testing.assert_array_equal(rgb, view.image)
    np.testing.assert_array_equal(depth, view.depth)
