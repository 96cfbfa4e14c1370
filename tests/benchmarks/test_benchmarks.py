"""The benchmarks run, check their sides against each other, and write complete records."""

import math
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.support.benchmark_scripts import is_interval, run

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "benchmarks"))

import against  # noqa: E402
import candidates  # noqa: E402
import threads  # noqa: E402
import throughput  # noqa: E402
import workload  # noqa: E402
from candidates.warpnerf_step import WarpStep  # noqa: E402


@pytest.mark.slow
def test_gradient_scaling(tmp_path):
    options = ("--pairs", "2", "--repeats", "1", "--grid", "8", "--models", "rgb", "deferred")
    record, _ = run("gradient_scaling.py", tmp_path / "record.json", *options)
    assert record["n_samples"] == 300_000
    assert record["grid"] == 8
    ours = ["render_backward", "render_train", "control"]
    assert [(result["model"], result["name"]) for result in record["results"]] == [
        *(("rgb", name) for name in (*ours, "torch backward", "operation alone")),
        *(("deferred", name) for name in ours),
    ]
    for result in record["results"]:
        assert result["pairs"] == 2
        assert result["with_us"] > 0 and result["backward_us"] > 0
        difference, share = result["difference_us"], result["share_of_backward"]
        assert difference["low"] <= difference["median"] <= difference["high"]
        assert abs(share["median"] * result["backward_us"] - difference["median"]) < 1e-6
    assert "instructions_per_sample" in record


@pytest.mark.slow
def test_throughput(tmp_path):
    options = ("--grids", "8", "12", "--rays", "64", "--steps", "16", "--rounds", "2")
    options += ("--threads", "1", "2", "--without", "torch.compile", "--models", "rgb")
    record, printed = run("throughput.py", tmp_path / "record.json", *options)
    compared = {"warpnerf", "torch"} | (
        set(candidates.MODULES) - {"torch.compile"} - set(record["left_out"])
    )
    assert "torch.compile" in record["left_out"]
    for name, reason in record["left_out"].items():
        assert f"left out: {name}, {reason}" in printed
    assert [
        (case["rays"], case["grid"], case["scene"], case["scaled"]) for case in record["cases"]
    ] == [
        ("random", 8, "dense", True),
        ("random", 12, "dense", True),
        ("patches", 12, "dense", True),
        ("random", 12, "sphere", True),
        ("random", 12, "dense", False),
    ]
    for case in record["cases"]:
        assert 0 < case["n_samples"] <= 64 * 16
        assert set(case["differences"]) == {
            f"{name}, {threads} threads" for name in compared for threads in (1, 2)
        }
        assert all(max(d.values()) < 1e-4 for d in case["differences"].values())
        assert [row["threads"] for row in case["rows"]] == [1, 2]
        for row in case["rows"]:
            assert set(row["candidates"]) == compared
            for figures in row["candidates"].values():
                assert all(is_interval(interval) for interval in figures.values())
            assert row["candidates"]["warpnerf"]["over_warpnerf"]["median"] == 1.0
            bounds = row["bounds_ms"]
            assert 0 < row["least_ms"] == max(bounds["arithmetic"], bounds["traffic"])
        assert "apart_over_one_thread" not in case["rows"][0]
        for key in ("apart_over_one_thread", "share_of_apart"):
            assert is_interval(case["rows"][1][key])
    rows = record["memory"]
    assert [row["n_samples"] for row in rows] == [64 * 8, 64 * 16, 64 * 32]
    assert len({row["warpnerf_room_bytes"] for row in rows}) == 1
    assert all(0 < row["warpnerf_bytes"] <= row["warpnerf_room_bytes"] for row in rows)
    assert rows[0]["torch_bytes"] < rows[1]["torch_bytes"] < rows[2]["torch_bytes"]
    plot = tmp_path / "record.png"
    assert plot.exists() == (f"plot: {plot}" in printed)
    assert plot.exists() or "no plot: matplotlib is not installed" in printed


@pytest.mark.slow
def test_throughput_of_other_models(tmp_path):
    options = ("--grids", "8", "--rays", "64", "--steps", "16", "--rounds", "2", "--threads", "1")
    options += ("--without", "torch.compile", "numba", "--models", "sh", "deferred", "per_sample")
    record, printed = run("throughput.py", tmp_path / "record.json", *options)
    assert [(case["model"], case["scene"]) for case in record["cases"]] == [
        (model, scene)
        for model in ("sh", "deferred", "per_sample")
        for scene in ("dense", "sphere")
    ]
    assert "drjit, is not written for it" in printed
    for case in record["cases"]:
        assert set(case["left_out"]) == {"torch.compile", "numba", "taichi", "drjit"}
        (row,) = case["rows"]
        assert set(row["candidates"]) == {"warpnerf", "torch"}
        assert "bounds_ms" not in row  # only rgb's operations are counted
        for differences in case["differences"].values():
            compared = {"rgb", "gradient", *(["network"] if case["model"] != "sh" else [])}
            assert set(differences) == compared
            assert max(differences.values()) < 1e-4


@pytest.mark.slow
def test_against(tmp_path):
    """This tree against itself."""
    options = (str(ROOT), "--grids", "8", "--rays", "64", "--steps", "16", "--threads", "2")
    options += ("--starts", "2", "--rounds", "2", "--models", "rgb", "deferred")
    record, printed = run("against.py", tmp_path / "record.json", *options)
    assert [row["model"] for row in record["rows"]] == ["rgb"] * 4 + ["deferred"] * 2
    assert record["commits"]["here"] == record["commits"]["there"]
    for row in record["rows"]:
        assert row["name"] in printed
        assert row["differences"] == {"rgb": 0.0, "gradient": 0.0}
        assert len(row["ratio_by_start"]) == 2
        for key in ("here_ms", "there_ms", "ratio", "ratio_of_cores"):
            assert is_interval(row[key])


@pytest.mark.slow
def test_digests():
    """A line a training, the same each time; another number of threads is another line."""
    options = ("builtin:room", "--only", "rgb", "dvgo-llff", "--steps", "3", "--voxels", "500")
    command = [sys.executable, str(ROOT / "benchmarks" / "digests.py"), *options]
    path = os.pathsep.join([str(ROOT), str(ROOT / "kernels")])
    printed = subprocess.run(
        command,
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": path},
    ).stdout
    lines = [line.split(" ", 3) for line in printed.splitlines()]
    assert [line[:3] for line in lines] == [
        ["builtin:room", name, threads] for name in ("dvgo-llff", "rgb") for threads in ("1", "2")
    ]
    assert all(line[3].startswith("refused: ") for line in lines[:2])
    assert all(re.fullmatch(r"free_distance=\w{16} values=.*", line[3]) for line in lines[2:])


def test_against_refuses_what_computes_something_else():
    class Answers:
        def __init__(self, rgb):
            self._rgb = rgb

        def ask(self, name, path):
            assert name == "results"
            np.savez(path, rgb=self._rgb, gradient=np.ones(3))

    found = against.compare(Answers(np.ones(3)), Answers(np.ones(3)))
    assert found == {"rgb": 0.0, "gradient": 0.0}
    with pytest.raises(SystemExit, match="the trees differ in rgb by"):
        against.compare(Answers(np.ones(3)), Answers(np.array([1.0, 1.0, 1.1])))


def test_apart_does_the_same_work(on_cpu):
    work = workload.make_workload("random", 8, 65, 16)
    apart = throughput.Apart(work, 2, "cpu")
    whole = WarpStep(work, 1, "cpu")
    whole.step()
    for call in (apart.in_turn, apart.at_once):
        for step in apart.steps:
            step.gradient().fill(0.0)
        call()
        sizes = [len(step.rgb()) for step in apart.steps]
        assert sizes == [33, 32]
        mean = sum(n * step.gradient() for n, step in zip(sizes, apart.steps, strict=True)) / 65
        largest = np.abs(whole.gradient()).max()
        assert np.abs(mean - whole.gradient()).max() < 1e-5 * largest


def test_one_thread_uses_all_that_it_has_room_for(on_cpu):
    work = workload.make_workload("random", 8, 64, 16)
    used, room = WarpStep(work, 1, "cpu").scratch_bytes()
    assert 0 < used == room


@pytest.mark.ci
def test_rendering(tmp_path):
    options = ("--grid", "24", "--pixels", "16", "--rounds", "2", "--threads", "2")
    record, _ = run("rendering.py", tmp_path / "record.json", *options)
    (row,) = record["rows"]
    assert row["grid"] == [24, 24, 24] and 0.3 < row["free"] < 1
    assert row["difference"] < 2e-3
    assert is_interval(row["torch_over_warpnerf"])
    for name in ("warpnerf", "torch"):
        assert 0 < row[name]["n_samples"] < 16 * 16 * 80
        for key in ("ms", "rays_per_second", "samples_per_second"):
            assert is_interval(row[name][key])


@pytest.mark.slow
def test_threads(tmp_path):
    options = ("--grids", "8", "12", "--rays", "64", "--steps", "16", "--rounds", "8")
    record, printed = run("threads.py", tmp_path / "record.json", *options)
    assert len(record["cases"]) == 5 + 6
    for case in record["cases"]:
        assert case["name"] in printed
        assert case["all"]["rounds"] == 8
        for figures in filter(None, (case["all"], case["undisturbed"])):
            for key in ("one_ms", "several_ms", "times_as_fast"):
                assert is_interval(figures[key])


def test_a_round_counts_where_nobody_else_had_the_cores():
    quiet = {1: (2.0, 1.0), 2: (1.1, 1.05)}
    rounds = [quiet, {1: (2.0, 1.3), 2: (1.1, 1.0)}, {1: (2.0, 1.0), 2: (2.1, 1.9)}, quiet]
    assert threads.undisturbed(rounds) == [quiet, quiet]
    assert threads.summarise(rounds[:1], 2)["times_as_fast"]["median"] == 2.0 / 1.1
    assert threads.undisturbed([{1: (2.0, 1.0), 2: (2.1, 1.9)}]) == []


@pytest.mark.slow
def test_footprint(tmp_path):
    options = ("builtin:room-sparse", "--downscale", "8", "--steps", "30", "--starts", "2")
    record, printed = run("footprint.py", tmp_path / "record.json", *options)
    assert record["cold_seconds"] > 0
    assert is_interval(record["cached_seconds"])
    memory = record["memory"]
    assert memory["steps"] == 30
    assert record["model"] == "deferred"
    assert memory["arrays_bytes"] == 4 * 4 * 8 * math.prod(memory["grid"])
    if memory["peak_bytes"] is None:
        assert "is not there to tell" in printed
    else:
        assert 0 < memory["before_bytes"] < memory["peak_bytes"]
        assert memory["over_arrays"] == memory["peak_bytes"] / memory["arrays_bytes"]


@pytest.mark.slow
def test_photos_on_disk(tmp_path):
    options = ("--photographs", "12", "--size", "200", "150", "--steps", "30", "--model", "rgb")
    record, printed = run(
        "photos_on_disk.py",
        tmp_path / "record.json",
        *(*options, "--in-turns", "5", "--rounds", "3", "--updates", "2"),
    )
    assert record["decoded_bytes"] == 12 * 200 * 150 * 3
    assert is_interval(record["disk_over_memory"])
    if record["most_anonymous_bytes"] is not None:
        assert 0 < record["most_anonymous_bytes"] < record["most_resident_bytes"]
        assert f"{record['most_anonymous_bytes'] / 2**30:6.2f} GiB" in printed


def test_the_truth_of_meshes():
    """What photographs of the room show lies on surfaces that mesh.py measures distances to."""
    pytest.importorskip("scipy")
    import mesh
    from solids_truth import distances_to

    from warpnerf.scenes.builtin.room import room_solids
    from warpnerf.scenes.formats.load import load_scene

    solids = list(room_solids())
    points, colours = mesh.photographed(load_scene("builtin:room", downscale=20))
    assert points.shape == colours.shape == (120 * 8 * 6, 3)
    assert distances_to(points, solids)[0].max() < 1e-4
    lifted = points + np.array([0.0, 0.0, 0.01])  # off the floor and into the ceiling
    level = np.isclose(points[:, 2], 0.0, atol=1e-6) | np.isclose(points[:, 2], 2.6, atol=1e-6)
    assert level.sum() > 100
    np.testing.assert_allclose(distances_to(lifted[level], solids)[0].max(), 0.01, atol=1e-4)


@pytest.mark.slow
def test_ray_order(tmp_path, on_cpu):
    options = ("builtin:room-sparse", "--downscale", "16", "--steps", "4", "--threads", "2")
    record, printed = run("ray_order.py", tmp_path / "record.json", *options, "--rounds", "2")
    row = record["scenes"]["builtin:room-sparse"]
    assert list(row) == [f"2 threads, {steps} steps" for steps in (1, 4, 16)]
    assert all(is_interval(found) for found in row.values())
    assert printed.count("builtin:room-sparse") == 3


@pytest.mark.slow
def test_viewer(tmp_path):
    from tests.support.tiny_fields import tiny_field
    from warpnerf.config import TrainConfig
    from warpnerf.runs.run import Run
    from warpnerf.scenes.formats.load import load_scene

    made = Run(tmp_path / "made")
    scene = load_scene("builtin:room-sparse", downscale=8)
    made.create(scene, "builtin:room-sparse", 8, scene.content_distance, TrainConfig())
    made.save_field(tiny_field())
    options = (str(made.folder), "--rounds", "2", "--seconds", "1", "--steps", "100")
    record, printed = run("viewer.py", tmp_path / "record.json", *options, "--no-browser")
    assert is_interval(record["first_picture_seconds"])
    assert is_interval(record["fine_picture_seconds"])
    assert record["moving_pictures_per_second"]["median"] > 1.0
    assert record["moving_pixels"]["high"] <= 800 * 600
    assert is_interval(record["painting"]["bands"]["core_seconds"])
    assert record["training"]["pictures"] > 0
    assert is_interval(record["training"]["ratios"]["nobody looks"])
    assert "at rest after" in printed
