"""What photographs of different exposure cost a field, and what fitting their exposures gives back.

    python benchmarks/exposures.py fox_q stitch lund_door builtin:room-sparse

Training views are given an exposure and a white balance of their own: their light (sRGB decoded)
is multiplied by 2^x, x normal of deviation --stops, and each channel by 2^y, y of a quarter of
that; then encoded and cut off as a camera does. Test views stay as they are, so that PSNR has
their colours corrected (cc-PSNR, docs/metrics.md). Each capture trains as it is and so changed,
with appearance none, auto and affine, the preset fast for so many steps. Prints a table and writes
benchmarks/results/exposures_<device>.json; --picture FILE shows, of the first scene's last change,
the darkest and the brightest training view, and a test view and its depth by the fields trained
with none and with affine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from measuring import machine, options, write_record
from PIL import Image
from training import path_of

import warpnerf as wn
from warpnerf.config import TrainConfig
from warpnerf.evaluation.metrics import colour_corrected, truth
from warpnerf.media.pictures import depth_picture, to_bytes
from warpnerf.presets import PRESETS
from warpnerf.runtime.parallel import Workers

APPEARANCES = ("none", "auto", "affine")
WIDTH = 960
"""Pixels of the picture, at least half as many."""
BALANCE = 0.25
"""Deviation of the white balance's stops, over that of the exposure's."""


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("scenes", nargs="+", help="builtin:room, folders")
    parser.add_argument("--stops", type=float, nargs="+", default=[0.0, 0.4])
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--voxels", type=int, default=2_000_000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--downscale", type=int, default=2, help="of captures; built-in scenes: 1")
    parser.add_argument("--picture", type=Path, help="JPEG")
    args = parser.parse_args()
    fast = replace(PRESETS["fast"], steps=args.steps, device=args.device)
    fast = replace(fast, grid=replace(fast.grid, voxels=args.voxels))
    rows: list[dict[str, Any]] = []
    pictured: list[tuple[wn.Scene, wn.Field]] = []
    print("scene                stops  appearance  used   PSNR  cc-PSNR    SSIM  near mass")
    for name in args.scenes:
        downscale = 1 if name.startswith("builtin:") else args.downscale
        scene = wn.load_scene(path_of(name), downscale=downscale)
        for stops in args.stops:
            for seed in args.seeds:
                given = with_exposures(scene, stops, seed)
                for appearance in APPEARANCES:
                    result, row = trained(given, replace(fast, appearance=appearance, seed=seed))
                    row = {"scene": name, "stops": stops, "seed": seed} | row
                    rows.append(row)
                    print(
                        f"{name:20} {stops:5.1f}  {appearance:10}  {'yes' if row['used'] else '':4}"
                        f" {row['psnr']:5.2f}  {row['cc_psnr']:7.2f}  {row['ssim']:.4f}"
                        f"  {row['near_mass']:9.5f}",
                        flush=True,
                    )
                    if name == args.scenes[0] and stops == args.stops[-1] and appearance != "auto":
                        pictured.append((result.scene, result.field))
    record = {
        "benchmark": "exposures",
        "machine": machine(args.device, Workers(args.device).count),
        "steps": args.steps,
        "voxels": args.voxels,
        "rows": rows,
    }
    if args.picture is not None:
        pixels = picture(pictured[:2])
        larger = max(1, WIDTH // pixels.shape[1])
        pixels = pixels.repeat(larger, axis=0).repeat(larger, axis=1)
        Image.fromarray(pixels).save(args.picture, quality=90)
        print(f"picture: {args.picture}")
    print(f"record: {write_record(record, args.output, 'exposures', args.device)}")


def with_exposures(scene: wn.Scene, stops: float, seed: int) -> wn.Scene:
    """A scene whose training views differ in exposure and white balance.

    Args:
        scene: As it is.
        stops: Deviation of their exposure.
        seed: Of what each gets.
    """
    rng, views = np.random.default_rng(1000 + seed), list(scene.views)
    for index in scene.splits["train"] if stops else ():
        view = views[index]
        light = 2.0 ** (stops * (rng.normal() + BALANCE * rng.normal(size=3)))
        image = view.image.copy()
        image[..., :3] = exposed(image[..., :3] / 255.0, light)
        views[index] = replace(view, image=image)
    return replace(scene, views=views)


def exposed(rgb: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Colours in sRGB of so many times the light, as bytes: IEC 61966-2-1.

    Args:
        rgb: [H, W, 3] in [0, 1].
        light: [3].
    """
    linear = light * np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    steep = 1.055 * np.maximum(linear, 1e-9) ** (1.0 / 2.4) - 0.055
    return to_bytes(np.where(linear <= 0.0031308, 12.92 * linear, steep))


def trained(scene: wn.Scene, config: TrainConfig) -> tuple[wn.TrainResult, dict[str, Any]]:
    """A field, and its figures."""
    result = wn.train(scene, config, progress=False)
    found = wn.evaluate(result.field, result.scene)
    figures = {name: found.mean[name] for name in ("psnr", "cc_psnr", "ssim")}
    used = result.exposures is not None
    mass = found.near_field.near_mass
    return result, {"appearance": config.appearance, "used": used, **figures, "near_mass": mass}


def picture(pairs: Sequence[tuple[wn.Scene, wn.Field]]) -> np.ndarray:
    """The darkest and the brightest training view, then a test view and its depth by each field."""
    scene = pairs[0][0]
    test = scene.splits["test"]
    view = scene.views[test[len(test) // 2]]
    target = truth(view, pairs[0][1].background)
    train = [scene.views[i] for i in scene.splits["train"]]
    means = [v.image[..., :3].mean() for v in train]
    shots = [train[int(i)].image[..., :3] for i in (np.argmin(means), np.argmax(means))]
    if any(shot.shape != shots[0].shape for shot in shots) or shots[0].shape != target.shape:
        shots = [to_bytes(target), to_bytes(target)]
    columns = [np.concatenate(shots)]
    near, far = 0.3 * scene.content_distance, 3.0 * scene.content_distance
    for _, field in pairs:
        seen = field.render(view.camera)
        rgb = colour_corrected(np.clip(seen.rgb, 0.0, 1.0), target, view.mask)
        columns.append(np.concatenate([to_bytes(rgb), to_bytes(depth_picture(seen, near, far))]))
    return np.concatenate(columns, axis=1)


if __name__ == "__main__":
    main()
