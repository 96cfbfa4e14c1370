"""Where the kernels under test run, where compiled code is kept, that Ctrl-C is heard, and what
stands for COLMAP."""

import gc
import os
import signal
from collections.abc import Iterator
from pathlib import Path

# Before torch is imported: between tests' small tensors, threads of OpenMP would mostly spin.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import pytest
import warp as wp

from tests.support import cli_process
from tests.support.compiling import compile_as_tests_do, not_optimising
from tests.support.fake_colmap import Colmap, photographs
from tests.support.kernel_runner import Kernels
from warpnerf.scenes.extent.photo_consistency import PhotoConsistency
from warpnerf.scenes.formats import assemble
from warpnerf.sfm import pose as sfm_pose

wp.config.log_level = wp.LOG_ERROR  # as the command has it
if "WARP_CACHE_PATH" in os.environ:
    wp.config.kernel_cache_dir = os.environ["WARP_CACHE_PATH"]

compile_as_tests_do()

# As shells have them for what runs in the background; commands under test would inherit it.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:  # nohup
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--device", default="cpu", help="as Warp names it: cpu, cuda:0")


def pytest_collection_finish() -> None:
    gc.freeze()  # what is imported stays: to look through it time and again takes long


def pytest_sessionfinish() -> None:
    cli_process.close_server()


@pytest.fixture(scope="session")
def device(request: pytest.FixtureRequest) -> str:
    return str(request.config.getoption("--device"))


@pytest.fixture(scope="session")
def on_cpu(device: str) -> None:
    """For what holds on the CPU only: CUDA adds gradients up in no fixed order."""
    if device != "cpu":
        pytest.skip("the CPU's promise: CUDA adds gradients up in no fixed order")


@pytest.fixture(scope="module")
def unoptimised() -> Iterator[None]:
    """For a module that launches kernels a few times each: most of its time would be compiling."""
    with not_optimising():
        yield


@pytest.fixture(scope="module")
def poses_as_given() -> Iterator[None]:
    """For a module that loads photographs often, but asks nothing of them: nor do scenes ask them
    which axes their poses have, which takes a second each time."""
    with pytest.MonkeyPatch.context() as patch:
        unasked = PhotoConsistency.of([])
        patch.setattr(
            assemble, "check_against_photographs", lambda v, t, p, o: (list(v), unasked, p, [])
        )
        yield


@pytest.fixture(scope="session")
def kernels64(device: str) -> Kernels:
    return Kernels("float64", device)


@pytest.fixture(scope="session", params=["plain", "packed"])
def kernels32(device: str, request: pytest.FixtureRequest) -> Kernels:
    if request.param == "packed" and device != "cpu":
        pytest.skip("packs of samples are the CPU's form of the kernels")
    return Kernels("float32", device, packed=request.param == "packed")


@pytest.fixture(scope="session")
def packed(device: str) -> Kernels:
    if device != "cpu":
        pytest.skip("packs of samples are the CPU's form of the kernels")
    return Kernels("float32", device, packed=True)


@pytest.fixture(scope="session")
def compiled_kernels(tmp_path_factory: pytest.TempPathFactory) -> None:
    """What a run compiles is in the cache, so that commands under test take their usual time."""
    folder = tmp_path_factory.mktemp("compiled")
    scene = cli_process.make_scene(folder)
    cli_process.assert_trained(cli_process.train(scene, folder=folder, limit=None))


@pytest.fixture
def colmap(monkeypatch: pytest.MonkeyPatch) -> Colmap:
    made_up = Colmap()
    monkeypatch.setattr(sfm_pose, "estimate", made_up)
    monkeypatch.setattr(sfm_pose, "require_pycolmap", lambda: None)
    return made_up


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    return photographs(tmp_path / "photos")
