"""What a sample of factors, or of a hash, costs: whole passes late in a training, against dense.

    python benchmarks/factors.py ../shared/data/lego_200
    python benchmarks/factors.py ../shared/data/lego_200 --field hash

Each field is trained alike up to the last tenth, and then the two trainings take turns, an update
each. Time is the processor's of all threads, so others on the machine matter little; a ratio is
that of neighbours in time. An update is all besides the pass: regularisers and Adam.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

from measuring import machine, median_interval, options, show, write_record

import warpnerf as wn
from warpnerf.model.storage_kinds import DENSE, STORAGE_KINDS, StorageKind, storage_of
from warpnerf.training.trainer import Trainer


def trained(scene: wn.Scene, config: wn.TrainConfig, field: StorageKind, steps: int) -> Trainer:
    """Late in a training: of so many steps, all but the last tenth."""
    trainer = Trainer(scene, replace(config, field=field, steps=steps))
    trainer.run(stop=lambda: trainer.fraction >= 0.9)
    return trainer


def cpu_seconds(call: Callable[[], object]) -> float:
    """Of all threads."""
    begin = time.process_time()
    call()
    return time.process_time() - begin


def one_update(trainer: Trainer) -> tuple[float, int, float]:
    """Seconds of the next update's pass, its samples, and seconds of what follows."""
    n_steps, fraction = trainer.schedule.steps_an_update(trainer.fraction), trainer.fraction
    batch = trainer._draw(n_steps)
    of_pass = cpu_seconds(lambda: trainer._differentiate(batch, n_steps))

    def rest() -> None:
        trainer._regularise(fraction, n_steps)
        trainer._step(fraction, n_steps)

    return of_pass, int(trainer._pass.n_samples.numpy()[: batch.count].sum()), cpu_seconds(rest)


def main() -> None:
    """Train, measure, print, and write a record."""
    parser = options(__doc__)
    parser.add_argument("scene", help="a folder, or builtin:room")
    parser.add_argument("--steps", type=int, default=2000, help="of each training")
    others = [name for name in STORAGE_KINDS if name not in (DENSE.name, "auto")]
    parser.add_argument("--field", choices=others, default="vm")
    parser.add_argument("--pairs", type=int, default=15)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--voxels", type=int, default=160**3)
    arguments = parser.parse_args()
    config = replace(wn.PRESETS["fast"], threads=arguments.threads)
    config = replace(config, grid=replace(config.grid, voxels=arguments.voxels))
    scene = wn.load_scene(arguments.scene)
    fields = {"dense": DENSE, arguments.field: storage_of(arguments.field)}
    trainers = {
        name: trained(scene, config, field, arguments.steps) for name, field in fields.items()
    }
    per_sample: dict[str, list[float]] = {name: [] for name in trainers}
    updates: dict[str, list[float]] = {name: [] for name in trainers}
    for pair in range(arguments.pairs):
        for name in list(trainers)[:: 1 if pair % 2 else -1]:
            of_pass, n_samples, rest = one_update(trainers[name])
            per_sample[name].append(1e9 * of_pass / n_samples)
            updates[name].append(1e3 * rest)
    print(f"{'':8}{'ns a sample':>24}{'ms an update':>24}{'samples a ray':>15}")
    for name, trainer in trainers.items():
        samples = trainer._pass.n_samples.numpy()[: trainer._pass.n_rays].mean()
        print(
            f"{name:8}{show(median_interval(per_sample[name]), 0):>24}"
            f"{show(median_interval(updates[name]), 1):>24}{samples:15.1f}"
        )
    pairs = zip(per_sample[arguments.field], per_sample["dense"], strict=True)
    ratios = [other / dense for other, dense in pairs]
    print(f"a sample of {arguments.field} over one of dense: {show(median_interval(ratios), 2)}")
    record = {
        "machine": machine("cpu", arguments.threads),
        "scene": arguments.scene,
        "ns_a_sample": {name: median_interval(of) for name, of in per_sample.items()},
        "ms_an_update": {name: median_interval(of) for name, of in updates.items()},
        f"{arguments.field}_over_dense": median_interval(ratios),
    }
    print(write_record(record, arguments.output, f"factors_{arguments.field}", "cpu"))


if __name__ == "__main__":
    main()
