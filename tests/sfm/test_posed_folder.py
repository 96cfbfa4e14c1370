"""The folder of a posed scene: whole or not there, and nothing else in it is touched.

COLMAP's answer is made up.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.support.fake_colmap import Colmap, N, listing, photographs
from tests.support.tiny_scenes import picture, ring, write_transforms
from warpnerf.checks import InputError
from warpnerf.scenes.formats.load import load_scene
from warpnerf.sfm import pose as module
from warpnerf.sfm.config import PoseConfig
from warpnerf.sfm.pose import is_made_of, pose
from warpnerf.sfm.summary import Posing


def test_a_scene_of_its_own_is_whole_and_the_photographs_stay(
    tmp_path: Path, photos: Path, colmap: Colmap
) -> None:
    before = listing(photos)
    posing = pose(photos, tmp_path / "new" / "scene")
    assert listing(photos) == before
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["scene"]
    assert (posing.registered, posing.photographs, posing.points) == (N, N, 321)
    scene = load_scene(tmp_path / "new" / "scene")
    assert [view.name for view in scene.views] == [f"images/{k:02}.png" for k in range(N)]
    assert not scene.warnings
    camera = scene.views[3].camera
    assert (camera.fx, camera.cx, camera.k1, camera.k2) == (10.0, 4.0, 0.01, 0.0)
    np.testing.assert_allclose(camera.c2w, ring(N)[3][:3], atol=1e-12)
    content = json.loads((tmp_path / "new" / "scene" / "transforms.json").read_text())
    assert content["ply_file_path"] == "sparse_pc.ply" and "k1" not in content["frames"][0]


@pytest.mark.parametrize("inside", ["", "images"])
def test_the_scene_may_be_the_photographs_folder(
    tmp_path: Path, colmap: Colmap, inside: str
) -> None:
    folder = tmp_path / "capture"
    photographs(folder / inside)
    before = listing(folder)
    pose(folder, folder)
    assert before.items() <= listing(folder).items()
    assert {"transforms.json", "pose.json", "sparse_pc.ply"} <= listing(folder).keys()
    assert len(list(folder.rglob("*.png"))) == N  # none of them twice
    assert len(load_scene(folder).views) == N
    with pytest.raises(InputError, match=r"holds a posed scene already; .*--overwrite"):
        pose(folder, folder)
    pose(folder, folder, overwrite=True)
    assert len(load_scene(folder).views) == N


def test_overwriting_removes_what_was_written_and_nothing_else(
    tmp_path: Path, photos: Path, colmap: Colmap
) -> None:
    pose(photos, tmp_path / "scene")
    (tmp_path / "scene" / "images" / "mine.txt").write_text("mine")
    pose(photographs(tmp_path / "others", 4), tmp_path / "scene", overwrite=True)
    assert len(load_scene(tmp_path / "scene").views) == 4
    assert len(list((tmp_path / "scene" / "images").iterdir())) == 5
    assert len(list(photos.iterdir())) == N


def test_a_scene_can_be_posed_anew_in_place(tmp_path: Path, photos: Path, colmap: Colmap) -> None:
    scene = tmp_path / "scene"
    pose(photos, scene)
    for path in photos.iterdir():
        path.unlink()  # its photographs are the only ones now
    pose(scene, scene, overwrite=True)
    assert len(load_scene(scene).views) == N
    pose(photographs(tmp_path / "others", 4), scene, overwrite=True)  # they still go with it
    assert len(load_scene(scene).views) == len(list((scene / "images").iterdir())) == 4


def test_interrupted_at_any_file_of_the_new_scene_a_whole_one_is_there(
    tmp_path: Path, photos: Path, colmap: Colmap, monkeypatch: pytest.MonkeyPatch
) -> None:
    others = photographs(tmp_path / "others", 4)
    replace_file, done = Path.replace, 0

    def cut(self: Path, target: Path) -> Path:
        nonlocal done
        if done == last:
            raise KeyboardInterrupt
        done += 1
        return replace_file(self, target)

    for last in range(8):
        scene, done = tmp_path / f"scene {last}", 0
        pose(photos, scene)
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(Path, "replace", cut)
            pose(others, scene, overwrite=True)
        assert len(json.loads((scene / "transforms.json").read_text())["frames"]) == N
        assert all((scene / "images" / f"{k:02}.png").exists() for k in range(N))
        pose(others, scene, overwrite=True)
        assert len(load_scene(scene).views) == 4


def test_a_record_from_elsewhere_removes_nothing_outside(
    tmp_path: Path, photos: Path, colmap: Colmap
) -> None:
    pose(photos, tmp_path / "scene")
    record = json.loads((tmp_path / "scene" / "pose.json").read_text())
    record["written"] += ["../photos/00.png", str(photos / "01.png"), "."]
    (tmp_path / "scene" / "pose.json").write_text(json.dumps(record))
    pose(photos, tmp_path / "scene", overwrite=True)
    assert len(list(photos.iterdir())) == N


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda out: out.write_text(""), "is a file"),
        (lambda out: write_transforms(out), "holds a scene already"),
        (lambda out: photographs(out), "holds other files"),
    ],
)
def test_a_folder_that_is_taken_is_refused(
    tmp_path: Path, photos: Path, colmap: Colmap, make: Any, says: str
) -> None:
    make(tmp_path / "scene")
    with pytest.raises(InputError, match=f"--output .*scene {says}"):
        pose(photos, tmp_path / "scene", overwrite=True)
    assert not colmap.job


def test_what_fails_leaves_nothing_behind(
    tmp_path: Path, photos: Path, colmap: Colmap, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(job: dict[str, Any], on_report: Any) -> dict[str, Any]:
        assert len(list(tmp_path.iterdir())) == 2
        raise KeyboardInterrupt

    monkeypatch.setattr(module, "estimate", interrupted)
    with pytest.raises(KeyboardInterrupt):
        pose(photos, tmp_path / "runs" / "scene")
    assert list(tmp_path.iterdir()) == [photos]
    assert len(list(photos.iterdir())) == N


def test_what_a_killed_process_left_is_swept(tmp_path: Path, photos: Path, colmap: Colmap) -> None:
    dead, alive = tmp_path / ".scene.4194304999.tmp", tmp_path / f".scene.{os.getppid()}.tmp"
    for folder in (dead, alive):
        (folder / "work").mkdir(parents=True)
    pose(photos, tmp_path / "scene")
    assert alive.exists() and not dead.exists()


def test_a_disk_that_cannot_be_written_is_named(
    tmp_path: Path, photos: Path, colmap: Colmap, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(module, "put_into", full)
    with pytest.raises(InputError, match=r"--output .*scene cannot be written: No space left"):
        pose(photos, tmp_path / "scene")
    assert list(tmp_path.iterdir()) == [photos]


# --- What is asked of COLMAP --------------------------------------------------------------------


def test_a_scene_knows_what_it_is_made_of(tmp_path: Path, photos: Path, colmap: Colmap) -> None:
    scene, config = tmp_path / "scene", PoseConfig()
    assert not is_made_of(scene, photos, config)
    posing: Posing = pose(photos, scene, config)
    assert posing.folder == scene
    assert is_made_of(scene, photos, PoseConfig(threads=1))
    assert not is_made_of(scene, photos, PoseConfig(mapper="global"))
    Image.fromarray(picture(99)).save(photos / "new.png")
    assert not is_made_of(scene, photos, config)


def test_the_same_masks_named_from_elsewhere_are_the_same(
    tmp_path: Path, photos: Path, colmap: Colmap, monkeypatch: pytest.MonkeyPatch
) -> None:
    photographs(tmp_path / "masks")
    pose(photos, tmp_path / "scene", PoseConfig(masks=tmp_path / "masks"))
    monkeypatch.chdir(tmp_path)
    assert is_made_of(Path("scene"), Path("photos"), PoseConfig(masks=Path("masks")))


def test_masks_that_come_or_change_later_are_another_scene(
    tmp_path: Path, photos: Path, colmap: Colmap
) -> None:
    scene, masks = tmp_path / "scene", tmp_path / "masks"
    masks.mkdir()
    for folder, config in ((photos, PoseConfig()), (masks, PoseConfig(masks=masks))):
        for name, size in (("03.png.mask.png", 8), ("03.png.mask.png", 16), ("04.png", 8)):
            name = name if folder == photos else name.replace(".png.mask.png", ".png")
            if folder == photos and name == "04.png":
                continue  # a photograph's own
            Image.new("L", (size, size * 3 // 4), 255).save(folder / name)
            assert not is_made_of(scene, photos, config)
            pose(photos, scene, config, overwrite=True)
            assert is_made_of(scene, photos, config)


def test_half_a_scene_is_made_again(tmp_path: Path, photos: Path, colmap: Colmap) -> None:
    pose(photos, tmp_path / "scene")
    assert is_made_of(tmp_path / "scene", photos, PoseConfig())
    (tmp_path / "scene" / "transforms.json").unlink()
    assert not is_made_of(tmp_path / "scene", photos, PoseConfig())
