"""How long the kernels of a training take to compile for CUDA; no GPU is needed for that.

    python benchmarks/cuda_compiling.py
    python benchmarks/cuda_compiling.py --tree ../before

Warp brings the compiler along. Of each preset and kind of scene the kernels that `warpnerf train
--device cuda` loads until its end, each compiled to machine code of one architecture in a folder
that is empty: seconds of one core as the process counts them, so that other programs on the machine
matter little, and the size of the code. With `--tree` another checkout takes turns with this one,
a process for each of both. It prints what it finds, and writes nothing.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from measuring import ROOT

KINDS = {"object": "none", "bounded": "none", "unbounded": "linf"}
"""Kinds of scenes, and the space in which they are trained."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--presets", nargs="+", default=["fast", "quality"])
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), default=list(KINDS))
    parser.add_argument("--arch", type=int, default=90, help="compute capability times ten")
    parser.add_argument("--tree", type=Path, help="another checkout, compiled in turns")
    parser.add_argument("--here", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.here:
        print(json.dumps([compiled(preset, kind, args.arch) for preset, kind in wanted(args)]))
        return
    trees = {"this": ROOT, **({"other": args.tree.resolve()} if args.tree else {})}
    for preset, kind in wanted(args):
        found = [
            in_words(name, compiled_in(tree, preset, kind, args.arch))
            for name, tree in trees.items()
        ]
        print(f"{preset}, {kind}: {'; '.join(found)}", flush=True)


def wanted(args: argparse.Namespace) -> list[tuple[str, str]]:
    """Presets and kinds of scenes."""
    return [(preset, kind) for preset in args.presets for kind in args.kinds]


def compiled_in(tree: Path, preset: str, kind: str, arch: int) -> dict[str, Any]:
    """What ``compiled`` says in a process that imports a checkout."""
    command = [sys.executable, __file__, "--here", "--arch", str(arch)]
    command += ["--presets", preset, "--kinds", kind]
    path = os.pathsep.join(map(str, (tree, tree / "kernels")))
    done = subprocess.run(
        command, env={**os.environ, "PYTHONPATH": path}, stdout=subprocess.PIPE, check=True
    )
    (found,) = json.loads(done.stdout.splitlines()[-1])
    return found  # type: ignore[no-any-return]


def compiled(preset: str, kind: str, arch: int) -> dict[str, Any]:
    """Compile the kernels of a training: seconds of one core and bytes, and the slowest."""
    import warp as wp

    modules = {kernel.module: kernel.key for kernel in kernels(preset, kind)}
    each = []
    for module, name in modules.items():
        with tempfile.TemporaryDirectory() as folder:
            start = time.process_time()
            wp.compile_aot_module(module, arch=arch, module_dir=folder, use_ptx=False)
            seconds = time.process_time() - start
            size = sum(path.stat().st_size for path in Path(folder).glob("*.cubin"))
        each.append({"kernel": name.rpartition("__")[2], "seconds": seconds, "bytes": size})
    return {
        "modules": len(each),
        "seconds": sum(one["seconds"] for one in each),
        "bytes": sum(one["bytes"] for one in each),
        "slowest": max(each, key=lambda one: one["seconds"]),
    }


def kernels(preset: str, kind: str) -> list[Any]:
    """What a training and its test views load."""
    from types import SimpleNamespace

    import warpnerf as wn
    from warpnerf.model.spaces import SPACES
    from warpnerf.training.warmup import rendering_kernels, training_kernels

    cuda: Any = SimpleNamespace(is_cuda=True)
    config, contraction = wn.PRESETS[preset], KINDS[kind]
    decided = config.for_kind(kind)
    sampler = config.sampler_in(SPACES[contraction])
    return [
        *training_kernels(
            config.model,
            contraction,
            config.scaling,
            config.jacobian,
            cuda,
            config.losses_for(kind),
            decided.field,
            sampler,
            config.optim.near_decay > 0.0,
            config.appearance != "none",
        ),
        *rendering_kernels(config.model, contraction, cuda, decided.field, sampler),
    ]


def in_words(tree: str, found: dict[str, Any]) -> str:
    """A line of one checkout."""
    slowest = found["slowest"]
    return (
        f"{tree} {found['seconds']:.0f} s and {found['bytes'] / 1e6:.1f} MB for {found['modules']} "
        f"modules, {slowest['kernel']} {slowest['seconds']:.0f} s"
    )


if __name__ == "__main__":
    main()
