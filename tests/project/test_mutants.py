"""Mutants are of the code as it stands: each finds its text, and a test that is there."""

import importlib.util
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import warp as wp

from tests.support.marks import LISTED, SLOW
from warpnerf.runtime import kernel_cache

HERE = Path(__file__).parents[1]
MUTANTS_FOLDER = HERE / "mutants"


@pytest.fixture
def mutants(monkeypatch: pytest.MonkeyPatch) -> tuple:
    monkeypatch.syspath_prepend(str(MUTANTS_FOLDER))
    before = set(sys.modules)
    spec = importlib.util.spec_from_file_location("all_mutants", MUTANTS_FOLDER / "__main__.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    for name in set(sys.modules) - before:
        del sys.modules[name]
    return module.MUTANTS


def test_each_mutant_finds_its_text(mutants: tuple, tmp_path: Path) -> None:
    for mutant in mutants:
        copy = tmp_path / mutant.path
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(HERE.parent / mutant.path, copy)
        before = copy.read_text()
        mutant.apply(tmp_path)
        assert copy.read_text() != before, mutant.name
        file, _, test = mutant.tests.partition("::")
        assert (HERE / file).exists(), mutant.name
        if test:
            assert f"def {test.partition('[')[0]}(" in (HERE / file).read_text(), mutant.name


@pytest.mark.ci  # collects all tests
def test_each_mutant_names_tests_that_there_are(mutants: tuple) -> None:
    """Also by the parameters in brackets, and where the host's are those that CI runs."""
    options = ("--collect-only", "-qq", "-n0", "-m", "", "-p", "tests.support.marks")
    command = [sys.executable, "-m", "pytest", *options]
    done = subprocess.run(command, capture_output=True, text=True, cwd=HERE.parent, check=True)
    lines = [line for line in done.stdout.splitlines() if line.startswith(LISTED)]
    tests = [line.removeprefix(f"{LISTED}tests/") for line in lines]
    for marks, found in (
        ("", [test.removesuffix(SLOW) for test in tests]),
        ("not slow", [test for test in tests if not test.endswith(SLOW)]),
    ):
        known = {part for test in found for part in (test, test.partition("[")[0])}
        known |= {test.partition("::")[0] for test in found}
        asked = {mutant.tests for mutant in mutants if mutant.marks == marks}
        assert asked and asked <= known, sorted(asked - known)


@pytest.mark.ci  # several runs of pytest
@pytest.mark.timeout(3600)
def test_mutants_of_the_host_are_noticed() -> None:
    """Every hundredth; all by ``python tests/mutants warpnerf/``, in more than half an hour."""
    kernel_cache.start()
    cache = wp.config.kernel_cache_dir
    command = [sys.executable, MUTANTS_FOLDER, "--cache", cache, "--every", "100", "warpnerf/"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
