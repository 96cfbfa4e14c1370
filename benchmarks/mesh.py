"""What is exported, compared with the truth: builtin:room, whose surfaces are known exactly.

Mesh: the distance of its vertices to the nearest true surface, and the distance of what training
pixels see, exactly traced, to the nearest vertex; for several levels of density, with and without
what no training camera sees. Colours: a vertex against the nearest point that a training photograph
shows, where one is within 2 cm. Splats: drawn by the renderer in tests/reference/splats.py, which
shares no code with the package, against what the field itself renders of test views.

    python benchmarks/mesh.py

Prints tables and writes benchmarks/results/mesh_<device>.json, and with --picture FILE a picture.
Needs scipy.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from measuring import machine, options, plain_training, write_record
from PIL import Image
from scipy.spatial import cKDTree
from solids_truth import distances_to

import warpnerf as wn
from warpnerf.exporting import surface
from warpnerf.exporting.splats import splats_ply
from warpnerf.scenes.builtin.room import room_solids

sys.path.append(str(Path(__file__).parent.parent))
from tests.reference.splats import draw_splats, read_splats

OPACITIES = (0.1, 0.15, 0.2, 0.3, 0.5)
"""Of a voxel edge, at the levels that are tried."""

NEAR = 0.05
"""Metres that count as right."""


def photographed(scene: wn.Scene) -> tuple[np.ndarray, np.ndarray]:
    """The true points behind the training pixels, [n, 3] metres, and their colours [n, 3]."""
    points, colours = [], []
    for index in scene.splits["train"]:
        view = scene.views[index]
        camera = view.camera
        assert view.depth is not None
        v, u = np.mgrid[: camera.height, : camera.width] + 0.5
        local = [(u - camera.cx) / camera.fx, (camera.cy - v) / camera.fy, -np.ones_like(u)]
        rays = np.stack(local, axis=-1) @ camera.c2w[:, :3].T
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        points.append((camera.position + rays * view.depth[..., None]).reshape(-1, 3))
        colours.append(view.image.reshape(-1, 3) / 255.0)
    return np.concatenate(points), np.concatenate(colours)


def psnr(squared_error: float) -> float:
    return float(-10.0 * np.log10(squared_error))


def measure_mesh(
    field: wn.Field, visible: wn.Visibility, opacity: float, unseen: bool, truth: tuple
) -> dict[str, float]:
    edge = float(field.lattice.voxel_size.mean())
    level = -np.log1p(-opacity) / edge
    mesh = wn.extract_surface(field, visible, unseen=unseen, level=level)
    points, colours = truth
    to_truth, _ = distances_to(mesh.points.astype(np.float64), list(room_solids()))
    to_mesh, _ = cKDTree(mesh.points).query(points[::7])
    apart, nearest = cKDTree(points).query(mesh.points)
    close = apart < 0.02
    return {
        "opacity": opacity,
        "unseen": unseen,
        "vertices": len(mesh.points),
        "mesh_to_truth": float(to_truth.mean()),
        "mesh_within_5_cm": float((to_truth < NEAR).mean()),
        "truth_to_mesh": float(to_mesh.mean()),
        "truth_within_5_cm": float((to_mesh < NEAR).mean()),
        "chamfer": float(0.5 * (to_truth.mean() + to_mesh.mean())),
        "colour_psnr": psnr(float(np.mean((mesh.rgb[close] - colours[nearest[close]]) ** 2))),
    }


def larger(camera: wn.Camera, factor: int) -> wn.Camera:
    return replace(
        camera,
        width=camera.width * factor,
        height=camera.height * factor,
        fx=camera.fx * factor,
        fy=camera.fy * factor,
        cx=camera.cx * factor,
        cy=camera.cy * factor,
    )


def main() -> None:
    parser = options(__doc__ or "")
    parser.add_argument("--steps", type=int, default=4000, help="of training")
    parser.add_argument("--views", type=int, default=5, help="test views that splats are drawn in")
    parser.add_argument("--picture", type=Path, help="JPEG of a test view: truth, field, splats")
    arguments = parser.parse_args()
    scene = wn.load_scene("builtin:room")
    config = plain_training(steps=arguments.steps, device=arguments.device)
    result = wn.train(scene, config, progress=False)
    field = result.field
    print(f"{arguments.steps} steps, voxel edge {field.lattice.voxel_size.mean():.4f} m")
    truth, visible = photographed(scene), wn.visibility(field, scene.training_cameras)
    print("opacity unseen vertices  mesh->truth within 5 cm  truth->mesh within 5 cm  colours")
    rows = []
    for opacity, unseen in [*((o, False) for o in OPACITIES), (surface.LEVEL_OPACITY, True)]:
        row = measure_mesh(field, visible, opacity, unseen, truth)
        rows.append(row)
        print(
            f"{opacity:7.2f} {unseen!s:6} {row['vertices']:8d}  "
            f"{100 * row['mesh_to_truth']:8.2f} cm {row['mesh_within_5_cm']:12.1%}  "
            f"{100 * row['truth_to_mesh']:8.2f} cm {row['truth_within_5_cm']:12.1%}  "
            f"{row['colour_psnr']:.1f} dB",
            flush=True,
        )
    made = wn.splats_of(field, visible)
    columns = read_splats(b"".join(splats_ply(made)))
    against_field, against_truth, pictures = [], [], []
    for index in scene.splits["test"][: arguments.views]:
        camera = larger(scene.cameras[index], 2)
        shown = field.render(camera).rgb
        drawn = draw_splats(
            columns,
            camera.c2w,
            (camera.fx, camera.fy),
            (camera.cx, camera.cy),
            (camera.width, camera.height),
            field.background,
        ).clip(0.0, 1.0)
        assert scene.photograph is not None
        photograph = scene.photograph(camera)
        assert photograph is not None
        against_field.append(psnr(float(np.mean((drawn - shown) ** 2))))
        against_truth.append(psnr(float(np.mean((drawn - photograph / 255.0) ** 2))))
        pictures.append(np.concatenate([photograph / 255.0, shown, drawn], axis=1))
        print(
            f"{len(made.centres)} splats, {scene.views[index].name}: against the field "
            f"{against_field[-1]:.2f} dB, against the truth {against_truth[-1]:.2f} dB",
            flush=True,
        )
    if arguments.picture:
        pixels = np.round(255.0 * pictures[min(2, len(pictures) - 1)]).astype(np.uint8)
        Image.fromarray(pixels).save(arguments.picture, quality=88)
    record = {
        "machine": machine(arguments.device, field.workers.count),
        "steps": arguments.steps,
        "voxel_edge": float(field.lattice.voxel_size.mean()),
        "mesh": rows,
        "splats": {
            "count": len(made.centres),
            "psnr_against_field": against_field,
            "psnr_against_truth": against_truth,
        },
    }
    print(f"wrote {write_record(record, arguments.output, 'mesh', arguments.device)}")


if __name__ == "__main__":
    main()
