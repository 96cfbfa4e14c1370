"""Public functions refuse arguments of wrong types in one sentence that names them."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pytest

import warpnerf as wn
from tests.support.tiny_fields import tiny_field
from tests.support.tiny_scenes import ring, tiny_scene
from warpnerf.checked import checked_arguments, in_words
from warpnerf.checks import InputError, said

if TYPE_CHECKING:
    from nowhere import Unknown  # type: ignore[import-not-found]


@checked_arguments
def example(
    path: str | Path,
    size: tuple[int, int] | None = None,
    *rest: int,
    kind: Literal["a", "b"] = "a",
    names: Mapping[str, float] | None = None,
    weights: Sequence[float] = (),
    then: Callable[[int], None] | None = None,
    unknown: Unknown = None,
) -> str:
    """Say that it was called."""
    return f"{path} {size} {rest} {kind}"


def test_what_fits_is_passed_on() -> None:
    given = {"names": {"a": 1}, "weights": np.ones(3), "then": print, "unknown": object()}
    assert example("a", (1, 2), 3, kind="b", **given) == "a (1, 2) (3,) b"  # type: ignore[arg-type]
    assert example(Path("a"), np.array([1, 2])) == "a [1, 2] () a"  # type: ignore[arg-type]
    assert list(inspect.signature(example).parameters)[:3] == ["path", "size", "rest"]
    assert example.__doc__ == "Say that it was called."
    with pytest.raises(TypeError, match=r"example\(\) got an unexpected keyword"):
        example("a", other=1)  # type: ignore[call-arg]
    with pytest.raises(TypeError, match=r"example\(\) missing 1 required"):
        example()  # type: ignore[call-arg]


def test_arrays_that_stand_for_numbers_become_these() -> None:
    @checked_arguments
    def taken(level: float, size: tuple[int, int] | None = None) -> tuple[Any, Any]:
        return level, size or "none"

    assert taken(np.array(1.5), np.array([4, 3])) == (1.5, [4, 3])  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"path": 3}, "example: path must be text or a path, not 3."),
        (
            {"path": "a\0"},
            "example: path has a character of code 0, which no name has;",
        ),
        (
            {"size": (1, 2.5)},
            "example: size must be a list of 2 values, each a whole number",
        ),
        ({"size": 3}, "not 3."),
        ({"kind": "c"}, "example: kind must be one of a, b, not 'c'."),
        ({"names": {"a": "b"}}, "example: names must be a dictionary, each value a number or None"),
        ({"names": {1: 1}}, "example: names must be a dictionary"),
        ({"weights": "12"}, "example: weights must be a list, each a number, not '12'."),
        ({"weights": ["a"]}, "not ['a']."),
        ({"then": 3}, "example: then must be a function or None, not 3."),
    ],
)
def test_what_does_not_fit(given: dict[str, Any], says: str) -> None:
    with pytest.raises(InputError) as refused:
        example(**{"path": "a", **given})
    assert says in str(refused.value)


def test_each_of_several_is_looked_at() -> None:
    with pytest.raises(InputError, match="rest must be a whole number"):
        example("a", None, 1, "2")  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["Field", "Scene", "TrainConfig"])
def test_the_way_out_is_named(name: str) -> None:
    wrong: Any = "runs/a"
    calls = {
        "Field": lambda: wn.save_field("a", wrong),
        "Scene": lambda: wn.train(wrong),
        "TrainConfig": lambda: wn.train(tiny_scene(ring(4)), wrong),
    }
    with pytest.raises(InputError, match=rf"must be a {name}.*, not 'runs/a'; \w"):
        calls[name]()


def test_all_public_functions_are_checked() -> None:
    """A list of what any argument may be would be a list of exceptions."""
    functions = [getattr(wn, name) for name in wn.__all__]
    functions = [f for f in functions if inspect.isfunction(f)]
    assert len(functions) > 15
    for function in functions:
        first = next(iter(inspect.signature(function).parameters))
        with pytest.raises(InputError, match=f"{first} must be "):
            function(**{**needed(function), first: 1j}) if first != "shown" else function(1j)


def needed(function: Callable[..., Any]) -> dict[str, Any]:
    """Arguments without which it cannot be called."""
    good = {"scene": tiny_scene(ring(4)), "field": tiny_field(), "cameras": [], "views": []}
    return {
        name: good.get(name, "x")
        for name, p in inspect.signature(function).parameters.items()
        if p.default is p.empty and p.kind is not p.VAR_POSITIONAL
    }


def test_words_of_types_and_values() -> None:
    assert in_words(Sequence[float]) == "a list, each a number"
    assert in_words(dict[str, int]) == "a dictionary, each value a whole number (int)"
    assert said(object()) == "a value of type object"
    assert said(10**400) == "a number of 401 digits" and said(-(10**400)) == said(10**400)
    assert said("x" * 100) == "'" + "x" * 55 + "...'"


@pytest.mark.parametrize("n_frames", [0, -1, 2**31])
def test_films_of_too_few_or_too_many_frames(n_frames: int) -> None:
    with pytest.raises(InputError, match="the number of frames must be"):
        wn.camera_path(tiny_scene(ring(4)), n_frames=n_frames)
