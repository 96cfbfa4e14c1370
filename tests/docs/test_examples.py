"""The scripts in examples/ run, with small settings, and do what their first lines say."""

import ast
import importlib
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from tests.kernels.test_seams import loss_and_gradient, loss_of, problem
from tests.support.expected import assert_close
from tests.support.kernel_runner import Kernels
from warpnerf.model.interface import Model

pytestmark = pytest.mark.ci

FOLDER = Path(__file__).parents[2] / "examples"
sys.path.insert(0, str(FOLDER))
SMALL = ("builtin:room-sparse", "--downscale", "8")


def example(name: str) -> ModuleType:
    return importlib.import_module(name)


def test_every_example_says_how_to_run_it_and_is_listed() -> None:
    scripts = sorted(FOLDER.glob("*.py"))
    listed = (FOLDER / "README.md").read_text()
    assert len(scripts) >= 6
    for script in scripts:
        assert f"[{script.name}]({script.name})" in listed
        said = ast.get_docstring(ast.parse(script.read_text()))
        assert said and f"python examples/{script.name}" in said
        assert f"def test_{script.stem}(" in Path(__file__).read_text()


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, str]:
    """What train_on_a_folder finds, and the file that it leaves."""
    field = str(tmp_path_factory.mktemp("trained") / "field.safetensors")
    options = [*SMALL, "--steps", "60", "--output", field]
    return example("train_on_a_folder").main(options), field


def test_train_on_a_folder(trained: tuple[Any, str]) -> None:
    found, field = trained
    assert 14.0 < found.mean["psnr"] < 30.0 and Path(field).stat().st_size > 1000


def test_export_and_look(trained: tuple[Any, str], tmp_path: Path) -> None:
    _, field = trained
    scene, *options = SMALL
    options += ["--output", str(tmp_path / "out"), "--stills", "2"]
    written = example("export_and_look").main([field, "--scene", scene, *options])
    names = ["scene.glb", "scene.splat.ply", "scene.points.ply", "orbit_0.png", "orbit_1.png"]
    assert [path.name for path in written] == names
    assert all(path.stat().st_size > 500 for path in written)


def test_compare_configurations(capsys: pytest.CaptureFixture[str]) -> None:
    psnr = example("compare_configurations").main([*SMALL, "--steps", "12", "--seeds", "0", "1"])
    assert list(psnr) == ["none", "clamped"]
    gain = np.subtract(psnr["clamped"], psnr["none"])
    assert len(gain) == 2 and (gain != 0.0).all()
    assert f"clamped - none: {gain.mean():+.2f}" in capsys.readouterr().out


def test_scale_in_torch() -> None:
    """The scaling changes what is learned; both sides begin alike and draw the same rays."""
    options = (SMALL[0], "--downscale", "16", "--steps", "15")
    scaled, plain = (
        example("scale_in_torch").main([*options, "--scaling", scaling])
        for scaling in ("clamped", "none")
    )
    assert 10.0 < scaled < 30.0 and 10.0 < plain < 30.0 and scaled != plain


def test_scale_in_flax() -> None:
    for package in ("jax", "flax", "optax"):
        pytest.importorskip(package)
    options = (SMALL[0], "--downscale", "16", "--steps", "15")
    scaled, plain = (
        example("scale_in_flax").main([*options, "--scaling", scaling])
        for scaling in ("clamped", "none")
    )
    assert 8.0 < scaled < 30.0 and 8.0 < plain < 30.0 and scaled != plain


def test_own_loss() -> None:
    found = example("own_loss").main([*SMALL, "--steps", "120", "--weight", "0.05"])
    without, with_it = (found[name].near_field.near_mass for name in found)
    assert 0.0 <= with_it < 0.7 * without


def test_own_head(tmp_path: Path) -> None:
    """Colours are opacity times the dark ink, and what lies towards the light one."""
    module = example("own_head")
    picture = tmp_path / "duotone.png"
    field = module.main([*SMALL, "--steps", "40", "--output", str(picture)])
    assert picture.stat().st_size > 200
    camera = module.wn.load_scene(SMALL[0], downscale=8).cameras[0]
    seen = field.render(camera)
    dark, light = np.array(module.DARK), np.array(module.LIGHT)
    rest = (
        seen.rgb
        - seen.opacity[..., None] * dark
        - (1.0 - seen.opacity[..., None]) * np.array(field.background)
    )
    amounts = rest / (light - dark)
    np.testing.assert_allclose(amounts, amounts[..., :1].repeat(3, -1), atol=2e-4)
    assert amounts.std() > 0.01


@pytest.mark.parametrize("name", ["own_loss", "own_head"])
def test_gradients_of_own_parts(name: str, kernels64: Kernels) -> None:
    """Against central differences, in float64."""
    module = example(name)
    model: Model = (
        module.Duotone() if name == "own_head" else module.ClearRgb(distance=2.5, weight=0.4)
    )
    h = 2e-5
    for seed in range(4):
        p = problem(model, seed)
        gradient = loss_and_gradient(kernels64, p)[1]
        rng = np.random.default_rng(seed)
        found, expected = [], []
        for _ in range(8):
            direction = rng.normal(size=p.raw.shape)
            at = {
                k: loss_of(kernels64, replace(p, raw=p.raw + k * h * direction))
                for k in (-2, -1, 1, 2)
            }
            near, far = at[1] - at[-1], at[2] - at[-2]
            if abs(2.0 * near - far) <= 1e-5 * abs(far):  # no ray has come to its end
                found.append(np.vdot(direction, gradient))
                expected.append((8.0 * near - far) / (12.0 * h))
        assert len(found) >= 3
        assert_close(found, expected, 1e-7)
