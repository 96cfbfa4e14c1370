"""LPIPS, a learned distance of images, with weights from a file that the user names.

d = sum_l mean_pixels sum_c w_lc (a_lc - b_lc)^2,  a_l = f_l / (|f_l| + 1e-10), |.| over channels

f_l are the activations of a network that was trained to classify photographs, at five depths, and
w_l weights fitted to people's judgements. Source: Zhang et al. 2018, "The Unreasonable
Effectiveness of Deep Features as a Perceptual Metric", version 0.1 of the authors' weights.

The file holds the tensors of the ``lpips`` package under its names, for AlexNet or VGG-16:

    torch.save(lpips.LPIPS(net="vgg").state_dict(), "lpips_vgg.pth")
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warpnerf.checks import InputError, require_extra

SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)
"""rgb in [-1, 1] is shifted and scaled by these, as the networks were trained."""


@dataclass(frozen=True, kw_only=True)
class Layer:
    """A convolution and its ReLU."""

    name: str
    """Of its tensors in the file."""
    channels: tuple[int, int]
    """In, out."""
    size: int
    """Edge of the kernel."""
    stride: int = 1
    """Pixels from one output to the next."""
    pool: int = 0
    """Edge of the maximum taken first, at every second pixel; 0: none."""
    tapped: bool = True
    """Whether its output is one of the five."""


def _vgg() -> tuple[Layer, ...]:
    layers = []
    before = 3
    for block, (index, channels, count) in enumerate(
        ((0, 64, 2), (5, 128, 2), (10, 256, 3), (17, 512, 3), (24, 512, 3))
    ):
        for k in range(count):
            layers.append(
                Layer(
                    name=f"net.slice{block + 1}.{index + 2 * k}",
                    channels=(before, channels),
                    size=3,
                    pool=2 if block and k == 0 else 0,
                    tapped=k == count - 1,
                )
            )
            before = channels
    return tuple(layers)


NETWORKS = {
    "AlexNet": (
        Layer(name="net.slice1.0", channels=(3, 64), size=11, stride=4),
        Layer(name="net.slice2.3", channels=(64, 192), size=5, pool=3),
        Layer(name="net.slice3.6", channels=(192, 384), size=3, pool=3),
        Layer(name="net.slice4.8", channels=(384, 256), size=3),
        Layer(name="net.slice5.10", channels=(256, 256), size=3),
    ),
    "VGG-16": _vgg(),
}

SMALLEST = 32
"""Pixels along the shorter edge, below which nothing would be left for the deepest layer."""


class Lpips:
    """The distance, with weights read from a file."""

    def __init__(self, path: str | Path) -> None:
        """Read the weights; which network they are of is seen from their names.

        Args:
            path: A safetensors file, or one by torch.save, of which nothing but tensors is read.

        Raises:
            InputError: torch is missing, the file cannot be read, or a tensor is missing, of the
                wrong shape or not finite.
        """
        path = Path(path)
        tensors = _read(path)
        self.network = "VGG-16" if "net.slice1.2.weight" in tensors else "AlexNet"
        """Name of the network."""
        self._layers = NETWORKS[self.network]

        def take(name: str, shape: tuple[int, ...]) -> Any:
            tensor = tensors.get(name)
            found = "missing" if tensor is None else f"of shape {list(tensor.shape)}"
            if tensor is None or tuple(tensor.shape) != shape:
                raise InputError(
                    f"{path}: {name} is {found}, but LPIPS with {self.network} has {list(shape)} "
                    'there; save lpips.LPIPS(net="alex" or "vgg").state_dict() whole.'
                )
            if not tensor.isfinite().all():
                raise InputError(f"{path}: {name} holds NaN or infinity; save the weights again.")
            return tensor.float()

        self._weights = []
        for layer in self._layers:
            inputs, outputs = layer.channels
            weight = take(f"{layer.name}.weight", (outputs, inputs, layer.size, layer.size))
            self._weights.append((weight, take(f"{layer.name}.bias", (outputs,))))
        taps = [layer.channels[1] for layer in self._layers if layer.tapped]
        self._heads = [
            take(f"lin{k}.model.1.weight", (1, channels, 1, 1)) for k, channels in enumerate(taps)
        ]

    def __call__(self, rgb: np.ndarray, target: np.ndarray) -> float:
        """The distance of two images; 0 for equal ones.

        Args:
            rgb: [H, W, 3] in [0, 1], at least 32 x 32.
            target: The same shape.

        Raises:
            InputError: Shapes differ, or an image is too small.
        """
        import torch

        if rgb.shape != target.shape or rgb.ndim != 3 or min(rgb.shape[:2]) < SMALLEST:
            raise InputError(
                f"LPIPS needs two images of one shape [H, W, 3], at least {SMALLEST} x {SMALLEST} "
                f"pixels, not {list(rgb.shape)} and {list(target.shape)}."
            )
        images = np.stack([rgb, target]).astype(np.float32).transpose(0, 3, 1, 2)
        shift, scale = (torch.tensor(c)[:, None, None] for c in (SHIFT, SCALE))
        total = 0.0
        with torch.inference_mode():
            pixels = (2.0 * torch.from_numpy(np.ascontiguousarray(images)) - 1.0 - shift) / scale
            for features, head in zip(self._features(pixels), self._heads, strict=True):
                a, b = features / (features.norm(dim=1, keepdim=True) + 1e-10)
                total += float((head[0] * (a - b) ** 2).sum(dim=0).mean())
        return total

    def _features(self, pixels: Any) -> list[Any]:
        """Activations [2, C, h, w] at five depths."""
        from torch.nn import functional

        tapped = []
        for layer, (weight, bias) in zip(self._layers, self._weights, strict=True):
            if layer.pool:
                pixels = functional.max_pool2d(pixels, layer.pool, stride=2)
            border = 2 if layer.size > 3 else 1
            pixels = functional.conv2d(pixels, weight, bias, layer.stride, border).relu()
            if layer.tapped:
                tapped.append(pixels)
        return tapped


def _read(path: Path) -> dict[str, Any]:
    """The tensors in a file, by name."""
    require_extra("torch", "torch", "LPIPS")
    import torch

    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            return dict(load_file(path))
        found = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # of many kinds, for many kinds of damage
        why = error.strerror if isinstance(error, OSError) and error.strerror else "not weights"
        raise InputError(
            f"{path}: cannot be read as weights of LPIPS ({why}); give the safetensors or torch "
            "file that holds them."
        ) from error
    if not isinstance(found, dict):
        raise InputError(f"{path}: holds no tensors by name; save a state_dict().")
    return {name: value for name, value in found.items() if isinstance(value, torch.Tensor)}
