"""`warpnerf view` and `train --view`: what they say, refuse, and leave when stopped."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import urllib.request
from pathlib import Path
from typing import Any

import pytest

from tests.support import cli_process
from tests.support.tiny_fields import tiny_field, tiny_state
from tests.support.tiny_scenes import ring, write_transforms
from warpnerf.checks import InputError
from warpnerf.cli.main import main
from warpnerf.config import TrainConfig
from warpnerf.runs.run import Run
from warpnerf.scenes.formats.load import load_scene
from warpnerf.viewer.session import Session
from warpnerf.viewer.view import open_view

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

from page_client import PageClient


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("view")
    write_transforms(folder / "scene", 6, scale=2)
    run = Run(folder / "run")
    scene = load_scene(folder / "scene")
    run.create(scene, str(folder / "scene"), 1, scene.content_distance, TrainConfig())
    run.save_field(tiny_field())
    return folder / "run"


def opened(*folders: Path, **options: Any) -> Session:
    chosen: dict[str, Any] = {"scene": None, "host": "127.0.0.1", "port": 0, "device": "cpu"}
    return open_view(folders, **(chosen | {"threads": 1} | options))


def started(*arguments: str | Path) -> tuple[subprocess.Popen[str], str]:
    """A command that serves a page, and the page's address."""
    process = subprocess.Popen(
        [sys.executable, "-m", "warpnerf", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ,
    )
    assert process.stdout is not None
    for line in process.stdout:
        found = re.search(r"look at (http://\S+?)[; ]", line)
        if found:
            return process, found.group(1)
    raise AssertionError(process.communicate()[1])


def port_of(address: str) -> int:
    return int(address.rpartition(":")[2])


@pytest.mark.ci
def test_a_run_is_served_until_ctrl_c(run_folder: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in run_folder.rglob("*")}
    process, address = started("view", run_folder, "--port", "0", "--threads", "1")
    with urllib.request.urlopen(address, timeout=120) as answer:
        assert answer.status == 200
    with PageClient(port_of(address)) as page:
        page.look_from(ring(5)[0][:3])
        page.wait_for_size(80, 60)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=240)
    assert process.returncode == 130
    assert "Traceback" not in err and "viser" not in out
    assert {path: path.stat().st_mtime_ns for path in run_folder.rglob("*")} == before


def test_two_runs_are_beside_each_other(run_folder: Path) -> None:
    with opened(run_folder, run_folder) as session:
        assert [subject.name for subject in session._painter.subjects] == ["run", "run"]
        assert session._panel.settings.layout == "side by side"


def test_a_run_without_a_field_shows_its_newest_checkpoint(
    run_folder: Path, tmp_path: Path
) -> None:
    run = Run(tmp_path / "run")
    scene = load_scene(run_folder.parent / "scene")
    run.create(scene, str(run_folder.parent / "scene"), 1, 3.0, TrainConfig(threads=1))
    for step in (1, 2):
        run.save_checkpoint(tiny_state(step))
    with opened(run.folder) as session:
        values = session._painter.subjects[0].field().storage.values.numpy()
        assert (values == tiny_state(2).field.storage.values.numpy()).all()


def test_photographs_that_have_moved_are_no_reason_not_to_look(
    run_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = Run(tmp_path / "run")
    scene = load_scene(run_folder.parent / "scene")
    run.create(scene, str(tmp_path / "gone"), 1, 3.0, TrainConfig(threads=1))
    run.save_field(tiny_field())
    with opened(run.folder) as session:
        assert not session._stage.cameras
    assert "shown without its photographs" in capsys.readouterr().out
    with opened(run.folder, scene=str(run_folder.parent / "scene")) as session:
        assert len(session._stage.cameras) == 5


def test_a_wrong_place_of_photographs_is_refused(
    run_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["view", str(run_folder), "--scene", str(tmp_path / "gone"), "--port", "0"]) == 2
    said = capsys.readouterr()
    assert f"{tmp_path / 'gone'}" in said.err and "shown without" not in said.out


def test_what_cannot_be_shown_is_refused(
    run_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["view", str(tmp_path)]) == 2
    assert "config.json does not exist" in capsys.readouterr().err
    assert main(["view", str(run_folder), str(tmp_path)]) == 2
    assert f"{tmp_path}" in capsys.readouterr().err
    assert main(["view", str(run_folder), "--port", "70000"]) == 2
    out, err = capsys.readouterr()
    assert "--port 70000" in err
    assert "reading" not in out
    assert main(["view", str(run_folder), "--device", "cuda:77"]) == 2
    assert "device" in capsys.readouterr().err
    with pytest.raises(InputError, match="not 3"):
        opened(run_folder, run_folder, run_folder)


@pytest.mark.parametrize("option", [("--port", "0"), ("--host", "0.0.0.0")])
def test_a_place_for_no_page_is_refused(
    option: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = main(["train", "builtin:room", "--output", str(tmp_path / "run"), *option])
    assert code == 2 and "--view" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_without_viser_nothing_is_begun(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("warpnerf.checks.importlib.util.find_spec", lambda name: None)
    code = main(["train", "builtin:room", "--output", str(tmp_path / "run"), "--view"])
    assert code == 2 and 'pip install "warpnerf[viewer]"' in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.ci
def test_a_training_is_looked_at_and_stopped(run_folder: Path, tmp_path: Path) -> None:
    """With a page that looks: Ctrl-C saves, and what is resumed ends as it does without a page."""
    scene = run_folder.parent / "scene"
    tiny = ("--voxels", "512", "--threads", "1")
    process, address = started(
        *("train", scene, "--output", tmp_path / "run", "--steps", "100000", *tiny),
        *("--view", "--port", "0"),
    )
    with PageClient(port_of(address)) as page:
        page.look_from(ring(5)[0][:3])
        page.wait_for_size(80, 60)
        before = len(page.pictures)
        page.wait(lambda page: len(page.pictures) > before)  # shown again, as it has trained on
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=240)
    assert process.returncode == 130, err
    assert "stopped and saved after step" in out and "Traceback" not in err
    assert Run(tmp_path / "run").last_step


@pytest.mark.ci
def test_a_training_with_a_page_ends_by_itself(run_folder: Path, tmp_path: Path) -> None:
    scene = run_folder.parent / "scene"
    tiny = ("--voxels", "512", "--threads", "1", "--steps", "50")
    fields = []
    for name, page in (("a", ()), ("b", ("--view", "--port", "0"))):
        command = ["train", scene, "--output", tmp_path / name, *tiny, *page]
        done = cli_process.run(*command)
        assert done.returncode == 0, done.stderr
        fields.append((tmp_path / name / "field.safetensors").read_bytes())
    assert fields[0] == fields[1]


def test_a_port_in_use_is_refused_before_photographs_are_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        train = ["train", "builtin:room", "--output", str(tmp_path / "run")]
        assert main([*train, "--view", "--port", port]) == 2
    out, err = capsys.readouterr()
    assert f"--port {port}" in err
    assert not out
    assert not (tmp_path / "run").exists()
