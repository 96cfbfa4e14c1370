"""How far below the others a photograph of a wrong pose lies at the end of a training.

    python benchmarks/wrong_poses.py fox_q stitch builtin:room

One training with the poses as they are, one in which one camera is turned by --turn degrees about
its vertical axis, and one in which two photographs have each other's pose; of each, the lowest
photographs, in dB and in standard deviations below the median, and what the warning names.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from measuring import options
from presets import configured
from training import path_of

import warpnerf as wn
from warpnerf.reports.misfits import NORMAL, misfits

LOWEST = 3
"""Photographs that are shown."""


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("scenes", nargs="+", help="builtin:room, builtin:room-sparse, folders")
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--turn", type=float, default=3.0, help="degrees")
    args = parser.parse_args()
    config = replace(configured(args.preset), steps=args.steps, device=args.device)
    for name in args.scenes:
        scene = wn.load_scene(path_of(name))
        chosen = scene.splits["train"]
        third, first, last = (chosen[len(chosen) * k // 12] for k in (4, 3, 9))
        wrong = {
            "right": {},
            f"turned by {args.turn:g} degrees": {third: turned(scene, third, args.turn)},
            "exchanged": {first: pose(scene, last), last: pose(scene, first)},
        }
        for kind, poses in wrong.items():
            views = [posed(view, poses.get(i)) for i, view in enumerate(scene.views)]
            psnr = wn.train(replace(scene, views=views), config, progress=False).photograph_psnr
            report(f"{name}, {kind}", psnr, {scene.views[i].name for i in poses})


def pose(scene: wn.Scene, index: int) -> np.ndarray:
    """[3, 4] camera to world of a view."""
    return scene.views[index].camera.c2w


def turned(scene: wn.Scene, index: int, degrees: float) -> np.ndarray:
    """The same, turned about the camera's vertical axis."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    c2w = pose(scene, index).copy()
    c2w[:, :3] = c2w[:, :3] @ np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    return c2w


def posed(view: wn.View, c2w: np.ndarray | None) -> wn.View:
    """A view with another pose; None: its own."""
    return view if c2w is None else replace(view, camera=replace(view.camera, c2w=c2w))


def report(what: str, psnr: dict[str, float], wrong: set[str]) -> None:
    """Print the lowest photographs; those of a wrong pose with a star."""
    found = np.array(list(psnr.values()))
    median = np.median(found)
    deviation = NORMAL * np.median(np.abs(found - median))
    lowest = sorted(psnr, key=psnr.__getitem__)[:LOWEST]
    shown = ", ".join(
        f"{name}{'*' * (name in wrong)} {median - psnr[name]:.1f} dB "
        f"({(median - psnr[name]) / deviation:.1f})"
        for name in lowest
    )
    named = ", ".join(misfits(psnr)) or "none"
    print(f"{what}: {len(psnr)} photographs, median {median:.2f} dB, below it {shown}", flush=True)
    print(f"  named: {named}", flush=True)


if __name__ == "__main__":
    main()
