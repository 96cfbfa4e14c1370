"""Where photographs' pixels are kept changes nothing but the memory that they take."""

from __future__ import annotations

import errno
import os
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.support.small_model import SQUARED
from tests.support.tiny_scenes import picture, ring, write_blender, write_transforms
from warpnerf.checks import InputError
from warpnerf.cli.main import main
from warpnerf.config import GridConfig, TrainConfig
from warpnerf.evaluation.evaluate import evaluate
from warpnerf.scenes.formats import assemble
from warpnerf.scenes.formats.load import load_scene
from warpnerf.scenes.images import photographs, transparency
from warpnerf.scenes.images.images import read_image
from warpnerf.scenes.images.photographs import Keeping
from warpnerf.scenes.images.pixel_file import PixelFile, expect_random_reads
from warpnerf.scenes.scene import Scene
from warpnerf.training.state import scene_digest
from warpnerf.training.train import train

PLACES = ("memory", "disk", "files")


def mixed_scene(folder: Path) -> Path:
    """Photographs of two kinds, so that they are not all as long."""
    write_transforms(folder, 6)
    for i in (1, 2, 4, 5):  # most of them, so that alpha counts
        Image.fromarray(picture(i, channels=4)).save(folder / f"images/{i:03d}.png")
    return folder


def in_places(folder: Path, **options: Any) -> list[Scene]:
    return [load_scene(folder, images=place, **options) for place in PLACES]  # type: ignore[arg-type]


@pytest.mark.parametrize("downscale", [1, 2])
def test_the_scene_is_the_same(tmp_path: Path, downscale: int) -> None:
    one, *others = in_places(mixed_scene(tmp_path), downscale=downscale)
    assert [view.channels for view in one.views] == [3, 4, 4, 3, 4, 4]
    for other in others:
        assert scene_digest(other) == scene_digest(one)
        assert (other.unbounded, other.has_alpha) == (one.unbounded, one.has_alpha)
        assert other.warnings == one.warnings
        for ours, theirs in zip(other.views, one.views, strict=True):
            assert ours.channels == theirs.channels
            np.testing.assert_array_equal(ours.image, theirs.image)


def test_transparency_is_seen_wherever_photographs_are(tmp_path: Path) -> None:
    write_blender(tmp_path, "train", ring(5))
    assert [scene.unbounded for scene in in_places(tmp_path)] == [False] * 3


def test_training_has_the_same_bits(tmp_path: Path) -> None:
    config = TrainConfig(
        steps=30,
        rays_per_step=64,
        threads=2,
        model="rgb",
        loss=SQUARED,
        grid=GridConfig(voxels=12**3),
    )
    fields = [train(scene, config).field for scene in in_places(mixed_scene(tmp_path))]
    values = [field.storage.values.numpy() for field in fields]
    assert np.abs(values[0]).max() > 0.1
    assert all(np.array_equal(values[0], other) for other in values[1:])


def test_evaluation_reads_the_views_of_its_split_one_by_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_transforms(tmp_path, 16, scale=3)
    scene = load_scene(tmp_path, images="files")
    config = TrainConfig(steps=2, rays_per_step=8, threads=1, model="rgb", loss=SQUARED)
    field = train(scene, replace(config, grid=GridConfig(voxels=8**3))).field
    read: list[str] = []
    whole = photographs.read_image

    def counted(path: Path) -> np.ndarray:
        read.append(path.name)
        return whole(path)

    monkeypatch.setattr(photographs, "read_image", counted)
    evaluate(field, scene, "test")
    assert read == ["000.png", "008.png"]


def test_the_file_on_disk_has_no_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "cache"
    folder.mkdir()
    scene = load_scene(mixed_scene(tmp_path / "scene"), images="disk", image_folder=folder)
    assert list(folder.iterdir()) == []
    (note,) = [note for note in scene.notes if "on disk" in note]
    assert note.startswith(f"photographs on disk: 0.00101 MiB in {folder}, removed at the end")
    monkeypatch.setattr(photographs, "lies_in_memory", lambda folder: True)
    notes = load_scene(tmp_path / "scene", images="disk", image_folder=folder).notes
    assert any("that folder lies in memory itself (tmpfs): choose one on a" in n for n in notes)
    image = scene.views[1].image
    assert not image.flags.writeable and not image.flags.owndata
    expect_random_reads(image)  # nor does that change it
    np.testing.assert_array_equal(image, picture(1, channels=4))


def test_memory_decides(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_transforms(tmp_path, 5)
    needed = 5 * 8 * 6 * 3
    for available, on_disk in ((2 * needed, False), (2 * needed - 1, True), (None, False)):
        monkeypatch.setattr(photographs, "available_memory", lambda value=available: value)
        scene = load_scene(tmp_path)
        assert any("photographs on disk" in note for note in scene.notes) == on_disk
        load_scene(tmp_path, images="disk")
    monkeypatch.setattr(photographs, "available_memory", lambda: needed // 4)
    with pytest.raises(InputError, match=r"5 photographs .* keep them on disk .*--downscale 2\."):
        load_scene(tmp_path, images="memory")
    assert len(load_scene(tmp_path, images="memory", downscale=2).views) == 5
    monkeypatch.setattr(
        photographs.shutil, "disk_usage", lambda folder: SimpleNamespace(free=needed // 9)
    )
    with pytest.raises(InputError, match=r"are free in .*; make room there, or use --downscale 3"):
        load_scene(tmp_path)


@pytest.mark.parametrize(("downscale", "alpha"), [(1, 255), (2, 0)])
def test_photographs_whose_alpha_is_ignored_are_decoded_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, downscale: int, alpha: int
) -> None:
    write_transforms(tmp_path, 40)
    for k in range(40):
        rgba = np.dstack([picture(k), np.full((6, 8), 255, np.uint8)])
        rgba[0, 0, 3] = alpha
        Image.fromarray(rgba).save(tmp_path / f"images/{k:03d}.png")
    decoded: Counter[str] = Counter()

    def counted(path: Path) -> np.ndarray:
        decoded[path.name] += 1
        return read_image(path)

    for module in (photographs, assemble, transparency):
        monkeypatch.setattr(module, "read_image", counted)
    scenes = in_places(tmp_path, downscale=downscale)
    assert {scene_digest(scene) for scene in scenes} == {scene_digest(scenes[0])}
    decoded.clear()
    load_scene(tmp_path, downscale=downscale)
    looked_at = assemble.LOOKED_AT
    assert min(decoded.values()) == 1 and sum(decoded.values()) <= 40 + looked_at
    monkeypatch.setattr(photographs, "available_memory", lambda: 40 * 8 * 6)
    decoded.clear()
    assert any("on disk" in note for note in load_scene(tmp_path).notes)
    assert min(decoded.values()) == 2


def test_a_disk_that_is_full_later_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_transforms(tmp_path, 5)

    def full(self: PixelFile, image: np.ndarray) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(PixelFile, "add", full)
    with pytest.raises(InputError, match="which cannot be written: No space left on device; make"):
        load_scene(tmp_path, images="disk")
    with pytest.raises(InputError, match="cannot be written: No such file"):
        load_scene(tmp_path, images="disk", image_folder=tmp_path / "nowhere")


@pytest.mark.ci
def test_the_command_says_where_they_are_and_goes_on_anywhere(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    write_transforms(tmp_path / "scene", 8, scale=3)
    run = tmp_path / "runs" / "a"
    begin = ["train", str(tmp_path / "scene"), "--output", str(run), "--model", "rgb"]
    begin += ["--steps", "8", "--voxels", "512", "--threads", "1"]
    monkeypatch.setattr(photographs, "TELL_EVERY", -1.0)
    assert main([*begin, "--images", "disk", "--keep", "checkpoint"]) == 0
    said = capsys.readouterr().out
    assert f"MiB in {run}, removed at the end" in said
    assert "read 7 of 8 photographs" in said
    field = (run / "field.safetensors").read_bytes()
    assert main(["train", "--resume", str(run), "--images", "disk"]) == 0
    assert main([*begin, "--keep", "checkpoint", "--overwrite"]) == 0
    assert "on disk" not in capsys.readouterr().out.rpartition("reading ")[2]
    assert (run / "field.safetensors").read_bytes() == field
    assert main(["eval", str(run), "--threads", "1"]) == 0


def test_photographs_that_change_are_told(tmp_path: Path) -> None:
    write_transforms(tmp_path, 4)
    scene = load_scene(tmp_path, images="files")
    Image.fromarray(picture(1, channels=4)).save(tmp_path / "images/001.png")
    with pytest.raises(InputError, match=r"001.png: has changed while it was read; begin again\."):
        _ = scene.views[1].image
    with pytest.raises(InputError, match="images must be one of"):
        load_scene(tmp_path, images="cloud")  # type: ignore[arg-type]


def test_where_large_temporary_files_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert Keeping(folder=tmp_path).disk == tmp_path
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(photographs.tempfile, "tempdir", None)
    assert Keeping().disk == tmp_path
    monkeypatch.delenv("TMPDIR")
    monkeypatch.setattr(photographs.tempfile, "tempdir", None)
    assert Keeping().disk.is_dir()
