"""The distance scaling in a model of plain torch: one line before compositing.

    python examples/scale_in_torch.py builtin:room-sparse --scaling clamped

The model is the smallest NeRF there is, an MLP over encoded positions, and knows nothing of
warpnerf but `scale_gradient`: identity in the forward pass, and in the backward pass gradients of a
sample's colour and density times min(1, (t / D)^2). So any pipeline can have it. `none` trains the
same without.
"""

import argparse
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

import warpnerf as wn
from warpnerf.torch import scale_gradient

OCTAVES = 6


class TinyNerf(nn.Module):
    """From positions [..., 3] to colours [..., 3] in [0, 1] and densities [...]."""

    def __init__(self, width: int = 64) -> None:
        """An MLP of two hidden layers."""
        super().__init__()
        self.layers = nn.Sequential(
            *(nn.Linear(3 + 6 * OCTAVES, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU()),
            nn.Linear(width, 4),
        )

    def forward(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """Colours and densities."""
        waves = [f(2.0**k * positions) for k in range(OCTAVES) for f in (torch.sin, torch.cos)]
        out = self.layers(torch.cat([positions, *waves], dim=-1))
        return torch.sigmoid(out[..., :3]), nn.functional.softplus(out[..., 3] - 1.0)


def rays_of(scene: wn.Scene, split: str) -> tuple[Tensor, Tensor, Tensor]:
    """Origins, unit directions and colours of all pixels, [n, 3] each; pinhole cameras."""
    origins, directions, colours = [], [], []
    for view in (scene.views[index] for index in scene.splits[split]):
        camera = view.camera
        v, u = np.mgrid[: camera.height, : camera.width] + 0.5
        x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
        towards = np.stack([x, -y, -np.ones_like(x)], -1).reshape(-1, 3) @ camera.c2w[:, :3].T
        directions.append(towards / np.linalg.norm(towards, axis=-1, keepdims=True))
        origins.append(np.broadcast_to(camera.c2w[:, 3], towards.shape))
        colours.append(view.image[..., :3].reshape(-1, 3) / 255.0)
    o, d, c = (
        torch.tensor(np.concatenate(x), dtype=torch.float32) for x in (origins, directions, colours)
    )
    return o, d, c


def render(
    model: TinyNerf, rays: tuple[Tensor, Tensor], far: float, scale: dict[str, Any]
) -> Tensor:
    """Colours [n, 3] of rays, by 48 samples each from the camera on: no near plane."""
    origins, directions = rays
    edges = torch.linspace(0.0, far, 49).expand(len(origins), -1)
    step = edges[:, 1:] - edges[:, :-1]
    t = edges[:, :-1] + torch.rand_like(step) * step
    colours, sigmas = model(origins[:, None] + t[..., None] * directions[:, None])

    colours, sigmas, t = scale_gradient(colours, sigmas, t, **scale)  # all that is new

    alpha = 1.0 - torch.exp(-sigmas * step)
    passed = torch.cumprod(torch.cat([torch.ones_like(t[:, :1]), 1.0 - alpha + 1e-10], -1), -1)
    return ((passed[:, :-1] * alpha)[..., None] * colours).sum(-2)


def main(words: Sequence[str] | None = None) -> float:
    """Run the example with these words of a command line."""
    parser = argparse.ArgumentParser(description="Scale gradients in a model of plain torch.")
    parser.add_argument("scene", nargs="?", default="builtin:room-sparse")
    parser.add_argument("--scaling", default="clamped", choices=["none", "quadratic", "clamped"])
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--downscale", type=int, default=4, help="of the photographs")
    args = parser.parse_args(words)

    torch.manual_seed(0)
    scene = wn.load_scene(args.scene, downscale=args.downscale)
    scale = {"content_distance": scene.content_distance, "scaling": args.scaling}
    far = 3.0 * scene.content_distance
    model = TinyNerf()
    optimiser = torch.optim.Adam(model.parameters(), lr=2e-3)
    origins, directions, colours = rays_of(scene, "train")
    for step in range(args.steps):
        batch = torch.randint(len(origins), (1024,))
        rendered = render(model, (origins[batch], directions[batch]), far, scale)
        loss = nn.functional.mse_loss(rendered, colours[batch])
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        if step % 200 == 0:
            print(f"step {step}: loss {loss.item():.4f}")
    with torch.no_grad():
        origins, directions, colours = rays_of(scene, "test")
        parts = zip(origins.split(4096), directions.split(4096), strict=True)
        rendered = torch.cat([render(model, rays, far, scale) for rays in parts])
    psnr = -10.0 * nn.functional.mse_loss(rendered, colours).log10().item()
    print(f"{args.scaling}: {psnr:.2f} dB on the test views")
    return psnr


if __name__ == "__main__":
    main()
