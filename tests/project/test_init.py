"""The package's names are all there, and cost nothing until they are used."""

from __future__ import annotations

import importlib.util
import inspect
import subprocess
import sys
from typing import Any

import pytest

import warpnerf
from warpnerf.torch import render_rays, scale_gradient

HEAVY = "{'warp', 'torch', 'jax', 'imageio', 'PIL', 'safetensors', 'tyro', 'rich', 'numpy'}"


def in_fresh_python(code: str) -> str:
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=240, check=True
    )
    return result.stdout.strip()


def test_import_loads_nothing_heavy() -> None:
    code = f"import sys, warpnerf; print(sorted({HEAVY} & set(sys.modules)))"
    assert in_fresh_python(code) == "[]"


def test_configuring_does_not_load_warp() -> None:
    code = (
        "import sys, warpnerf; warpnerf.TrainConfig(); warpnerf.load_scene; warpnerf.InputError;"
        "print(sorted({'warp', 'torch', 'jax'} & set(sys.modules)))"
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
    ("name", "home"), [("train", "training.train"), ("evaluate", "evaluation.evaluate")]
)
def test_they_stay_functions_when_their_modules_come_first(name: str, home: str) -> None:
    """Importing a submodule binds its name on the package, so none may bear a public name."""
    code = f"import warpnerf as wn; from warpnerf.{home} import {name}; print(wn.{name} is {name})"
    assert in_fresh_python(code) == "True"


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no_such_name"):
        warpnerf.no_such_name  # noqa: B018


def public_functions() -> dict[str, Any]:
    """Functions, and methods where they are first defined, of public names."""
    homes = {name: getattr(warpnerf, name) for name in warpnerf.__all__}
    homes |= {f"torch.{f.__name__}": f for f in (scale_gradient, render_rays)}
    if importlib.util.find_spec("jax") is not None:
        of_jax = importlib.import_module("warpnerf.jax")
        homes |= {f"jax.{f}": getattr(of_jax, f) for f in ("scale_gradient", "render_rays")}
    found = {}
    for name, value in homes.items():
        if inspect.isfunction(value):
            found[name] = value
        elif inspect.isclass(value) and value.__module__.startswith("warpnerf"):
            for method, function in vars(value).items():
                plain = getattr(function, "__func__", function)
                inherited = any(hasattr(base, method) for base in value.__mro__[1:])
                if not method.startswith("_") and inspect.isfunction(plain) and not inherited:
                    found[f"{name}.{method}"] = plain
    return found


@pytest.mark.parametrize("name", public_functions())
def test_public_functions_say_what_they_take_and_return(name: str) -> None:
    function = public_functions()[name]
    says = function.__doc__ or ""
    parameters = [p for p in inspect.signature(function).parameters if p not in ("self", "cls")]
    for parameter in parameters:
        assert f"    {parameter}: " in says.partition("Args:")[2], parameter
    if inspect.signature(function).return_annotation not in (None, "None"):
        assert "Returns:" in says or not parameters
