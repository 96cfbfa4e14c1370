"""config.json in a run's folder: read as it was written, and refused where it was changed."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.faulty_saves import new_run, run_with
from tests.training.test_determinism import small_scene
from warpnerf.checks import InputError
from warpnerf.config import TrainConfig
from warpnerf.runs.run import Run


def test_a_configuration_that_is_not_the_checkpoint_s_is_refused(tmp_path: Path) -> None:
    run = run_with(tmp_path, 1)
    path = tmp_path / "config.json"
    path.write_text(path.read_text().replace('"rays_per_step": 4096', '"rays_per_step": 8'))
    with pytest.raises(InputError, match=r"config\.json: train\.rays_per_step is 8, but .* 4096"):
        run.load_state()


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('"steps": 4000', '"steps": 0', "steps"),
        ('"steps": 4000', '"steps": "many"', r"train\.steps"),
        ('"downscale": 1', '"down": 1', "downscale"),
        ('"downscale": 1', '"downscale": 1, "downscale": 2', "twice"),
        ('"grow_at": "auto"', '"grow_at": [["auto"]]', "grow_at"),
        ('"grow_at": "auto"', '"grow_at": "never"', "grow_at"),
    ],
)
def test_a_broken_config_json_is_refused(tmp_path: Path, old: str, new: str, says: str) -> None:
    run = new_run(tmp_path)
    path = tmp_path / "config.json"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=rf"config\.json.*{says}"):
        run.read_config()


def test_the_configuration_comes_back_as_it_was(tmp_path: Path) -> None:
    config = TrainConfig(content_distance=0.1, background=(0.0, 1.0, 0.5), time_limit=3.0)
    run = Run(tmp_path)
    run.create(small_scene(), "builtin:room", 3, 0.1, config)
    read = run.read_config()
    assert (read.scene, read.downscale, read.train) == ("builtin:room", 3, config)
