"""As many threads as are requested read photographs, and --threads asks."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import warpnerf as wn
from tests.exporting.test_cameras import ball_scene
from tests.support.fake_colmap import Colmap
from tests.support.solid_fields import LEVEL, ball_field
from tests.support.tiny_scenes import write_transforms
from warpnerf.cli.main import main
from warpnerf.exporting.export import export
from warpnerf.inspection import diagnostics
from warpnerf.runs.run import Run
from warpnerf.runtime.memory import usable_cores
from warpnerf.scenes.formats import assemble
from warpnerf.scenes.images import photographs as posed
from warpnerf.sfm import photographs as unposed

pytestmark = pytest.mark.usefixtures("poses_as_given")


@pytest.fixture
def pools(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[int]]:
    """How many threads each pool has that reads photographs."""
    made: list[int] = []

    class Pool(ThreadPoolExecutor):
        def __init__(self, threads: int) -> None:
            made.append(threads)
            super().__init__(threads)

    for module in (assemble, posed, diagnostics, unposed):
        monkeypatch.setattr(module, "ThreadPoolExecutor", Pool)
    yield made


@pytest.mark.parametrize("place", ["memory", "disk", "files"])
def test_photographs_are_read_by_as_many(place: str, pools: list[int], tmp_path: Path) -> None:
    write_transforms(tmp_path / "scene")
    wn.load_scene(tmp_path / "scene", images=place, threads=5)  # type: ignore[arg-type]
    assert pools == [5] * (1 if place == "files" else 2)
    pools.clear()
    wn.load_scene(tmp_path / "scene", images=place)  # type: ignore[arg-type]
    assert set(pools) == {usable_cores()}
    with pytest.raises(wn.InputError, match="threads must be a whole number of at least 1, not 0"):
        wn.load_scene(tmp_path / "scene", threads=0)


def test_the_command_passes_it_on(pools: list[int], tmp_path: Path) -> None:
    write_transforms(tmp_path / "scene", scale=2)
    run = str(tmp_path / "run")
    tiny = ("--steps", "2", "--voxels", "512", "--model", "rgb", "--keep", "checkpoint")
    assert main(["train", str(tmp_path / "scene"), "--output", run, *tiny, "--threads", "3"]) == 0
    assert len(pools) >= 3 and set(pools) == {3}
    pools.clear()
    assert main(["train", "--resume", run]) == 0
    assert len(pools) >= 2 and set(pools) == {3}
    pools.clear()
    assert main(["eval", run, "--threads", "4"]) == 0
    assert pools == [4]


@pytest.mark.ci
@pytest.mark.parametrize(
    "arguments", [["export", "RUN", "OUTPUT.ply"], ["render", "RUN", "--stills", "test"]]
)
def test_what_shows_a_run_passes_it_on(
    arguments: list[str], pools: list[int], tmp_path: Path
) -> None:
    export(ball_field(), tmp_path / "scene", scene=ball_scene(), level=LEVEL)
    scene = wn.load_scene(tmp_path / "scene")
    run = Run(tmp_path / "run")
    run.create(scene, str(tmp_path / "scene"), 1, scene.content_distance, wn.TrainConfig())
    run.save_field(ball_field())
    pools.clear()
    places = {"RUN": str(tmp_path / "run"), "OUTPUT.ply": str(tmp_path / "ball.ply")}
    assert main([*(places.get(word, word) for word in arguments), "--threads", "3"]) == 0
    assert pools == [3]


def test_poses_are_looked_for_with_it(
    pools: list[int], tmp_path: Path, photos: Path, colmap: Colmap
) -> None:
    wn.pose(photos, tmp_path / "scene", wn.PoseConfig(threads=3))
    assert pools[0] == 3
