"""The checks of ``warpnerf check``: they pass here, and each fails where something is wrong."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.support.small_model import SMALL
from warpnerf.checks import InputError
from warpnerf.runtime.parallel import Workers
from warpnerf.training import train as training
from warpnerf.verification import verify as checks
from warpnerf.verification.gradient_check import ProblemKernels
from warpnerf.verification.gradient_errors import relative_error
from warpnerf.verification.problems import Found
from warpnerf.verification.verify import Result, report, verify


def test_each_is_begun_ended_and_passes_here(monkeypatch: pytest.MonkeyPatch, device: str) -> None:
    """Of a few; tests/cli/test_machine.py has all of them, by the command."""
    every = checks._checks
    few = "differences, plain", "gather"
    monkeypatch.setattr(
        checks,
        "_checks",
        lambda workers: [check for check in every(workers) if any(w in check[0] for w in few)],
    )
    begun: list[str] = []
    ended: list[Result] = []
    results = verify(device, 2, begun.append, ended.append)
    assert [result.name for result in results if not result.passed] == []
    assert results == ended
    assert [result.name for result in results] == begun
    assert len(set(begun)) == len(begun) >= 3
    names = [check[0] for check in every(Workers(device, 2))]
    assert len(set(names)) == len(names)


def failing(device: str, *words: str) -> set[str]:
    """The checks with one of these words in their names: which of them fail."""
    found = {}
    for name, tolerance, measure in checks._checks(Workers(device, 2)):
        if any(word in name for word in words):
            found[name] = Result(name=name, error=measure(), tolerance=tolerance).passed
    assert found
    return {name for name, passed in found.items() if not passed}


Spoil = Callable[[Callable[..., Any]], Callable[..., Any]]


def multiplied(found: Any, factor: float, *arrays: str) -> Any:
    """A gradient, all of it or some of its arrays, or an array."""
    return found.times(factor, *arrays) if isinstance(found, Found) else factor * found


def times(factor: float, *arrays: str) -> Spoil:
    return lambda method: (
        lambda *given, **named: multiplied(method(*given, **named), factor, *arrays)
    )


def trained_times(factor: float) -> Spoil:
    def spoil(method: Callable[..., Any]) -> Callable[..., Any]:
        def train(*given: Any, **named: Any) -> Any:
            error, gradient = method(*given, **named)
            return error, multiplied(gradient, factor)

        return train

    return spoil


def without_scaling(method: Callable[..., Any]) -> Callable[..., Any]:
    return lambda self, problem, scaling="none": method(self, problem)


def never_above_one(method: Callable[..., Any]) -> Callable[..., Any]:
    return lambda self, problem, scaling="none": method(
        self, problem, "quadratic" if scaling == "clamped" else scaling
    )


def brighter_when_scaled(method: Callable[..., Any]) -> Callable[..., Any]:
    def train(self: ProblemKernels, problem: Any, scaling: str = "none") -> Any:
        error, gradient = method(self, problem, scaling)
        return (np.nextafter(error, 1.0) if scaling == "clamped" else error), gradient

    return train


def sum_for_mean(method: Callable[..., Any]) -> Callable[..., Any]:
    def train(self: ProblemKernels, problem: Any, scaling: str = "none") -> Any:
        error, gradient = method(self, problem, scaling)
        return error, multiplied(gradient, problem.n_rays)

    return train


def coarse_when_packed(method: Callable[..., Any]) -> Callable[..., Any]:
    def see(self: ProblemKernels, problem: Any) -> Any:
        seen = method(self, problem)
        return replace(seen, depth=seen.depth * (1.0 + 1e-3 * self._packed))

    return see


def coarse_bound_when_packed(method: Callable[..., Any]) -> Callable[..., Any]:
    def bound(self: ProblemKernels, problem: Any) -> Any:
        loss, gradient = method(self, problem)
        return loss * (1.0 + 1e-3 * self._packed), gradient

    return bound


def slow(*case: Any) -> Any:
    return pytest.param(*case, marks=pytest.mark.slow)


passed: set[tuple[str, ...]] = set()
"""Words of checks that do not fail where nothing is spoilt."""


@pytest.mark.ci
@pytest.mark.parametrize(
    ("method", "spoil", "words"),
    [
        ("gradient", times(1.0 + 1e-6), ["differences, plain", "differences, contracted space"]),
        slow("gradient", times(1.0 + 1e-5, "weights"), ["differences, deferred"]),
        ("gradient", times(1.0 + 1e-6), ["differences, frustum"]),
        ("train", trained_times(1.0 + 1e-6), ["differences, losses"]),
        ("scatter", times(1.0 + 1e-5), ["gather"]),
        slow("gradient", times(1.0 + 1e-6, "planes"), ["differences, field vm"]),
        slow("gradient", times(1.0 + 1e-6, "lines"), ["differences, field vm"]),
        slow("gradient", times(1.0 + 1e-6, "decoder"), ["differences, field vm"]),
        slow("gradient", times(1.0 + 1e-6, "values"), ["differences, field hash"]),
        slow("gradient", times(1.0 + 1e-6, "decoder"), ["differences, field hash"]),
        ("bound", trained_times(1.0 + 1e-6), ["differences, bound"]),
        ("bound", coarse_bound_when_packed, ["in packs of sixteen to float64, bound"]),
        ("gradient", without_scaling, ["s(t)", "t = 0"]),
        ("gradient", never_above_one, ["beyond", "its own s(t)"]),
        ("train", sum_for_mean, ["training launch"]),
        ("train", brighter_when_scaled, ["image has the same bits"]),
        (
            "see",
            coarse_when_packed,
            ["in packs of sixteen to float64, plain", "in packs of sixteen to one by one, plain"],
        ),
    ],
)
def test_each_can_fail(
    monkeypatch: pytest.MonkeyPatch,
    method: str,
    spoil: Spoil,
    words: list[str],
    device: str,
    on_cpu: None,
) -> None:
    monkeypatch.setattr(checks, "VIEW_DEPENDENT", (SMALL,))
    if tuple(words) not in passed:
        assert failing(device, *words) == set()
        passed.add(tuple(words))
    monkeypatch.setattr(ProblemKernels, method, spoil(getattr(ProblemKernels, method)))
    spoilt = failing(device, *words)
    assert all(any(word in name for name in spoilt) for word in words)


@pytest.mark.slow
def test_training_that_differs_fails(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], device: str, on_cpu: None
) -> None:
    """And that none shows a progress bar, which would stand between the checks."""
    monkeypatch.setattr(training, "has_bar", lambda: True)
    monkeypatch.setattr(checks, "TRAININGS", {"training": checks.TRAININGS["training"]})
    train = checks.train
    count = iter(range(100))

    def drifting(scene: Any, config: Any, **rest: Any) -> Any:
        return train(scene, replace(config, steps=config.steps + next(count)), **rest)

    assert failing(device, "twice from one seed") == set()
    monkeypatch.setattr(checks, "train", drifting)
    assert len(failing(device, "twice from one seed")) == 1
    assert not capsys.readouterr().out


@pytest.mark.slow
def test_a_check_that_cannot_run_fails_and_says_why(
    monkeypatch: pytest.MonkeyPatch, device: str
) -> None:
    def broken(*given: Any) -> Any:
        raise RuntimeError("does not compile\nat all")

    monkeypatch.setattr(checks, "VIEW_DEPENDENT", (SMALL,))
    monkeypatch.setattr(checks, "STORED", ())
    monkeypatch.setattr(ProblemKernels, "see", broken)
    monkeypatch.setattr(ProblemKernels, "train", broken)
    monkeypatch.setattr(checks, "_trained_twice", lambda config: 0.0)
    results = verify(device, 1)
    failed = [result for result in results if not result.passed]
    assert 5 < len(failed) < len(results)
    assert {result.note for result in failed} == {"RuntimeError: does not compile"}


def test_what_shows_nothing_does_not_pass() -> None:
    one = np.ones(3)
    assert relative_error(one + 0.5, one) == pytest.approx(0.5)
    for value, expected in ((0.0 * one, 0.0 * one), (math.nan * one, one), (one, math.nan * one)):
        error = relative_error(value, expected)
        assert not Result(name="", error=error, tolerance=1.0).passed


def test_a_missing_device() -> None:
    with pytest.raises(InputError, match="cuda:97"):
        verify("cuda:97")


def test_the_report_is_json_whatever_happened() -> None:
    results = [
        Result(name="a", error=1e-9, tolerance=1e-7),
        Result(name="b", error=math.nan, tolerance=0.0, note="Exception: why"),
    ]

    def refuse(constant: str) -> None:
        raise AssertionError(constant)

    said = json.loads(report(results, "cpu", 1.234), parse_constant=refuse)
    assert (said["passed"], said["device"], said["seconds"]) == (False, "cpu", 1.23)
    good, bad = said["checks"]
    assert good == {"name": "a", "error": 1e-9, "tolerance": 1e-7, "passed": True}
    assert (bad["error"], bad["passed"], bad["note"]) == (None, False, "Exception: why")
    assert json.loads(report(results[:1], "cpu", 1.0))["passed"]
