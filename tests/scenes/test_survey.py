"""What a look at a scene's files finds, besides what loading it does."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.support.tiny_scenes import ring, save, write_blender, write_transforms
from warpnerf.scenes.formats.load import load_scene
from warpnerf.scenes.formats.survey import survey


def test_formats_are_named(tmp_path: Path) -> None:
    write_transforms(tmp_path / "a")
    write_blender(tmp_path / "b", "train", ring(4))
    write_blender(tmp_path / "b", "test", ring(2))
    for path in (tmp_path / "a", tmp_path / "a" / "transforms.json"):
        found = survey(path)
        assert found.format == "instant-ngp / nerfstudio (transforms.json)"
        assert found.files == (tmp_path / "a" / "transforms.json",)
    found = survey(tmp_path / "b")
    assert found.format == "Blender / NeRF-synthetic (transforms_train.json, transforms_test.json)"
    assert survey("builtin:room").format.startswith("built in")
    assert survey(tmp_path / "nowhere").files == ()


def test_a_file_that_is_named_is_the_one_that_is_surveyed(tmp_path: Path) -> None:
    write_blender(tmp_path, "train", ring(4))
    content = write_transforms(tmp_path, 4)
    for name in ("transforms.json", "transforms_mine.json"):
        save(tmp_path / name, content | {"exposure": 2.0})
        found = survey(tmp_path / name)
        assert found.format == f"instant-ngp / nerfstudio ({name})"
        assert found.files == (tmp_path / name,) and "exposure" in found.diagnostics[0]
    assert survey(tmp_path).format.startswith("Blender")
    np.savez(tmp_path / "a.npz", a=1)
    assert survey(tmp_path / "a.npz").format == "npz (a.npz)"


def test_all_poses_that_are_refused_are_named(tmp_path: Path) -> None:
    content = write_transforms(tmp_path, 6)
    content["frames"][1]["transform_matrix"][0][0] += 0.1
    content["frames"][4]["transform_matrix"] = [[1.0]]
    save(tmp_path / "transforms.json", content)
    assert survey(tmp_path).refused == ("$.frames[1]", "$.frames[4]")


def test_poses_that_are_not_quite_rigid_are_counted(tmp_path: Path) -> None:
    content = write_transforms(tmp_path, 4)
    assert survey(tmp_path).diagnostics == ()
    content["frames"][2]["transform_matrix"][0][0] += 3e-4
    save(tmp_path / "transforms.json", content)
    found = survey(tmp_path)
    assert found.refused == ()
    assert (
        len(found.diagnostics) == 1 and "1 of 4 poses are not quite rigid" in found.diagnostics[0]
    )


def test_unknown_keys_are_named_and_harmless_ones_are_not(tmp_path: Path) -> None:
    content = write_transforms(tmp_path, 4)
    content |= {"aabb_scale": 4, "exposure": 2.0}
    content["frames"][3] |= {"sharpness": 9.0, "white_balance": [1, 1, 1]}
    save(tmp_path / "transforms.json", content)
    (finding,) = survey(tmp_path).diagnostics
    assert finding.endswith("keys that are not read: exposure, white_balance")


def test_what_cannot_be_read_is_left_to_loading(tmp_path: Path) -> None:
    (tmp_path / "transforms.json").write_text("{")
    found = survey(tmp_path)
    assert (found.refused, found.diagnostics) == ((), ())


@pytest.mark.parametrize(("times", "said"), [((0.0, 0.0, 0.0, 0.0), False), ((0, 1, 1, 2), True)])
def test_times_of_what_moves_are_said(tmp_path: Path, times: tuple[float, ...], said: bool) -> None:
    content = write_transforms(tmp_path)
    for frame, time in zip(content["frames"], times, strict=True):
        frame["time"] = time
    save(tmp_path / "transforms.json", content)
    found = " ".join(survey(tmp_path).diagnostics)
    assert ("frames have 3 different times, but the scene is trained as if" in found) == said


def test_other_files_of_frames_are_named(tmp_path: Path) -> None:
    content = write_transforms(tmp_path / "a", 8)
    save(tmp_path / "a" / "transforms_test.json", content)
    note = "also in the folder, and not read: transforms_test.json"
    assert note in load_scene(tmp_path / "a").notes
    for k in range(3):
        save(tmp_path / "a" / f"transforms_{k}.json", content)
    note = "not read: transforms_0.json, transforms_1.json, transforms_2.json, ... (4)"
    assert load_scene(tmp_path / "a").notes[-1].endswith(note)
    write_blender(tmp_path / "b", "train", ring(4))
    write_blender(tmp_path / "b", "test", ring(2))
    assert not any("also in the folder" in note for note in load_scene(tmp_path / "b").notes)
    save(tmp_path / "b" / "transforms_all.json", content)
    note = "also in the folder, and not read: transforms_all.json"
    assert note in load_scene(tmp_path / "b").notes
