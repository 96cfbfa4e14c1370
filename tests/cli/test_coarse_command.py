"""The short training before a training, as the command shows it."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.support.cli_process import command, make_scene
from warpnerf.runs.run import Run
from warpnerf.training import coarse

FEW = ("--model", "rgb", "--threads", "1", "--voxels", "8000", "--steps", "500")


def black_scene(folder: Path) -> Path:
    """Photographs that empty space explains as well as anything."""
    scene = make_scene(folder)
    for path in (scene / "images").iterdir():
        Image.fromarray(np.zeros((12, 16, 3), np.uint8)).save(path)
    return scene


@pytest.mark.ci  # a training of seconds
def test_the_command_says_that_nothing_was_found(tmp_path: Path) -> None:
    scene = black_scene(tmp_path)
    done = command("train", scene, "--output", "run", *FEW, folder=tmp_path, limit=None)
    assert done.code == 0, done.err
    assert f"note: {coarse.NOTHING_SEEN}" in done.out
    config = json.loads((done.run / "config.json").read_text())
    assert "found" not in config and coarse.NOTHING_SEEN in config["notes"]


def test_the_command_refuses_photographs_that_show_nothing(tmp_path: Path) -> None:
    scene = black_scene(tmp_path)
    longer = (*FEW[:-1], "2000")
    done = command("train", scene, "--output", "run", *longer, folder=tmp_path, limit=None)
    assert done.code == 2 and "200 steps of a short training met nothing opaque" in done.err
    assert not done.run.exists()


def test_the_command_refuses_distances_of_cameras_that_see_nothing(tmp_path: Path) -> None:
    scene = black_scene(tmp_path)
    each = ("--content-distance", "per-camera")
    done = command("train", scene, "--output", "run", *FEW, *each, folder=tmp_path, limit=None)
    assert done.code == 2 and not done.run.exists()
    assert done.err.count("\n") == 1 and "something opaque; use auto, or a number" in done.err


@pytest.mark.ci
def test_the_command_keeps_what_it_found(tmp_path: Path) -> None:
    scene = make_scene(tmp_path)
    done = command("train", scene, "--output", "run", *FEW, folder=tmp_path, limit=None)
    assert done.code == 0, done.err
    looking, _, rest = done.out.partition("found by a short training")
    assert "step 25" in looking.partition("estimating the extent of the scene")[2] and rest
    config = Run(done.run).read_config()
    assert config.found is not None
    assert config.found.content_distance == config.content_distance


@pytest.mark.ci
@pytest.mark.skipif(sys.platform == "win32", reason="no SIGINT for one process there")
def test_stopped_while_it_looks_the_command_leaves_nothing(tmp_path: Path) -> None:
    scene, run = make_scene(tmp_path), tmp_path / "run"
    process = subprocess.Popen(
        [sys.executable, "-m", "warpnerf", "train", str(scene), "--output", str(run), *FEW[:-4]],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout is not None
        for line in process.stdout:
            if "step " in line:
                break
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130 and err == "stopped\n"
    assert "content distance" not in out and not run.exists()
