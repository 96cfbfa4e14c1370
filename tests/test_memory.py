"""The least of all limits counts."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from tiny_scenes import write_transforms

from warpnerf.checks import InputError
from warpnerf.runtime import memory
from warpnerf.scenes import assemble
from warpnerf.scenes.load import load_scene

GIB = 2**30


def test_the_machine_has_some() -> None:
    usable = memory.usable_memory()
    assert usable is not None and usable > GIB // 8


@pytest.mark.parametrize(
    ("text", "expected"), [("1048576\n", 1048576), ("max\n", None), (None, None)]
)
def test_a_container_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str | None, expected: int | None
) -> None:
    monkeypatch.setattr(memory, "CONTAINER_LIMITS", ())
    without = memory.usable_memory()
    if text is not None:
        (tmp_path / "memory.max").write_text(text)
    monkeypatch.setattr(memory, "CONTAINER_LIMITS", (tmp_path / "memory.max",))
    assert memory.usable_memory() == (expected or without)


@pytest.mark.parametrize(
    ("texts", "expected"),
    [
        (["200000 100000\n"], 2),
        (["350000 100000\n"], 3),
        (["50000 100000\n"], 1),
        (["9900000 100000\n"], 8),
        (["max 100000\n"], 8),
        (["300000\n", "100000\n"], 3),
        (["-1\n", "100000\n"], 8),
        ([], 8),
    ],
)
def test_a_container_s_share_of_the_cores_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, texts: list[str], expected: int
) -> None:
    files = tuple(tmp_path / str(i) for i in range(max(1, len(texts))))
    for file, text in zip(files, texts, strict=False):
        file.write_text(text)
    monkeypatch.setattr(memory, "CORE_LIMITS", (files,))
    monkeypatch.setattr(memory.os, "cpu_count", lambda: 8)
    monkeypatch.setattr(
        memory.os, "sched_getaffinity", lambda process: set(range(8)), raising=False
    )
    assert memory.usable_cores() == expected


@pytest.mark.skipif(sys.platform == "win32", reason="no such limit there")
def test_the_limit_of_the_process_counts() -> None:
    code = (
        "import resource; from warpnerf.runtime.memory import usable_memory\n"
        f"resource.setrlimit(resource.RLIMIT_AS, ({GIB}, resource.RLIM_INFINITY))\n"
        "print(usable_memory())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert 0 < int(done.stdout) <= GIB


def test_images_that_would_not_fit_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_transforms(tmp_path, 5)
    needed = 5 * 8 * 6 * (3 + assemble.COPIED_BYTES)
    monkeypatch.setattr(assemble, "usable_memory", lambda: needed)
    load_scene(tmp_path)
    monkeypatch.setattr(assemble, "usable_memory", lambda: needed // 4)
    with pytest.raises(InputError, match=r"5 images of 8x6 pixels need .*; use --downscale 2,"):
        load_scene(tmp_path)
    assert len(load_scene(tmp_path, downscale=2).views) == 5
    monkeypatch.setattr(assemble, "usable_memory", lambda: None)
    load_scene(tmp_path)
