"""Two configurations against each other: same seeds, same batches, differences in pairs.

    python examples/compare_configurations.py builtin:room-sparse --steps 1000 --seeds 0 1 2

Compares the preset `fast` without and with the distance scaling; change CANDIDATES to compare what
you like. A difference means something where it is larger than its spread over the seeds.
benchmarks/presets.py does more: equal time in turns, records, any field by its path.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import warp as wp

import warpnerf as wn

FAST = wn.PRESETS["fast"]
CANDIDATES = {
    "none": replace(FAST, scaling="none"),
    "clamped": replace(FAST, scaling="clamped"),
}


def main(words: Sequence[str] | None = None) -> dict[str, list[float]]:
    """Run the example with these words of a command line."""
    parser = argparse.ArgumentParser(description="Compare two configurations.")
    parser.add_argument("scene", nargs="?", default="builtin:room-sparse")
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--downscale", type=int, default=1, help="of the photographs")
    args = parser.parse_args(words)
    wp.config.log_level = wp.LOG_ERROR  # Warp would name each kernel that it loads

    scene = wn.load_scene(args.scene, downscale=args.downscale)
    psnr: dict[str, list[float]] = {name: [] for name in CANDIDATES}
    for seed in args.seeds:
        for name, config in CANDIDATES.items():
            result = wn.train(scene, replace(config, steps=args.steps, seed=seed))
            psnr[name].append(wn.evaluate(result.field, scene).mean["psnr"])
            print(f"seed {seed}, {name}: {psnr[name][-1]:.2f} dB")
    first, second = psnr
    gain = np.subtract(psnr[second], psnr[first])
    print(f"{second} - {first}: {gain.mean():+.2f} +- {np.ptp(gain) / 2:.2f} dB")
    return psnr


if __name__ == "__main__":
    main()
