"""Train on a folder of photographs with poses, say how good it is, and keep the field.

    python examples/train_on_a_folder.py SCENE --output field.safetensors --time-limit 60

SCENE is what `warpnerf train` takes: a folder with transforms.json, a COLMAP project, LLFF, or
builtin:room, which is there without any files.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace

import warp as wp

import warpnerf as wn


def main(words: Sequence[str] | None = None) -> wn.Evaluation:
    """Run the example with these words of a command line."""
    parser = argparse.ArgumentParser(description="Train on a folder and keep the field.")
    parser.add_argument("scene", nargs="?", default="builtin:room")
    parser.add_argument("--output", default="field.safetensors")
    parser.add_argument("--time-limit", type=float, default=60.0, help="seconds")
    parser.add_argument("--steps", type=int, default=100_000, help="at most")
    parser.add_argument("--downscale", type=int, default=1, help="of the photographs")
    args = parser.parse_args(words)
    wp.config.log_level = wp.LOG_ERROR  # Warp would name each kernel that it loads

    scene = wn.load_scene(args.scene, downscale=args.downscale)
    config = replace(wn.PRESETS["fast"], steps=args.steps, time_limit=args.time_limit)
    result = wn.train(scene, config, on_progress=lambda now: print(f"step {now.step}", end="\r"))
    found = wn.evaluate(result.field, scene, split="test")
    print(f"{result.progress.step} steps, content distance {result.content_distance:.3g}")
    print(found)  # PSNR and SSIM of each test view, and what floats before the training cameras
    wn.save_field(args.output, result.field)
    print(f"field: {args.output}; wn.load_field({args.output!r}) reads it")
    return found


if __name__ == "__main__":
    main()
