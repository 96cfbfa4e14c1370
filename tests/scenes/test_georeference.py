"""Coordinates of a country: centred when read, kept in a run, added again when exported."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.scenes.test_points import ball, write_ply
from tests.support.tiny_scenes import ring, save, write_transforms
from warpnerf.config import TrainConfig
from warpnerf.exporting import mesh, splats, volume
from warpnerf.exporting.cameras import write_scene
from warpnerf.exporting.ply import surface_columns
from warpnerf.exporting.surface import Surface
from warpnerf.runs.config import RunConfig, describe
from warpnerf.scenes.cameras.tracks import Tracks
from warpnerf.scenes.formats.load import load_scene
from warpnerf.scenes.formats.ply import read_ply
from warpnerf.scenes.scene import Scene

UTM = np.array([441_547.25, 5_121_946.5, 2345.125])


def georeferenced(folder: Path, at: np.ndarray = UTM) -> Scene:
    """Cameras around a ball somewhere, with points."""
    content = write_transforms(folder, 9)
    for frame in content["frames"]:
        pose = np.array(frame["transform_matrix"])
        pose[:3, 3] += at
        frame["transform_matrix"] = pose.tolist()
    save(folder / "transforms.json", content | {"ply_file_path": "points.ply"})
    write_ply(folder / "points.ply", ball(100) + at)
    return load_scene(folder)


def test_a_scene_far_away_is_that_at_the_origin(tmp_path: Path) -> None:
    here = georeferenced(tmp_path / "here", np.zeros(3))
    far = georeferenced(tmp_path / "far")
    assert here.offset is None and far.offset is not None
    assert (far.offset % 1.0 == 0.0).all() and np.abs(far.offset - UTM).max() < 3.0  # round, near
    assert f"less ({', '.join(f'{x:.0f}' for x in far.offset)})" in " ".join(far.notes)
    by = UTM - far.offset
    assert far.content_distance == pytest.approx(here.content_distance, rel=1e-7)
    assert not far.guessed and far.points is not None and here.points is not None
    np.testing.assert_allclose(far.box_min, here.box_min + by, atol=1e-7)
    np.testing.assert_allclose(far.points, here.points + by, atol=1e-7)
    for a, b in zip(far.cameras, here.cameras, strict=True):
        np.testing.assert_allclose(a.position, b.position + by, atol=1e-8)
        np.testing.assert_array_equal(a.c2w[:, :3], b.c2w[:, :3])


@pytest.mark.parametrize(("times", "moved"), [(900.0, False), (1100.0, True)])
def test_scenes_near_the_origin_stay_where_they_are(
    tmp_path: Path, times: float, moved: bool
) -> None:
    scene = georeferenced(
        tmp_path / "scene", np.array([0.0, times * 3.0, 0.0])
    )  # the ring's radius
    assert (scene.offset is not None) == moved


def test_there_and_back_again(tmp_path: Path) -> None:
    scene = georeferenced(tmp_path / "scene")
    assert scene.points is not None
    scene = replace(scene, tracks=Tracks(positions=scene.points, shown={}))
    back = scene.at_offset(None)
    assert back.offset is None and scene.at_offset(scene.offset) is scene
    np.testing.assert_allclose(back.cameras[2].position - UTM, ring(9)[2][:3, 3], atol=1e-8)
    again = back.at_offset(scene.offset)
    assert scene.observations is not None and again.observations is not None
    assert back.tracks is not None and again.tracks is not None
    np.testing.assert_allclose(again.tracks.positions, scene.points, atol=1e-8)
    assert np.abs(back.tracks.positions - UTM).max() < 3.0
    for name in ("box_min", "box_max", "points", "offset"):
        np.testing.assert_allclose(getattr(again, name), getattr(scene, name), atol=1e-8)
    np.testing.assert_allclose(
        again.observations.positions, scene.observations.positions, atol=1e-8
    )


def test_a_run_keeps_its_coordinates(tmp_path: Path) -> None:
    """Also where its scene would be centred elsewhere now, or was not when it was trained."""
    scene = georeferenced(tmp_path / "scene")
    said = describe(scene, "scene", 1, 3.0, TrainConfig(), None, False)
    assert scene.offset is not None and said["offset"] == scene.offset.tolist()
    config = RunConfig(scene="", downscale=1, content_distance=3.0, train=TrainConfig())
    older = config.as_trained(scene)
    assert older.offset is None
    np.testing.assert_allclose(older.cameras[0].position, scene.cameras[0].position + scene.offset)
    elsewhere = RunConfig(
        scene="",
        downscale=1,
        content_distance=3.0,
        train=TrainConfig(),
        offset=tuple(scene.offset - 46.0),
    )
    moved = elsewhere.as_trained(scene).cameras[0].position - scene.cameras[0].position
    np.testing.assert_allclose(moved, 46.0, atol=1e-9)


def surface_at(offset: np.ndarray) -> Surface:
    points = np.array([[0.5, 0.25, 0.125], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0625]], np.float32)
    return Surface(
        points=points + offset,
        faces=np.array([[0, 1, 2]], np.int32),
        normals=np.eye(3, dtype=np.float32),
        rgb=np.full((3, 3), 0.5, np.float32),
    )


def test_files_that_hold_double_precision_have_the_capture_s_coordinates(tmp_path: Path) -> None:
    made = surface_at(UTM)
    (tmp_path / "a.ply").write_bytes(b"".join(mesh.mesh_ply(made)))
    np.testing.assert_allclose(read_ply(tmp_path / "a.ply"), made.points, atol=1e-9)
    text = b"".join(mesh.mesh_obj(made)).decode()
    read = [[float(w) for w in line.split()[1:4]] for line in text.splitlines() if line[:2] == "v "]
    np.testing.assert_allclose(read, made.points, atol=1e-4)
    near = surface_columns(surface_at(np.zeros(3, np.float32)).points, made.normals, made.rgb)
    assert near["x"].dtype == np.float32


def test_an_exported_scene_is_read_where_the_capture_is(tmp_path: Path) -> None:
    scene = georeferenced(tmp_path / "scene")
    (tmp_path / "out").mkdir()
    write_scene(tmp_path / "out", scene.at_offset(None), surface_at(UTM))
    content = json.loads((tmp_path / "out" / "transforms.json").read_text())
    place = np.array(content["frames"][1]["transform_matrix"])[:3, 3]
    np.testing.assert_allclose(place - UTM, ring(9)[1][:3, 3], atol=1e-8)
    rows = (tmp_path / "out/sparse/0/points3D.txt").read_text().splitlines()[1:]
    found = np.array([[float(w) for w in row.split()[1:4]] for row in rows])
    np.testing.assert_allclose(found - UTM, surface_at(np.zeros(3)).points, atol=1e-4)
    for path in (tmp_path / "out", tmp_path / "out/sparse/0"):
        again = load_scene(path)
        place = again.at_offset(None).cameras[3].position
        assert again.offset is not None
        np.testing.assert_allclose(place - UTM, ring(9)[3][:3, 3], atol=1e-7)


def test_files_of_single_precision_say_what_is_missing() -> None:
    made, offset = surface_at(np.zeros(3, np.float32)), np.array([441_547.0, 5_121_946.0, 2346.0])
    data = b"".join(mesh.mesh_glb(made, None, offset))
    tree = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    assert tree["asset"]["extras"] == {"offset": offset.tolist()}
    some = splats.Splats(
        centres=made.points,
        scales=np.ones((3, 3), np.float32),
        rotations=np.eye(4, dtype=np.float32)[:3],
        opacity=np.full(3, 0.5, np.float32),
        rgb=np.full((3, 3), 0.5, np.float32),
    )
    head = splats.splats_ply(some, None, offset)[0].decode()
    assert "comment offset 441547 5121946 2346\n" in head
    assert "offset" not in splats.splats_ply(some)[0].decode()
    block = volume.Volume(
        density=np.zeros((2, 2, 2), np.float32),
        rgb=np.zeros((2, 2, 2, 3), np.uint8),
        seen=np.ones((2, 2, 2), bool),
        box_min=np.zeros(3),
        box_max=np.ones(3),
    )
    np.testing.assert_array_equal(block.moved(offset).box_max, offset + 1.0)
