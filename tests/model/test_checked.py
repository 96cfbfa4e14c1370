"""Values of wrong types, in any field, get one sentence; those of NumPy are as good as Python's."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields, replace
from typing import Any

import msgspec
import numpy as np
import pytest

import warpnerf as wn
from warpnerf.checked import checked, fits
from warpnerf.checks import InputError, said
from warpnerf.config_json import config_from_json, config_to_json, decode

CAMERA = wn.Camera(width=40, height=30, fx=50.0, fy=50.0, cx=20.0, cy=15.0, c2w=np.eye(4)[:3])
VALUES = (
    wn.TrainConfig(),
    wn.GridConfig(),
    wn.MarchConfig(),
    wn.OptimConfig(),
    wn.LossConfig(),
    wn.Vm(),
    wn.Hash(),
    wn.Resampled(),
    wn.SphericalHarmonics(),
    wn.Deferred(),
    wn.PerSample(),
    wn.PoseConfig(),
    CAMERA,
)
WRONG = (
    *(None, True, "x", "", b"x", 2**31, 2**70, 10**400, -1, 1.5, float("nan"), float("inf"), 1j),
    *([], [1], {}, set(), (), (1, 2), ("a",), object(), int, np.zeros(3), np.array("x")),
    *(np.float32("nan"), np.int64(-5), [[]] * 500),
)


@pytest.mark.parametrize("value", VALUES, ids=lambda value: type(value).__name__)
def test_any_value_in_any_field_is_taken_or_refused_in_a_sentence(value: Any) -> None:
    n_refused = 0
    for field in fields(value):
        for wrong in WRONG:
            try:
                replace(value, **{field.name: wrong})
            except InputError as error:
                n_refused += 1
                named = field.name if field.name != "coarsest" else "field."
                assert named in str(error) and len(str(error)) < 400, error
                assert "\n" not in str(error)
    assert n_refused > 15 * len(fields(value))


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: wn.GridConfig(alpha_init=None), "grid.alpha_init must be a number, not None."),
        (lambda: wn.GridConfig(contraction=3), "grid.contraction must be "),
        (lambda: wn.TrainConfig(background=None), "background must be .*, not None."),
        (lambda: wn.TrainConfig(device=None), "device must be text, not None."),
        (lambda: wn.TrainConfig(skip_empty_rays="no"), "skip_empty_rays must be True or False, "),
        (
            lambda: wn.PoseConfig(threads="2"),
            "threads must be a whole number of at least 1, not '2'.",
        ),
        (lambda: replace(CAMERA, cx=None), "Camera.cx must be a finite number, not None."),
        (
            lambda: replace(CAMERA, width=10.5),
            r"Camera.width must be a whole number \(int\), not 10.5.",
        ),
        (lambda: replace(CAMERA, fisheye=1), "Camera.fisheye must be True or False, not 1."),
    ],
)
def test_it_is_said_which_and_what_is_wanted(make: Any, says: str) -> None:
    with pytest.raises(InputError, match=says):
        make()


@pytest.mark.parametrize(
    ("kind", "name", "value"),
    [
        (wn.Deferred, "specular", "1"),
        (wn.Deferred, "frequencies", np.array(1.5)),
        (wn.PerSample, "hidden_layers", np.array(1.5)),
        (wn.SphericalHarmonics, "degree", np.array(1.5)),
        (wn.Hash, "coarsest", np.array(1.5)),
        (wn.Hash, "levels", np.array([2, 3])),
        (wn.Vm, "learning_rate", "0.1"),
        (wn.Resampled, "update_every", np.array(1.5)),
    ],
)
def test_nothing_is_rounded_or_read_from_text(kind: Any, name: str, value: Any) -> None:
    with pytest.raises(InputError, match=rf"\.{name} must be a "):
        kind(**{name: value})


def test_presets_stay_what_they_are() -> None:
    presets: Any = wn.PRESETS
    with pytest.raises(TypeError, match="does not support item"):
        presets["fast"] = 5
    with pytest.raises(TypeError, match="does not support item"):
        del presets["ngp"]


def test_numbers_of_numpy_are_numbers() -> None:
    config = wn.TrainConfig(
        steps=np.int64(7),
        alpha_min=np.float32(0.5),
        skip_empty_rays=np.bool_(True),
        grid=wn.GridConfig(border=np.float32(0.25), contraction="linf", grow_at=(np.float64(0.5),)),
    )
    assert config.steps == 7
    written = json.loads(json.dumps(config_to_json(config)))
    found = msgspec.convert(config_from_json(written), wn.TrainConfig, dec_hook=decode)
    assert found == config
    replace(CAMERA, cx=np.float64(3.0), width=np.int32(40))


def test_values_are_checked_against_types() -> None:
    assert fits((1, 2.0), tuple[float, ...]) and not fits((1, "a"), tuple[float, ...])
    assert fits((1, 2), tuple[int, int]) and not fits((1, 2, 3), tuple[int, int])
    assert not fits(True, int) and not fits(1, bool) and fits(None, int | None)


def test_long_values_are_named_by_their_type() -> None:
    assert said("short") == "'short'" and said(3) == "3"
    assert said(list(range(100))) == "[0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 1...]"
    assert said(10**5000) == "a value of type int"
    assert said(np.eye(3)) == "a value of type ndarray"
    assert said("two\nlines") == "'two\\nlines'"


def test_names_that_are_not_known_at_run_time_check_nothing() -> None:
    @checked("part")
    @dataclass(frozen=True)
    class Odd:
        value: Unknown = 1  # type: ignore[name-defined]  # noqa: F821

        def __post_init__(self) -> None:
            assert self.value != 0

    assert Odd(value="anything").value == "anything"
