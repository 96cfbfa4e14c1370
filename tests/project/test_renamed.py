"""Names of the version before still work, warn, and mean the same."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import warpnerf as wn
from tests.runs.test_checkpoint import rewrite
from tests.support.solid_fields import ball_field
from tests.support.tiny_fields import tiny_field
from warpnerf.cli.configured import configured
from warpnerf.cli.model_options import chosen_model
from warpnerf.config_json import config_from_json, decode
from warpnerf.exporting.visibility import Visibility
from warpnerf.model.models import FORMER_NAMES, MODELS, from_json, model_of
from warpnerf.model.registry import to_json
from warpnerf.renamed import FORMER_NAMES as FORMER_PUBLIC
from warpnerf.renamed import renamed_argument
from warpnerf.rendering.field import Field
from warpnerf.runs.checkpoint import load_field, save_field


@pytest.mark.parametrize(("old", "new"), list(FORMER_PUBLIC.items()))
def test_public_names(old: str, new: str) -> None:
    with pytest.warns(DeprecationWarning, match=rf"warpnerf\.{old} is called warpnerf\.{new} now"):
        found = getattr(wn, old)
    assert found is getattr(wn, new)
    assert old not in wn.__all__


@pytest.mark.parametrize(
    "use",
    [
        lambda: wn.TrainConfig(model="features"),  # type: ignore[arg-type]
        lambda: model_of("features"),
        lambda: wn.look,
        lambda: wn.splats_of(ball_field(), sight=None),  # type: ignore[call-arg]
    ],
)
def test_warnings_are_about_the_line_that_uses_the_name(use: Callable[[], object]) -> None:
    """Python shows a DeprecationWarning only of the program itself."""
    with pytest.warns(DeprecationWarning) as found:
        use()
    assert {warning.filename for warning in found} == {__file__}


def test_a_name_warns_each_time() -> None:
    """It is not kept as an attribute of the package, which would hide it."""
    for _ in range(2):
        with pytest.warns(DeprecationWarning):
            assert wn.Features is wn.PerSample


def all_light(field: Field) -> Visibility:
    light = np.ones(field.lattice.size, np.float32)
    return Visibility(light=light, colour=np.full((*light.shape, 3), 0.25, np.float32))


def test_the_argument_sight() -> None:
    field = ball_field()
    seen = all_light(field)
    surface, splats = wn.extract_surface(field, seen), wn.splats_of(field, visibility=seen)
    with pytest.warns(DeprecationWarning, match="visibility="):
        same_surface = wn.extract_surface(field, sight=seen)  # type: ignore[call-arg]
    with pytest.warns(DeprecationWarning, match="visibility="):
        same_splats = wn.splats_of(field, sight=seen)  # type: ignore[call-arg]
    np.testing.assert_array_equal(same_surface.rgb, surface.rgb)
    np.testing.assert_array_equal(same_splats.rgb, splats.rgb)
    assert (splats.rgb == 0.25).all()
    assert not np.array_equal(wn.splats_of(field).rgb, splats.rgb)


def test_an_argument_by_both_names_is_refused() -> None:
    @renamed_argument("old", "new")
    def double(new: int) -> int:
        return 2 * new

    with pytest.raises(TypeError, match="'new' and its former name 'old'"):
        double(new=1, old=2)  # type: ignore[call-arg]
    assert double(3) == double(new=3) == 6


def test_inspections_diagnostics() -> None:
    found = wn.inspect("builtin:room-sparse")
    found = replace(found, diagnostics=("a sentence",))
    with pytest.warns(DeprecationWarning, match="is called diagnostics now"):
        assert found.oddities == ("a sentence",)
    facts = json.loads(found.to_json())
    assert facts["odd"] == facts["diagnostics"] == ["a sentence"]


@pytest.mark.parametrize("old", list(FORMER_NAMES))
def test_models_by_their_former_name(old: str, capsys: pytest.CaptureFixture[str]) -> None:
    new = FORMER_NAMES[old]
    assert old not in MODELS
    with pytest.warns(DeprecationWarning, match=f"the model {old} is called {new} now"):
        assert model_of(old) == MODELS[new]()
    with pytest.warns(DeprecationWarning):
        assert wn.TrainConfig(model=old).model == MODELS[new]()  # type: ignore[arg-type]
    with pytest.warns(DeprecationWarning):
        assert chosen_model(wn.Rgb(), old, ["width=16"]) == model_of(new).__class__(width=16)
    assert f"the model {old} is called {new} now" in capsys.readouterr().err
    with pytest.warns(DeprecationWarning):
        given = configured(wn.TrainConfig(), {"model": (old,), "model.width": ("16",)})
    assert given == wn.TrainConfig(model=replace(MODELS[new](), width=16))  # type: ignore[type-var]


@pytest.mark.parametrize("old", list(FORMER_NAMES))
def test_files_with_former_names_of_models(tmp_path: Path, old: str) -> None:
    """They are not the reader's to mend, so nothing warns."""
    new = FORMER_NAMES[old]
    model = wn.PerSample(width=16, hidden_layers=1)
    tree = to_json(model)
    assert tree["name"] == new
    field, path = tiny_field(model=model), tmp_path / "field.safetensors"
    save_field(path, field)
    rewrite(path, lambda text: text.replace(f'"{new}"', f'"{old}"'))
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)
        assert from_json(tree | {"name": old}) == model
        assert decode(wn.Model, config_from_json({"model": tree | {"name": old}})["model"]) == model
        back = load_field(path, threads=1)
    assert back.model == model
    densities = [f.storage.raw_densities(f.workers) for f in (back, field)]
    np.testing.assert_array_equal(*densities)
