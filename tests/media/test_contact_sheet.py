"""The sheet shows each view's panels in its own shape, and says what they are."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.support.tiny_fields import tiny_field
from tests.training.test_determinism import small_scene
from warpnerf.config import TrainConfig
from warpnerf.evaluation.metrics import truth
from warpnerf.media import contact_sheet as module
from warpnerf.media.contact_sheet import MAX_WIDTH, SheetRow, contact_sheet, spread
from warpnerf.media.filming import depth_range
from warpnerf.media.pictures import depth_colours, depth_legend
from warpnerf.rendering.field import Rendering
from warpnerf.runs.run import Run
from warpnerf.scenes.scene import Scene

TRUTH, SEEN = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)


def row(width: int, height: int, *, depth: float | None = None, **changes: Any) -> SheetRow:
    """Red truth, green rendering, 2 units away."""
    shape = (height, width)
    rendering = Rendering(
        rgb=np.full((*shape, 3), SEEN), depth=np.full(shape, 2.0), opacity=np.ones(shape)
    )
    values: dict[str, Any] = {
        "name": "view.png",
        "psnr": 20.0,
        "target": np.full((*shape, 3), TRUTH),
        "rendering": rendering,
        "depth": None if depth is None else np.full(shape, depth),
    }
    return SheetRow(**values | changes)


def places(sheet: np.ndarray, colour: tuple[float, ...] | np.ndarray) -> list[tuple[int, ...]]:
    """Top, left, height and width of panels of exactly one colour, one below the other."""
    found = (sheet == np.round(255 * np.asarray(colour))).all(axis=2)
    long = found.sum(axis=1) >= 20  # not the legend's single columns
    edges = np.flatnonzero(np.diff(np.concatenate([[False], long, [False]]).astype(int)))
    boxes = []
    for top, bottom in edges.reshape(-1, 2):
        columns = np.flatnonzero(found[top:bottom].all(axis=0))
        boxes.append((top, columns[0], bottom - top, len(columns)))
    return [tuple(int(x) for x in box) for box in boxes]


@pytest.mark.parametrize(("count", "indices"), [(1, [0]), (3, [0, 1, 2]), (10, [0, 3, 6, 9])])
def test_views_are_spread_over_the_split(count: int, indices: list[int]) -> None:
    assert spread(count) == indices


@pytest.mark.parametrize("size", [(160, 120), (270, 480), (8, 6), (1200, 900), (900, 12)])
@pytest.mark.parametrize("known", [False, True])
def test_panels_keep_their_shape_and_fit(size: tuple[int, int], known: bool) -> None:
    sheet = contact_sheet([row(*size, depth=3.0 if known else None)] * 4, "four", 1.0, 4.0)
    assert sheet.dtype == np.uint8 and sheet.shape[1] <= MAX_WIDTH
    boxes = places(sheet, TRUTH)
    assert len(boxes) == 4
    for _, _, height, width in boxes:
        assert abs(width / height / (size[0] / size[1]) - 1.0) < 0.2
        assert max(width, height) >= 300
    for colour in (SEEN, depth_colours(np.array([[2.0]]), 1.0, 4.0)[0, 0]):
        assert [box[::2] for box in places(sheet, colour)] == [box[::2] for box in boxes]


def test_columns_follow_each_other_and_hold_portrait_and_landscape() -> None:
    near, far = 1.0, 4.0
    rows = [row(60, 90, depth=3.0), row(90, 60), row(600, 200, depth=3.0)]
    sheet = contact_sheet(rows, "mixed", near, far)
    colours = [TRUTH, SEEN, *(depth_colours(np.array([[d]]), near, far)[0, 0] for d in (2.0, 3.0))]
    columns = [places(sheet, colour) for colour in colours]
    assert [len(column) for column in columns] == [3, 3, 3, 2]
    for left, right in pairwise(columns):
        assert max(x + width for _, x, _, width in left) < min(x for _, x, _, _ in right)
    for column in columns[:3]:
        middles = [x + width / 2 for _, x, _, width in column]
        assert np.ptp(middles) <= 1.0
        assert column[0][2] > column[0][3] and column[1][2] < column[1][3]
    assert {box[0] for box in columns[3]} == {columns[0][0][0], columns[0][2][0]}


def test_small_photographs_keep_their_pixels() -> None:
    target = np.random.default_rng(0).random((6, 8, 3))
    sheet = contact_sheet([row(8, 6, target=target)], "small", 1.0, 4.0)
    pixels = np.round(255 * target)
    times = 450 // 8
    large = np.repeat(np.repeat(pixels, times, axis=0), times, axis=1)
    tops, lefts = np.nonzero((sheet == large[0, 0]).all(axis=2))
    part = sheet[tops[0] : tops[0] + len(large), lefts[0] : lefts[0] + large.shape[1]]
    np.testing.assert_array_equal(part, large)


def test_the_legend_says_the_range_below_the_panels() -> None:
    sheet = contact_sheet([row(160, 120)], "one", 1.5, 40.0)
    left = places(sheet, TRUTH)[0][1]
    top, _, height, _ = places(sheet, TRUTH)[0]
    for width in range(sheet.shape[1] - left, 0, -1):
        legend = depth_legend(width, 1.5, 40.0)
        below = sheet[top + height + 8 :][: legend.shape[0], left : left + width]
        if below.shape == legend.shape and np.array_equal(below, legend):
            return
    raise AssertionError("there is no legend")


def test_true_depth_that_is_not_known_is_white() -> None:
    depth = np.full((90, 60), 3.0)
    depth[:45] = np.inf
    sheet = contact_sheet([row(60, 90, depth=3.0), row(60, 90)], "x", 1.0, 4.0)
    half = contact_sheet([replace(row(60, 90), depth=depth)], "x", 1.0, 4.0)
    colour = depth_colours(np.array([[3.0]]), 1.0, 4.0)[0, 0]
    assert 2 * places(half, colour)[0][2] == places(sheet, colour)[0][2]


def test_words_differ_and_long_or_broken_ones_fit() -> None:
    sheet = contact_sheet([row(60, 90)], "title", 1.0, 4.0)
    for changed in (row(60, 90, psnr=21.0), row(60, 90, name="other.png")):
        other = contact_sheet([changed], "title", 1.0, 4.0)
        assert other.shape == sheet.shape and (other != sheet).any()
    long = contact_sheet([row(60, 90, name=90 * "long/" + "\ud800.png")], 900 * "t", 1.0, 4.0)
    assert long.shape[1] == MAX_WIDTH
    top, left, height, _ = places(long, TRUTH)[0]
    assert (long[top : top + height, left - 8 : left] == 255).all()  # no word runs into a panel
    assert (long[:, -6:] == 255).all()
    assert module._shortened("abc/0012.png", 60, 16).endswith("12.png")


def shown_by_a_run(folder: Path, scene: Scene, split: str, monkeypatch: Any) -> dict[str, Any]:
    """What a run's evaluation puts on its sheet."""
    run = Run(folder)
    run.create(scene, "builtin:room", 1, 2.0, TrainConfig())
    calls: list[tuple[Any, ...]] = []

    def noted(*arguments: Any) -> np.ndarray:
        calls.append(arguments)
        return contact_sheet(*arguments)

    monkeypatch.setattr("warpnerf.runs.pictures.contact_sheet", noted)
    result = run.evaluate(tiny_field(), scene, split)
    ((rows, title, near, far),) = calls
    pixels = np.asarray(Image.open(folder / "test.png"))
    np.testing.assert_array_equal(pixels, contact_sheet(rows, title, near, far))
    return {"rows": rows, "title": title, "depths": (near, far), "result": result}


def test_a_run_shows_views_spread_over_the_test_split(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = small_scene()
    names = [view.name for view in scene.views]
    scene = replace(scene, splits={"train": (0,), "test": tuple(range(1, len(names)))})
    found = shown_by_a_run(tmp_path, scene, "test", monkeypatch)
    tested = [scene.views[index] for index in scene.splits["test"]]
    rows = found["rows"]
    assert [row.name for row in rows] == [tested[index].name for index in spread(len(tested))]
    assert found["title"] == f"{scene.name}: {len(rows)} of {len(tested)} test views"
    figures = {image.name: image.psnr for image in found["result"].images}
    for shown in rows:
        view = next(view for view in tested if view.name == shown.name)
        assert shown.psnr == figures[shown.name] and shown.depth is view.depth
        np.testing.assert_array_equal(shown.target, truth(view, tiny_field().background))
    assert found["depths"] == depth_range(tiny_field(), [view.camera for view in tested])


def test_where_true_depths_are_known_they_set_the_range(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A field of fog would hide how wrong it is."""
    scene = small_scene()
    views = list(scene.views)
    for index, view in enumerate(views):
        depth = np.full((view.camera.height, view.camera.width), 5.0 + index, np.float32)
        depth[0, 0] = np.inf
        views[index] = replace(view, depth=depth)
    split = {"train": (0,), "test": tuple(range(1, len(views)))}
    scene = replace(scene, views=views, splits=split)
    found = shown_by_a_run(tmp_path, scene, "test", monkeypatch)
    assert found["depths"] == (6.0, 4.0 + len(views))


def test_a_run_without_test_views_shows_training_views_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = small_scene()
    scene = replace(scene, splits={"train": tuple(range(len(scene.views))), "test": ()})
    found = shown_by_a_run(tmp_path, scene, "train", monkeypatch)
    assert found["title"].endswith("training views, as there are no test views")


def test_a_sheet_goes_where_its_run_goes(tmp_path: Path) -> None:
    run = Run(tmp_path)
    run.create(small_scene(), "builtin:room", 1, 2.0, TrainConfig())
    run.sheet.write_bytes(b"older")
    run.create(small_scene(), "builtin:room", 1, 2.0, TrainConfig())
    assert not run.sheet.exists()


def test_what_the_typeface_has_not_is_not_drawn_as_boxes() -> None:
    name, plain = (
        contact_sheet([row(60, 40, name=f"{letter}.png")], f"{letter}: 1 view", 1.0, 3.0)
        for letter in "\u00fcu"
    )
    np.testing.assert_array_equal(name, plain)
