"""warpnerf behind nerfbaselines: its training and rendering there, and the metrics of both.

    python benchmarks/nerfbaselines_client.py path/to/fox path/to/a_colmap_scene

Makes a virtual environment of its own, because nerfbaselines wants numpy below 2, installs
nerfbaselines and this tree into it, and runs its commands with `--backend python`. Then it compares
the PSNR and SSIM that nerfbaselines finds for its pictures with those that `warpnerf` finds for the
same field and the same views, read by warpnerf's own readers.

Prints a line for each scene and writes benchmarks/results/nerfbaselines_client_cpu.json.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import venv
from pathlib import Path
from typing import Any

import numpy as np
from measuring import default_threads, machine, options, write_record

import warpnerf as wn
from warpnerf.evaluation.metrics import psnr, ssim

ROOT = Path(__file__).resolve().parent.parent

THEIRS = """
import json, sys
from pathlib import Path
import numpy as np
from PIL import Image
from nerfbaselines import metrics
folder, out = Path(sys.argv[1]), {}
for path in sorted((folder / "color").rglob("*.png")):
    name = path.relative_to(folder / "color")
    pair = [np.asarray(Image.open(folder / kind / name).convert("RGB"), np.float32)[None] / 255
            for kind in ("color", "gt-color")]
    found = [float(f(*pair)[0]) for f in (metrics.psnr, metrics.ssim)]
    out[name.with_suffix("").as_posix()] = found
print(json.dumps(out))
"""
"""Of the pictures in a folder that `nerfbaselines render` wrote: PSNR and SSIM of each."""


def main() -> None:
    parser = options(__doc__ or "")
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--venv", type=Path, help="to keep and use again; default: a temporary one")
    args = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        scratch = Path(temporary)
        programs = installed(args.venv or scratch / "venv")
        for scene in args.scenes:
            rows.append(compare(scene, args.steps, programs, scratch))
            print(json.dumps(rows[-1]), flush=True)
    threads = default_threads()[-1]
    record = {"machine": machine(args.device, threads), "steps": args.steps, "scenes": rows}
    print("wrote", write_record(record, args.output, "nerfbaselines_client", args.device))


def installed(folder: Path) -> Path:
    """The programs of an environment with nerfbaselines and this tree; made where it is missing."""
    programs = folder / ("Scripts" if os.name == "nt" else "bin")
    if not programs.exists():
        venv.create(folder, with_pip=True)
    run(programs, "python", "-m", "pip", "install", "--quiet", "nerfbaselines", str(ROOT))
    return programs


def run(programs: Path, name: str, *arguments: str) -> str:
    """What a program of the environment prints; ends this one where it fails."""
    done = subprocess.run(
        [str(programs / name), *arguments],
        env={**os.environ, "PYTHONPATH": ""},
        capture_output=True,
        text=True,
    )
    if done.returncode:
        sys.exit(f"{name} {' '.join(arguments)} failed:\n{done.stderr[-4000:]}")
    return done.stdout


def compare(scene: Path, steps: int, programs: Path, scratch: Path) -> dict[str, Any]:
    """A row: what both find for the test views that nerfbaselines chooses."""
    data, out = scratch / scene.name, scratch / f"{scene.name}-out"
    shutil.copytree(scene, data)
    loader = "nerfstudio" if (data / "transforms.json").exists() else "colmap"
    (data / "nb-info.json").write_text(json.dumps({"loader": loader}))
    command = ("--backend", "python", "--data", str(data))
    run(
        programs,
        "nerfbaselines",
        "train",
        *("--method", "warpnerf", *command, "--output", str(out), "--set", f"steps={steps}"),
        *("--eval-all-iters", "0", "--eval-few-iters", "0", "--logger", "none"),
        "--disable-output-artifact",
    )
    checkpoint = out / f"checkpoint-{steps}"
    pictures = out / "pictures"
    run(
        programs,
        "nerfbaselines",
        "render",
        *("--checkpoint", str(checkpoint), *command, "--output", str(pictures)),
    )
    theirs = json.loads(run(programs, "python", "-c", THEIRS, str(pictures)).splitlines()[-1])
    ours = our_metrics(data, checkpoint, set(theirs))
    of_theirs = np.mean([theirs[name] for name in theirs], axis=0)
    of_ours = np.mean([ours[name] for name in theirs], axis=0)
    return {
        "scene": scene.name,
        "views": len(theirs),
        "psnr_nerfbaselines": float(of_theirs[0]),
        "psnr_warpnerf": float(of_ours[0]),
        "ssim_nerfbaselines": float(of_theirs[1]),
        "ssim_warpnerf": float(of_ours[1]),
    }


def our_metrics(data: Path, checkpoint: Path, names: set[str]) -> dict[str, tuple[float, float]]:
    """PSNR and SSIM of the same views, by warpnerf's readers, renderer and metrics."""
    field = wn.load_field(checkpoint / "checkpoint.safetensors")
    found = {}
    for view in wn.load_scene(data).views:
        name = next((n for n in names if _same(n, view.name)), None)
        if name is not None:
            seen = field.render(view.camera).rgb
            target = view.image[..., :3] / 255.0
            found[name] = (psnr(seen, target), ssim(seen, target))
    missing = names - set(found)
    if missing:
        sys.exit(f"{data}: warpnerf does not find {', '.join(sorted(missing))}")
    return found


def _same(name: str, of_view: str) -> bool:
    """Whether both name one photograph: without its ending, and folders left out by one of them."""
    ours = Path(of_view).with_suffix("").as_posix()
    return ours == name or ours.endswith(f"/{name}") or name.endswith(f"/{ours}")


if __name__ == "__main__":
    main()
