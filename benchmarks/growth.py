"""What the optimiser and densities go through where a grid grows, at equal steps.

    python benchmarks/growth.py builtin:room path/to/scene --steps 2000 --seeds 0 1 2

Scenes are as for training.py. Trainings differ in nothing but what happens at each growth: moments
of Adam that are carried over to the new nodes, as by default; an optimiser that restarts, rates
and all (``OptimConfig.restart_at_growth``); densities that are lowered by 1
(``GridConfig.shift_at_growth``); both, as in DVGO. Prints PSNR and SSIM on the test views; writes
benchmarks/results/growth_<device>.json.
"""

from __future__ import annotations

from dataclasses import replace
from statistics import mean

from measuring import add_model, machine, options, plain_training, write_record
from training import path_of

import warpnerf as wn
from warpnerf.runtime.parallel import Workers

WAYS = {
    "carried over": (0.0, False),
    "restarted": (0.0, True),
    "shifted": (1.0, False),
    "both": (1.0, True),
}
"""Shift of densities, and whether the optimiser restarts."""


def main() -> None:
    parser = options(__doc__)
    known = "builtin:room, builtin:room-sparse, folders"
    parser.add_argument("scenes", nargs="*", default=["builtin:room"], help=known)
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--voxels", type=int, default=100**3)
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--threads", type=int, help="by default one for each core")
    add_model(parser)
    arguments = parser.parse_args()
    config = plain_training(
        model=arguments.model,
        steps=arguments.steps,
        threads=arguments.threads,
        device=arguments.device,
        grid=wn.GridConfig(voxels=arguments.voxels),
    )
    print("scene           seed  at growth       PSNR   SSIM  seconds")
    rows = []
    for name in arguments.scenes:
        scene = wn.load_scene(path_of(name), downscale=arguments.downscale)
        for seed in arguments.seeds:
            for way, (shift, anew) in WAYS.items():
                found = measure(scene, replace(config, seed=seed), shift, anew)
                rows.append({"scene": name, "seed": seed, "at_growth": way, **found})
                print(
                    f"{name:14}  {seed:4}  {way:12}  {found['psnr']:6.2f}  {found['ssim']:.3f}  "
                    f"{found['seconds']:7.1f}",
                    flush=True,
                )
        for way in WAYS:
            of_way = [r for r in rows if r["scene"] == name and r["at_growth"] == way]
            print(f"{name:14}  mean  {way:12}  {mean(r['psnr'] for r in of_way):6.2f}")
    record = {
        "machine": machine(arguments.device, Workers(arguments.device, arguments.threads).count),
        "model": arguments.model,
        "steps": arguments.steps,
        "voxels": arguments.voxels,
        "downscale": arguments.downscale,
        "rows": rows,
    }
    print(f"wrote {write_record(record, arguments.output, 'growth', arguments.device)}")


def measure(scene: wn.Scene, config: wn.TrainConfig, shift: float, anew: bool) -> dict[str, float]:
    """Train, and measure the test views."""
    config = replace(
        config,
        grid=replace(config.grid, shift_at_growth=shift),
        optim=replace(config.optim, restart_at_growth=anew),
    )
    result = wn.train(scene, config, progress=False)
    found = wn.evaluate(result.field, scene).mean
    return {"psnr": found["psnr"], "ssim": found["ssim"], "seconds": result.progress.seconds}


if __name__ == "__main__":
    main()
