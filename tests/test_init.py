"""The package's names are all there, and cost nothing until they are used."""

from __future__ import annotations

import subprocess
import sys

import pytest

import warpnerf

HEAVY = "{'warp', 'torch', 'imageio', 'PIL', 'safetensors', 'tyro', 'rich', 'numpy'}"


def in_fresh_python(code: str) -> str:
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    return result.stdout.strip()


def test_import_loads_nothing_heavy() -> None:
    code = f"import sys, warpnerf; print(sorted({HEAVY} & set(sys.modules)))"
    assert in_fresh_python(code) == "[]"


def test_configuring_does_not_load_warp() -> None:
    code = (
        "import sys, warpnerf; warpnerf.TrainConfig(); warpnerf.load_scene; warpnerf.InputError;"
        "print(sorted({'warp', 'torch'} & set(sys.modules)))"
    )
    assert in_fresh_python(code) == "[]"


def test_every_name_is_found_and_listed() -> None:
    for name in warpnerf.__all__:
        assert getattr(warpnerf, name) is not None
        assert name in dir(warpnerf)
    assert warpnerf.__version__


def test_train_and_evaluate_are_functions() -> None:
    code = "import warpnerf as wn; print(callable(wn.train), callable(wn.evaluate))"
    assert in_fresh_python(code) == "True True"


@pytest.mark.parametrize(
    ("name", "home"), [("train", "training.trainer"), ("evaluate", "evaluation.evaluate")]
)
def test_they_stay_functions_when_their_modules_come_first(name: str, home: str) -> None:
    """Importing a submodule binds its name on the package, so none may bear a public name."""
    code = f"import warpnerf as wn; from warpnerf.{home} import {name}; print(wn.{name} is {name})"
    assert in_fresh_python(code) == "True"


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no_such_name"):
        warpnerf.no_such_name  # noqa: B018
