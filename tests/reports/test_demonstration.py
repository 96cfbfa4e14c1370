"""The demonstration, made tiny: both trainings, the figures, the picture and the film."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.support.tiny_fields import tiny_field
from warpnerf.checks import InputError
from warpnerf.config import Scaling
from warpnerf.media.camera_path import backing_away
from warpnerf.media.pictures import depth_colours
from warpnerf.rendering.field import Field
from warpnerf.reports import demonstration
from warpnerf.reports.demonstration import BACK, CAMERAS, SCALINGS, comparison_picture, demo
from warpnerf.scenes.builtin.room import first_hit, photograph
from warpnerf.scenes.cameras.camera import Camera


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demonstration, "FRAMES_PER_CAMERA", 2)
    monkeypatch.setattr(demonstration, "FRAME_SIZE", (32, 24))
    monkeypatch.setattr(demonstration, "PICTURE_SIZE", (64, 48))


def test_it_trains_both_and_shows_them(tiny: None, tmp_path: Path) -> None:
    reports: list[tuple[str, float, str]] = []
    result = demo(
        tmp_path / "demo",
        steps=50,
        downscale=8,
        threads=1,
        report=lambda *report: reports.append(report),
    )
    assert {path.name for path in (tmp_path / "demo").iterdir()} == {
        "floaters.png",
        "floaters.mp4",
        "figures.json",
    }
    figures = json.loads(result.record.read_text())["figures"]
    assert figures == result.figures
    for scaling in SCALINGS:
        row = figures[scaling]
        assert set(row) - {"flip"} == {"psnr", "ssim", "depth_error", "near_density", "seconds"}
        assert row["near_density"] > 0.0
        assert f"{row['psnr']:.2f}" in str(result)
    none, clamped = (result.fields[s].storage.values.numpy() for s in ("none", "clamped"))
    assert (none != clamped).any()
    stages = list(dict.fromkeys(stage for stage, _, _ in reports))
    assert [stage for stage in stages if stage.startswith("training")] == [
        "training without scaling",
        "training with scaling",
    ]
    assert ("training with scaling", 1.0) in [report[:2] for report in reports]
    with Image.open(result.picture) as picture:
        assert picture.width > 2 * 64 and picture.height > 3 * 48
    import av

    with av.open(result.video) as film:
        assert len(list(film.decode(video=0))) == 2 * len(CAMERAS)


def test_the_first_row_of_the_picture_is_the_truth(tiny: None) -> None:
    scene = demonstration.load_scene("builtin:room-sparse", downscale=8)
    row = {"psnr": 1.0, "ssim": 0.5, "depth_error": 1.0, "near_density": 0.1}
    fields: dict[Scaling, Field] = {"none": tiny_field(), "clamped": tiny_field(density=0.0)}
    picture = comparison_picture(scene, fields, {"none": row, "clamped": row}, 4.0)
    camera = next(view.camera for view in scene.views if view.name == CAMERAS[0])
    small = replace(
        camera, width=64, height=48, fx=3.2 * camera.fx, fy=3.2 * camera.fy, cx=32, cy=24
    )
    rgb, depth = photograph(backing_away(small, BACK, 2)[-1], 3)
    rows, columns = np.nonzero((picture == rgb[0, 0]).all(axis=2))
    found = [
        (top, left)
        for top, left in zip(rows, columns, strict=True)
        if np.array_equal(picture[top : top + 48, left : left + 64], rgb)
    ]
    ((top, left),) = found
    colours = np.round(255.0 * depth_colours(depth, 0.0, 4.0))
    right = picture[top : top + 48, left + 64 :]
    shifts = range(right.shape[1] - 63)
    assert any(np.array_equal(right[:, s : s + 64], colours) for s in shifts)
    below = [picture[top + n * 56 : top + n * 56 + 48, left : left + 64] for n in (1, 2)]
    for panel, field in zip(below, fields.values(), strict=True):
        seen = field.render(backing_away(small, BACK, 2)[-1]).rgb
        np.testing.assert_array_equal(panel, np.round(255.0 * np.clip(seen, 0.0, 1.0)))


def test_there_is_room_behind_the_cameras_that_are_backed_away_from() -> None:
    scene = demonstration.load_scene("builtin:room-sparse", downscale=8)
    cameras: dict[str, Camera] = {view.name: view.camera for view in scene.views}
    for name in CAMERAS:
        camera = cameras[name]
        free = first_hit(camera.position[None], camera.c2w[:, 2][None])[0]
        assert free > BACK
        last = backing_away(replace(camera, width=4, height=3), BACK, 2)[-1]
        assert photograph(last, 1)[1].min() > 0.1


def test_bad_input_is_refused_before_anything_is_trained(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("mine")
    for output in (file, file / "below"):
        with pytest.raises(InputError, match="--output"):
            demo(output)
    with pytest.raises(InputError, match="steps"):
        demo(tmp_path / "demo", steps=0)
    with pytest.raises(InputError, match=r"holds other files \(file\); name a new folder"):
        demo(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
