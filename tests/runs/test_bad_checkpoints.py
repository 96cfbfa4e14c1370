"""Checkpoints that are none, through the command: one sentence, exit code 2, nothing changed."""

from __future__ import annotations

import errno
import io
import json
import os
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from tests.support import cli_process
from tests.support.tiny_fields import tiny_state
from tests.training.test_determinism import small_scene
from warpnerf.checks import InputError
from warpnerf.config import TrainConfig
from warpnerf.runs.checkpoint import load_checkpoint, load_field
from warpnerf.runs.run import Run
from warpnerf.runs.tensor_file import DamagedFileError

COMMANDS = {"eval": ("eval",), "resume": ("train", "--resume")}
EITHER = pytest.mark.parametrize("command", COMMANDS)


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    """The one checkpoint of a run."""
    run = Run(tmp_path / "run")
    run.create(small_scene(), "builtin:room", 8, 2.0, TrainConfig())
    run.save_checkpoint(tiny_state(5))
    return run.checkpoints[0]


def refused(command: str, checkpoint: Path) -> str:
    """What the command says; everything else that holds for all bad input is checked here."""
    folder = checkpoint.parent
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    process = cli_process.run(*COMMANDS[command], folder)
    assert process.returncode == 2, process.stderr
    assert "Traceback" not in process.stdout + process.stderr
    said = [line for line in process.stderr.splitlines() if line.startswith("warpnerf: ")]
    assert len(said) == 1 and said[0].startswith("warpnerf: error: ")
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before
    return said[0]


@EITHER
def test_64_a_cut_checkpoint(checkpoint: Path, command: str) -> None:
    content = checkpoint.read_bytes()
    checkpoint.write_bytes(content[: len(content) // 2])
    said = refused(command, checkpoint)
    assert f"{checkpoint} is damaged" in said and "train again" in said


@EITHER
def test_65_a_flipped_bit_in_a_checkpoint(checkpoint: Path, command: str) -> None:
    content = bytearray(checkpoint.read_bytes())
    content[-1000] ^= 4
    checkpoint.write_bytes(content)
    said = refused(command, checkpoint)
    assert f"{checkpoint} is damaged" in said and "SHA-256" in said


@EITHER
def test_66_a_checkpoint_of_another_version(checkpoint: Path, command: str) -> None:
    with safe_open(checkpoint, framework="numpy") as file:
        metadata = file.metadata()
    metadata["header"] = metadata["header"].replace("warpnerf-training-8", "warpnerf-training-9")
    save_file(load_file(checkpoint), checkpoint, metadata)
    said = refused(command, checkpoint)
    assert f"{checkpoint} has format 'warpnerf-training-9'" in said
    assert "use the version of warpnerf that wrote it" in said


def test_67_a_checkpoint_of_another_configuration(checkpoint: Path) -> None:
    path = checkpoint.with_name("config.json")
    config = json.loads(path.read_text())
    config["train"]["grid"]["voxels"] = 1000
    path.write_text(json.dumps(config))
    said = refused("resume", checkpoint)
    assert f"{path}: train.grid.voxels is 1000, but {checkpoint.name} was saved with" in said


class Explosive:
    """Executes what it likes when unpickled."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return (exec, ("raise SystemExit('boom')",))


@EITHER
@pytest.mark.parametrize("protocol", [0, pickle.HIGHEST_PROTOCOL])
def test_68_a_pickle_as_a_checkpoint(checkpoint: Path, command: str, protocol: int) -> None:
    stream = io.BytesIO()
    pickle.dump({"values": np.zeros(8), "bang": Explosive()}, stream, protocol)
    checkpoint.write_bytes(stream.getvalue())
    said = refused(command, checkpoint)
    assert f"{checkpoint} is damaged" in said and "safetensors" in said


@EITHER
@pytest.mark.parametrize("key", ["sha256", "values.moments"])
def test_69_a_duplicate_key_in_a_checkpoint(checkpoint: Path, command: str, key: str) -> None:
    content = checkpoint.read_bytes()
    length = int.from_bytes(content[:8], "little")
    table = json.loads(content[8 : 8 + length])
    value = table["__metadata__"]["sha256"] if key == "sha256" else table[key]
    again = f'"{key}": {json.dumps(value)}, "{key}":'
    text = json.dumps(table).replace(f'"{key}":', again, 1).encode()
    checkpoint.write_bytes(len(text).to_bytes(8, "little") + text + content[8 + length :])
    said = refused(command, checkpoint)
    assert f"{checkpoint} is damaged" in said and f"'{key}' is given twice" in said


LIMITED = """
import resource, sys
from warpnerf.cli.main import main
resource.setrlimit(resource.RLIMIT_FSIZE, (40_000_000, 40_000_000))
sys.exit(main(sys.argv[1:]))
"""


def test_a_file_that_may_not_be_read_is_not_called_damaged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def denied(*_: Any) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    path = tmp_path / "field.safetensors"
    path.touch()
    monkeypatch.setattr(Path, "open", denied)
    with pytest.raises(
        InputError, match=r"cannot be read: Permission denied; give access"
    ) as error:
        load_field(path)
    assert not isinstance(error.value, DamagedFileError)


@pytest.mark.ci  # a training of seconds; test_saves.py has every call that may fail
@pytest.mark.skipif(sys.platform == "win32", reason="no limits of a process there")
def test_71_disk_full_while_training(tmp_path: Path) -> None:
    """A file of the grid before it grows fits, one of the grid after that does not."""
    folder = tmp_path / "run"
    scene = ("builtin:room-sparse", "--downscale", "8", "--threads", "1")
    options = ("--output", str(folder), "--steps", "210", "--checkpoint-every", "0.1")
    process = subprocess.run(
        [sys.executable, "-c", LIMITED, "train", *scene, *options],
        capture_output=True,
        text=True,
        timeout=240,
    )
    assert process.returncode == 2, process.stderr
    assert "Traceback" not in process.stdout + process.stderr
    said = [line for line in process.stderr.splitlines() if line.startswith("warpnerf: ")]
    run = Run(folder)
    assert len(said) == 1
    assert f"{folder} cannot be written: File too large" in said[0]
    assert f"continue after step {run.last_step} with: {run.resume_command}" in said[0]
    assert len(run.checkpoints) == 2
    saved = load_checkpoint(run.checkpoints[0])
    assert saved.progress.step == run.last_step < 210 and saved.grown == 0
    assert not list(folder.glob(".*"))
