"""Values out of range, tensors of the wrong kind and a machine at its limits, one by one."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import warp as wp
from PIL import Image

import warpnerf as wn
from tests.support.cli_process import (
    Outcome,
    assert_refused,
    assert_trained,
    command,
    make_scene,
    train,
)
from tests.support.small_model import SQUARED
from tests.support.tiny_scenes import camera_at, picture, ring
from warpnerf.checks import InputError
from warpnerf.runtime.memory import usable_memory
from warpnerf.torch import render_rays, scale_gradient

pytestmark = pytest.mark.usefixtures("compiled_kernels")

NAN = math.nan


# --- 60 and 61, and 26: values ------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "says"),
    [
        pytest.param(["--content-distance", "0"], "content_distance", id="60-content-distance-0"),
        pytest.param(
            ["--content-distance", "-1"], "content_distance", id="60-content-distance-neg"
        ),
        pytest.param(
            ["--content-distance", "nan"], "content_distance", id="60-content-distance-NaN"
        ),
        pytest.param(
            ["--content-distance", "inf"], "content_distance", id="60-content-distance-inf"
        ),
        pytest.param(["--steps", "0"], "steps must be a whole number", id="60-steps-0"),
        pytest.param(["--steps", "-5"], "steps must be a whole number", id="60-steps-negative"),
        pytest.param(["--voxels", "0"], "grid.voxels must be a whole", id="60-resolution-0"),
        pytest.param(
            ["--voxels", "-8"], "grid.voxels must be a whole", id="60-resolution-negative"
        ),
        pytest.param(
            ["--voxels", str(10_000**3)], "grid.voxels must be below 2^31", id="61-10000-cubed"
        ),
        pytest.param(
            ["--voxels", str(10**400)], "grid.voxels must be below 2^31", id="61-10-to-the-400"
        ),
        pytest.param(
            ["--voxels", str(21 * 10**8)],
            "GiB, but this machine has",
            id="61-more-than-the-memory",
            marks=pytest.mark.skipif(
                (usable_memory() or 0) > 40 * 21 * 10**8, reason="this machine has 84 GB"
            ),
        ),
        pytest.param(["--voxels", "1e12"], "grid.voxels must be below 2^31", id="61-1e12"),
        pytest.param(["--threads", "5000"], "threads must be at most ", id="threads-5000"),
        pytest.param(["--near", "-1"], "march.near", id="near-negative"),
        pytest.param(["--near", "nan"], "march.near", id="near-NaN"),
        pytest.param(["--near", "50"], "use a smaller --near", id="near-beyond-the-scene"),
    ],
)
def test_value(tmp_path: Path, options: list[str], says: str) -> None:
    assert_refused(train(make_scene(tmp_path), *options, folder=tmp_path), says)


@pytest.mark.parametrize(
    "options",
    [
        pytest.param(["--steps", "nan"], id="60-steps-NaN"),
        pytest.param(["--voxels", "nan"], id="60-resolution-NaN"),
        pytest.param(["--voxels", "1.5"], id="60-resolution-1.5"),
    ],
)
def test_value_of_another_type(tmp_path: Path, options: list[str]) -> None:
    outcome = train(make_scene(tmp_path), *options, folder=tmp_path)
    assert outcome.code == 2
    kind = {"--steps": "", "--voxels": "auto or "}[options[0]] + "a whole number"
    assert f"{options[0]} must be {kind}, not '{options[1]}'" in outcome.err
    assert not outcome.run.exists()


@pytest.mark.parametrize("value", [0.0, -1.0, NAN, math.inf])
@pytest.mark.parametrize(
    ("make", "field"),
    [
        pytest.param(
            lambda value: wn.OptimConfig(learning_rate_density=value),
            "optim.learning_rate_density",
            id="60-learning-rate-of-density",
        ),
        pytest.param(
            lambda value: wn.OptimConfig(learning_rate_rgb=value),
            "optim.learning_rate_rgb",
            id="60-learning-rate-of-rgb",
        ),
        pytest.param(lambda value: wn.TrainConfig(steps=value), "steps", id="60-steps"),
        pytest.param(lambda value: wn.GridConfig(voxels=value), "grid.voxels", id="60-resolution"),
        pytest.param(
            lambda value: wn.TrainConfig(content_distance=value),
            "content_distance",
            id="60-content-distance",
        ),
    ],
)
def test_configuration(make: Callable[[float], object], field: str, value: float) -> None:
    with pytest.raises(InputError, match=rf"^{field} must be .* not "):
        make(value)


def scene_by_hand(**changes: Any) -> wn.Scene:
    """Two cameras that look at the box [-1, 1]^3 from 3.2 scene units away."""
    views = [
        wn.View(name=f"{i}.png", camera=camera_at(pose), image=picture(i))
        for i, pose in enumerate(ring(2))
    ]
    good = {
        "name": "by hand",
        "views": views,
        "splits": {"train": (0, 1), "test": (0,)},
        "box_min": -np.ones(3),
        "box_max": np.ones(3),
        "unbounded": False,
        "content_distance": 3.0,
    }
    return wn.Scene(**{**good, **changes})


@pytest.mark.parametrize(
    "box",
    [
        pytest.param((np.ones(3), -np.ones(3)), id="26-box-min-above-max"),
        pytest.param((np.zeros(3), np.array([1.0, 1.0, 0.0])), id="26-box-min-equals-max"),
        pytest.param((np.array([NAN, 0.0, 0.0]), np.ones(3)), id="26-box-NaN"),
        pytest.param((np.zeros(2), np.ones(2)), id="26-box-of-two-numbers"),
    ],
)
def test_box(box: tuple[np.ndarray, np.ndarray]) -> None:
    scene_by_hand()
    with pytest.raises(InputError, match="by hand: box_min must lie below box_max on every axis"):
        scene_by_hand(box_min=box[0], box_max=box[1])
    if len(box[0]) == 3:
        rays = torch.zeros(1, 3), torch.tensor([[0.0, 0.0, 1.0]])
        with pytest.raises(InputError, match="box_m"):
            render_rays(torch.zeros(2, 2, 2, 4), *rays, box, step=0.1)


@pytest.mark.ci
@pytest.mark.parametrize(
    ("march", "message"),
    [
        pytest.param({"near": 5.0}, "march.near is 5, but the scene's box ends", id="near"),
        pytest.param({"far": 1.5}, "march.far is 1.5, but the scene's box begins", id="far"),
    ],
)
def test_clip_distances_that_leave_no_sample(march: dict[str, float], message: str) -> None:
    config = wn.TrainConfig(model="rgb", steps=1, threads=1, grid=wn.GridConfig(voxels=512))
    config = replace(config, loss=SQUARED)
    wn.train(scene_by_hand(), replace(config, march=wn.MarchConfig(near=4.0, far=4.1)))
    wn.train(scene_by_hand(), replace(config, march=wn.MarchConfig(far=2.5)))
    with pytest.raises(InputError, match=message):
        wn.train(scene_by_hand(), replace(config, march=wn.MarchConfig(**march)))
    contracted = replace(config.grid, contraction="linf")
    if "far" in march:  # the space around the box is sampled too
        wn.train(scene_by_hand(), replace(config, grid=contracted, march=wn.MarchConfig(**march)))


def test_an_opacity_that_makes_all_space_free() -> None:
    with pytest.raises(InputError, match=r"alpha_min must be an opacity in \[0, 1\), not 5\.0"):
        wn.TrainConfig(alpha_min=5.0)


@pytest.mark.parametrize("share", [0.0, 1.0, float("nan")])
def test_a_share_of_the_training_that_is_none(share: float) -> None:
    with pytest.raises(
        InputError, match=rf"settle_at must be a share .* \(0, 1\), not {share}; none"
    ):
        wn.TrainConfig(settle_at=share)


# --- 62: NaN in a grid --------------------------------------------------------------------------


@pytest.mark.parametrize("value", [NAN, math.inf])
def test_62_NaN_in_a_grid(tmp_path: Path, value: float) -> None:
    outcome = train(make_scene(tmp_path), folder=tmp_path)
    assert_trained(outcome)
    field = wn.load_field(outcome.run / "field.safetensors", threads=1)
    values = field.storage.values.numpy()
    values[10, 2] = value
    bad = replace(
        field.storage, values=wp.array(values, dtype=field.storage.values.dtype, device="cpu")
    )
    (tmp_path / "bad").mkdir()
    shutil.copy(outcome.run / "config.json", tmp_path / "bad")
    wn.save_field(tmp_path / "bad/field.safetensors", replace(field, storage=bad))
    outcome = command("eval", tmp_path / "bad", "--threads", "1", folder=tmp_path)
    says = "bad/field.safetensors", "holds values that cannot be rendered"
    assert_refused(replace(outcome, run=tmp_path / "none"), *says)


# --- 63: tensors --------------------------------------------------------------------------------

RAW = torch.zeros(3, 3, 3, 4)
ORIGINS = torch.tensor([[0.0, 0.0, -2.0], [0.1, 0.0, -2.0]])
DIRECTIONS = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])


def render(**changes: Any) -> Any:
    arguments = {
        "raw": RAW,
        "origins": ORIGINS,
        "directions": DIRECTIONS,
        "box": ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)),
        "step": 0.1,
    }
    return render_rays(**{**arguments, **changes})


def scaled(**changes: Any) -> Any:
    arguments = {"colors": torch.ones(2, 5, 3), "sigmas": torch.ones(2, 5)}
    return scale_gradient(**{**arguments, "distances": torch.ones(2, 5), **changes})


@pytest.mark.parametrize(
    ("call", "changes", "message"),
    [
        pytest.param(render, {"raw": RAW.half()}, "raw must be float32 or", id="63-type-half"),
        pytest.param(render, {"raw": RAW.int()}, "raw must be floating", id="63-type-int"),
        pytest.param(render, {"raw": RAW.cfloat()}, "raw must be floating", id="63-type-complex"),
        pytest.param(render, {"raw": RAW.numpy()}, "raw must be a torch tensor", id="63-numpy"),
        pytest.param(
            render, {"origins": ORIGINS.long()}, "origins must be floating", id="63-type-of-rays"
        ),
        pytest.param(
            render, {"directions": DIRECTIONS.tolist()}, "directions must be a torch", id="63-list"
        ),
        pytest.param(render, {"raw": RAW[0]}, r"raw must be \[X, Y, Z, 4\]", id="63-rank-3"),
        pytest.param(render, {"raw": RAW[None]}, r"raw must be \[X, Y, Z, 4\]", id="63-rank-5"),
        pytest.param(
            render, {"origins": ORIGINS[0]}, r"origins must be \[n_rays", id="63-rank-of-rays"
        ),
        pytest.param(
            render, {"raw": RAW.to("meta")}, "raw must be on the CPU or on CUDA", id="63-device"
        ),
        pytest.param(
            render, {"origins": ORIGINS.to("meta")}, "origins must be on", id="63-device-of-rays"
        ),
        pytest.param(render, {"raw": RAW.to_sparse()}, "raw must be a dense", id="63-sparse"),
        pytest.param(
            render, {"origins": ORIGINS.to_sparse()}, "origins must be a dense", id="63-sparse-rays"
        ),
        pytest.param(
            render,
            {"background": torch.ones(3).to_sparse()},
            "background must be a dense",
            id="63-sparse-background",
        ),
        pytest.param(
            render,
            {"box": (torch.ones(3).to_sparse(), torch.ones(3))},
            "box_min must be a dense",
            id="63-sparse-corner",
        ),
        pytest.param(
            scaled, {"colors": np.ones((2, 5, 3))}, "colors must be a torch", id="63-scale-numpy"
        ),
        pytest.param(
            scaled,
            {"sigmas": torch.ones(2, 5).long()},
            "sigmas must be floating",
            id="63-scale-int",
        ),
        pytest.param(
            scaled, {"sigmas": torch.ones(2, 4)}, "must have one shape", id="63-scale-shape"
        ),
        pytest.param(
            scaled,
            {"colors": torch.ones(5, 3)},
            r"colors must be \[\.\.\., C\]",
            id="63-scale-rank",
        ),
        pytest.param(
            scaled,
            {"sigmas": torch.ones(2, 5, device="meta")},
            "sigmas must be on",
            id="63-scale-device",
        ),
        pytest.param(
            scaled,
            {"distances": torch.ones(2, 5).to_sparse()},
            "distances must be a dense",
            id="63-scale-sparse",
        ),
        pytest.param(
            scaled,
            {"content_distance": torch.ones(4)},
            "content_distance must broadcast over",
            id="63-scale-content-distance",
        ),
    ],
)
def test_tensor(call: Callable[..., Any], changes: dict[str, Any], message: str) -> None:
    call()
    with pytest.raises(InputError, match=message):
        call(**changes)


def test_63_not_contiguous() -> None:
    """Accepted: read as what they are."""
    generator = torch.Generator().manual_seed(0)
    raw = torch.randn(3, 4, 5, 4, generator=generator)
    mixed = raw.permute(2, 1, 0, 3).contiguous().permute(2, 1, 0, 3)
    rays = {"origins": ORIGINS.T.contiguous().T, "directions": DIRECTIONS[:1].expand(2, 3)}
    assert not mixed.is_contiguous() and not rays["directions"].is_contiguous()
    expected = render(raw=raw)
    for found, wanted in zip(render(raw=mixed, **rays), expected, strict=True):
        assert torch.equal(found, wanted)
    assert float(expected.opacity.min()) > 0.1


# --- 70: the cache of compiled kernels ----------------------------------------------------------

FALLS_BACK = "warpnerf: warning: the cache of compiled kernels"


def assert_fell_back(outcome: Outcome, why: str) -> Outcome:
    """One warning of it; what the command says besides."""
    warnings = [line for line in outcome.err.splitlines() if line.startswith(FALLS_BACK)]
    assert len(warnings) == 1 and why in warnings[0] and "WARP_CACHE_PATH" in warnings[0]
    return replace(outcome, err=outcome.err.replace(warnings[0] + "\n", ""))


def looked_at(folder: Path, cache: Path) -> Outcome:
    """What eval says of a run in the folder with that cache, which is quicker than to train."""
    outcome = command("eval", folder / "run", folder=folder, env={"WARP_CACHE_PATH": str(cache)})
    assert outcome.code == 0 and "\nmean " in outcome.out, outcome.err
    return outcome


@pytest.mark.ci  # compiles what another cache has
def test_70_kernel_cache_unwritable(tmp_path: Path) -> None:
    assert_trained(train(make_scene(tmp_path), folder=tmp_path))
    cache = tmp_path / "cache"
    cache.write_text("a file, which nobody can make folders in")
    said = assert_fell_back(looked_at(tmp_path, cache), "Not a directory")
    assert not said.err


@pytest.mark.slow  # as the one before, which is about the same fallback
def test_70_read_only_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("WARP_CACHE_PATH", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    env = {"HOME": "/proc/self"}
    outcome = train(make_scene(tmp_path), folder=tmp_path, env=env)
    assert_trained(assert_fell_back(outcome, "/proc/self/.cache"))


@pytest.mark.ci  # compiles what another cache has
def test_70_damaged_cached_kernel(tmp_path: Path) -> None:
    assert_trained(train(make_scene(tmp_path), folder=tmp_path))
    cache = tmp_path / "run" / "cache"
    cache.mkdir()
    assert not looked_at(tmp_path, cache).err
    machine_code = min(cache.rglob("*render_forward*.o"))
    content = bytearray(machine_code.read_bytes())
    content[len(content) // 2] ^= 0x10
    machine_code.write_bytes(content)
    why = f"{machine_code.parent.name} in it is damaged"
    said = assert_fell_back(looked_at(tmp_path, cache), why)
    assert not said.err


# --- 72: out of memory --------------------------------------------------------------------------


def leaving(mebibytes: int, load: str) -> str:
    """Python that leaves so much memory to this process, besides what is loaded before."""
    return (
        f"import resource\n{load}\n"
        "used = int(open('/proc/self/statm').read().split()[0]) * resource.getpagesize()\n"
        f"limit = used + {mebibytes} * 2**20\n"
        "resource.setrlimit(resource.RLIMIT_AS, (limit, limit))"
    )


needs_limits = pytest.mark.skipif(
    not Path("/proc/self/statm").exists(), reason="no such limit on this system"
)


@needs_limits
def test_72_out_of_memory_for_the_grid(tmp_path: Path) -> None:
    scene = make_scene(tmp_path)
    prelude = leaving(
        200, "import warp, warpnerf.runs.run, warpnerf.runtime.parallel as p; p.Workers()"
    )
    outcome = train(scene, "--voxels", "60000000", folder=tmp_path, prelude=prelude)
    assert_refused(outcome, "fewer")


@needs_limits
def test_72_out_of_memory_for_an_image(tmp_path: Path) -> None:
    lens = {"w": 8000, "h": 6000, "fl_x": 9000.0, "fl_y": 9000.0, "cx": 4000.0, "cy": 3000.0}
    scene = make_scene(tmp_path, lambda content: content.update(lens))
    Image.new("RGB", (8000, 6000)).save(scene / "images/000.png")
    for other in sorted((scene / "images").glob("*.png"))[1:]:
        shutil.copyfile(scene / "images/000.png", other)
    prelude = leaving(100, "import warpnerf.scenes.formats.load, warpnerf.evaluation.evaluate")
    outcome = train(scene, folder=tmp_path, prelude=prelude)
    assert_refused(outcome, "out of memory", "--downscale")


def test_refused_before_warp_is_loaded(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, lambda content: content.update(fl_x=0.0))
    prelude = "import sys; sys.modules['warp'] = None"
    assert_refused(train(scene, folder=tmp_path, prelude=prelude), "$.fl_x")
