"""The least of all limits counts."""

from __future__ import annotations

import mmap
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import warpnerf as wn
from tests.support.tiny_scenes import ring, tiny_scene
from tests.support.tiny_trainings import tiny_config
from warpnerf.fields import storage
from warpnerf.runtime import memory
from warpnerf.training.trainer import Trainer

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
    assert without is not None
    if text is not None:
        (tmp_path / "memory.max").write_text(text)
    monkeypatch.setattr(memory, "CONTAINER_LIMITS", (tmp_path / "memory.max",))
    assert memory.usable_memory() == (expected or without)
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")
    assert memory.usable_memory() == (expected or without) // 2


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


@pytest.mark.parametrize("version", [1, 2])
def test_files_in_a_container_s_memory_count_as_free(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, version: int
) -> None:
    monkeypatch.setattr(memory, "CONTAINER_LIMITS", ())
    free = memory.available_memory()
    assert free is not None and 0 < free <= (memory.usable_memory() or 0)
    limit, used, stat = (tmp_path / name for name in ("limit", "used", "stat"))
    limit.write_text("1000000\n")
    monkeypatch.setattr(memory, "CONTAINER_LIMITS", (limit,))
    monkeypatch.setattr(memory, "CONTAINER_USES", ((used, stat),))
    assert memory.available_memory() == 1000000  # what is used is not known
    used.write_text("900000\n")
    stat.write_text("anon 5\ninactive_file 300000\nactive_file 50000\n")
    assert memory.available_memory() == 450000
    used.write_text("1900000\n")
    assert memory.available_memory() == 0


def test_folders_in_memory_are_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a" / "b").mkdir(parents=True)
    mounts = tmp_path / "mounts"
    mounts.write_text(
        f"/dev/vda / ext4 rw 0 0\ntmpfs {tmp_path}/a tmpfs rw 0 0\n/dev/b {tmp_path}/c xfs rw 0 0\n"
    )
    monkeypatch.setattr(memory, "MOUNTS", mounts)
    found = {name: memory.lies_in_memory(tmp_path / name) for name in ("a", "a/b", "c", ".")}
    assert found == {"a": True, "a/b": True, "c": False, ".": False}
    monkeypatch.setattr(memory, "MOUNTS", tmp_path / "nowhere")
    assert not memory.lies_in_memory(tmp_path / "a")


@pytest.mark.skipif(sys.platform == "win32", reason="no such limit there")
def test_what_the_process_has_is_not_free() -> None:
    code = (
        "import resource; from warpnerf.runtime.memory import available_memory\n"
        f"resource.setrlimit(resource.RLIMIT_AS, ({GIB}, resource.RLIM_INFINITY))\n"
        "before = available_memory(); kept = bytearray(2**28); print(before - available_memory())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(done.stdout) == pytest.approx(2**28, rel=0.05)


@pytest.mark.skipif(
    not Path("/sys/kernel/mm/transparent_hugepage").exists(), reason="the system has no such pages"
)
def test_large_pages_are_asked_for() -> None:
    room = mmap.mmap(-1, 8 << 20)
    address = np.frombuffer(room, np.uint8).ctypes.data
    assert "hg" not in flags_of(address)
    memory.prefer_large_pages(address, 0)
    assert "hg" not in flags_of(address)
    memory.prefer_large_pages(address + 64, (8 << 20) - 64)
    assert "hg" in flags_of(address + 4096)


def test_values_of_nodes_lie_on_large_pages(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    asked: list[int] = []
    monkeypatch.setattr(storage, "prefer_large_pages", lambda ptr, n: asked.append(ptr))
    trainer = Trainer(tiny_scene(ring(4)), tiny_config())
    small = replace(trainer.lattice, size=(6, 6, 6))
    held = [trainer.storage, trainer.storage.resized(trainer.workers, small)]
    wn.save_field(tmp_path / "field.safetensors", trainer.field())
    held.append(wn.load_field(tmp_path / "field.safetensors").storage)
    assert all(one.values.ptr in asked for one in held)


def flags_of(address: int) -> list[str]:
    """What Linux says of the memory that holds an address."""
    inside = False
    for line in Path("/proc/self/smaps").read_text().splitlines():
        words = line.split()
        if not words[0].endswith(":"):
            begin, end = (int(word, 16) for word in words[0].split("-"))
            inside = begin <= address < end
        elif inside and words[0] == "VmFlags:":
            return words[1:]
    raise AssertionError("no memory there")
