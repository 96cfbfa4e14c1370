"""Mutants are of the code as it stands: each finds its text."""

import importlib.util
import shutil
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
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
    kernels = Path("kernels") / "warpnerf_kernels"
    for mutant in mutants:
        copy = tmp_path / kernels / mutant.file
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(HERE.parent / kernels / mutant.file, copy)
        before = copy.read_text()
        mutant.apply(tmp_path)
        assert copy.read_text() != before, mutant.name
        assert (HERE / mutant.tests.partition("::")[0]).exists(), mutant.name
