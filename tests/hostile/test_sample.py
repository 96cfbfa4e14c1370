"""A sample of the hostile inputs; ``python -m tests.hostile --seed 0 --cases 3000`` tries more."""

from __future__ import annotations

import os
import random
import subprocess
import sys
from pathlib import Path

import pytest

from tests.hostile.running import Case, fresh, judged, outcome
from tests.hostile.values import JSON, mutated
from tests.support.compiling import one_at_a_time
from warpnerf.checks import InputError

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="cases run in forks")


def refuse() -> None:
    raise InputError("steps must be above 0, not 0.")


def write_elsewhere() -> None:
    Path("precious").write_text("changed")


def wait() -> None:
    import time

    time.sleep(30)


def fail() -> None:
    raise TypeError("unexpected")


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: None, None),
        (refuse, None),
        (fail, "traceback: TypeError: unexpected"),
        (write_elsewhere, "changed outside of its output"),
        (wait, "hangs"),
    ],
)
def test_how_a_case_ends_is_seen(call: object, says: str | None, tmp_path: Path) -> None:
    folder = fresh(tmp_path / "case")
    (folder / "precious").write_text("precious")
    found = outcome(Case(call=call), folder, limit=3.0)  # type: ignore[arg-type]
    assert found is None if says is None else found is not None and found.startswith(says)


@pytest.mark.parametrize(
    "told",
    [
        (2, "", "two\nlines.\n"),
        (2, "", "warpnerf: error: without an end\n"),
        (2, "", "warpnerf: error: not <object object at 0x7f>.\n"),
        (1, "", "warpnerf: error: a sentence.\n"),
        (0, "Traceback (most recent call last):", ""),
    ],
)
def test_what_is_no_sentence_is_seen(told: tuple[int, str, str]) -> None:
    assert judged(*told)
    assert judged(2, "", "warpnerf: error: a sentence; and the way out.\n") is None


def test_documents_are_mutated_alike_by_one_seed() -> None:
    content = {"a": [1, 2, {"b": 3.0}], "c": "x"}
    many = [repr(mutated(random.Random(seed), content)) for seed in range(50)]
    assert many == [repr(mutated(random.Random(seed), content)) for seed in range(50)]
    assert len(set(many)) > 30 and repr(content) == "{'a': [1, 2, {'b': 3.0}], 'c': 'x'}"
    assert len(JSON) > 30


@pytest.mark.ci
def test_a_sample_of_all_families() -> None:
    """Each ends in success or in one sentence."""
    with one_at_a_time("commands"):
        done = subprocess.run(
            [sys.executable, "-m", "tests.hostile", "--seed", "0", "--cases", "24"],
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=280,
        )
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.startswith("24 cases in ") and "0 failed" in done.stdout
