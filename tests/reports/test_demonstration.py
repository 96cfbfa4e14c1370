"""The demonstration without its trainings: the table, the picture, and what is refused."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.support.tiny_fields import tiny_field
from warpnerf.checks import InputError
from warpnerf.config import Scaling, TrainConfig
from warpnerf.media.camera_path import backing_away
from warpnerf.media.pictures import depth_colours
from warpnerf.rendering.field import Field
from warpnerf.reports import demonstration
from warpnerf.reports.comparison import Row
from warpnerf.reports.demonstration import (
    BACK,
    CAMERAS,
    NAMES,
    SHOWN,
    Demo,
    comparison_picture,
    demo,
)
from warpnerf.reports.experiment import Candidate
from warpnerf.scenes.builtin.room import first_hit, photograph
from warpnerf.scenes.cameras.camera import Camera

VALUES = dict.fromkeys(SHOWN, 0.5)


def test_the_table_says_of_each_row_whether_it_is_better_or_why_not(tmp_path: Path) -> None:
    rows = [
        Row(
            candidate=Candidate(name=name, config=TrainConfig(scaling=scaling)),
            values={key: [value + by, value - by] for key, value in values.items()},
            seconds=[1.0, 2.0],
            differences={},
        )
        for (scaling, name), values, by in zip(
            NAMES.items(),
            (VALUES, {**VALUES, "psnr": 0.6, "front_train": 0.4, "seen_depth_error": 0.7}),
            (0.0, 0.2),
            strict=True,
        )
    ]
    made = Demo(
        rows=rows, fields={}, picture=tmp_path, video=tmp_path, record=tmp_path, page=tmp_path
    )
    lines = {re.split("  |: ", line)[0]: line.split() for line in str(made).splitlines()}
    assert lines["PSNR [dB]"][2:] == ["0.50", "0.60", "better"]
    assert lines["light in front, training rays"][-1] == "better"
    assert lines["depth error there [scene units]"][-3:] == ["0.7000", "no", "better"]
    assert lines["seconds of training"][-2:] == ["2", "2"]
    said = str(made)
    assert "depth error there: no better, as light that ends in front, on test rays, makes" in said
    assert "\nSSIM; PSNR of views pulled back" in said and ": no better, with these seeds" in said


def test_the_first_row_of_the_picture_is_the_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demonstration, "PICTURE_SIZE", (64, 48))
    scene = demonstration.load_scene("builtin:room-sparse", downscale=8)
    fields: dict[Scaling, Field] = {"none": tiny_field(), "clamped": tiny_field(density=0.0)}
    picture = comparison_picture(scene, fields, {"none": VALUES, "clamped": VALUES}, 4.0)
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
            demo(output, downscale=8)
    with pytest.raises(InputError, match="steps"):
        demo(tmp_path / "demo", steps=0)
    with pytest.raises(InputError, match=r"holds other files \(file\); name a new folder"):
        demo(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
