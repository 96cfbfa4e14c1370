"""LPIPS against figures of the authors' package, with weights that anyone can make."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from warpnerf.checks import InputError
from warpnerf.evaluation.lpips import NETWORKS, Lpips

# By lpips 0.1.4 with torchvision 0.29.2 and torch 2.13.0, of the images and weights below.
PUBLISHED = {"AlexNet": (0.8114847540, 0.0065288777), "VGG-16": (3.4377155304, 0.3839409947)}


def wave(shape: tuple[int, ...], phase: float, size: float) -> np.ndarray:
    n = int(np.prod(shape))
    wave = size * np.sin(0.37 * np.arange(n, dtype=np.float64) ** 1.1 + phase)
    return wave.astype(np.float32).reshape(shape)


def image(phase: float) -> np.ndarray:
    return 0.5 + 0.5 * wave((48, 56, 3), phase, 1.0)


def weights(network: str) -> dict[str, torch.Tensor]:
    shapes: dict[str, tuple[int, ...]] = {}
    for layer in NETWORKS[network]:
        shapes[f"{layer.name}.weight"] = (*layer.channels[::-1], layer.size, layer.size)
        shapes[f"{layer.name}.bias"] = (layer.channels[1],)
    taps = [layer.channels[1] for layer in NETWORKS[network] if layer.tapped]
    for k, channels in enumerate(taps):
        shapes[f"lin{k}.model.1.weight"] = (1, channels, 1, 1)
    tensors = {}
    for k, name in enumerate(sorted(shapes)):
        shape = shapes[name]
        if name.startswith("lin"):
            values = np.abs(wave(shape, k, 1.0))
        elif name.endswith("bias"):
            values = wave(shape, k, 0.1)
        else:
            values = wave(shape, k, float(np.sqrt(6.0 / np.prod(shape[1:]))))
        tensors[name] = torch.tensor(values)
    return tensors


@pytest.mark.parametrize("ending", ["pth", "safetensors"])
@pytest.mark.parametrize("network", NETWORKS)
def test_the_authors_figures(tmp_path: Path, network: str, ending: str) -> None:
    path = tmp_path / f"weights.{ending}"
    (save_file if ending == "safetensors" else torch.save)(weights(network), path)
    lpips = Lpips(path)
    assert lpips.network == network
    a, b = image(0.0), image(1.0)
    far, near = PUBLISHED[network]
    assert lpips(a, b) == pytest.approx(far, rel=1e-5)
    assert lpips(b, a) == pytest.approx(far, rel=1e-5)
    assert lpips(a, np.clip(a + np.float32(0.02), 0.0, 1.0)) == pytest.approx(near, rel=1e-4)
    assert lpips(a.astype(np.float64), a) == 0.0


class Harmful:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return sys.exit, ("run",)


def bad_weights(kind: str) -> object:
    tensors = weights("AlexNet")
    if kind == "missing":
        del tensors["lin3.model.1.weight"]
    if kind == "shape":
        tensors["net.slice3.6.weight"] = tensors["net.slice3.6.weight"][:, :-1]
    if kind == "nan":
        tensors["net.slice1.0.bias"][3] = torch.nan
    if kind == "list":
        return list(tensors.values())
    if kind == "code":
        return {**tensors, "more": Harmful()}
    return tensors


@pytest.mark.parametrize(
    ("kind", "says"),
    [
        ("missing", r"lin3.model.1.weight is missing.*\[1, 256, 1, 1\]"),
        ("shape", r"net.slice3.6.weight is of shape \[384, 191, 3, 3\].*\[384, 192, 3, 3\]"),
        ("nan", "net.slice1.0.bias holds NaN"),
        ("list", "no tensors by name"),
        ("code", "cannot be read as weights"),
    ],
)
def test_bad_weights_are_named(tmp_path: Path, kind: str, says: str) -> None:
    path = tmp_path / "weights.pth"
    torch.save(bad_weights(kind), path)
    with pytest.raises(InputError, match=rf"weights.pth: .*{says}"):
        Lpips(path)


@pytest.mark.parametrize("name", ["none.pth", "none.safetensors", "text.pth", "text.safetensors"])
def test_files_that_are_no_weights(tmp_path: Path, name: str) -> None:
    (tmp_path / "text.pth").write_text("no weights")
    (tmp_path / "text.safetensors").write_text("no weights")
    with pytest.raises(InputError, match=f"{name}: cannot be read as weights"):
        Lpips(tmp_path / name)


def test_small_or_unequal_images_are_refused(tmp_path: Path) -> None:
    torch.save(weights("AlexNet"), tmp_path / "weights.pth")
    lpips = Lpips(tmp_path / "weights.pth")
    for a, b in ((image(0.0)[:31], image(0.0)[:31]), (image(0.0), image(0.0)[1:])):
        with pytest.raises(InputError, match="32 x 32"):
            lpips(a, b)
    assert lpips(image(0.0)[:32, :32], image(1.0)[:32, :32]) > 0.0


def test_without_torch_it_says_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(InputError, match=r'LPIPS needs torch: pip install "warpnerf\[torch\]"'):
        Lpips(tmp_path / "weights.pth")
