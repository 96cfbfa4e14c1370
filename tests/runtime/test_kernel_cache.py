"""Compiled kernels are believed only as they were written."""

from __future__ import annotations

import contextlib
import hashlib
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import pytest
import warp as wp

from warpnerf.checks import InputError
from warpnerf.runtime import kernel_cache, process
from warpnerf.runtime.kernel_cache import SUMS, DamagedKernelError, _seal, _verify
from warpnerf.runtime.parallel import Workers

CODE, META, SOURCE = "a.cpu.o", "a.meta", "a.cpp"


@pytest.fixture
def module(tmp_path: Path) -> Path:
    """A sealed folder as Warp leaves it."""
    for name in (CODE, META, SOURCE):
        (tmp_path / name).write_text(f"content of {name}")
    _verify(tmp_path)
    _seal(tmp_path)
    return tmp_path


def test_a_seal_is_what_sha256sum_writes(module: Path) -> None:
    lines = [
        f"{hashlib.sha256((module / name).read_bytes()).hexdigest()}  {name}\n"
        for name in (CODE, META)
    ]
    assert (module / SUMS).read_text() == "".join(lines)
    assert sorted(path.name for path in module.iterdir()) == sorted([SUMS, CODE, META, SOURCE])


@pytest.mark.parametrize("name", [CODE, META])
@pytest.mark.parametrize("content", ["content of a.cpu.p", "", "content"])
def test_damage_shows(module: Path, name: str, content: str) -> None:
    _verify(module)
    (module / name).write_text(content)
    with pytest.raises(DamagedKernelError, match=rf"{module.name} in it is damaged"):
        _verify(module)


@pytest.mark.parametrize("sums", [b"", b"0  a.cpu.o\n", b"nonsense", b"\xff"])
def test_a_damaged_seal_is_damage_too(module: Path, sums: bytes) -> None:
    (module / SUMS).write_bytes(sums)
    if not sums:  # seals nothing
        _verify(module)
        return
    with pytest.raises(DamagedKernelError):
        _verify(module)


def test_what_was_removed_is_compiled_again_and_what_was_added_is_sealed(module: Path) -> None:
    (module / CODE).unlink()
    _verify(module)
    (module / CODE).write_text("compiled again")
    (module / "a.sm_90.cubin").write_text("for another device")
    _seal(module)
    _verify(module)
    (module / "a.sm_90.cubin").write_text("for another device?")
    with pytest.raises(DamagedKernelError):
        _verify(module)


def test_a_folder_that_is_not_there_is_neither_damaged_nor_made(tmp_path: Path) -> None:
    _verify(tmp_path / "none")
    _seal(tmp_path / "none")
    assert not (tmp_path / "none").exists()


class Module:
    """What is asked of Warp's modules."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.name = folder, folder.name

    def get_module_identifier(self, block_dim: int) -> str:
        return self.folder.name

    def load(self, device: object, block_dim: int) -> None:
        self.folder.mkdir(exist_ok=True)
        (self.folder / "a.cpu0.o").write_text("compiled")

    def unload(self) -> None: ...


def use_cache(folder: Path, monkeypatch: pytest.MonkeyPatch, *, own: bool) -> None:
    """Have kernels in a folder, in a process that is the command's own, or is not."""
    kernel_cache.start()
    monkeypatch.setattr(process, "_own", own)
    monkeypatch.setattr(kernel_cache, "_temporary", None)  # and afterwards what it was
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(folder))


def test_compiling_is_announced_once_and_reading_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kernel_cache.start()  # or Warp would choose a folder of its own when it is first used
    said: list[str] = []
    monkeypatch.setattr(kernel_cache._log, "info", said.append)
    monkeypatch.setattr(kernel_cache, "_said", False)
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    cpu = wp.get_device("cpu")
    (tmp_path / "cached").mkdir()
    (tmp_path / "cached" / "a.cpu0.o").write_text("compiled")
    for name, times in (("cached", 0), ("first", 1), ("second", 1), ("first", 1)):
        kernel_cache._load(Module(tmp_path / name), cpu)
        assert said == ["compiling kernels (once; later runs start at once)"] * times


def test_nothing_is_compiled_on_a_full_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kernel_cache.start()
    cpu = wp.get_device("cpu")
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    full = SimpleNamespace(total=1 << 40, free=kernel_cache.ROOM - 1)
    (tmp_path / "cached").mkdir()
    (tmp_path / "cached" / "a.cpu0.o").write_text("compiled")
    monkeypatch.setattr(kernel_cache.shutil, "disk_usage", lambda path: full)
    kernel_cache._load(Module(tmp_path / "cached"), cpu)
    with pytest.raises(OSError, match="No space left"):
        kernel_cache._load(Module(tmp_path / "new"), cpu)
    assert not (tmp_path / "new").exists()
    monkeypatch.setattr(kernel_cache, "_temporary", None)  # and afterwards what it was
    monkeypatch.setattr(process, "_own", True)
    with pytest.raises(InputError, match="set WARP_CACHE_PATH"), pytest.warns(RuntimeWarning):
        kernel_cache.load(SimpleNamespace(module=Module(tmp_path / "new")), cpu)
    unknown = SimpleNamespace(total=0, free=0)
    monkeypatch.setattr(kernel_cache.shutil, "disk_usage", lambda path: unknown)
    kernel_cache._load(Module(tmp_path / "new"), cpu)


@pytest.mark.parametrize("own", [False, True])
def test_only_the_command_changes_what_the_process_shares(
    own: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    kernel_cache.start()
    duplicated: list[int] = []
    duplicate = kernel_cache.os.dup
    monkeypatch.setattr(kernel_cache.os, "dup", lambda n: duplicated.append(n) or duplicate(n))
    monkeypatch.setattr(kernel_cache, "_started", False)
    monkeypatch.setattr(process, "_own", own)
    monkeypatch.setattr(wp.config, "log_level", wp.LOG_WARNING)
    Workers("cpu", 1)
    assert (wp.config.log_level == wp.LOG_ERROR, duplicated) == (own, [2] * own)
    wp.config.log_level = wp.LOG_DEBUG
    Workers("cpu", 1)
    assert wp.config.log_level == wp.LOG_DEBUG


def test_a_library_says_what_is_wrong_with_the_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And uses it again once it is mended."""
    use_cache(tmp_path, monkeypatch, own=False)
    kernel, cpu = SimpleNamespace(module=Module(tmp_path / "a")), wp.get_device("cpu")
    kernel_cache.load(kernel, cpu)
    (tmp_path / "a" / "a.cpu0.o").write_text("damaged")
    with pytest.raises(
        InputError, match=rf"{tmp_path} cannot be used \(a in it is damaged\); make"
    ):
        kernel_cache.load(kernel, cpu)
    assert wp.config.kernel_cache_dir == str(tmp_path) and kernel_cache._temporary is None
    (tmp_path / "a" / SUMS).unlink()
    kernel_cache.load(kernel, cpu)

    def no_cache() -> None:
        raise NotADirectoryError("no folder")

    with monkeypatch.context() as patch:
        patch.setattr(kernel_cache, "_started", False)
        patch.setattr(wp, "init", no_cache)
        with pytest.raises(InputError, match=r"cannot be used \(no folder\); make .* to another"):
            kernel_cache.start()


class ForgetfulModule(Module):
    """Fails as long as it is told to, and, as Warp's do, until it is unloaded."""

    error: Exception | None = None
    failed = False

    def load(self, device: object, block_dim: int) -> None:
        self.failed = self.failed or self.error is not None
        if self.failed:
            raise self.error or RuntimeError("it failed before")
        super().load(device, block_dim)

    def unload(self) -> None:
        self.failed = False


@pytest.mark.parametrize("error", [PermissionError("not yours"), RuntimeError("cut short")])
def test_a_library_loads_once_the_cause_is_gone(
    error: Exception, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_cache(tmp_path, monkeypatch, own=False)
    module, cpu = ForgetfulModule(tmp_path / "a"), wp.get_device("cpu")
    module.error = error
    for _ in range(2):
        with pytest.raises((InputError, RuntimeError), match=str(error)):
            kernel_cache.load(SimpleNamespace(module=module), cpu)
    module.error = None
    with contextlib.suppress(InputError, RuntimeError):
        kernel_cache.load(SimpleNamespace(module=module), cpu)
    assert (tmp_path / "a" / SUMS).exists()


@pytest.mark.parametrize("modules", [1, 3])
def test_one_thread_loads_a_module_and_others_load_others(
    modules: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Warp crashes where two load a module for the first time."""
    inside: list[object] = []
    together: list[int] = []
    meeting = threading.Barrier(modules, timeout=60.0)

    def load(module: object, device: object) -> None:
        inside.append(module)
        meeting.wait()
        time.sleep(0.05)
        together.append(inside.count(module))
        inside.remove(module)

    monkeypatch.setattr(kernel_cache, "_load", load)
    made = [Module(Path(str(number))) for number in range(modules)]
    kernels = [SimpleNamespace(module=made[number % modules]) for number in range(3)]
    load_it = getattr(kernel_cache.load, "__wrapped__", kernel_cache.load)  # tests lock files
    with ThreadPoolExecutor(3) as pool:
        list(pool.map(lambda kernel: load_it(kernel, None), kernels))
    assert together == [1, 1, 1]


def test_threads_leave_a_damaged_cache_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each finds its module damaged; one of them chooses where all compile from then on."""
    use_cache(tmp_path, monkeypatch, own=True)
    meeting, tried, caches = threading.Barrier(2, timeout=60.0), [], []

    def load(module: Module, device: object) -> None:
        if module not in tried:
            tried.append(module)
            meeting.wait()
            raise DamagedKernelError(f"{module.name} in it is damaged")
        caches.append(wp.config.kernel_cache_dir)

    monkeypatch.setattr(kernel_cache, "_load", load)
    kernels = [SimpleNamespace(module=Module(tmp_path / name)) for name in "ab"]
    with ThreadPoolExecutor(2) as pool, pytest.warns(RuntimeWarning) as warned:
        list(pool.map(lambda kernel: kernel_cache.load(kernel, None), kernels))
    assert len(warned) == 1 and caches == [str(kernel_cache._temporary)] * 2
    assert caches[0] != str(tmp_path)
