"""The benchmarks that train run, and write complete records."""

import ast
import json
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

import warpnerf as wn
from tests.support.benchmark_scripts import ROOT, is_interval, run

sys.path.insert(0, str(ROOT / "benchmarks"))

import calibration


@pytest.mark.slow
def test_models(tmp_path):
    options = ("builtin:room-sparse", "--downscale", "16", "--steps", "12", "--rounds", "2")
    options += ("--threads", "1", "2", "--models", "deferred")
    record, printed = run("models.py", tmp_path / "record.json", *options)
    rows = record["rows"]
    assert [(row["threads"], row["model"]) for row in rows] == [
        (threads, model) for threads in (1, 2) for model in ("rgb", "deferred")
    ]
    for row in rows:
        assert row["steps_an_update"] == 16 and row["samples_per_ray"] > 1
        for key in ("step_ms", "rays_ms", "drawing_ms", "Adam_ms", "smoothing_ms", "over_rgb"):
            assert is_interval(row[key])
        parts = sum(row[f"{part}_ms"]["median"] for part in ("rays", "drawing", "Adam"))
        assert parts < 1.5 * row["step_ms"]["median"]
        assert f"{row['over_rgb']['median']:.2f}" in printed
        if row["model"] == "rgb":
            assert row["over_rgb"]["low"] == row["over_rgb"]["high"] == 1.0


@pytest.mark.slow
def test_floaters(tmp_path):
    script = [sys.executable, str(ROOT / "benchmarks" / "floaters.py"), "--output", str(tmp_path)]
    options = ["--steps", "20", "40", "--seeds", "0", "1", "--downscale", "8"]
    path = os.pathsep.join([str(ROOT), str(ROOT / "kernels")])
    env = {**os.environ, "PYTHONPATH": path}
    printed = subprocess.run([*script, *options], env=env, check=True, capture_output=True).stdout
    rows = json.loads((tmp_path / "floaters_cpu.json").read_text())["rows"]
    assert [(row["steps"], row["scaling"]) for row in rows] == [
        (steps, scaling) for steps in (20, 40) for scaling in ("none", "clamped")
    ]
    for row in rows:
        for name in ("psnr", "depth_error", "pulled_psnr", "near_density"):
            one, other = row[name]
            assert one > 0 and other > 0 and one != other
            assert f"{np.mean(row[name]):.4f}" in printed.decode()
    for scaling in ("none", "clamped"):
        assert (tmp_path / f"floaters_{scaling}.png").exists()


@pytest.mark.slow
def test_factors(tmp_path):
    options = ("builtin:room-sparse", "--steps", "40", "--pairs", "3", "--voxels", "4000")
    record, printed = run("factors.py", tmp_path / "record.json", *options)
    for numbers in (*record["ns_a_sample"].values(), *record["ms_an_update"].values()):
        assert 0 < numbers["low"] <= numbers["median"] <= numbers["high"]
    assert f"{record['vm_over_dense']['median']:.2f}" in printed


@pytest.mark.slow
def test_heads(tmp_path):
    options = ("builtin:room-sparse", "--downscale", "8", "--time-limit", "2", "--points", "3")
    options += ("--models", "rgb", "deferred", "--seeds", "0", "1")
    record, printed = run("heads.py", tmp_path / "record.json", *options)
    rows = record["rows"]
    assert [(row["seed"], row["model"]) for row in rows] == [
        (seed, model) for seed in (0, 1) for model in ("rgb", "deferred")
    ]
    for row in rows:
        seconds = [point["seconds"] for point in row["curve"]]
        assert 1 <= len(seconds) <= 3 and seconds == sorted(seconds)
        assert seconds[-1] > 1.9  # the others' turns do not count
        assert all(5 < point["psnr"] < 50 and 0 < point["ssim"] < 1 for point in row["curve"])
        assert f"{row['curve'][-1]['psnr']:.2f}" in printed
    plot = tmp_path / "record.png"
    assert plot.exists() == (f"plot: {plot}" in printed)


@pytest.mark.slow
def test_training(tmp_path):
    options = ("builtin:room-sparse", "--downscale", "16", "--steps", "30", "--model", "sh")
    record, printed = run("training.py", tmp_path / "record.json", *options)
    row = record["scenes"]["builtin:room-sparse"]
    parts = ["rays", "drawing", "Adam", "smoothing", "free space", "growing", "reports", "rest"]
    assert all(f"{100 * row[part]:.1f} %" in printed for part in parts)
    assert abs(sum(row[part] for part in parts) - 1) < 1e-9
    assert all(row[part] > 0 for part in parts if part != "free space")  # not in so few steps
    assert row["steps"] == 30 and row["samples_per_ray"] > 1
    assert record["model"] == "sh"


@pytest.mark.slow
def test_extents(tmp_path):
    options = ("room-scan", "--views", "9", "--steps", "500", "--voxels", "8000", "--threads", "1")
    record, printed = run("extents.py", tmp_path / "record.json", *options)
    rows = {row["extent"]: row for row in record["rows"]}
    found = [f"{by}{each}" for by in ("photographs", "coarse") for each in ("", ", per camera")]
    assert list(rows) == ["cameras", *found, "points", "points, per camera"]
    assert rows["cameras"]["longest_edge"] < 1.5  # a guess
    for extent in ("points", "points, per camera"):
        assert 5.0 < rows[extent]["longest_edge"] < 6.0  # the room's
        assert 1.5 < rows[extent]["content_distance"] < 2.5
    for row in rows.values():
        assert row["psnr"] > 5 and row["near_mass"] >= 0 and row["seconds"] > 0
        assert 1.5 < row["true_distance"] < 2.5
        assert f"{row['psnr']:5.2f}" in printed


@pytest.mark.slow
def test_boxes(tmp_path):
    options = ("room-table", "--steps", "2", "--voxels", "600", "--boxes", "2", "--views", "10")
    options += ("--downscale", "10")
    record, printed = run("boxes.py", tmp_path / "record.json", *options)
    own, best, worst = record["rows"]
    assert own["border"] == 0.2
    assert best["predicted"] < own["predicted"] < worst["predicted"]
    assert "correlation" in printed


@pytest.mark.slow
def test_distances(tmp_path):
    options = ("room-inward", "--views", "9", "--model", "rgb", "--threads", "1")
    record, printed = run("distances.py", tmp_path / "record.json", *options)
    (row,) = record["rows"]
    assert 2.0 < row["true"] < 3.5 and not row["box_found"]
    assert row["cameras"] < 0.8 * row["true"] and 0.5 < row["found"] / row["true"] < 2.0
    assert f"{row['found']:.3g}" in printed and f"{row['true']:.3g}" in printed


@pytest.mark.slow
def test_growth(tmp_path):
    options = ("builtin:room-sparse", "--downscale", "8", "--steps", "320", "--voxels", "8000")
    record, printed = run("growth.py", tmp_path / "record.json", *options, "--model", "rgb")
    ways = ["carried over", "restarted", "shifted", "both"]
    assert [row["at_growth"] for row in record["rows"]] == ways
    assert len({row["psnr"] for row in record["rows"]}) == 4  # each changes something
    for row in record["rows"]:
        assert row["psnr"] > 5 and row["seconds"] > 0 and f"{row['psnr']:.2f}" in printed


@pytest.mark.slow
def test_scaling_fields_goes_on_where_it_was(tmp_path):
    output = tmp_path / "record.json"
    small = ("builtin:room-sparse", "--fields", "dense", "hash", "--steps", "6", "--rays", "64")
    small += ("--voxels", "4096", "--downscale", "8")
    first, _ = run("scaling_fields.py", output, *small, "--seeds", "0")
    record, said = run("scaling_fields.py", output, *small, "--seeds", "0", "1")
    assert record["rows"][:6] == first["rows"] and len(record["rows"]) == 12
    assert "[7 of 12]" in said and "[6 of 12]" not in said
    assert {row["scaling"] for row in record["rows"]} == {"none", "quadratic", "clamped"}
    for row in record["rows"]:
        assert row["psnr"] > 5 and row["near_mass"] >= 0 and row["depth_error"] > 0
    gains = [line for line in said.splitlines() if "clamped" in line and "+-" in line]
    assert len(gains) == 2


@pytest.mark.slow
def test_calibration(tmp_path):
    options = ("builtin:room-sparse", "--steps", "30", "--voxels", "20000", "--test-views", "2")
    record, printed = run("calibration.py", tmp_path / "record.json", *options)
    assert len(record["rows"]) == 2
    for row in record["rows"]:
        assert row["coloured"] >= row["psnr"] - 1e-3  # the affine map may be none
        assert row["view"] in printed
    assert "mean gain: poses" in printed


@pytest.mark.slow
def test_exposures(tmp_path):
    options = ("builtin:room-sparse", "--steps", "400", "--voxels", "20000", "--stops", "0.4")
    output = "--picture", str(tmp_path / "seen.jpg")
    record, printed = run("exposures.py", tmp_path / "record.json", *options, *output)
    rows = {row["appearance"]: row for row in record["rows"]}
    assert [row["used"] for row in rows.values()] == [False, True, True]
    for row in rows.values():
        assert row["cc_psnr"] > row["psnr"] and f"{row['cc_psnr']:.2f}" in printed
    assert (tmp_path / "seen.jpg").stat().st_size > 1000


@pytest.mark.slow
def test_a_camera_that_was_moved_is_found_again():
    scene = wn.load_scene("builtin:room", downscale=2)
    config = replace(wn.PRESETS["fast"], steps=600, coarse_steps=0)
    field = wn.train(scene, config, progress=False).field
    camera = scene.views[scene.splits["train"][0]].camera
    truth = field.render(camera).rgb
    away = calibration.moved(camera.c2w, np.array([0.004, -0.003, 0.002, 0.01, 0.02, -0.01]))
    found = calibration.fitted_pose(field, replace(camera, c2w=away), truth, 3.0)
    assert np.abs(found - camera.c2w).max() < 0.1 * np.abs(away - camera.c2w).max()


def test_what_is_printed_is_the_results_and_no_progress():
    """Else a terminal shows a bar between the lines of a table, and a file does not."""
    for script in sorted((ROOT / "benchmarks").glob("*.py")):
        for node in ast.walk(ast.parse(script.read_text())):
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "wn.train":
                asked = {word.arg for word in node.keywords}
                assert asked & {"progress", "on_progress"}, f"{script.name}:{node.lineno}"
