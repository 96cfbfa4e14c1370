"""Every code block of README.md and docs/*.md runs as it stands, in smaller scenes and for fewer
steps, or has its options read by the command; so do the commands in running text."""

from __future__ import annotations

import functools
import json
import re
import shlex
import shutil
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import warpnerf as wn
from tests.exporting.test_cameras import ball_scene
from tests.support import cli_process
from tests.support.documents import (
    DOCUMENTS,
    ROOT,
    FieldHeadNames,
    blocks,
    inline_commands,
    lines_of_shell,
    stand_in,
)
from tests.support.solid_fields import ball_field
from warpnerf.cli.main import COMMANDS, main

STEPS = 5
LANGUAGES = {"python", "sh", "json"}
PYTHON = [name for name in DOCUMENTS if any(b.language == "python" for b in blocks(name))]
Names = dict[str, Any]


def test_every_block_is_of_a_language_that_is_tested() -> None:
    found = {name: [block.language for block in blocks(name)] for name in DOCUMENTS}
    assert all(set(languages) <= LANGUAGES for languages in found.values()), found
    fences = {
        name: len(re.findall("^```", (ROOT / name).read_text(), re.MULTILINE)) for name in DOCUMENTS
    }
    shell = {name: found[name].count("sh") for name in DOCUMENTS}
    assert found["README.md"].count("python") == 1 and shell["README.md"] == 3
    assert all(fences[name] // 2 <= len(found[name]) for name in DOCUMENTS)


# --- Python -------------------------------------------------------------------------------------


@pytest.fixture
def small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Scenes, trainings and paths are small, files are written to a folder of the test's; the
    folder ``photos`` is a scene."""
    load_scene, train, camera_path = wn.load_scene, wn.train, wn.camera_path

    def train_shortly(scene: wn.Scene, config: Any = None, **options: Any) -> wn.TrainResult:
        return train(scene, config and replace(config, steps=STEPS), **options)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(wn, "load_scene", lambda path: load_scene(path, downscale=8))
    monkeypatch.setattr(wn, "train", train_shortly)
    monkeypatch.setattr(
        wn, "camera_path", lambda scene, kind, n_frames: camera_path(scene, kind, n_frames=3)
    )
    stand_in(monkeypatch)


def of_a_ball(names: Names) -> None:
    """After so few steps there is no surface yet."""
    names |= {"result": SimpleNamespace(field=ball_field()), "scene": ball_scene()}


BEFORE: dict[tuple[str, str], Callable[[Names], None]] = {
    ("docs/python.md", "Meshes, splats, and other files"): of_a_ball,
}
"""What replaces names of earlier blocks, by document and section."""


def after_readme(names: Names, out: str) -> None:
    assert names["image"].rgb.shape == (15, 20, 3)
    assert "psnr" in out.lower()


def after_python(names: Names, out: str) -> None:
    assert Path("orbit.mp4").stat().st_size > 0 and Path("room.glb").stat().st_size > 0
    assert len(names["splats"].centres) > 100
    assert names["state"].progress.step == STEPS


def after_torch(names: Names, out: str) -> None:
    """The examples say what they do: their numbers, their gradients, and the shapes of others'
    packages."""
    import torch

    lines = out.splitlines()
    assert lines[0] == "without 0.62, with 0.05" and "It prints 0.62 without and 0.05 with" in (
        (ROOT / "docs/torch.md").read_text()
    )
    assert "0.0625, 0.0625, 0.0625" in lines[1]
    assert all(tensor.grad.abs().max() > 0 for tensor in list(names["mlp"].parameters())[1:])

    rgb, density = torch.ones(2, 3, 3, requires_grad=True), torch.ones(2, 3, 1, requires_grad=True)
    frustums = SimpleNamespace(starts=torch.zeros(2, 3, 1), ends=torch.full((2, 3, 1), 0.5))
    outputs = {FieldHeadNames.RGB: rgb, FieldHeadNames.DENSITY: density}
    scaled = names["nerfacto"].scale_gradients_by_distance_squared(
        outputs, SimpleNamespace(frustums=frustums)
    )
    (scaled[FieldHeadNames.RGB].sum() + scaled[FieldHeadNames.DENSITY].sum()).backward()
    assert rgb.grad is not None and density.grad is not None
    assert float(rgb.grad[0, 0, 0]) == float(density.grad[0, 0, 0]) == 0.25  # (0.25 / 0.5)^2

    def model(positions: Any, towards: Any) -> tuple[Any, Any]:
        return torch.sigmoid(positions * weight), torch.exp(towards[:, 2] * weight)

    weight = torch.ones((), requires_grad=True)
    rays = (torch.zeros(2, 3), torch.tensor([[0.0, 0.0, 1.0]] * 2), torch.tensor([0, 0, 1]))
    t = torch.tensor([0.0, 1.0, 0.5])
    colors, opacities, _, _ = names["render_packed"](model, *rays, t, t + 1.0, torch.ones(2))
    assert colors.shape == (2, 3) and opacities.shape == (2, 1)
    colors.sum().backward()
    assert weight.grad is not None and float(weight.grad) != 0.0

    scene = ball_scene()
    splats = names["splats_from"](ball_field(), scene, "cpu")
    camera = scene.views[2].camera
    picture, alpha = names["rendered"](splats, camera, 2.4)
    middle = alpha[camera.height // 3 : -camera.height // 3, camera.width // 3 : -16, 0]
    assert middle.mean().item() > 3.0 * alpha[0].mean().item()  # the ball is in the middle
    picture.sum().backward()
    assert all(float(splats[k].grad.abs().max()) > 0 for k in (3, 4))

    wn.export(ball_field(), "folder", scene=scene)
    pictures = names["pictures_of_instant_ngp"]("folder", scene, steps=3)
    assert [p.shape for p in pictures] == [(40, 48, 3)] * 2 and np.allclose(pictures, 1.0)

    network = names["tiny_cuda_model"]()
    places, t = torch.rand(5, 7, 3), torch.rand(5, 7)
    colors, sigmas = names["colors_and_sigmas"](network, places, t, 1.0)
    assert colors.shape == (5, 7, 3) and sigmas.shape == (5, 7)


def after_jax(names: Names, out: str) -> None:
    """The error falls, and gradients are scaled."""
    import jax.numpy as jnp

    batch = jnp.arange(0, len(names["pixels"]), 50)
    first = names["first_layers"](names["jax"].random.key(0))
    assert names["loss"](names["layers"], batch) < 0.7 * names["loss"](first, batch)
    assert float(jnp.abs(names["gradient"]).max()) > 0.0

    def seen(rgb: Any) -> Any:
        results = {"rgb": rgb, "density": jnp.ones((1, 2))}
        tdist, directions = jnp.array([[0.0, 1.0, 2.0]]), jnp.array([[0.0, 0.0, 2.0]])
        return names["scaled"](results, tdist, directions, 4.0)["rgb"].sum()

    gradient = names["jax"].grad(seen)(jnp.ones((1, 2, 3)))
    assert np.allclose(gradient[0, :, 0], [1 / 16, 9 / 16])  # (1 / 4)^2, (3 / 4)^2


AFTER = {
    "README.md": after_readme,
    "docs/python.md": after_python,
    "docs/torch.md": after_torch,
    "docs/jax.md": after_jax,
}
NEEDS = {"docs/python.md": ("av",), "docs/torch.md": ("torch",), "docs/jax.md": ("jax",)}


@pytest.mark.ci
@pytest.mark.parametrize("document", PYTHON)
def test_python_runs(document: str, small: None, capsys: pytest.CaptureFixture[str]) -> None:
    """All blocks of a document, one after another, with the names of those before."""
    for package in NEEDS.get(document, ()):
        pytest.importorskip(package)
    names: Names = {"__name__": "a block"}
    for block in blocks(document):
        if block.language != "python":
            continue
        assert block.text.count("\n") <= 33
        BEFORE.get((document, block.section), lambda names: None)(names)
        exec(compile(block.text, f"{document}, {block.section}", "exec"), names)
    if document in AFTER:
        AFTER[document](names, capsys.readouterr().out)


# --- Shell --------------------------------------------------------------------------------------


@pytest.fixture
def read_only(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The command reads its options and does nothing; names of the subcommands that it would
    have called."""
    called: list[str] = []

    def recorded(name: str, command: Callable[..., int]) -> Callable[..., int]:
        @functools.wraps(command)
        def instead(*arguments: Any, **options: Any) -> int:
            called.append(name)
            return 0

        return instead

    for name, command in list(COMMANDS.items()):
        monkeypatch.setitem(COMMANDS, name, recorded(name, command))
    return called


def read(command: str, called: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    """Have the command read its options."""
    words = shlex.split(command)[1:]
    if "..." in words or words[0] == "COMMAND":
        return
    if words[0] in COMMANDS and len(words) == 1:  # only its name
        return
    if {"--help", "--help-all"} & {*words}:
        with pytest.raises(SystemExit) as stop:
            main(words)
        assert stop.value.code == 0, command
        return
    try:
        code = main(words)
    except SystemExit as stop:
        code = int(stop.code or 0)
    said = capsys.readouterr().err
    assert code == 0, f"{command}: {said}"
    assert words == ["--version"] or called.pop() == words[0]


EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]


def check_shell(command: str, read_command: Callable[[str], None]) -> None:
    """Fail unless a command of a document is one that there is.

    Options of warpnerf are read by it, those of scripts must stand in them, and extras of packages
    in pyproject.toml.
    """
    words = shlex.split(command)
    if words[0] == "torchrun":
        words = words[words.index("-m") + 1 :]
        command = shlex.join(words)
    if words[0] == "warpnerf":
        read_command(command)
    elif words[0] == "python":
        assert words[1] == "-m" or (ROOT / words[1]).exists(), command
        if words[1] == "-m":
            assert (ROOT / words[2].replace(".", "/")).exists() or words[2] == "venv", command
            return
        options = [word.partition("=")[0] for word in words if word.startswith("--")]
        source = (ROOT / words[1]).read_text()
        assert all(f'"{option}"' in source for option in options), command
    elif words[:2] == ["pip", "install"]:
        for extras in re.findall(r"\[([\w,]+)\]", command):
            assert set(extras.split(",")) <= set(EXTRAS), command
    elif words[0] == "nerfbaselines":
        assert words[1] in ("train", "render") and "python" in words, command
    else:
        assert words[0] in ("pytest", ".venv/bin/activate", ".", "source", "ssh", "sudo"), command


@pytest.mark.parametrize("document", DOCUMENTS)
def test_shell_is_read(
    document: str, read_only: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    """Blocks, and what stands as `warpnerf ...` in running text."""
    commands = [
        line for b in blocks(document) if b.language == "sh" for line in lines_of_shell(b.text)
    ]
    for command in [*commands, *inline_commands(document)]:
        check_shell(command, lambda line: read(line, read_only, capsys))


@pytest.mark.parametrize(
    "command",
    [
        "warpnerf train scene --outptu runs/x",
        "warpnerf trian scene",
        "python benchmarks/none.py",
        "python benchmarks/floaters.py --such-option",
        'pip install ".[videos]"',
        "curl x",
    ],
)
def test_a_wrong_command_is_found(
    command: str, read_only: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(AssertionError):
        check_shell(command, lambda line: read(line, read_only, capsys))


def test_json_is_read(tmp_path: Path) -> None:
    found = [block for name in DOCUMENTS for block in blocks(name) if block.language == "json"]
    (path,) = [block for block in found if "warpnerf_path" in json.loads(block.text)]
    (tmp_path / "path.json").write_text(path.text)
    assert len(wn.read_path(tmp_path / "path.json").cameras(5)) == 5


# --- Shell, run ---------------------------------------------------------------------------------

SHORT = {
    "train": ("--steps", "150", "--voxels", "20000"),
    "render": ("--seconds", "0.2", "--size", "64", "48"),
    "demo": ("--steps", "20", "--downscale", "8"),
    "pose": (),
}
"""Options that are added to a document's command, which takes minutes without them."""


def prepare(folder: Path) -> None:
    """A working directory with what the documents name: ``photos`` without poses, a COLMAP project,
    a scene."""
    room = wn.load_scene("builtin:room", downscale=4)
    some = replace(
        room,
        views=[room.views[k] for k in range(0, 120, 6)],
        splits={"train": tuple(range(2, 20)), "test": (0, 1)},
    )
    field = wn.train(some, replace(wn.TrainConfig(), steps=200)).field
    wn.export(field, folder / "scene", scene=some, level=0.5)
    shutil.copytree(folder / "scene", folder / "colmap_project")
    (folder / "colmap_project" / "transforms.json").unlink()


@pytest.mark.ci
def test_the_commands_for_ones_own_photographs_run(tmp_path: Path) -> None:
    """All commands of README.md on scenes with poses, in their order, each training shortened; the
    viewer serves until it is stopped, and tests/viewer has its own."""
    prepare(tmp_path)
    (block,) = [b for b in blocks("README.md") if "colmap_project" in b.text]
    n_run = 0
    for line in lines_of_shell(block.text):
        words = shlex.split(line)
        if words[0] != "warpnerf" or words[1] == "view" or "photos" in words:
            continue
        if words[1] == "train":
            shutil.rmtree(tmp_path / "runs", ignore_errors=True)
        done = cli_process.run(*words[1:], *SHORT.get(words[1], ()), cwd=tmp_path)
        assert done.returncode == 0, f"{line}: {done.stdout}{done.stderr}"
        n_run += 1
    assert n_run == 4
    assert (tmp_path / "scene.glb").stat().st_size > 0
