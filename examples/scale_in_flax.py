"""The distance scaling in a NeRF of flax: one line before compositing.

    pip install ".[jax]" flax optax
    python examples/scale_in_flax.py builtin:room-sparse --scaling clamped

As multinerf has it: a flax module maps encoded positions to colours and densities, and a function
composites samples along rays. The line that is new is the identity in the forward pass, and in the
backward pass multiplies gradients of a sample's colour and density by min(1, (t / D)^2). `none`
trains the same without.
"""

import argparse
from collections.abc import Sequence
from functools import partial
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax

import warpnerf as wn
from warpnerf.jax import scale_gradient

OCTAVES, SAMPLES = 6, 48


class Nerf(nn.Module):
    """From positions [..., 3] to colours [..., 3] in [0, 1] and densities [...]."""

    width: int = 64

    @nn.compact
    def __call__(self, positions: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Colours and densities."""
        waves = [f(2.0**k * positions) for k in range(OCTAVES) for f in (jnp.sin, jnp.cos)]
        x = jnp.concatenate([positions, *waves], axis=-1)
        for _ in range(2):
            x = nn.relu(nn.Dense(self.width)(x))
        x = nn.Dense(4)(x)
        return nn.sigmoid(x[..., :3]), nn.softplus(x[..., 3] - 1.0)


def rays_of(scene: wn.Scene, split: str) -> tuple[jax.Array, jax.Array, jax.Array]:
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
    o, d, c = (jnp.asarray(np.concatenate(x), jnp.float32) for x in (origins, directions, colours))
    return o, d, c


def render(
    model: Nerf,
    params: Any,
    rays: tuple[jax.Array, jax.Array],
    far: float,
    key: jax.Array,
    **scale: Any,
) -> jax.Array:
    """Colours [n, 3] of rays, by samples drawn from the camera on: no near plane."""
    origins, directions = rays
    edges = jnp.linspace(0.0, far, SAMPLES + 1)
    step = edges[1:] - edges[:-1]
    t = edges[:-1] + jax.random.uniform(key, (len(origins), SAMPLES)) * step
    positions = origins[:, None] + t[..., None] * directions[:, None]
    colours, sigmas = model.apply(params, positions)

    colours, sigmas, t = scale_gradient(colours, sigmas, t, **scale)  # all that is new

    depth = sigmas * step
    through = jnp.cumsum(depth, axis=1) - depth
    weights = jnp.exp(-through) * (1.0 - jnp.exp(-depth))
    return jnp.sum(weights[..., None] * colours, axis=1)


def main(words: Sequence[str] | None = None) -> float:
    """Run the example with these words of a command line."""
    parser = argparse.ArgumentParser(description="Scale gradients in a NeRF of flax.")
    parser.add_argument("scene", nargs="?", default="builtin:room-sparse")
    parser.add_argument("--scaling", default="clamped", choices=["none", "quadratic", "clamped"])
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--downscale", type=int, default=4, help="of the photographs")
    args = parser.parse_args(words)

    scene = wn.load_scene(args.scene, downscale=args.downscale)
    scale = {"content_distance": scene.content_distance, "scaling": args.scaling}
    model, optimiser = Nerf(), optax.adam(2e-3)
    seen = partial(render, model, far=3.0 * scene.content_distance, **scale)
    origins, directions, colours = rays_of(scene, "train")

    def loss(params: Any, batch: jax.Array, key: jax.Array) -> jax.Array:
        rgb = seen(params, (origins[batch], directions[batch]), key=key)
        return jnp.mean((rgb - colours[batch]) ** 2)

    @jax.jit
    def update(params: Any, state: Any, key: jax.Array) -> tuple[Any, Any, jax.Array]:
        of_batch, of_samples = jax.random.split(key)
        batch = jax.random.randint(of_batch, (1024,), 0, len(origins))
        error, gradient = jax.value_and_grad(loss)(params, batch, of_samples)
        change, state = optimiser.update(gradient, state)
        return optax.apply_updates(params, change), state, error

    params = model.init(jax.random.key(0), jnp.zeros((1, 3)))
    state = optimiser.init(params)
    for step, key in enumerate(jax.random.split(jax.random.key(1), args.steps)):
        params, state, error = update(params, state, key)
        if step % 200 == 0:
            print(f"step {step}: loss {error:.4f}")

    origins, directions, colours = rays_of(scene, "test")
    look = jax.jit(seen)
    squares = [
        jnp.sum((look(params, (origins[k::64], directions[k::64]), key=key) - colours[k::64]) ** 2)
        for k, key in enumerate(jax.random.split(jax.random.key(2), 64))
    ]
    psnr = -10.0 * float(jnp.log10(sum(squares) / colours.size))
    print(f"{args.scaling}: {psnr:.2f} dB on the test views")
    return psnr


if __name__ == "__main__":
    main()
