"""`warpnerf inspect`: a table, JSON, and a plan."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from PIL import Image

from tests.support.tiny_scenes import write_transforms
from warpnerf.checks import InputError
from warpnerf.cli.inspect import InspectOptions, inspect_command


def test_a_table_and_a_plan(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_transforms(tmp_path / "scene", 6)
    plan = tmp_path / "plan.png"
    assert (
        inspect_command(
            InspectOptions(scene=str(tmp_path / "scene"), output=plan, plots=tmp_path / "plots"),
            {"threads": ("3",)},
        )
        == 0
    )
    said, _, plots = capsys.readouterr().out.partition(f"wrote {tmp_path / 'plots'}")
    assert "sampling.png" in plots
    assert said.startswith("scene\n  format")
    assert "on 3 CPU threads" in said
    assert said.endswith(f"wrote {plan}\n")
    with Image.open(plan) as picture:
        assert picture.size > (1000, 500)
    assert {path.name for path in tmp_path.iterdir()} == {"scene", "plan.png", "plots"}
    assert {path.name for path in (tmp_path / "plots").iterdir()} == {"cameras.png", "sampling.png"}


def test_time_is_estimated_of_the_cpu_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_transforms(tmp_path / "scene", 6)
    options = InspectOptions(scene=str(tmp_path / "scene"), json=tmp_path / "facts.json")
    assert inspect_command(options, {"threads": ("1",)}) == 0
    assert " on 1 CPU thread\n" in capsys.readouterr().out
    assert inspect_command(options, {"device": ("cuda:1",)}) == 0
    said = capsys.readouterr().out
    assert "GiB of memory; time on cuda:1 is not estimated\n" in said and "CPU" not in said
    costs = json.loads((tmp_path / "facts.json").read_text())["costs"].values()
    assert [cost["seconds"] for cost in costs] == [None, None]
    with pytest.raises(InputError, match=r"must be cpu, cuda, or cuda:1, \.\.\., not 'gpu'"):
        inspect_command(options, {"device": ("gpu",)})


def test_plots_are_not_written_through_a_link(tmp_path: Path) -> None:
    write_transforms(tmp_path / "scene", 6)
    (tmp_path / "plots").mkdir()
    (tmp_path / "plots" / "sampling.png").symlink_to(tmp_path / "precious")
    with pytest.raises(InputError, match=r"sampling.png is a link, and inspect writes only"):
        inspect_command(InspectOptions(scene=str(tmp_path / "scene"), plots=tmp_path / "plots"))
    assert [path.name for path in (tmp_path / "plots").iterdir()] == ["sampling.png"]


def test_json(tmp_path: Path) -> None:
    write_transforms(tmp_path / "scene", 6)
    file = tmp_path / "facts.json"
    options = InspectOptions(scene=str(tmp_path / "scene"), json=file)
    assert inspect_command(options, {"march.near": ("50",)}) == 0
    facts = json.loads(file.read_text())
    assert facts["views"] == 6
    assert any("the near plane begins 50" in finding for finding in facts["odd"])
    with pytest.raises(InputError, match=r"--json .*its folder does not exist"):
        inspect_command(
            InspectOptions(scene=options.scene, json=tmp_path / "nowhere" / "facts.json")
        )


def test_json_does_not_replace_the_scene(tmp_path: Path) -> None:
    write_transforms(tmp_path / "scene", 6)
    file = tmp_path / "scene" / "transforms.json"
    before = file.read_bytes()
    for scene in (tmp_path / "scene", file):
        with pytest.raises(InputError, match=r"--json .*is another file, which would be replaced"):
            inspect_command(InspectOptions(scene=str(scene), json=file))
    assert file.read_bytes() == before


@pytest.mark.parametrize("output", ["plan.jpg", "nowhere/plan.png", "folder.png"])
def test_a_plan_that_cannot_be_written_is_refused(tmp_path: Path, output: str) -> None:
    write_transforms(tmp_path / "scene", 6)
    (tmp_path / "folder.png").mkdir()
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(InputError, match=f"--output .*{output}"):
        inspect_command(InspectOptions(scene=str(tmp_path / "scene"), output=tmp_path / output))
    assert sorted(tmp_path.rglob("*")) == before
