"""What README.md and docs/python.md say in Python runs as it stands, in a smaller room and for
fewer steps."""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import warpnerf as wn
from tests.exporting.test_cameras import ball_scene
from tests.support.solid_fields import ball_field

ROOT = Path(__file__).parents[2]
STEPS = 5


def examples(document: str) -> list[str]:
    """Python in a document; blocks are short."""
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / document).read_text(), re.DOTALL)
    assert all(block.count("\n") <= 12 for block in blocks)
    return blocks


def run(document: str, block: str, names: dict[str, Any]) -> None:
    exec(compile(block, document, "exec"), names)


@pytest.fixture
def small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Scenes, trainings and paths are small, files are written to a folder of the test's."""
    load_scene, train, camera_path = wn.load_scene, wn.train, wn.camera_path

    def train_shortly(scene: wn.Scene, config: Any = None, **options: Any) -> wn.TrainResult:
        return train(scene, config and replace(config, steps=STEPS), **options)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(wn, "load_scene", lambda path: load_scene(path, downscale=8))
    monkeypatch.setattr(wn, "train", train_shortly)
    monkeypatch.setattr(
        wn, "camera_path", lambda scene, kind, n_frames: camera_path(scene, kind, n_frames=3)
    )


def test_the_python_of_the_readme_runs(small: None, capsys: pytest.CaptureFixture[str]) -> None:
    names: dict[str, Any] = {}
    (block,) = examples("README.md")
    run("README.md", block, names)
    assert names["image"].rgb.shape == (15, 20, 3)
    assert "psnr" in capsys.readouterr().out.lower()


def test_the_python_of_the_page_about_it_runs(small: None, tmp_path: Path) -> None:
    pytest.importorskip("av")
    pytest.importorskip("torch")
    names: dict[str, Any] = {}
    first, called, after, exported, scaled, rendered, with_head = examples("docs/python.md")
    for block in (first, called, after):
        run("docs/python.md", block, names)
    step, seconds, *figures = names["rows"][-1]
    assert step == STEPS and seconds > 0.0 and None not in figures
    assert (tmp_path / "orbit.mp4").stat().st_size > 0
    assert names["result"].progress.step == STEPS

    # After so few steps there is no surface yet.
    of_a_ball = names | {"result": SimpleNamespace(field=ball_field()), "scene": ball_scene()}
    run("docs/python.md", exported, of_a_ball)
    assert (tmp_path / "room.glb").stat().st_size > 0
    assert len(of_a_ball["splats"].centres) > 100

    run("docs/python.md", scaled, names)
    assert names["colors"].grad_fn is not None and names["distances"].shape == (100, 64)
    run("docs/python.md", rendered, names)
    assert names["rays"].rgb.shape == (1, 3) and names["raw"].grad.abs().max() > 0
    run("docs/python.md", with_head, names)
    assert all(tensor.grad.abs().max() > 0 for tensor in list(names["mlp"].parameters())[1:])
