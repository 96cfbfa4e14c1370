"""A comparison made tiny: trainings that are cut and resumed, the report, and what is refused."""

from __future__ import annotations

import json
import os
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import get_args
from unittest.mock import Mock

import av
import pytest

from tests.support.tiny_scenes import write_transforms
from warpnerf.checks import InputError
from warpnerf.cli.compare import CompareOptions, compare_command
from warpnerf.config import GridConfig, LossConfig, Scaling, TrainConfig
from warpnerf.evaluation import sight
from warpnerf.model.models import Rgb
from warpnerf.reports import comparison_film
from warpnerf.reports.compare import require_comparable, write_comparison
from warpnerf.reports.comparison import (
    FIGURES,
    Row,
    candidates_of,
    compare_figures,
    sentences,
    value_at,
)
from warpnerf.reports.comparison_film import usual_path
from warpnerf.reports.experiment import MOMENTS, Candidate, Capture, Experiment
from warpnerf.reports.paired import paired_difference
from warpnerf.scenes.formats.load import load_scene
from warpnerf.scenes.scene import Scene
from warpnerf.training import trainer as training

CONFIG = TrainConfig(
    model=Rgb(), loss=LossConfig(), steps=16, threads=1, grid=GridConfig(voxels=4000)
)


@pytest.fixture(scope="module")
def room() -> Scene:
    """With few views, as each training's measures look at all."""
    whole = load_scene("builtin:room-sparse", downscale=8)
    splits = {split: indices[:3] for split, indices in whole.splits.items()}
    return replace(whole, splits=splits)


def experiment(folder: Path, scene: Scene, n_seeds: int = 2) -> Experiment:
    """Of two scalings."""
    candidates = [
        Candidate(name="plain", config=replace(CONFIG, scaling="none")),
        Candidate(name="scaled", config=replace(CONFIG, scaling="clamped"), against="plain"),
    ]
    capture = Capture(scene=scene, source="builtin:room-sparse", downscale=8)
    return Experiment(folder, capture, candidates, n_seeds)


@pytest.fixture(scope="module")
def looked() -> Mock:
    """Counts how often it is looked which training views see some surfaces."""
    return Mock(side_effect=sight.training_views_that_see)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory, room: Scene, looked: Mock) -> Experiment:
    """One that was never interrupted."""
    made = experiment(tmp_path_factory.mktemp("experiments") / "whole", room)
    made.begin()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sight, "training_views_that_see", looked)
        for candidate, seed in made.trials:
            assert made.train(candidate, seed)
    return made


def contents(folder: Path) -> dict[str, bytes]:
    """What must not depend on interruptions."""
    kinds = ("runs/*/field.safetensors", "runs/*/metrics.json", "moments/*/*.npz")
    paths = [path for kind in kinds for path in folder.glob(kind)]
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(paths)}


def test_cut_anywhere_it_ends_with_the_same_bits(
    finished: Experiment,
    looked: Mock,
    room: Scene,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each training is stopped once, by a process that does not know the others."""
    assert looked.call_count == len(room.splits["test"])
    updates = 0
    update = training.Trainer.update

    def counted(self: training.Trainer) -> None:
        nonlocal updates
        updates += 1
        update(self)

    monkeypatch.setattr(training.Trainer, "update", counted)
    for _ in range(2 * len(finished.trials)):
        again = experiment(tmp_path / "cut", room)
        again.begin()
        for number, (candidate, seed) in enumerate(again.trials):
            before, fresh = updates, not again.run(candidate, seed).checkpoints
            most = before + 3 + 2 * number if fresh else 10**9
            if not again.train(candidate, seed, lambda most=most: updates >= most):
                break
    assert contents(tmp_path / "cut") == contents(finished.folder)
    assert len(contents(finished.folder)) == 4 + 4 + 2 * len(MOMENTS)
    done = updates
    assert all(again.train(candidate, seed) for candidate, seed in again.trials)
    assert updates == done
    of_seeds = [finished.metrics(finished.candidates[0], seed) for seed in finished.seeds]
    assert of_seeds[0] != of_seeds[1]


def test_the_report_is_one_file_and_says_what_figures_say(
    finished: Experiment, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(comparison_film, "N_FRAMES", 2)
    rows = write_comparison(finished)
    names = {path.name for path in finished.folder.iterdir()}
    assert {"report.html", "figures.json", "moments.png", "cameras.png", "curves.png"} <= names
    with av.open(finished.folder / "floaters.mp4") as film:
        assert film.streams.video[0].frames == 2 and film.streams.video[0].width == 2 * 40 + 6
    first, last = (camera.position for camera in usual_path(finished))
    scene = finished.capture.scene
    camera = scene.training_cameras[1]
    assert first == pytest.approx(camera.position)
    assert last == pytest.approx(camera.position - 0.5 * scene.content_distance * camera.forward)
    page = (finished.folder / "report.html").read_text()
    assert not re.search(r"(src|href)=\"(?!data:|#)", page) and "$" not in page.split("<script>")[0]
    assert page.count("data:video/mp4") == 1
    assert page.count("data:image/jpeg") == 3 * 3  # photograph and two configurations
    record = json.loads((finished.folder / "figures.json").read_text())
    plain, scaled = record["configurations"]
    metrics = [finished.metrics(finished.candidates[0], seed) for seed in (0, 1)]
    assert plain["figures"]["psnr"]["values"] == [m["mean"]["psnr"] for m in metrics if m]
    assert set(scaled["figures"]) == set(FIGURES) == set(scaled["differences"])
    for name, difference in scaled["differences"].items():
        means = (side["figures"][name]["mean"] for side in (scaled, plain))
        mine, theirs = means
        assert difference["mean"] == pytest.approx(mine - theirs, abs=1e-12)
        assert difference["low"] <= difference["mean"] <= difference["high"]
    assert plain["differences"] == {} and record["sentences"] == sentences(rows)
    assert all(sentence.split(" (")[0][:40] in page for sentence in record["sentences"])


def test_a_training_that_fails_is_left_out_and_said(
    finished: Experiment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And one that a kill left between its field and the end of its checkpoints is tidied up."""
    whole = finished.capture.scene
    made = experiment(tmp_path / "out", whole)
    shutil.copytree(finished.folder, made.folder)
    (plain, scaled), runs = made.candidates, made.folder / "runs"
    shutil.rmtree(runs / "scaled-seed-0")
    for name in ("metrics.json", "curves.png"):
        (runs / "plain-seed-1" / name).unlink(missing_ok=True)
    (runs / "plain-seed-1" / "checkpoint-00000008.safetensors").write_bytes(b"")

    def fails(self: training.Trainer) -> None:
        raise FloatingPointError("the loss is no longer finite.")

    monkeypatch.setattr(training.Trainer, "update", fails)
    made.begin()
    assert made.train(scaled, 0) and made.train(scaled, 0) and made.train(plain, 1)
    assert not made.run(plain, 1).checkpoints
    rows = write_comparison(made)
    assert [len(row.seconds) for row in rows] == [2, 1]
    assert {difference.seeds for difference in rows[1].differences.values()} == {1}
    mine, theirs = (made.metrics(candidate, 1) for candidate in (scaled, plain))
    assert mine is not None and theirs is not None
    apart = mine["mean"]["psnr"] - theirs["mean"]["psnr"]
    assert rows[1].differences["psnr"].mean == pytest.approx(apart)
    page = (made.folder / "report.html").read_text()
    assert "scaled with seed 0 failed, and counts in no figure: the loss is no longer" in page
    path = runs / "plain-seed-1" / "metrics.json"
    theirs["floaters"]["within"] *= 2.0
    path.write_text(json.dumps(theirs))
    rows = compare_figures(made)
    assert "near_mass" not in rows[1].differences and "psnr" in rows[1].differences
    assert "figures near cameras are not compared" in " ".join(sentences(rows))


def test_seeds_may_have_found_other_extents(
    finished: Experiment, room: Scene, tmp_path: Path
) -> None:
    """Figures near cameras are compared where both of a pair were taken up to one distance."""
    shutil.copytree(finished.folder, tmp_path / "other")
    made = experiment(tmp_path / "other", room)
    for candidate in made.candidates:
        metrics = made.metrics(candidate, 1)
        assert metrics is not None
        metrics["floaters"]["within"] *= 2.0
        (made.run(candidate, 1).folder / "metrics.json").write_text(json.dumps(metrics))
    assert "near_mass" in compare_figures(made)[1].differences


def row(values: dict[str, list[float]], against: dict[str, list[float]] | None = None) -> Row:
    differences = {n: paired_difference(v, against[n]) for n, v in values.items() if against}
    name, other = ("b", "a") if against else ("a", None)
    candidate = Candidate(name=name, config=CONFIG, against=other)
    return Row(candidate=candidate, values=values, seconds=[1.0] * 3, differences=differences)


def test_a_sentence_tells_better_from_worse_and_from_chance() -> None:
    plain = {
        "psnr": [20.0] * 3,
        "front_train": [0.5] * 3,
        "hit_train": [0.4] * 3,
        "near_mass": [0.1] * 3,
    }
    other = {  # emptier: less in front, and at the surfaces as well
        "psnr": [21.0, 21.1, 20.9],
        "front_train": [0.4, 0.41, 0.39],
        "hit_train": [0.3, 0.31, 0.29],
        "near_mass": [0.0, 0.3, 0.1],
    }
    said, caution = sentences([row(plain), row(other, plain)])
    assert said.startswith("b against a: better in PSNR (+1.00, ")
    assert ". Worse in light at surfaces, training rays (-0.1000" in said
    assert ". Changed in light in front, training rays (-0.1000" in said
    assert ". No significant difference in optical depth near cameras." in said
    assert "by Student's t" in caution
    assert "Of 4 differences, 0.2 are expected to look significant by chance." in caution
    single = replace(row({"psnr": [21.0]}, {"psnr": [20.0]}), seconds=[1.0])
    (said,) = sentences([single])
    assert said.startswith("One seed")


def test_names_with_commas_are_told_apart() -> None:
    plain = {"psnr": [20.0] * 3, "front_train": [0.5] * 3, "hit_train": [0.4] * 3}
    other = {"psnr": [20.1, 19.9, 20.0], "front_train": [0.5] * 3, "hit_train": [0.4, 0.5, 0.3]}
    said, _ = sentences([row(plain), row(other, plain)])
    assert "in PSNR; light in front, training rays; light at surfaces, training rays." in said


def test_each_is_compared_with_the_first_scaling_of_its_own_kind() -> None:
    keys = [
        ("fast", field, scaling, decay)
        for field in ("dense", "vm")
        for scaling in get_args(Scaling)
        for decay in (None, "decay-0.1")
    ]
    found = candidates_of(dict.fromkeys(keys, CONFIG))
    against = {candidate.name: candidate.against for candidate in found}
    assert against["fast-vm-clamped"] == "fast-vm-none" and against["fast-vm-none"] is None
    assert against["fast-vm-none-decay-0.1"] == "fast-vm-none"
    alone = candidates_of({(name, None, "none", None): CONFIG for name in ("fast", "quality")})
    assert [candidate.against for candidate in alone] == [None, "fast-none"]


def test_figures_that_a_capture_lacks_are_none() -> None:
    assert value_at({"mean": {"psnr": 3}}, ("mean", "psnr")) == 3.0
    assert value_at({"mean": {}}, ("mean", "psnr")) is None
    assert value_at({}, ("measures", "seen", "2", "psnr")) is None


def test_a_folder_of_something_else_is_refused(finished: Experiment, room: Scene) -> None:
    with pytest.raises(InputError, match=r"another comparison: its seeds is 2, not 1; name a new"):
        experiment(finished.folder, room, n_seeds=1).begin()
    swapped = {**room.splits, "test": room.splits["test"][::-1]}
    with pytest.raises(InputError, match=r"on other photographs, masks, cameras or split; bring"):
        experiment(finished.folder, replace(room, splits=swapped)).begin()
    other = experiment(finished.folder, room)
    longer = replace(other.candidates[1], config=replace(CONFIG, steps=17))
    other.candidates = (other.candidates[0], longer)
    with pytest.raises(InputError, match=r"its configurations\.scaled\.steps is 16, not 17"):
        other.begin()
    with pytest.raises(InputError, match=r"holds other files \(plain-seed-0\)"):
        experiment(finished.folder / "runs", room).begin()
    with pytest.raises(InputError, match="cannot be written"):
        experiment(finished.folder / "experiment.json" / "x", room).begin()


def test_more_seeds_and_configurations_are_accepted_and_leftovers_swept(
    room: Scene, tmp_path: Path
) -> None:
    folder = tmp_path / "out"
    folder.mkdir()
    dead = 4194304999  # no process has such a number
    (folder / f".experiment.json.{dead}.tmp").write_text("{")
    made = experiment(folder, room, n_seeds=1)
    made.begin()
    (folder / "moments" / "plain").mkdir(parents=True)
    leftovers = [
        folder / f".report.html.{dead}.tmp",
        folder / f"moments/plain/.0.npz.{dead}.tmp",
    ]
    for path in leftovers:
        path.write_bytes(b"")
    more = experiment(folder, room)
    more.candidates += (Candidate(name="third", config=CONFIG),)
    more.begin()
    assert not list(folder.rglob("*.tmp"))
    record = json.loads((folder / "experiment.json").read_text())
    assert record["seeds"] == 2 and list(record["configurations"]) == ["plain", "scaled", "third"]
    with pytest.raises(InputError, match="configurations has plain, scaled, third, not plain, sca"):
        experiment(folder, room).begin()


def test_a_record_that_was_emptied_is_not_none(room: Scene, tmp_path: Path) -> None:
    """Else results of other configurations would stand for those that are requested."""
    (tmp_path / "experiment.json").write_text("{}")
    with pytest.raises(InputError, match=r"another comparison: its scene is null, not \"builtin:"):
        experiment(tmp_path, room).begin()


@pytest.mark.parametrize("dangling", [False, True])
@pytest.mark.parametrize(
    "name",
    [
        *("experiment.json", "report.html", "figures.json", "near.png", "floaters.mp4"),
        *("views/test_00-plain.png", "moments/plain/0.npz", "runs/plain-seed-0/failed.json"),
        *("views", "moments", "moments/plain", "runs", "runs/plain-seed-0"),
    ],
)
def test_a_link_is_not_written_through(
    room: Scene, tmp_path: Path, name: str, dangling: bool
) -> None:
    made, target = experiment(tmp_path / "out", room), tmp_path / "precious"
    made.begin()
    place = made.folder / name
    place.parent.mkdir(parents=True, exist_ok=True)
    place.unlink(missing_ok=True)
    if not dangling and place.suffix:
        target.write_text("precious")
    elif not dangling:
        (target / "0.npz").mkdir(parents=True)
    place.symlink_to(target)
    if name == "experiment.json":
        (made.folder / "runs").mkdir()
    with pytest.raises(InputError, match=f"{name} is a link, and a comparison writes only to"):
        made.begin()
    place.unlink()
    if place.suffix:
        os.mkfifo(place)
        with pytest.raises(InputError, match=f"{name} is neither a file nor a folder"):
            made.begin()


def test_options_that_came_after_an_experiment_began_have_their_defaults(
    room: Scene, tmp_path: Path
) -> None:
    experiment(tmp_path, room).begin()
    path = tmp_path / "experiment.json"
    record = json.loads(path.read_text())
    of_another_version = record["configurations"]["plain"] | {"of_a_later_version": 1}
    for tree in record["configurations"].values():
        del tree["optim"]["near_decay"]
    path.write_text(json.dumps(record))
    experiment(tmp_path, room).begin()
    for wrong in (
        {"optim": {"near_decay": "x"}},
        {"optim": {"near_decay": -1.0}},
        None,
        {"steps": 3},
        of_another_version,
    ):
        record["configurations"]["plain"] = wrong
        path.write_text(json.dumps(record))
        with pytest.raises(InputError, match="holds another comparison"):
            experiment(tmp_path, room).begin()


def test_too_few_test_views_are_refused(room: Scene) -> None:
    for n, words in ((0, "no test views"), (1, "one test view")):
        fewer = replace(room, splits={**room.splits, "test": room.splits["test"][:n]})
        with pytest.raises(InputError, match=f"{words}, and .* by --split"):
            require_comparable(fewer)


@pytest.mark.parametrize(
    ("options", "given", "words"),
    [
        ({"scalings": ("none", "clampd")}, {}, "--scalings: 'clampd' is none of .* clamped"),
        ({"scalings": ("none", "none")}, {}, "--scalings: none is given twice"),
        ({"near_decays": ("0.1", ".1")}, {}, "--near-decays: .1 is given twice"),
        ({"near_decays": ("2",)}, {}, "near_decay must lie in"),
        ({"fields": ("cube",)}, {}, "--fields: 'cube' is none of dense, vm, hash"),
        ({"presets": ()}, {}, "--presets has no value"),
        ({"seeds": 0}, {}, "--seeds must be a whole number of at least 1"),
        ({"seeds": 1001}, {}, "--seeds must be at most 1000, not 1001"),
        ({"scalings": ("none",)}, {}, "needs two configurations or more; name several by --sca"),
        ({}, {"seed": ("3",)}, "--seed: compare takes several, by --seeds"),
        ({"split": "all"}, {}, "no test views"),
    ],
)
def test_bad_input_is_refused_before_anything_is_written(
    tmp_path: Path, options: dict, given: dict, words: str
) -> None:
    room = {"scene": "builtin:room-sparse", "downscale": 8, "output": tmp_path / "out"}
    with pytest.raises(InputError, match=words):
        compare_command(CompareOptions(**room, **options), given)
    assert not (tmp_path / "out").exists()


def test_the_command_trains_reports_and_continues(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two presets with the same kernels, on photographs without depths."""
    write_transforms(tmp_path / "scene", 4, scale=2)
    options = CompareOptions(
        scene=str(tmp_path / "scene"),
        output=tmp_path / "out",
        split="2",
        scalings=("clamped",),
        presets=("fast", "quality"),
        seeds=1,
    )
    given = {"steps": ("2",), "threads": ("1",), "grid.voxels": ("512",)}
    assert compare_command(options, given) == 0
    first = capsys.readouterr().out
    assert "2 of 2  quality-clamped     0" in first and "One seed" in first
    page = (tmp_path / "out" / "report.html").read_text()
    assert "quality-clamped less fast-clamped" in page and "light in front" not in page
    assert compare_command(options, given) == 0
    assert "steps/s" not in capsys.readouterr().out
