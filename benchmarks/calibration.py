"""How much of the error on test views is that of their cameras, and how much of their exposure.

    python benchmarks/calibration.py fox_q stitch cup_colmap --steps 2000 --voxels 2000000

Trains the preset fast, for so many steps, and leaves the field as it is. Then the pose of each test
view is fitted to its photograph by Gauss-Newton on the colours of random pixels, whose derivatives
are differences of renderings from half a pixel to each side; and its colours by an affine map of
each channel. What both gain on the view that they are fitted to is the most that refined poses, or
an exposure for each photograph, could gain there. Writes
benchmarks/results/calibration_<device>.json.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from measuring import machine, options, write_record
from presets import some
from training import path_of

import warpnerf as wn
from warpnerf.evaluation.metrics import psnr
from warpnerf.presets import PRESETS
from warpnerf.rendering.rays import camera_rays
from warpnerf.runtime.parallel import Workers

PIXELS = 4000
"""Of a photograph, in each round."""
ROUNDS = 5
HALF = 0.5
"""Pixels, to each side, between the renderings whose difference is a derivative."""
MOST = 2.0
"""Pixels that a round moves at most."""
OUTLIER = 0.1
"""Of a colour: from here on residuals count by their size, not its square (Huber)."""


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("scenes", nargs="+", help="builtin:room, folders")
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--voxels", type=int, default=2_000_000)
    parser.add_argument("--test-views", type=int, default=8, help="at most so many, spread")
    args = parser.parse_args()
    rows = []
    for name in args.scenes:
        scene = wn.load_scene(path_of(name))
        fast = PRESETS["fast"]
        grid = replace(fast.grid, voxels=args.voxels)
        config = replace(fast, steps=args.steps, grid=grid, device=args.device)
        result = wn.train(scene, config, progress=False)
        views = [scene.views[i] for i in some(scene.splits["test"], args.test_views)]
        print(f"\n{name}\n  PSNR [dB]  pose fitted  colours fitted  moved, turned [pixels]  view")
        for view in views:
            row = looked_at(result.field, view, result.content_distance)
            rows.append({"scene": name, **row})
            print(
                f"  {row['psnr']:9.2f}  {row['posed'] - row['psnr']:+11.2f}  "
                f"{row['coloured'] - row['psnr']:+14.2f}  "
                f"{row['moved']:13.2f} {row['turned']:8.2f}  {row['view']}",
                flush=True,
            )
        own = [row for row in rows if row["scene"] == name]
        gains = {
            key: np.mean([row[key] - row["psnr"] for row in own]) for key in ("posed", "coloured")
        }
        print(f"  mean gain: poses {gains['posed']:+.2f} dB, colours {gains['coloured']:+.2f} dB")
    record = {
        "benchmark": "calibration",
        "machine": machine(args.device, Workers(args.device).count),
        "steps": args.steps,
        "voxels": args.voxels,
        "rows": rows,
    }
    print(f"\nrecord: {write_record(record, args.output, 'calibration', args.device)}")


def looked_at(field: wn.Field, view: wn.View, distance: float) -> dict[str, Any]:
    """PSNR of a view as it is, with its pose fitted, and with its colours fitted.

    Args:
        field: A trained one.
        view: Not trained on.
        distance: At which a motion of the camera is told in pixels, scene units.
    """
    truth = colours_of(view, field)
    seen = field.render(view.camera).rgb
    pose = fitted_pose(field, view.camera, truth, distance)
    posed = field.render(replace(view.camera, c2w=pose)).rgb
    coloured = np.stack([fitted(seen[..., c], truth[..., c]) for c in range(3)], axis=-1)
    turn = pose[:, :3].T @ view.camera.c2w[:, :3]
    angle = np.arccos(np.clip((np.trace(turn) - 1.0) / 2.0, -1.0, 1.0))
    move = np.linalg.norm(pose[:, 3] - view.camera.position)
    return {
        "view": view.name,
        "psnr": psnr(seen, truth),
        "posed": psnr(posed, truth),
        "coloured": psnr(coloured.astype(np.float32), truth),
        "moved": float(move / distance * view.camera.fx),
        "turned": float(angle * view.camera.fx),
    }


def colours_of(view: wn.View, field: wn.Field) -> np.ndarray:
    """A photograph in [0, 1], on the field's background."""
    truth = view.image[..., :3].astype(np.float32) / 255.0
    if view.channels == 4:
        alpha = view.image[..., 3:].astype(np.float32) / 255.0
        truth = alpha * truth + (1.0 - alpha) * np.array(field.background, np.float32)
    return truth


def fitted(seen: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """A channel of a rendering, mapped affinely to what comes closest to the photograph's."""
    columns = np.stack([seen.ravel(), np.ones(seen.size)], axis=1)
    return (columns @ np.linalg.lstsq(columns, truth.ravel(), rcond=None)[0]).reshape(seen.shape)


def fitted_pose(
    field: wn.Field, camera: wn.Camera, truth: np.ndarray, distance: float
) -> np.ndarray:
    """The pose from which the field looks most like a photograph, [3, 4].

    Args:
        field: What is rendered.
        camera: Where to begin.
        truth: [H, W, 3] colours.
        distance: As for ``looked_at``.
    """
    rng = np.random.default_rng(0)
    still = replace(camera, c2w=np.eye(3, 4))
    directions = camera_rays(still, field.workers)[1].numpy().reshape(-1, 3)
    pose, angle = camera.c2w, HALF / camera.fx
    units = np.array([angle] * 3 + [angle * distance] * 3)  # half a pixel, each
    for _ in range(ROUNDS):
        pixels = rng.permutation(len(directions))[:PIXELS]
        moves = [np.zeros(6), *np.diag(units), *np.diag(-units)]
        poses = [moved(pose, move) for move in moves]
        seen = colours_from(field, poses, directions[pixels])
        residual = (seen[0] - truth.reshape(-1, 3)[pixels]).ravel()
        slopes = (seen[1:7] - seen[7:]).reshape(6, -1).T / 2.0  # per half pixel
        weighted = slopes / np.maximum(1.0, np.abs(residual) / OUTLIER)[:, None]
        normal = weighted.T @ slopes
        normal += np.diag(0.01 * np.diag(normal) + 1e-9)
        step = -np.linalg.solve(normal, weighted.T @ residual)
        step *= min(1.0, MOST / HALF / np.abs(step).max())
        pose = moved(pose, step * units)
    return pose


def moved(pose: np.ndarray, by: np.ndarray) -> np.ndarray:
    """A pose turned by a rotation vector, and moved, in the camera's axes: by [6]."""
    angle = float(np.linalg.norm(by[:3]))
    x, y, z = by[:3] / max(angle, 1e-12)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turn = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
    return np.column_stack([pose[:, :3] @ turn, pose[:, 3] + pose[:, :3] @ by[3:]])


def colours_from(field: wn.Field, poses: list[np.ndarray], directions: np.ndarray) -> np.ndarray:
    """What is seen from several poses in the same directions of the camera, [n_poses, n, 3]."""
    n = len(directions)
    origins = np.repeat([pose[:, 3] for pose in poses], n, axis=0)
    turned = np.concatenate([directions @ pose[:, :3].T for pose in poses])
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    seen = field.render_rays(origins.astype(np.float32), turned.astype(np.float32))
    return seen.rgb.reshape(len(poses), n, 3)


if __name__ == "__main__":
    main()
