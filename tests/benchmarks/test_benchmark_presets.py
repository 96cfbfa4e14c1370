"""The benchmarks of configurations and of whole steps run, and write complete records."""

import pytest

from tests.support.benchmark_scripts import is_interval, run


@pytest.mark.slow
def test_presets(tmp_path):
    other = "fast grid.voxels=1000 model=rgb optim.tv_every=4 grid.grow_at=[0.5]"
    options = ("builtin:room-sparse", "--downscale", "8", "--steps", "60", "--seeds", "0", "1")
    options += ("--candidate", "fast grid.voxels=1000", "--candidate", other)
    record, printed = run("presets.py", tmp_path / "record.json", *options)
    rows = record["rows"]
    assert [(row["seed"], row["candidate"]) for row in rows] == [
        (seed, text) for seed in (0, 1) for text in ("fast grid.voxels=1000", other)
    ]
    for row in rows:
        assert row["steps"] == 60 and 5.0 < row["psnr"] < 40.0 and 5.0 < row["training_psnr"] < 40.0
    assert record["candidates"][other]["optim"]["tv_every"] == 4
    assert record["candidates"][other]["grid"]["grow_at"] == [0.5]
    assert record["candidates"][other]["model"] == {"name": "rgb"}
    assert record["time_limit"] is None and other in printed


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("slow", "slow"),
        ("fast grid.voxel=8", "voxel"),
        ("fast grid", "grid"),
        ("fast seed.x=1", "x"),
    ],
)
def test_a_candidate_that_there_is_not_is_refused(text, named):
    import presets

    with pytest.raises(presets.InputError, match=named):
        presets.configured(text)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scenes", "models"),
    [(("dense", "sphere"), ("dvgo",)), (("builtin:room",), ("per_sample",))],
)
def test_against_torch(tmp_path, scenes, models):
    options = (*scenes, "--models", *models, "--grid", "10", "--rays", "48", "--steps", "250")
    options += ("--downscale", "8", "--rounds", "2", "--threads", "1")
    record, _ = run("against_torch.py", tmp_path / "record.json", *options)
    cases = [(row["scene"], row["model"]) for row in record["rows"]]
    assert cases == [(scene, model) for scene in scenes for model in models]
    for row in record["rows"]:
        for what in ("step", "pass"):
            assert is_interval(row[f"{what}_over_warpnerf"]) and is_interval(
                row[f"torch_{what}_ms"]
            )
        assert row["n_samples"] > 0 and row["torch_choices"]["1"]


@pytest.mark.slow
@pytest.mark.parametrize("field", ["hash"])  # of vm, torch's reading is tested with its models
def test_against_torch_with_other_fields(tmp_path, field):
    options = ("builtin:room-sparse", "--field", field, "--grid", "10", "--steps", "250")
    options += ("--downscale", "8", "--rounds", "2", "--threads", "1")
    record, _ = run("against_torch.py", tmp_path / "record.json", *options)
    (row,) = record["rows"]
    assert record["field"] == field and row["model"] == "deferred" and row["n_samples"] > 0
    assert {"rgb", "decoder", "network"} < set(row["differences"]["torch, 1 threads"])
    assert is_interval(row["step_over_warpnerf"]) and is_interval(row["pass_over_warpnerf"])
    assert "read by" in row["torch_choices"]["1"]


@pytest.mark.slow
def test_schedules(tmp_path):
    scene = ("builtin:room-sparse", "--downscale", "8")
    options = (*scene, "--seeds", "1", "2", "--time-limit", "1.5")
    record, printed = run("schedules.py", tmp_path / "record.json", *options)
    rows = record["rows"]
    assert [row["seed"] for row in rows] == [1] * 4 + [2] * 4
    assert list(record["schedules"]) == [row["schedule"] for row in rows[:4]]
    for row in rows:
        assert row["steps"] > 2 and 5 < row["psnr"] < 50 and 0 < row["besides_rays"] < 1
        assert row["seconds"] > 1.4  # the others' turns do not count
        assert f"{row['psnr']:.2f}" in printed
