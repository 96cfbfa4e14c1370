"""--model and --model-options, and the configurations that models refuse."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.support.tiny_runs import TINY, run
from warpnerf.checks import InputError
from warpnerf.cli.model_options import chosen_model
from warpnerf.model.interface import Model
from warpnerf.model.models import (
    MODELS,
    Deferred,
    PerSample,
    Rgb,
    SphericalHarmonics,
    from_json,
    model_of,
    register,
)
from warpnerf.model.registry import to_json


def test_options_change_the_model_they_are_for() -> None:
    begun = Deferred(specular=8)
    assert chosen_model(begun, None, ()) == begun
    assert chosen_model(begun, "deferred", ["width=48"]) == Deferred(specular=8, width=48)
    assert chosen_model(begun, "sh", ["degree=1"]) == SphericalHarmonics(degree=1)
    given = ["residual=false", "threshold=0", "features=2", "learning_rate_mlp=1e-3"]
    expected = PerSample(residual=False, threshold=0.0, features=2, learning_rate_mlp=1e-3)
    assert chosen_model(begun, "per_sample", given) == expected


REFUSED = [
    ("nerf", [], "--model must be one of rgb, sh, deferred, per_sample, "),
    ("sh", ["degree=4"], "model.degree must be 0, 1, 2 or 3, not 4."),
    ("sh", ["degree=-1"], "model.degree must be a whole number of at least 0, not -1."),
    ("sh", ["degree=two"], "degree must be a whole number, not 'two'."),
    ("sh", ["width=32"], "'width=32' is no option of the model sh; it has degree=2, "),
    ("rgb", ["width=32"], "'width=32' is no option of the model rgb; it has none."),
    ("deferred", ["width=40"], "model.width must be a multiple of 16 up to 128, not 40: "),
    ("deferred", ["width=144"], "model.width must be a multiple of 16 up to 128, not 144: "),
    ("deferred", ["width=0"], "model.width must be a whole number of at least 1, not 0."),
    ("deferred", ["width"], "'width' is no option of the model deferred; it has frequencies=1, "),
    ("deferred", ["width=32", "width=64"], "width is given twice; keep one of them."),
    ("deferred", ["specular=29"], "model.specular must be at most 28, not 29."),
    ("deferred", ["specular=0"], "model.specular must be a whole number of at least 1, not 0."),
    ("deferred", ["hidden_layers=4"], "model.hidden_layers must be 1, 2 or 3, not 4."),
    ("deferred", ["frequencies=9"], "model.frequencies must be at most 8, not 9."),
    ("deferred", ["learning_rate_mlp=0"], "model.learning_rate_mlp must be a finite number above"),
    ("per_sample", ["features=3"], "use more, or residual=false."),
    ("per_sample", ["features=32"], "model.features must be at most 31, not 32."),
    ("per_sample", ["residual=maybe"], "residual must be true or false, not 'maybe'."),
    ("per_sample", ["threshold=1"], "model.threshold must be below 1, not 1.0."),
    ("per_sample", ["threshold=nan"], "model.threshold must be a finite number"),
]


@pytest.mark.parametrize(("name", "options", "says"), REFUSED)
def test_what_does_not_fit_is_refused(name: str, options: list[str], says: str) -> None:
    with pytest.raises(InputError) as error:
        chosen_model(Rgb(), name, options)
    assert says in str(error.value)


def test_the_command_refuses_in_a_sentence_and_writes_nothing(tmp_path: Path) -> None:
    given = [
        (("--model", "nerf"), "--model must be one of"),
        (("--model", "sh", "--model-options", "degree=4"), "model.degree"),
        (("--model-options", "width=40"), "model.width"),
        (
            ("--voxels", str(1200**3), "--model", "sh", "--model-options", "degree=3"),
            "use fewer voxels, or a model with fewer features",
        ),
    ]
    for options, says in given:
        code, _, err = run("train", *TINY, *options, "--output", tmp_path / "run")
        assert code == 2, err
        assert says in err and "Traceback" not in err
    for command in ("inspect", "warmup"):
        scene = ("builtin:room-sparse",) if command == "inspect" else ()
        code, _, err = run(command, *scene, "--model-options", "width=40")
        assert code == 2 and "model.width" in err
    assert not any(tmp_path.iterdir())


def test_a_models_numbers_are_plain_ones() -> None:
    """So JSON holds them, and what is read back is the same."""
    given = PerSample(
        features=np.int64(6), threshold=0, residual=np.bool_(True), width=np.int32(16)
    )
    assert given == PerSample(features=6, threshold=0.0, residual=True, width=16)
    assert [type(value) for value in (given.features, given.threshold, given.residual)] == [
        int,
        float,
        bool,
    ]
    for model in (given, Rgb(), SphericalHarmonics(degree=0, learning_rate_sh=1)):
        assert from_json(json.loads(json.dumps(to_json(model)))) == model
    whole = to_json(given) | {"threshold": 0}
    assert from_json(whole) == given
    for residual in (1, "false", None):
        with pytest.raises(InputError, match="residual must be True or False"):
            PerSample(residual=residual)  # type: ignore[arg-type]
    for wrong in ({"width": 16.0}, {"residual": 0}, {"degree": 1}, {"width": "16"}):
        with pytest.raises(ValueError, match="cannot be"):
            from_json(to_json(given) | wrong)


def test_a_name_stands_for_one_model() -> None:
    class Other(Model):
        name = "rgb"

    with pytest.raises(ValueError, match="is the name of another model"):
        register(Other)
    assert register(Rgb) is Rgb and MODELS["rgb"] is Rgb
    assert type(model_of("rgb")) is Rgb


def test_what_a_step_takes_goes_with_the_configuration() -> None:
    times = [
        model.relative_time
        for model in (
            Rgb(),
            Deferred(width=32),
            Deferred(),
            PerSample(),
            PerSample(width=128, hidden_layers=3),
        )
    ]
    assert times[0] == 1.0 and times == sorted(times) and len({*times}) == len(times)
    assert SphericalHarmonics(degree=3).relative_time > SphericalHarmonics(degree=0).relative_time
