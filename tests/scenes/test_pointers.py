"""Files of Git LFS that were not fetched: a few lines of text in place of what they stand for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.scenes.test_colmap import scene_with_model
from tests.support.tiny_scenes import write_transforms
from warpnerf.checks import InputError
from warpnerf.scenes.formats.load import load_scene

POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a21\nsize 12345\n"


@pytest.mark.parametrize(
    "name",
    ["transforms.json", "images/001.png", "sparse/0/cameras.bin", "sparse/0/points3D.bin", "m.ply"],
)
def test_a_pointer_is_told(tmp_path: Path, name: str) -> None:
    (scene_with_model if name.startswith("sparse") else write_transforms)(tmp_path)
    (tmp_path / name).write_text(POINTER)
    if name.endswith(".ply"):
        assert load_scene(tmp_path).points is None  # it is only tried
        return
    says = rf"{Path(name).name}: is a Git LFS pointer, not the file itself; run `git lfs pull`"
    with pytest.raises(InputError, match=says):
        load_scene(tmp_path)


def test_poses_of_llff(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    (tmp_path / "transforms.json").unlink()
    np.save(tmp_path / "poses_bounds.npy", np.zeros((4, 17)))
    (tmp_path / "poses_bounds.npy").write_text(POINTER)
    with pytest.raises(InputError, match=r"poses_bounds\.npy: is a Git LFS pointer"):
        load_scene(tmp_path)
