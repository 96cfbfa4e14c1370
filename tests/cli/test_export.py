"""`warpnerf export` on a tiny run: what it writes, says, and refuses."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.exporting.test_cameras import ball_scene
from tests.support import cli_process
from tests.support.solid_fields import LEVEL, ball_field, read_ply
from tests.support.tiny_scenes import write_transforms
from warpnerf.checks import InputError
from warpnerf.cli import export as command
from warpnerf.config import TrainConfig
from warpnerf.exporting import splats, surface, visibility_file, volume
from warpnerf.exporting.export import FORMATS, export
from warpnerf.exporting.visibility import visibility as computed_visibility
from warpnerf.runs.run import Run
from warpnerf.scenes.formats.load import load_scene

pytestmark = pytest.mark.usefixtures("poses_as_given")


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose scene is the ball's, written by the command's own format."""
    folder = tmp_path_factory.mktemp("export")
    export(ball_field(), folder / "scene", scene=ball_scene(), level=LEVEL)
    run = Run(folder / "run")
    scene = load_scene(folder / "scene")
    run.create(scene, str(folder / "scene"), 1, scene.content_distance, TrainConfig())
    run.save_field(ball_field())
    return folder / "run"


OF_RUN = {"scene", "device", "threads"}


def export_command(folder: Path, files: tuple[Path, ...], **options: Any) -> int:
    of_run = {name: options.pop(name) for name in OF_RUN & options.keys()}
    return command.export_command(folder, files, command.Options(**options), **of_run)


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.ci
@pytest.mark.parametrize("ending", [e for e in FORMATS if e not in (".html", "")])
def test_every_ending_becomes_a_file(
    run_folder: Path, tmp_path: Path, ending: str, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / f"BALL{ending.upper()}"
    target.write_bytes(b"older")
    assert export_command(run_folder, (target,), threads=1) == 0
    assert len(target.read_bytes()) > 1000
    assert [path.name for path in tmp_path.iterdir()] == [target.name]
    said = capsys.readouterr().out
    kind = FORMATS[ending]
    assert f"nodes as {kind if kind.endswith('s') else 'a ' + kind}\n" in said
    assert f"wrote {target}" in said
    assert "10 of 10 training cameras" in said


@pytest.mark.ci
@pytest.mark.parametrize("k1", [0.0, 0.01])
def test_lenses_that_3dgs_does_not_read_are_said(
    run_folder: Path, tmp_path: Path, k1: float, capsys: pytest.CaptureFixture[str]
) -> None:
    bent = dict.fromkeys(("k2", "k3", "k4", "k5", "k6", "p1", "p2"), 0.0)
    scene = load_scene(run_folder.parent / "scene")
    views = [
        replace(view, camera=replace(view.camera, **(bent | {"k1": k1}))) for view in scene.views
    ]
    export(ball_field(), tmp_path / "scene", scene=replace(scene, views=views), level=LEVEL)
    run = Run(tmp_path / "run")
    run.create(scene, str(tmp_path / "scene"), 1, scene.content_distance, TrainConfig())
    run.save_field(ball_field())
    assert export_command(tmp_path / "run", (tmp_path / "out",), threads=1) == 0
    said = capsys.readouterr().out
    assert ("3DGS reads PINHOLE only: --pinhole writes such a folder" in said) == (k1 > 0.0)


def test_options_reach_the_surface(run_folder: Path, tmp_path: Path) -> None:
    whole, half = tmp_path / "whole.ply", tmp_path / "half.ply"
    export_command(run_folder, (whole,), level=LEVEL, threads=1)
    export_command(run_folder, (half,), level=LEVEL, crop=(-1, -1, -1, 0.1, 1, 1), threads=1)
    points, _ = read_ply(half.read_bytes())
    assert points["x"].max() <= 0.1 < read_ply(whole.read_bytes())[0]["x"].max()
    assert np.hypot(*(points[c] - m for c, m in zip("xy", (0.1, -0.05), strict=True))).max() < 0.61


@pytest.mark.parametrize(
    ("file", "options", "says"),
    [
        ("ball.stl", {}, r"let the name end in .*\.glb.*, or in nothing for a folder"),
        ("nowhere/ball.ply", {}, "its folder does not exist"),
        ("folder.ply", {}, "is a folder"),
        ("ball.ply", {"level": -1.0}, "level must be"),
        ("ball.ply", {"level": 1e7}, "where it is .* to 400 per"),
        ("ball.ply", {"crop": (5, 5, 5, 6, 6, 6)}, "lies outside of the field"),
        ("ball.ply", {"crop": (1, 0, 0, 0, 1, 1)}, "the first below the second"),
        ("ball.splat.ply", {"level": 3.0}, "level is of surfaces, and there is none"),
        ("ball.npz", {"min_size": 3.0}, "min_size is of surfaces"),
        ("ball.npz", {"crop": (-0.01, 0, 0, 0.04, 1, 1)}, "fewer than two nodes"),
        ("ball.ply", {"scene": "/no/such/place"}, "does not exist"),
        ("ball.ply", {"device": "cuda:77"}, "device"),
    ],
)
def test_bad_input_is_refused_and_nothing_is_written(
    run_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    file: str,
    options: dict[str, Any],
    says: str,
) -> None:
    def takes_long(*_: object) -> None:
        pytest.fail("looks through all cameras first")

    monkeypatch.setattr("warpnerf.exporting.export.cached_visibility", takes_long)
    (tmp_path / "folder.ply").mkdir()
    before = contents(run_folder)
    with pytest.raises(InputError, match=says):
        export_command(run_folder, (tmp_path / file,), **options)
    assert contents(run_folder) == before
    assert [path.name for path in tmp_path.iterdir()] == ["folder.ply"]


@pytest.mark.ci
def test_several_files_are_written_in_one_pass(
    run_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Each with the bytes that it has alone; cameras, surface and splats are computed once."""
    names = ("a.glb", "b.ply", "c.splat.ply", "d.npz", "e")
    for name in names:
        export_command(run_folder, (tmp_path / name,), level=LEVEL if name in "ae" else None)
    Run(run_folder).visibility_file.unlink()
    counted: dict[str, int] = {}

    def count(module: Any, name: str) -> None:
        function = getattr(module, name)

        def counting(*arguments: Any, **options: Any) -> Any:
            counted[name] = counted.get(name, 0) + 1
            return function(*arguments, **options)

        monkeypatch.setattr(module, name, counting)

    count(visibility_file.computed, "visibility")
    count(surface, "extract_surface")
    count(splats, "splats_of")
    (tmp_path / "all").mkdir()
    together = tuple(tmp_path / "all" / name for name in names)
    assert export_command(run_folder, together, threads=1) == 0
    assert "nodes as a mesh, splats, a volume and a scene\n" in capsys.readouterr().out
    assert counted == {"visibility": 1, "extract_surface": 1, "splats_of": 1}
    for name in names[:-1]:
        assert (tmp_path / "all" / name).read_bytes() == (tmp_path / name).read_bytes(), name
    assert {path.name for path in (tmp_path / "all").iterdir()} == {*names}
    assert export_command(run_folder, (tmp_path / "all" / "f.glb",), threads=1) == 0
    assert counted["visibility"] == 1  # read from the run's folder
    assert (tmp_path / "all" / "f.glb").read_bytes() == (tmp_path / "a.glb").read_bytes()


def test_of_another_field_the_visibility_is_computed_again(tmp_path: Path) -> None:
    scene, file = ball_scene(), tmp_path / "seen.safetensors"
    views = [scene.views[index] for index in scene.splits["train"]]
    first = visibility_file.cached_visibility(ball_field(), views, file)
    again = visibility_file.cached_visibility(ball_field(), views, file)
    np.testing.assert_array_equal(first.light, again.light)
    np.testing.assert_array_equal(first.colour, again.colour)
    small = ball_field(radius=0.3)
    left = np.broadcast_to(np.arange(48) < 24, (40, 48))
    masked = [replace(views[0], mask=left), *views[1:]]
    nearer = [
        replace(view, camera=replace(view.camera, c2w=view.camera.c2w * [1, 1, 1, 0.8]))
        for view in views
    ]
    ball = ball_field()
    for field, seen in ((ball, masked), (ball, views), (ball, nearer), (small, nearer)):
        found = visibility_file.cached_visibility(field, seen, file)
        np.testing.assert_array_equal(found.light, computed_visibility(field, seen).light)
    file.write_bytes(file.read_bytes()[:-40] + bytes(40))  # damaged
    found = visibility_file.cached_visibility(ball_field(), views, file)
    np.testing.assert_array_equal(found.light, first.light)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes in folders")
def test_a_pipe_in_place_of_the_cache_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "seen.safetensors")
    views = ball_scene().views
    found = visibility_file.cached_visibility(ball_field(), views, tmp_path / "seen.safetensors")
    assert found.light.any() and (tmp_path / "seen.safetensors").is_fifo()


def test_a_link_in_place_of_the_cache_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "other").write_bytes(b"mine")
    (tmp_path / "seen.safetensors").symlink_to(tmp_path / "other")
    views = ball_scene().views
    visibility_file.cached_visibility(ball_field(), views, tmp_path / "seen.safetensors")
    assert (tmp_path / "other").read_bytes() == b"mine"


def test_if_one_file_cannot_be_written_none_is(
    run_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    (tmp_path / "a.glb").write_bytes(b"older")
    monkeypatch.setattr(volume, "volume_npz", full)
    files = (tmp_path / "a.glb", tmp_path / "scene", tmp_path / "b.npz")
    with pytest.raises(InputError, match="No space left on device; name another place"):
        export_command(run_folder, files, threads=1)
    assert [path.name for path in tmp_path.iterdir()] == ["a.glb"]
    assert (tmp_path / "a.glb").read_bytes() == b"older"
    with pytest.raises(InputError, match="named twice"):
        export_command(run_folder, (tmp_path / "x.glb", tmp_path / "." / "x.glb"), threads=1)


def test_what_is_no_run_ends_with_a_sentence(tmp_path: Path) -> None:
    done = cli_process.run("export", tmp_path, tmp_path / "a.ply")
    assert done.returncode == 2
    assert done.stderr.strip().endswith("config.json does not exist; name the folder of a run.")


def test_cameras_that_look_away_see_nothing_and_that_is_said(tmp_path: Path) -> None:
    write_transforms(tmp_path / "scene", 6)
    away = load_scene(tmp_path / "scene")
    with pytest.raises(InputError, match="keep what is unseen"):
        export(ball_field(), tmp_path / "a.ply", level=LEVEL, scene=away, min_size=2.5)


@pytest.mark.parametrize(("faces", "said"), [(100_000, True), (200, False)])
def test_a_mesh_of_fewer_faces_than_are_wanted_is_said(
    run_folder: Path, tmp_path: Path, faces: int, said: bool, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level("INFO", logger="warpnerf"):
        export_command(run_folder, (tmp_path / "a.ply",), level=LEVEL, faces=faces, threads=1)
    _, triangles = read_ply((tmp_path / "a.ply").read_bytes())
    assert triangles is not None
    words = f"the mesh has {len(triangles)} triangles, not {faces}, and stays as it is"
    assert (words in caplog.text) == said


def test_a_scene_that_is_all_trained_on_is_exported_so(run_folder: Path, tmp_path: Path) -> None:
    """nerfstudio refuses a file that lists photographs for some of its three splits only."""
    run = Run(tmp_path / "run")
    source = run_folder.parent / "scene"
    scene = load_scene(source, split="all")
    run.create(scene, str(source), 1, scene.content_distance, TrainConfig(), split="all")
    run.save_field(ball_field())
    assert export_command(run.folder, (tmp_path / "out",), threads=1) == 0
    again = load_scene(tmp_path / "out")
    assert again.splits == {"train": tuple(range(12)), "test": ()} == scene.splits
    assert "no photograph is withheld for testing: all 12 are trained on" in again.notes
    content = json.loads((tmp_path / "out" / "transforms.json").read_bytes())
    lists = [content.get(f"{split}_filenames", []) for split in ("train", "val", "test")]
    assert [len(each) for each in lists] == [12, 12, 12]
