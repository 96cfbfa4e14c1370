"""`warpnerf render` on a tiny run: what it writes, says, and refuses."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.rendering.test_composite import composite_of
from tests.support import cli_process
from tests.support.solid_fields import ball_field
from tests.support.tiny_fields import tiny_field
from tests.support.tiny_scenes import look_at, ring, write_transforms
from warpnerf.checks import InputError
from warpnerf.cli import render
from warpnerf.config import TrainConfig
from warpnerf.media.recorded_path import Key, RecordedPath
from warpnerf.runs.run import Run
from warpnerf.scenes.formats.load import load_scene

OF_RUN = {"scene", "device", "threads"}


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("render")
    write_transforms(folder / "scene", 6)
    run = Run(folder / "run")
    scene = load_scene(folder / "scene")
    run.create(scene, str(folder / "scene"), 1, scene.content_distance, TrainConfig())
    run.save_field(tiny_field())
    return folder / "run"


def render_command(folder: Path, **options: Any) -> int:
    of_run = {name: options.pop(name) for name in OF_RUN & options.keys()}
    return render.render_command(folder, render.RenderOptions(**options), **of_run)


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("path", ["auto", "orbit", "through", "back"])
def test_a_path_becomes_a_video(
    run_folder: Path, tmp_path: Path, path: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "frames"
    options = {"fps": 10.0, "seconds": 0.5, "size": (30, 20), "threads": 1}
    assert render_command(run_folder, path=path, output=target, **options) == 0
    pictures = [Image.open(file) for file in sorted(target.iterdir())]
    assert len(pictures) == 5
    assert pictures[0].width == 2 * 30 + 4
    assert np.asarray(pictures[0])[:20, :30].std() > 0.0
    said = capsys.readouterr().out
    assert f"path '{'orbit' if path == 'auto' else path}'" in said
    assert "depth from" in said and "scene units" in said
    assert "frame 5 of 5" in said
    assert f"wrote {target}" in said


def test_a_recorded_path_becomes_a_video_of_its_own_size_and_length(
    run_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    keys = [
        Key(seconds=0.5 * i, fov=40.0, c2w=pose[:3].tolist()) for i, pose in enumerate(ring(5)[:3])
    ]
    file = tmp_path / "mine.json"
    file.write_bytes(RecordedPath(width=30, height=20, keys=keys).to_json())
    target = tmp_path / "frames"
    assert render_command(run_folder, path=str(file), output=target, fps=10.0, threads=1) == 0
    pictures = [Image.open(frame) for frame in sorted(target.iterdir())]
    assert len(pictures) == 10 and pictures[0].width == 2 * 30 + 4
    assert "path " + str(file) in capsys.readouterr().out
    shown = np.asarray(pictures[-1])[:20, :30] / 255.0
    field = Run(run_folder).load_field("cpu", 1)[0]
    last = RecordedPath(width=30, height=20, keys=keys).cameras(10)[-1]
    np.testing.assert_allclose(shown, field.render(last).rgb, atol=0.01)
    assert shown.std() > 0.05
    options: dict[str, Any] = {"seconds": 0.3, "size": (24, 12), "fps": 10.0, "threads": 1}
    assert render_command(run_folder, path=str(file), **options) == 0
    assert (run_folder / "mine.mp4").exists()


@pytest.mark.parametrize(
    ("path", "says"),
    [
        ("spiral", r"--path spiral is none of auto, orbit, through, back"),
        ("no/such.json", "no/such.json"),
    ],
)
def test_a_path_that_is_none_is_refused(run_folder: Path, path: str, says: str) -> None:
    before = contents(run_folder)
    with pytest.raises(InputError, match=says):
        render_command(run_folder, path=path)
    assert contents(run_folder) == before


def test_by_default_the_video_goes_into_the_run(run_folder: Path) -> None:
    assert render_command(run_folder, fps=10.0, seconds=0.3, depths=(1.0, 4.0), threads=1) == 0
    assert (run_folder / "video.mp4").read_bytes()[4:8] == b"ftyp"


def test_stills_are_those_of_the_split(run_folder: Path, tmp_path: Path) -> None:
    assert render_command(run_folder, stills="test", output=tmp_path / "a", threads=1) == 0
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["images_000.png"]
    assert Image.open(tmp_path / "a" / "images_000.png").width == 2 * 8 + 4
    options = {"size": (31, 17), "output": tmp_path / "b", "threads": 1}
    assert render_command(run_folder, stills="all", **options) == 0
    assert len(list((tmp_path / "b").iterdir())) == 6
    assert Image.open(tmp_path / "b" / "images_003.png").width == 2 * 31 + 4


def test_outputs_crop_and_photographs_by_name(run_folder: Path, tmp_path: Path) -> None:
    options: dict[str, Any] = {"show": ("normals", "colour"), "threads": 1, "transparent": True}
    names = ("000.png", "002")  # the end of a name, and that without its ending
    assert render_command(run_folder, photographs=names, output=tmp_path / "a", **options) == 0
    files = sorted((tmp_path / "a").iterdir())
    assert [path.name for path in files] == ["images_000.png", "images_002.png"]
    picture = Image.open(files[1])
    assert picture.size == (2 * 8 + 4, 6) and picture.mode == "RGBA"
    field = Run(run_folder).load_field("cpu", 1)[0]
    camera = load_scene(run_folder.parent / "scene").views[2].camera
    alpha = np.asarray(picture)[:, 12:, 3] / 255.0
    np.testing.assert_allclose(alpha, field.render(camera).opacity, atol=0.01)
    low, high = field.lattice.box_min, 0.5 * (field.lattice.box_min + field.lattice.box_max)
    cropped = {"photographs": names[1:], "output": tmp_path / "b", "show": ("opacity",)}
    assert render_command(run_folder, crop=(*low, *high), threads=1, **cropped) == 0
    shown = np.asarray(Image.open(tmp_path / "b" / "images_002.png"))[..., 0]
    assert shown.sum() < 255.0 * alpha.sum()


def test_a_crop_that_holds_nothing_is_refused(
    run_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Run, "load_field", lambda *_: (ball_field(), []))
    crop = (0.8, -1.0, -1.0, 1.0, -0.7, -0.7)
    with pytest.raises(InputError, match=r"crop between .* holds nothing") as refused:
        render_command(run_folder, crop=crop, stills="test", output=tmp_path / "a", threads=1)
    where = re.findall(r"-?[0-9.]+[0-9]", str(refused.value).rpartition("between")[2])
    middle = np.array([0.1, -0.05, 0.15])  # of the ball, whose radius is 0.6
    wanted = np.stack([middle - 0.6, middle + 0.6])
    np.testing.assert_allclose(np.array(where, float).reshape(2, 3), wanted, atol=0.2)
    assert not (tmp_path / "a").exists()


@pytest.mark.parametrize("blocks", [False, True])
def test_a_crop_that_no_camera_sees_is_said(
    run_folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    blocks: bool,
) -> None:
    if blocks:
        monkeypatch.setattr(Run, "load_field", lambda *_: (composite_of([tiny_field()] * 4), []))
    away = look_at((3.0, 0.0, 0.0), (9.0, 0.0, 0.0))
    keys = [Key(seconds=float(i), fov=40.0, c2w=away[:3].tolist()) for i in range(2)]
    file = tmp_path / "away.json"
    file.write_bytes(RecordedPath(width=30, height=20, keys=keys).to_json())
    options: dict[str, Any] = {"path": str(file), "fps": 2.0, "threads": 1}
    crop = (-1.0, -1.0, -1.0, 1.0, 1.0, 1.0)
    assert render_command(run_folder, crop=crop, output=tmp_path / "a", **options) == 0
    said = (
        "note: nothing is seen of the crop from there; what the field holds lies between -1 -1 -1"
    )
    assert said in capsys.readouterr().out
    assert render_command(run_folder, output=tmp_path / "b", **options) == 0
    assert "note: nothing is seen" not in capsys.readouterr().out


@pytest.mark.parametrize("kind", ["file", "link"])
def test_stills_replace_nothing_but_stills(run_folder: Path, tmp_path: Path, kind: str) -> None:
    write_transforms(tmp_path / "scene", 6)
    run = Run(tmp_path / "run")
    scene = load_scene(tmp_path / "scene")
    run.create(scene, str(tmp_path / "scene"), 1, scene.content_distance, TrainConfig())
    run.save_field(tiny_field())
    options: dict[str, Any] = {"stills": "all", "threads": 1}
    mine = run.folder / "images_003.png"
    if kind == "file":
        mine.write_bytes((tmp_path / "scene" / "images" / "003.png").read_bytes())
    else:
        mine.symlink_to(tmp_path / "nowhere.png")
    before = contents(tmp_path)
    with pytest.raises(InputError, match=r"images_003\.png is not a picture .* another folder"):
        render_command(run.folder, output=run.folder, **options)
    assert contents(tmp_path) == before
    mine.unlink()
    for size in ((8, 6), (12, 9)):  # their own are replaced
        assert render_command(run.folder, output=run.folder, size=size, **options) == 0
        assert Image.open(mine).width == 2 * size[0] + 4


def test_a_path_of_nerfstudio_is_followed(
    run_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frames = [
        {"camera_to_world": np.vstack([pose[:3], [0, 0, 0, 1]]).ravel().tolist(), "fov": 40.0}
        for pose in ring(5)[:3]
    ]
    tree = {"camera_path": frames, "render_width": 30, "render_height": 20, "fps": 10}
    file = tmp_path / "camera_path.json"
    file.write_text(json.dumps(tree))
    options: dict[str, Any] = {"threads": 1, "show": ("colour",)}
    assert render_command(run_folder, path=str(file), output=tmp_path / "f", **options) == 0
    out = capsys.readouterr().out
    assert "taken to be in the scene's coordinates" in out and "rendering 3 frames, path" in out
    one = tmp_path / "one.json"
    one.write_text(json.dumps(tree | {"camera_path": frames[:1], "fps": None, "seconds": 0.001}))
    assert render_command(run_folder, path=str(one), output=tmp_path / "one", **options) == 0
    assert len(list((tmp_path / "one").iterdir())) == 1
    capsys.readouterr()
    assert len(list((tmp_path / "f").iterdir())) == 3
    transforms = {"transform": np.eye(3, 4).tolist(), "scale": 1.0}
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps(transforms))
    assert render_command(run_folder, path=str(file), output=tmp_path / "g", **options) == 0
    assert "taken to be" not in capsys.readouterr().out
    assert render_command(run_folder, path=str(file), output=tmp_path / "h", fps=5, **options) == 0
    assert len(list((tmp_path / "h").iterdir())) == 2
    for name in ("00000.png", "00002.png"):
        first, second = (np.asarray(Image.open(tmp_path / f / name)) for f in "fg")
        np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"transparent": True}, r"no transparency; let the name end in \.mov"),
        ({"show": ("colour", "colour")}, "given twice"),
        ({"crop": (1, 0, 0, 0, 1, 1)}, "the first below the second"),
        (
            {"photographs": ("nowhere.png",), "output": "a", "fps": None, "seconds": None},
            "none of the 6 photographs; the nearest is",
        ),
        ({"photographs": ("a",), "stills": "test"}, "give one of them"),
        ({"path_transforms": Path("a.json")}, "is of a path of nerfstudio"),
        ({"seconds": 0.0}, "--seconds"),
        ({"seconds": 1e9}, "frames, more than"),
        ({"fps": float("nan")}, "frame rate"),
        ({"size": (0, 9)}, "width"),
        ({"depths": (3.0, 1.0)}, "range of depths"),
        ({"distance": -1.0, "path": "back"}, "distance of the path"),
        ({"scene": "/no/such/place"}, "does not exist"),
        ({"output": "a", "stills": "val", "fps": None, "seconds": None}, "no 'val' views"),
        ({"stills": "test", "seconds": None}, "--fps and --seconds are of a video"),
        ({"stills": "test", "fps": None}, "--fps and --seconds are of a video"),
        ({"output": "film.avi"}, r"\.mp4 or \.gif"),
        (
            {"output": "a.mp4", "stills": "test", "fps": None, "seconds": None},
            "stills go into a folder",
        ),
        (
            {"output": "nowhere/stills", "stills": "test", "fps": None, "seconds": None},
            "folder above",
        ),
        ({"device": "cuda:77"}, "device"),
    ],
)
def test_bad_options_are_refused_and_nothing_is_written(
    run_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    options: dict[str, Any],
    says: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    chosen = {"output": Path("film.gif"), "fps": 10.0, "seconds": 0.3, **options}
    chosen["output"] = Path(chosen["output"])
    before = contents(run_folder)
    with pytest.raises(InputError, match=says):
        render_command(run_folder, **chosen)
    assert contents(run_folder) == before
    assert list(tmp_path.iterdir()) == []


def test_what_is_no_run_ends_with_a_sentence(tmp_path: Path) -> None:
    done = cli_process.run("render", tmp_path)
    assert done.returncode == 2
    assert done.stderr.strip().endswith("config.json does not exist; name the folder of a run.")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.ci
def test_ctrl_c_leaves_nothing_behind(run_folder: Path, tmp_path: Path) -> None:
    target = tmp_path / "film.gif"
    command = [sys.executable, "-m", "warpnerf", "render", str(run_folder), "--seconds", "600"]
    process = subprocess.Popen(
        [*command, "--output", str(target)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    while "frame" not in process.stdout.readline():  # the first report of a frame
        assert process.poll() is None
    time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=240)
    assert process.returncode == 130
    assert "Traceback" not in err
    assert list(tmp_path.iterdir()) == []
