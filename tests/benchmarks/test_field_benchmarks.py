"""Benchmarks of fields besides dense grids: what they measure is what torch computes as well."""

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.support.benchmark_scripts import is_interval, run

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import adjoint_launches
import candidates
import cases
import field_workload
import gradient_scaling
import workload


@pytest.mark.slow
def test_gradient_scaling_of_fields(tmp_path):
    """Of models that torch has with them; of others nothing is said."""
    options = ("--pairs", "2", "--repeats", "1", "--grid", "8", "--fields", "vm", "hash")
    options += ("--models", "deferred", "per_sample")
    record, printed = run("gradient_scaling.py", tmp_path / "record.json", *options)
    assert [(row["model"], row["field"], row["name"]) for row in record["results"]] == [
        ("deferred", field, name)
        for field in ("vm", "hash")
        for name in ("render_backward", "render_train", "control")
    ]
    assert all(row["pairs"] == 2 and row["with_us"] > 0 for row in record["results"])
    assert "deferred, vm" in printed and "deferred, hash" in printed


@pytest.mark.slow
def test_throughput_of_fields(tmp_path):
    options = ("--grids", "8", "12", "--rays", "64", "--steps", "16", "--rounds", "2")
    options += ("--threads", "1", "--models", "deferred", "--fields", "vm", "hash")
    record, printed = run("throughput.py", tmp_path / "record.json", *options)
    assert [(case["model"], case["field"], case["grid"]) for case in record["cases"]] == [
        ("deferred", "vm", 12),
        ("deferred", "hash", 12),
    ]
    assert "numba, is not written for it" in printed and not record["memory"]
    arrays = {"vm": {"planes", "lines"}, "hash": {"values"}}
    for case in record["cases"]:
        assert 0 < case["n_samples"] <= 64 * 16
        (row,) = case["rows"]
        assert set(row["candidates"]) == {"warpnerf", "torch"} and "bounds_ms" not in row
        assert all(is_interval(one) for of in row["candidates"].values() for one in of.values())
        for differences in case["differences"].values():
            assert set(differences) == {"rgb", "network", "decoder", *arrays[case["field"]]}


def asked(*words):
    parser = argparse.ArgumentParser()
    parser.add_argument("--models", nargs="+", default=list(workload.DEFAULT_MODELS))
    field_workload.add_fields(parser)
    return field_workload.models_of(parser, parser.parse_args(words))


def test_models_that_torch_does_not_have_with_a_field(capsys):
    assert asked() == [("dense", model) for model in workload.DEFAULT_MODELS]
    found = asked("--fields", "dense", "vm")
    assert ("dense", "per_sample") in found and ("vm", "per_sample") not in found
    assert [model for field, model in found if field == "vm"] == ["rgb", "sh", "deferred"]
    with pytest.raises(SystemExit) as stopped:
        asked("--fields", "vm", "hash", "--models", "per_sample")
    assert stopped.value.code == 2
    assert "--fields vm hash goes with deferred, sh, rgb" in capsys.readouterr().err


def test_cases_of_fields_come_beside_those_of_dense_grids():
    """Once each, on the last grid."""
    found = cases.make_cases([4, 6], asked("--fields", "hash", "--models", "deferred", "sh"))
    assert [str(case) for case in found] == [
        f"{model}, random rays, 6^3, dense, scaled, hash" for model in ("deferred", "sh")
    ]
    both = cases.make_cases([4, 6], asked("--fields", "dense", "vm"))
    assert both[:-3] == cases.make_cases([4, 6])
    assert {case.field for case in both[-3:]} == {"vm"}


@pytest.mark.parametrize("field", ["vm", "hash"])
def test_made_fields(field):
    """All rays have all of their samples, numbers are neither tiny nor huge, padding is 0."""
    work = workload.make_workload("inside", 8, 20, 30, model="deferred")
    made = field_workload.made_field(field, work)
    assert (np.bincount(made.ray_of_sample, minlength=20) == 30).all()
    t = made.distances.reshape(20, 30)
    points = work.origins[:, None] + t[..., None] * work.directions[:, None]
    np.testing.assert_allclose(made.positions_in_field.reshape(20, 30, 3), points, atol=1e-6)
    np.testing.assert_allclose(made.lengths, work.step, rtol=1e-6)
    decoder = made.trained.tensors()["decoder"]
    assert not decoder[:, made.trained.n_decoded :].any()
    assert 0.5 < np.linalg.norm(decoder[:, 0]) < 2.0
    if field == "hash":
        values, shapes = made.trained.tensors()["values"], field_workload.level_shapes
        levels = shapes(made.trained.kind, made.trained.lattice)
        sizes = [values[level.begin : level.end].std() for level in levels]
        assert (np.diff(sizes) < 0.0).all() and sizes[0] == pytest.approx(1.0, rel=0.05)


def test_who_can_compute_fields():
    found, missing = candidates.find("cpu", "deferred", "vm")
    assert list(found) == ["warpnerf", "torch"] and "numba" in missing
    assert "torch" in candidates.find("cuda:0", "deferred", "hash")[1]


@pytest.mark.slow
@pytest.mark.parametrize("field", ["vm", "hash"])
def test_launches_of_another_gradient_are_not_timed(field):
    work = gradient_scaling.inside(field, "deferred", 8)
    ours = adjoint_launches.WarpAdjoint(work, "cpu", 2, gradient_scaling.N_SAMPLES)
    sides = {"none": replace(work, scaled=False), "clamped": work}
    theirs = {s: gradient_scaling.torch_of(side, 2, "cpu") for s, side in sides.items()}
    gradient_scaling.check(ours, theirs, gradient_scaling.AT_KINKS)
    with pytest.raises(SystemExit, match="with scaling 'none' the gradient of"):
        gradient_scaling.check(ours, {"none": theirs["clamped"]}, gradient_scaling.AT_KINKS)
