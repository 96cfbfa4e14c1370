"""Every command that looks at a run's photographs again ignores what its training ignored."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import warpnerf as wn
from tests.support.tiny_fields import tiny_field
from tests.support.tiny_scenes import write_transforms
from warpnerf.checks import InputError
from warpnerf.cli.evaluate import eval_command
from warpnerf.cli.export import Options, export_command
from warpnerf.cli.render import RenderOptions, render_command
from warpnerf.cli.train import TrainOptions, train_command
from warpnerf.config import TrainConfig
from warpnerf.exporting import visibility as exporting
from warpnerf.runs.run import Run
from warpnerf.runs.scene import load_run_scene
from warpnerf.scenes.formats.load import load_scene


def masked_run(folder: Path) -> Path:
    """A run on six photographs; masks in the scene's folder hide all of one, half of the rest."""
    write_transforms(folder / "scene", 6)
    (folder / "scene/hide").mkdir()
    for number in range(6):
        mask = np.zeros((6, 8), np.uint8)
        mask[:, 4:] = 0 if number == 2 else 255
        Image.fromarray(mask).save(folder / f"scene/hide/{number:03d}.png")
    masks = folder / "scene/hide"
    scene = load_scene(folder / "scene", masks=masks)
    run = Run(folder / "run")
    distance = scene.content_distance
    run.create(scene, str(folder / "scene"), 1, distance, TrainConfig(), str(masks))
    run.save_field(tiny_field())
    return folder / "run"


@pytest.mark.parametrize("moved", [False, True])
def test_commands_keep_the_masks_of_the_training(
    tmp_path: Path, moved: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, place = masked_run(tmp_path), None
    if moved:
        (tmp_path / "scene").rename(tmp_path / "elsewhere")
        place = str(tmp_path / "elsewhere")
    stills = tmp_path / "stills"
    assert (
        render_command(run, RenderOptions(stills="all", output=stills), scene=place, threads=1) == 0
    )
    assert len(list(stills.glob("*.png"))) == 5

    looked: list[np.ndarray] = []
    visibility = exporting.visibility

    def look(field: Any, views: Any, on_camera: Any) -> Any:
        looked.extend(view.mask for view in views)
        return visibility(field, views, on_camera)

    monkeypatch.setattr(exporting, "visibility", look)
    assert export_command(run, (tmp_path / "a.npz",), Options(), scene=place, threads=1) == 0
    assert looked and all(mask[:, 4:].all() and not mask[:, :4].any() for mask in looked)


def test_a_training_of_a_scene_that_moved_goes_on_with_its_masks(tmp_path: Path) -> None:
    write_transforms(tmp_path / "scene", 6, scale=2)
    masks = tmp_path / "scene/hide"
    masks.mkdir()
    for number in range(6):
        Image.new("L", (16, 12), 255).save(masks / f"{number:03d}.png")
    run = tmp_path / "run"
    tiny = {"steps": ("2",), "threads": ("1",), "grid.voxels": ("512",)}
    kept = {"masks": masks, "keep": "checkpoint"}
    options = TrainOptions(scene=str(tmp_path / "scene"), output=run, **kept)
    assert train_command(options, tiny) == 0
    (tmp_path / "scene").rename(tmp_path / "elsewhere")
    options = TrainOptions(scene=str(tmp_path / "elsewhere"), resume=run)
    assert train_command(options) == 0
    (tmp_path / "elsewhere/hide").rename(tmp_path / "hidden")
    with pytest.raises(InputError, match="scene/hide: the masks that the run was trained with"):
        train_command(options)


def test_commands_on_a_scene_that_moved_say_how_to_name_it(tmp_path: Path) -> None:
    run = masked_run(tmp_path)
    (tmp_path / "scene").rename(tmp_path / "elsewhere")
    for command in (
        lambda: eval_command(run),
        lambda: export_command(run, (tmp_path / "a.npz",), Options(), threads=1),
        lambda: render_command(run, RenderOptions(output=tmp_path / "a.gif"), threads=1),
    ):
        with pytest.raises(InputError, match=r"scene: the scene .* no longer there.*by --scene"):
            command()


def test_another_scene_is_not_taken_for_one_that_moved(tmp_path: Path) -> None:
    run = masked_run(tmp_path)
    write_transforms(tmp_path / "other", 4)
    other = {"scene": str(tmp_path / "other"), "threads": 1}
    for command in (
        lambda: export_command(run, (tmp_path / "a.npz",), Options(), **other),
        lambda: render_command(run, RenderOptions(output=tmp_path / "a.gif"), **other),
    ):
        with pytest.raises(InputError, match=r"other: is not what .* 3 photographs, not 5"):
            command()


def test_the_viewer_shows_no_photograph_that_is_masked_wholly(tmp_path: Path) -> None:
    pytest.importorskip("viser")
    from warpnerf.viewer.view import open_view

    run = masked_run(tmp_path)
    n = len(load_run_scene(Run(run).read_config()).training_cameras)
    assert n < len(load_scene(tmp_path / "scene").training_cameras)
    for scene in (None, str(tmp_path / "scene")):
        with open_view(
            [run], scene=scene, host="127.0.0.1", port=0, device="cpu", threads=1
        ) as session:
            assert len(session._stage.cameras) == n


def test_the_viewer_of_a_field_wants_a_scene_that_is_loaded() -> None:
    pytest.importorskip("viser")
    for scene in ("photos", 3):
        with pytest.raises(
            InputError, match=r"view: scene must be a Scene or None, not .* gives that"
        ):
            wn.view(tiny_field(), scene=scene)  # type: ignore[arg-type]


def test_masks_that_are_gone_are_named(tmp_path: Path) -> None:
    config = Run(masked_run(tmp_path)).read_config()
    (tmp_path / "scene/hide").rename(tmp_path / "hidden")
    for moved in (None, str(tmp_path / "scene")):
        with pytest.raises(InputError, match="scene/hide: the masks that the run was trained with"):
            load_run_scene(config, moved)
