"""Blocks as jobs: begun, lost, taken over, stopped, never trained twice; then one scene."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
import trimesh

from tests.support import cli_process
from tests.support.solid_fields import ball_field
from tests.support.tiny_runs import run, start
from warpnerf.blocks import train
from warpnerf.blocks.cut import cut as cut_scene
from warpnerf.blocks.engines import Work
from warpnerf.blocks.folder import BlockFolder, stored_source, write_blocks
from warpnerf.blocks.train import BlockTraining
from warpnerf.checks import InputError
from warpnerf.rendering.composite import CompositeField
from warpnerf.runs.checkpoint import save_field
from warpnerf.scenes.formats.load import load_scene

ROOM = ("builtin:room-sparse", "--downscale", "8")
OPTIONS = ("--voxels", "512", "--model", "rgb", "--sampler", "march")


def cut(folder: Path) -> Path:
    code, _, err = run("blocks", *ROOM, "--output", folder, "--count", "2")
    assert code == 0, err
    return folder


def refused(*arguments: str | Path) -> str:
    code, _, err = run(*arguments)
    assert code == 2 and err.count("\n") == 1, err
    return err


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two blocks that were trained by the command, one alone first."""
    folder = cut(tmp_path_factory.mktemp("blocks") / "room")
    options = ("--threads", "1", "--", "--steps", "12", *OPTIONS)
    code, out, err = run("train-blocks", folder, "--only", "1", *options)
    assert code == 0 and "block-0" not in out, (out, err)
    assert f"{folder}: block-0 has not been trained" in refused("eval", folder)
    code, out, err = run("train-blocks", folder, "--threads", "1")  # options are kept
    assert code == 0 and "block-0 is done" in out and "block-1 begins" not in out, (out, err)
    assert "2 of 2 blocks done\n" in out
    return folder


def test_blocks_are_one_scene(trained: Path, tmp_path: Path) -> None:
    json_file = tmp_path / "figures.json"
    code, _, err = run("eval", trained, "--json", json_file)
    assert code == 0 and len(json.loads(json_file.read_text())["images"]) == 10, err
    code, _, err = run(
        "render", trained, "--photographs", "test_03.png", "--output", tmp_path / "a"
    )
    assert code == 0 and (tmp_path / "a/test_03.png").exists(), err
    field, _ = BlockFolder.read(trained).load_field("cpu", 1)
    assert isinstance(field, CompositeField)
    camera = load_scene("builtin:room-sparse", downscale=8).views[3].camera
    seen = [field.render(camera).rgb, *(member().render(camera).rgb for member in field.members)]
    assert all(np.abs(seen[0] - alone).max() > 1e-5 for alone in seen[1:])


@pytest.mark.ci  # exports for seconds
def test_exports_are_the_cores_joined(trained: Path, tmp_path: Path) -> None:
    """A ball in the middle of two blocks, which both know, is written once."""
    shutil.copytree(trained, tmp_path / "ball")
    blocks, middle, radius = BlockFolder.read(tmp_path / "ball"), (0.1, -0.2, 0.6), 0.4
    for number in range(2):
        ball = ball_field(middle, radius)
        save_field(blocks.run(number).folder / "field.safetensors", ball)
        config = blocks.run(number).folder / "config.json"  # as where the folder was moved
        config.write_text(config.read_text().replace(str(trained), str(tmp_path / "gone")))
    files = [tmp_path / "a.ply", tmp_path / "a.splat.ply"]
    code, _, err = run("export", blocks.folder, *files, "--unseen", "--threads", "1")
    assert code == 0 and files[1].stat().st_size > 10_000, err
    made = trimesh.load(files[0])
    away = np.linalg.norm(made.vertices - middle, axis=1)
    np.testing.assert_allclose(away, radius, atol=0.03)
    assert made.area == pytest.approx(4.0 * np.pi * radius**2, rel=0.15)
    for block in blocks.config.blocks:
        low, high = np.array(block.core_min), np.array(block.core_max)
        assert ((low <= made.vertices) & (made.vertices <= high)).all(axis=1).sum() > 200
    save_field(blocks.run(1).folder / "field.safetensors", ball_field((0.1, -0.2, 9.0), radius))
    code, out, err = run("export", blocks.folder, *files, "--unseen", "--threads", "1")
    assert code == 0 and out.count("block-1 has no") == 2 and "block-0 has no" not in out, err
    assert "level must be" in refused("export", blocks.folder, *files, "--level=-1")


def test_what_is_no_scene_in_blocks_is_refused(trained: Path, tmp_path: Path) -> None:
    assert "block-0 was begun with" in refused("train-blocks", trained, "--", "--steps", "9")
    assert "has blocks 0 to 1" in refused("train-blocks", trained, "--only", "2")
    assert "give --engine ray" in refused("train-blocks", trained, "--address", "auto")
    assert "--output is not an option" in refused("train-blocks", trained, "--", "--output", "x")
    assert "blocks.json does not exist" in refused("train-blocks", tmp_path)
    assert "is made of one field" in refused("export", trained, tmp_path / "a.nvdb")
    assert "--texture is for" in refused("export", trained, tmp_path / "a.glb", "--texture")
    assert "normals are of one field" in refused(
        "render", trained, "--show", "normals", "--output", tmp_path / "a.mp4"
    )
    other = tmp_path / "other"
    shutil.copytree(trained, other)
    part = json.loads((other / "block-1.part.json").read_text())
    part["box_min"][0] += 0.1  # as another cut has it
    (other / "block-1.part.json").write_text(json.dumps(part))
    for command in ("eval", "train-blocks"):
        assert "block-1 holds a run of another scene" in refused(command, other)
    assert "--nonsense" in refused("train-blocks", cut(tmp_path / "new"), "--", "--nonsense", "1")
    assert not (tmp_path / "new/block-0").exists() and not (tmp_path / "new/train.json").exists()


@pytest.fixture(scope="module")
def untrained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two blocks, as they are cut."""
    return cut(tmp_path_factory.mktemp("untrained") / "room")


@pytest.mark.parametrize("name", ["train.json", "block-0.log", "block-1"])
def test_links_and_pipes_are_not_written_to(untrained: Path, tmp_path: Path, name: str) -> None:
    folder, precious = tmp_path / "room", tmp_path / "precious"
    words = ("train-blocks", folder, "--threads", "1", "--", "--steps", "2", *OPTIONS)
    shutil.copytree(untrained, folder)
    for is_there in (False, True):
        (folder / name).symlink_to(precious)
        assert f"{name} is a link, and train-blocks writes" in refused(*words)
        assert precious.exists() == is_there
        precious.mkdir(exist_ok=True)
        (folder / name).unlink()
    os.mkfifo(folder / name)
    assert f"{name} is neither a file nor a folder" in refused(*words)


@pytest.mark.parametrize("words", [["--output", "x"], ["--overwrite"], ["--resume=x"]])
def test_stored_options_are_no_others_than_given_ones(
    untrained: Path, tmp_path: Path, words: list[str]
) -> None:
    shutil.copytree(untrained, tmp_path / "room")
    (tmp_path / "room/train.json").write_text(json.dumps({"options": ["--steps", "2", *words]}))
    name = words[0].partition("=")[0]
    says = f"train.json: $.options: {name} is not an option for the training of blocks"
    assert says in refused("train-blocks", tmp_path / "room")


def test_blocks_that_are_not_those_of_a_cut_are_refused(untrained: Path, tmp_path: Path) -> None:
    folder = tmp_path / "room"
    words = ("train-blocks", folder, "--threads", "1", "--", "--steps", "2", *OPTIONS)
    shutil.copytree(untrained, folder)
    path = folder / "blocks.json"
    content = json.loads(path.read_text())

    def said(**changes: object) -> str:
        first = content["blocks"][0] | changes
        path.write_text(json.dumps(content | {"blocks": [first, *content["blocks"][1:]]}))
        return refused(*words)

    assert "at `$.blocks[0].photographs`; correct" in said(photographs=-5)
    low = content["blocks"][0]["core_min"]
    high = [(a + b) / 2 for a, b in zip(low, content["blocks"][0]["core_max"], strict=True)]
    assert "$.blocks: cores must fill the box of the scene, each place once" in said(core_max=high)
    path.write_text(json.dumps(content | {"blocks": []}))
    assert "at `$.blocks`; correct" in refused(*words)
    part = folder / "block-0.part.json"
    says = refused("blocks", part, "--count", "2", "--output", tmp_path / "parts")
    assert f"{part} is a part of a capture already" in says and not (tmp_path / "parts").exists()


def test_blocks_are_not_resumed_as_a_run(trained: Path) -> None:
    said = refused("train", "--resume", trained)
    assert f"--resume {trained} holds blocks; warpnerf train-blocks {trained} continues" in said


@pytest.mark.ci  # a process of its own, in which Warp starts
def test_blocks_are_read_in_silence(trained: Path) -> None:
    done = cli_process.run("eval", trained, env=dict(os.environ))
    assert done.returncode == 0 and done.stderr == ""


class Scripted:
    """An engine whose trainings end at once with the given codes, by block; 0 with a field."""

    slots, threads = 1, 1

    def __init__(self, folder: Path, codes: dict[str, int], on_start: Callable[[str], None]):
        self.folder, self.codes, self.on_start = folder, codes, on_start

    def start(self, work: Work) -> int:
        name = work.log.stem
        self.on_start(name)
        work.log.write_text(f"warpnerf: error: {name} has no photograph.\n")
        code = self.codes.get(name, 0)
        if name not in self.codes:
            (self.folder / name).mkdir(exist_ok=True)
            for file in ("config.json", "field.safetensors"):
                (self.folder / name / file).touch()
        return code

    def ended(self, started: int) -> int:
        return started

    def stop(self, started: object) -> None:
        pass

    def close(self) -> None:
        pass


def test_a_block_that_cannot_be_trained_stops_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And one that another process still saves is waited for; the first of all may be refused."""
    monkeypatch.setattr(train, "AGAIN", 0.0)
    scene = load_scene(ROOM[0], downscale=8)
    source = stored_source(ROOM[0], 8, None, None)
    blocks = write_blocks(tmp_path / "room", scene, source, cut_scene(scene, 5))
    begun: list[str] = []

    def on_start(name: str) -> None:
        begun.append(name)
        if name == "block-3":
            saving.close()

    codes = {"block-2": 2, "block-3": 0}  # is refused; ends without a field
    engine = Scripted(blocks.folder, codes, on_start)
    with pytest.raises(InputError, match="block-2: block-2 has no photograph"):
        BlockTraining(blocks, [2, 4], [], engine).run(lambda line: None, lambda states: None)
    begun.clear()
    with ExitStack() as saving:
        saving.enter_context(blocks.run(0).only_writer())
        training = BlockTraining(blocks, range(5), [], engine)
        assert training.run(lambda line: None, lambda states: None) == 1
    assert begun == [f"block-{n}" for n in (1, 2, 3, 0, 4)]
    assert [state.state for state in training.states()] == ["done"] * 2 + ["failed"] * 2 + ["done"]


def until(what: Callable[[], bool], process: subprocess.Popen[str]) -> None:
    limit = time.monotonic() + cli_process.LIMIT
    while not what():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < limit
        time.sleep(0.05)


@pytest.mark.ci  # trains in processes for seconds
def test_a_lost_block_is_taken_over_and_a_signal_to_all_saves_it(tmp_path: Path) -> None:
    """As a scheduler stops a job: a training is asked twice at once, by it and by its parent."""
    blocks = BlockFolder.read(cut(tmp_path / "room"))
    endless = ("--steps", "1000000", "--checkpoint-every", "0.3", *OPTIONS)
    one = ("--only", "0", "--threads", "1")
    process = start("train-blocks", blocks.folder, *one, "--", *endless)
    run_of_first = blocks.run(0)
    until(lambda: run_of_first.last_step is not None, process)
    lock = run_of_first.folder / ".lock"
    lost_at, killed = run_of_first.last_step or 0, int(lock.read_text())
    os.kill(killed, signal.SIGKILL)
    until(lambda: "resuming after step" in (blocks.folder / "block-0.log").read_text(), process)
    until(lambda: (run_of_first.last_step or 0) > lost_at, process)
    for number in (signal.SIGINT, signal.SIGTERM):
        os.kill(int(lock.read_text()), number)
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate(timeout=cli_process.LIMIT)
    assert process.returncode == 143, (out, err)
    assert "block-0 was lost; it is taken over" in out and "block-0 resumes" in out
    assert "continue with: warpnerf train-blocks" in out and not lock.exists()
    said = (blocks.folder / "block-0.log").read_text()
    assert f"stopped and saved after step {run_of_first.last_step}" in said
