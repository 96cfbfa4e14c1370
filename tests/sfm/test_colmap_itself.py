"""Poses by COLMAP itself, of photographs of the built-in room, compared with the true ones."""

from __future__ import annotations

import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.support.cli_process import Outcome, assert_refused, command
from tests.support.tiny_scenes import look_at
from warpnerf.checks import InputError
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.formats.load import load_scene
from warpnerf.scenes.scene import Scene
from warpnerf.sfm.config import PoseConfig
from warpnerf.sfm.pose import pose

pytestmark = [
    pytest.mark.ci,
    pytest.mark.skipif(
        importlib.util.find_spec("pycolmap") is None,
        reason='needs pycolmap: pip install "warpnerf[sfm]"',
    ),
]

KILLED = """
import subprocess, warpnerf.sfm.worker
class Killed(subprocess.Popen):
    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        self.kill()
warpnerf.sfm.worker.subprocess.Popen = Killed
"""
"""Python that has COLMAP's process killed as soon as it is there."""

N = 12
WIDTH, HEIGHT, FOCAL = 480, 360, 390.0
"""Of the photographs. In 320 x 240 with one ray a pixel, errors of the focal length turn cameras by
2 degrees, more or less with COLMAP's threads and seed; in these it is half a degree."""


def true_pose(k: int) -> np.ndarray:
    """[3, 4], from a half circle around the table."""
    a = np.pi * k / N
    eye = (0.1 + 1.2 * np.cos(a), 1.6 * np.sin(a), 1.4 + 0.1 * np.sin(5.0 * a))
    return look_at(eye, (-0.2, 0.0, 0.5))[:3]


def write_photographs(
    folder: Path, poses: list[np.ndarray], *, width: int, height: int, focal: float
) -> Path:
    from warpnerf.scenes.builtin.room import photograph

    folder.mkdir()
    for k, c2w in enumerate(poses):
        camera = Camera(
            width=width,
            height=height,
            fx=focal,
            fy=focal,
            cx=width / 2,
            cy=height / 2,
            c2w=c2w,
        )
        Image.fromarray(photograph(camera)[0]).save(folder / f"{k:02}.png")
    return folder


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("room") / "photos"
    poses = [true_pose(k) for k in range(N)]
    return write_photographs(folder, poses, width=WIDTH, height=HEIGHT, focal=FOCAL)


def errors(scene: Scene) -> tuple[float, float]:
    """Largest error of a rotation, degrees, and of a place, in spreads of the cameras.

    After the similarity that brings the places together (Umeyama 1991).
    """
    number = [int(Path(view.name).stem[-2:]) for view in scene.views]
    found = np.stack([view.camera.c2w for view in scene.views])
    true = np.stack([true_pose(k) for k in number])
    x, y = (c2w[:, :, 3] - c2w[:, :, 3].mean(axis=0) for c2w in (found, true))
    u, size, vt = np.linalg.svd(y.T @ x)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = u * sign @ vt
    scale = (size * sign).sum() / np.square(x).sum()
    spread = np.sqrt(np.square(y).sum(axis=1).mean())
    apart = np.linalg.norm(scale * x @ rotation.T - y, axis=1).max() / spread
    turned = np.einsum("ij,njk,nlk->nil", rotation, found[:, :, :3], true[:, :, :3])
    cosine = (np.trace(turned, axis1=1, axis2=2) - 1.0) / 2.0
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).max()), float(apart)


@pytest.mark.slow  # COLMAP takes seconds
@pytest.mark.parametrize(
    "config",
    [
        PoseConfig(camera_model="PINHOLE"),
        PoseConfig(camera_model="PINHOLE", mapper="global", matching="sequential"),
    ],
    ids=["incremental", "global"],
)
def test_poses_are_those_that_the_photographs_were_taken_from(
    tmp_path: Path, photos: Path, config: PoseConfig
) -> None:
    stages: list[str] = []
    shares: list[float] = []

    def report(share: float, text: str) -> None:
        shares.append(share)
        stages.append(text.split(":")[0])

    posing = pose(photos, tmp_path / "scene", config, on_progress=report)
    assert posing.registered == N and not posing.missing
    assert posing.points > 200 and 0.05 < posing.error < 1.0
    assert list(dict.fromkeys(stages))[:3] == ["features", "matches", "poses"]
    assert shares == sorted(shares) and shares[-1] == 1.0
    scene = load_scene(tmp_path / "scene")
    rotation, place = errors(scene)
    assert rotation < 2.0 and place < 0.05
    assert abs(scene.views[0].camera.fx / FOCAL - 1.0) < 0.06
    assert any("points of sparse/0" in note for note in scene.notes)  # which have tracks
    # Upright: all cameras' horizontal axes lie level.
    assert max(abs(view.camera.c2w[2, 0]) for view in scene.views) < 0.05
    assert all(view.camera.c2w[2, 1] > 0.5 for view in scene.views)


@pytest.mark.slow
def test_the_colmap_model_is_the_same_scene(tmp_path: Path, photos: Path) -> None:
    pose(photos, tmp_path / "scene")
    ours = load_scene(tmp_path / "scene")
    theirs = load_scene(tmp_path / "scene" / "sparse" / "0")
    for one, other in zip(ours.views, theirs.views, strict=True):
        assert one.name == f"images/{other.name}"
        np.testing.assert_allclose(one.camera.c2w, other.camera.c2w, atol=1e-9)
        assert one.camera.fx == pytest.approx(other.camera.fx)
        assert one.camera.k1 == pytest.approx(other.camera.k1)


@pytest.mark.slow
def test_photographs_held_upright_by_exif_give_the_same_up(tmp_path: Path, photos: Path) -> None:
    """Stored lying on their side, with a tag that says so."""
    exif = Image.Exif()
    exif[0x0112] = 6  # turn by 90 degrees clockwise to see it
    (tmp_path / "turned").mkdir()
    for path in photos.iterdir():
        lying = np.rot90(np.asarray(Image.open(path)))  # anticlockwise
        turned = tmp_path / "turned" / path.with_suffix(".jpg").name  # as cameras write it
        Image.fromarray(lying).save(turned, exif=exif, quality=95)
    pose(tmp_path / "turned", tmp_path / "scene")
    scene = load_scene(tmp_path / "scene")
    # What is the picture's left is up in the room.
    assert all(-view.camera.c2w[2, 0] > 0.5 for view in scene.views)


def test_a_photograph_of_something_else_is_left_out_and_named(tmp_path: Path, photos: Path) -> None:
    (tmp_path / "photos").mkdir()
    for path in photos.iterdir():
        (tmp_path / "photos" / path.name).write_bytes(path.read_bytes())
    Image.new("RGB", (WIDTH, HEIGHT), (90, 120, 90)).save(tmp_path / "photos" / "wall.png")
    posing = pose(tmp_path / "photos", tmp_path / "scene")
    assert posing.registered == N
    assert posing.missing["wall.png"].startswith("only 0 features: blurred")


def test_noise_is_no_scene(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    for k in range(4):
        noise = np.random.default_rng(k).integers(0, 256, (120, 160, 3), dtype=np.uint8)
        Image.fromarray(noise).resize((320, 240)).save(tmp_path / "photos" / f"{k}.png")
    with pytest.raises(InputError, match="none of 4 photographs could be placed"):
        pose(tmp_path / "photos", tmp_path / "scene")
    assert not (tmp_path / "scene").exists()


def test_nothing_is_found_where_a_mask_is_black(tmp_path: Path, photos: Path) -> None:
    (tmp_path / "masks").mkdir()
    for path in photos.iterdir():
        Image.new("L", (WIDTH, HEIGHT), 0).save(tmp_path / "masks" / path.name)
    with pytest.raises(InputError, match=r"12 of them show too little \(first: 00.png, 0 features"):
        pose(photos, tmp_path / "scene", PoseConfig(masks=tmp_path / "masks"))


@pytest.mark.slow
def test_a_camera_that_moves_straight_on_is_placed(tmp_path: Path) -> None:
    """By a second try: the rays of no two photographs open as far as COLMAP requires at first."""
    ahead = [
        look_at((0.9 + 0.01 * k, 0.03 * k - 2.2, 1.3), (0.75, 0.03 * k - 0.2, 1.2))[:3]
        for k in range(10)
    ]
    write_photographs(tmp_path / "photos", ahead, width=480, height=360, focal=390.0)
    assert pose(tmp_path / "photos", tmp_path / "scene").registered == 10
    z = load_scene(tmp_path / "scene").views[5].camera.c2w[2, 1]
    assert z > 0.9


# --- Through the command ------------------------------------------------------------------------


def trained(photos: Path, *more: str, folder: Path) -> Outcome:
    tiny = ("--steps", "2", "--threads", "1", "--voxels", "512", "--downscale", "8")
    arguments = (*tiny, "--output", str(folder / "run"), *more)
    return command("train", photos, *arguments, folder=folder, limit=None)


@pytest.mark.slow
def test_train_estimates_the_poses_first_and_only_once(tmp_path: Path, photos: Path) -> None:
    first = trained(photos, folder=tmp_path)
    assert first.code == 0, first.err
    assert f"registered {N} of {N} photographs" in first.out
    config = json.loads((first.run / "config.json").read_text())
    assert config["scene"] == "scene"
    again = trained(photos, "--keep", "checkpoint", "--overwrite", folder=tmp_path)
    assert again.code == 0, again.err
    assert "are in" in again.out and "registered" not in again.out
    resumed = command("train", "--resume", first.run, folder=tmp_path, limit=None)
    assert resumed.code == 0, resumed.err
    (first.run / "config.json").unlink()  # as if it had been stopped when the poses were there
    for path in first.run.glob("*"):
        if path.is_file():
            path.unlink()
    for path in first.run.glob("test/*"):
        path.unlink()
    once_more = trained(photos, folder=tmp_path)
    assert once_more.code == 0, once_more.err
    assert "registered" not in once_more.out


def test_pose_refuses_in_one_sentence(tmp_path: Path, photos: Path) -> None:
    (tmp_path / "one").mkdir()
    (tmp_path / "one" / "a.jpg").write_bytes(b"")
    for source, says in [("none", "does not exist"), ("one", "holds 1 photograph, and poses")]:
        outcome = command("pose", source, "--output", "run", folder=tmp_path)
        assert_refused(outcome, says)


@pytest.mark.skipif(os.name != "posix", reason="signals")
@pytest.mark.parametrize("how", ["pose", "train"])
def test_ctrl_c_leaves_neither_files_nor_a_process(tmp_path: Path, photos: Path, how: str) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "warpnerf", how, str(photos), "--output", str(tmp_path / "run")],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert process.stdout is not None
    for line in process.stdout:
        if "features" in line:
            break
    time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    rest = process.stdout.read()
    assert process.wait() == 130, rest
    assert rest.splitlines()[-1] == "stopped"
    assert list(tmp_path.iterdir()) == []


def test_a_failure_of_colmap_is_told(tmp_path: Path) -> None:
    from warpnerf.sfm.worker import estimate

    with pytest.raises(ChildProcessError, match=r"COLMAP failed: KeyError: .*; use other"):
        estimate({"work": str(tmp_path)}, lambda *_: None)


def test_a_colmap_that_was_killed_is_one_sentence(tmp_path: Path, photos: Path) -> None:
    outcome = command(
        *("pose", photos, "--output", "run"),
        folder=tmp_path,
        limit=None,
        prelude=KILLED,
    )
    assert outcome.code == 1 and not outcome.run.exists()
    assert "error: COLMAP was ended by signal 9, as where memory runs out" in outcome.err
    assert "Traceback" not in outcome.err
