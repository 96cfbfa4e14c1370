"""Some mutants of scene files in each format; tests/fuzz_readers.py tries more of them."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.fuzz_readers import FORMATS, Target

FOUND = {
    # A quotient that overflows, a header that Python cannot take apart, one of a gigabyte.
    "llff": (213, 235, 5054),
    "ply-binary": (226,),  # a signalling NaN
    "colmap-images.txt": (5619,),  # a place at infinity
    "colmap-cameras.txt": (255,),  # a lens's name that would steer a terminal
}
"""Seeds of mutants that were not refused as they should have been."""


@pytest.mark.parametrize("name", FORMATS)
def test_a_mutant_loads_or_is_refused_in_a_sentence(tmp_path: Path, name: str) -> None:
    target = Target(name, tmp_path / "scene")
    for seed in (*range(25), *FOUND.get(name, ())):
        target.attempt(seed, memory=seed < 10 or seed > 100)


@pytest.mark.parametrize("name", ["transforms", "colmap-images.bin"])
def test_mutants_differ_and_some_of_them_load(tmp_path: Path, name: str) -> None:
    target = Target(name, tmp_path / "scene")
    mutants = [target.mutant(seed) for seed in range(60)]
    assert len({*mutants, target.raw}) > 55
    loaded = 0
    for raw in mutants:
        target.file.write_bytes(raw)
        loaded += target.load()
    assert 0 < loaded < 60


def test_a_reader_that_fails_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = Target("transforms", tmp_path / "scene")

    def greedy(folder: Path) -> None:
        bytearray(64 * 2**20)

    monkeypatch.setattr("tests.fuzz_readers.load_scene", greedy)
    with pytest.raises(AssertionError, match="took 6"):
        target.attempt(0, memory=True)

    def broken(folder: Path) -> None:
        raise KeyError("frames")

    monkeypatch.setattr("tests.fuzz_readers.load_scene", broken)
    with pytest.raises(KeyError):
        target.attempt(0, memory=False)
