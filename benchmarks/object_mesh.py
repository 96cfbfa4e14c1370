"""Meshes of the object of object_scan.py, compared with its surfaces, which are known exactly.

    python benchmarks/object_scan.py crane
    warpnerf train crane --output runs/crane && warpnerf export runs/crane crane.ply
    python benchmarks/object_mesh.py crane.ply

Chamfer distance: the mean of the distance from points spread over the mesh to the nearest true
surface, and of that from what the training cameras see, exactly traced, to the nearest of these
points. The second one by itself for thin parts: bars and ropes of at most THIN across. Surfaces
within other solids count as well, for all meshes alike. The distance between points and their
nearest neighbours, which no mesh can come below by much, is printed beside. Meshes may be of other
versions, or programs, in the units and axes of the capture. Prints a table; writes
benchmarks/results/object_mesh_<device>.json. Needs scipy and trimesh.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from measuring import machine, options, write_record
from object_scan import ANGLE_X, AWAY, RADIUS, poses, solids, tracer, turning
from scipy.spatial import cKDTree
from solids_truth import distances_to

from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.overlap import content_at

THIN = 0.03
"""Scene units across, in two directions."""
POINTS = 4_000_000
"""That are spread over a mesh."""
CHECKED = 200_000
"""Of these, how many are compared with the solids."""
SEEN_SIZE = 160
"""Width and height of the pictures that say what cameras see, pixels."""
CAMERAS = 100
"""Those of the training views of object_scan.py."""

COLUMNS = {
    "mesh_to_truth": "mesh->truth",
    "truth_to_mesh": "truth->mesh",
    "chamfer": "chamfer",
    "thin_mean": "thin, mean",
    "thin_median": "median",
    "thin_most": "nine tenths",
    "apart": "points",
}


def main() -> None:
    parser = options(__doc__ or "")
    parser.add_argument("meshes", nargs="+", type=Path, help="files that trimesh reads")
    parser.add_argument("--about", default="", help="how the meshes were made, for the record")
    parser.add_argument("--edge", type=float, help="of a voxel, scene units, to compare with")
    arguments = parser.parse_args()
    crane = list(solids())[1:]  # the first is the room around it
    truth, rows = seen_points(), []
    thin = np.array([np.sort(np.subtract(s.hi, s.lo))[1] <= THIN for s in crane])
    is_thin = thin[distances_to(truth, crane)[1]]
    print("thousandths of a scene unit")
    print("".join(f"{column:>13}" for column in COLUMNS.values()))
    for path in arguments.meshes:
        mesh = trimesh.load(path, force="mesh")
        points, _ = trimesh.sample.sample_surface(mesh, POINTS, seed=0)
        points = np.asarray(points) @ turning()  # the inverse, of rows
        some = points[:: POINTS // CHECKED]
        tree = cKDTree(points)
        to_truth, to_mesh = distances_to(some, crane)[0], tree.query(truth)[0]
        row = {
            "mesh": path.name,
            "faces": len(mesh.faces),
            "mesh_to_truth": float(to_truth.mean()),
            "truth_to_mesh": float(to_mesh.mean()),
            "chamfer": float(0.5 * (to_truth.mean() + to_mesh.mean())),
            "thin_mean": float(to_mesh[is_thin].mean()),
            "thin_median": float(np.median(to_mesh[is_thin])),
            "thin_most": float(np.quantile(to_mesh[is_thin], 0.9)),
            "apart": float(tree.query(some, 2)[0][:, 1].mean()),
        }
        print("".join(f"{1e3 * row[name]:13.2f}" for name in COLUMNS) + f"   {path.name}")
        if arguments.edge:
            row["thin_within_half_a_voxel"] = float(
                (to_mesh[is_thin] <= 0.5 * arguments.edge).mean()
            )
            print(f"  of thin parts, within half a voxel: {row['thin_within_half_a_voxel']:.1%}")
        rows.append(row)
    record = {
        "machine": machine(arguments.device, 1),
        "about": arguments.about,
        "edge": arguments.edge,
        "thin": THIN,
        "rows": rows,
    }
    print(f"wrote {write_record(record, arguments.output, 'object_mesh', arguments.device)}")


def seen_points() -> np.ndarray:
    """What the training cameras see of the object before it is turned, [n, 3] scene units."""
    focal, middle = 0.5 * SEEN_SIZE / np.tan(0.5 * ANGLE_X), 0.5 * SEEN_SIZE
    size = {"width": SEEN_SIZE, "height": SEEN_SIZE}
    points = []
    for c2w in poses(CAMERAS, 0):
        camera = Camera(**size, fx=focal, fy=focal, cx=middle, cy=middle, c2w=c2w)
        depth = tracer().depth(camera)
        v, u = np.nonzero(depth < AWAY + RADIUS)  # the object's pixels
        points.append(content_at(camera, u + 0.5, v + 0.5, depth[v, u]))
    return np.concatenate(points)


if __name__ == "__main__":
    main()
