"""Structure from motion by pycolmap: features, matches, and a sparse model of poses and points.

Run as a process of its own, ``python -m warpnerf.sfm.mapping``, which ``sfm.worker`` starts: it can
be ended at any moment, and an abort in C++ ends nothing else. The job comes as a line of JSON on
standard input, reports and the result go out as lines of JSON on standard output.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.focus import up_direction
from warpnerf.scenes.formats.colmap_files import PARAMETERS

SEED = 0
MAX_FEATURES = 4096
"""Of a photograph. Comparing two goes with their number: 8192 take twice as long, for a tenth more
points in common."""
MIN_MODEL = 3
"""Photographs of the smallest model that counts."""

EXHAUSTIVE_BLOCK = 10
"""Photographs whose features are in memory at a time, squared: small, so that progress shows."""

FORWARD_ANGLE = 4.0
"""Degrees between the rays of the first two photographs that are enough when COLMAP's 16 are not
to be had, as where a camera moves forward."""

Report = Callable[..., None]


def main() -> int:
    """Do the job on standard input; 0 when its result was written."""
    lines = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what C++ prints is no report

    def report(**content: Any) -> None:
        lines.write(json.dumps(content) + "\n")
        lines.flush()

    job = json.loads(sys.stdin.readline())
    threading.Thread(target=_end_with_parent, daemon=True).start()
    report(result=run(job, report))
    return 0


def _end_with_parent() -> None:
    """Standard input ends when the process that started this one does, however it ends."""
    sys.stdin.read()
    os._exit(1)


def run(job: dict[str, Any], report: Report) -> dict[str, Any]:
    """Estimate poses.

    Args:
        job: As ``sfm.worker`` makes it.
        report: Called with ``stage``, ``done`` and ``of`` when a stage begins, and on the way where
            COLMAP says how far it is.

    Returns:
        What was found. The model is in the job's ``model`` folder, with z up.
    """
    import pycolmap

    pycolmap.logging.minloglevel = 2
    pycolmap.set_random_seed(SEED)
    database = Path(job["work"]) / "database.db"
    n = len(job["photographs"])
    report(stage="features", done=0, of=n)
    pycolmap.Database.open(database).close()
    _extract(pycolmap, job, database)
    with closing(pycolmap.Database.open(database)) as opened:
        features = {
            i.name: opened.num_keypoints_for_image(i.image_id) for i in opened.read_all_images()
        }
    unread = [p["name"] for p in job["photographs"] if p["name"] not in features]
    if unread:
        return {"unread": unread}
    report(stage="matches", done=0, of=_pairs(n, job["matching"]))
    _match(pycolmap, job, database)
    models = _map(pycolmap, job, database, report)
    if not models:
        return {"registered": {}, "features": features, "links": _links(pycolmap, database, set())}
    best = models[0]
    _turn_upright(pycolmap, best, {p["name"]: p["up"] for p in job["photographs"]})
    Path(job["model"]).mkdir(parents=True)
    best.write_binary(job["model"])
    best.export_PLY(job["points"])
    placed = {best.image(number).name: best.image(number) for number in best.reg_image_ids()}
    return {
        "registered": {name: _pose(image) for name, image in placed.items()},
        "cameras": {name: _camera(best.camera(image.camera_id)) for name, image in placed.items()},
        "points": best.num_points3D(),
        "error": best.compute_mean_reprojection_error(),
        "groups": [[m.image(number).name for number in m.reg_image_ids()] for m in models],
        "features": features,
        "links": _links(pycolmap, database, set(placed)),
    }


def _extract(pycolmap: Any, job: dict[str, Any], database: Path) -> None:
    """SIFT features of all photographs, on the CPU; those of one lens together."""
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads, options.max_image_size = job["threads"], job["max_image_size"]
    options.sift.max_num_features = MAX_FEATURES
    for lens in sorted({p["lens"] for p in job["photographs"]}):
        members = [p for p in job["photographs"] if p["lens"] == lens]
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = members[0]["camera_model"]
        if job["masks"] is not None:
            reader.mask_path = job["masks"]
        which = {
            "image_names": [p["name"] for p in members],
            "camera_mode": pycolmap.CameraMode.SINGLE,
        }
        # Photographs get their numbers here, in the order of their names: extraction would number
        # them as its threads are done, and what is placed first depends on the numbers.
        pycolmap.import_images(database, job["images"], options=reader, **which)
        pycolmap.extract_features(
            database,
            job["images"],
            reader_options=reader,
            extraction_options=options,
            device=pycolmap.Device.cpu,
            **which,
        )


def _match(pycolmap: Any, job: dict[str, Any], database: Path) -> None:
    options = pycolmap.FeatureMatchingOptions()
    options.num_threads = job["threads"]
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    common = {
        "matching_options": options,
        "verification_options": verification,
        "device": pycolmap.Device.cpu,
    }
    if job["matching"] == "exhaustive":
        pairing = pycolmap.ExhaustivePairingOptions()
        pairing.block_size = EXHAUSTIVE_BLOCK
        pycolmap.match_exhaustive(database, pairing_options=pairing, **common)
    else:
        # Besides the next ten, those 16, 32, ... further on: they join a path that comes back.
        pairing = pycolmap.SequentialPairingOptions()
        pairing.quadratic_overlap = True
        pycolmap.match_sequential(database, pairing_options=pairing, **common)


def _map(pycolmap: Any, job: dict[str, Any], database: Path, report: Report) -> list[Any]:
    """The models, that of most photographs first."""
    n = len(job["photographs"])
    report(stage="poses", done=0, of=n)
    if job["mapper"] == "global":
        pycolmap.calibrate_view_graph(database)
        options = pycolmap.GlobalPipelineOptions()
        options.num_threads, options.random_seed = 1, SEED
        options.min_model_size = MIN_MODEL
        folder = Path(job["work"]) / "global"
        folder.mkdir()
        found = pycolmap.global_mapping(database, job["images"], folder, options)
        return _by_size(found)
    models = _grow(pycolmap, job, database, report, angle=None)
    if not models or 2 * models[0].num_reg_images() < n:
        again = _grow(pycolmap, job, database, report, angle=FORWARD_ANGLE)
        models = max(models, again, key=lambda m: m[0].num_reg_images() if m else 0)
    return models


def _grow(
    pycolmap: Any, job: dict[str, Any], database: Path, report: Report, angle: float | None
) -> list[Any]:
    """Models by placing photograph after photograph."""
    n = len(job["photographs"])
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = 1, SEED
    options.min_model_size = MIN_MODEL
    if angle is not None:
        options.mapper.init_min_tri_angle = angle
        options.mapper.init_max_forward_motion = 1.0
    done = 0

    def placed() -> None:
        nonlocal done
        done += 1
        report(stage="poses", done=min(done, n), of=n)

    folder = Path(job["work"]) / f"incremental-{angle}"
    folder.mkdir()
    found = pycolmap.incremental_mapping(
        database,
        job["images"],
        folder,
        options=options,
        initial_image_pair_callback=placed,
        next_image_callback=placed,
    )
    return _by_size(found)


def _by_size(found: dict[int, Any]) -> list[Any]:
    models = [model for model in found.values() if model.num_reg_images() >= MIN_MODEL]
    return sorted(models, key=lambda model: -model.num_reg_images())


def _turn_upright(pycolmap: Any, model: Any, up: dict[str, list[int]]) -> None:
    """Turn a model so that z is up, as far as its cameras tell; nothing is moved or scaled."""
    cameras = []
    for number in model.reg_image_ids():
        image = model.image(number)
        right, above = up[image.name]
        c2w = np.array(_pose(image))
        # As if the camera had been held upright.
        turned = np.array([[above, right, 0.0], [-right, above, 0.0], [0.0, 0.0, 1.0]])
        c2w[:, :3] = c2w[:, :3] @ turned
        cameras.append(Camera(width=1, height=1, fx=1.0, fy=1.0, cx=0.5, cy=0.5, c2w=c2w))
    z = up_direction(cameras)
    x = np.cross(np.eye(3)[int(np.argmin(np.abs(z)))], z)
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(rotation), np.zeros(3)))


def _pose(image: Any) -> list[list[float]]:
    """Camera to world, [3, 4], OpenGL axes."""
    c2w = np.array(image.cam_from_world().inverse().matrix())
    c2w[:, 1:3] *= -1.0
    return c2w.tolist()


def _camera(camera: Any) -> dict[str, Any]:
    names = PARAMETERS[camera.model_name]
    values = dict(zip(names, map(float, camera.params), strict=True))
    if "fl" in values:
        focal = values.pop("fl")
        values = {"fl_x": focal, "fl_y": focal} | values
    return {"model": camera.model_name, "w": camera.width, "h": camera.height, **values}


def _links(pycolmap: Any, database: Path, placed: set[str]) -> dict[str, tuple[int, str]]:
    """For each photograph that was not placed: most points shared with one, and its name."""
    best: dict[str, tuple[int, str]] = {}
    with closing(pycolmap.Database.open(database)) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        for pair, shared in zip(*opened.read_two_view_geometry_num_inliers(), strict=True):
            first, second = (names[number] for number in pycolmap.pair_id_to_image_pair(pair))
            for one, other in ((first, second), (second, first)):
                if one not in placed and shared > best.get(one, (0, ""))[0]:
                    best[one] = shared, other
    return best


def _pairs(n: int, matching: str) -> int:
    """Pairs of photographs that are matched."""
    if matching == "exhaustive":
        return n * (n - 1) // 2
    steps = {*range(1, 11), *(2**k for k in range(10))}
    return sum(max(n - step, 0) for step in steps)


if __name__ == "__main__":
    sys.exit(main())
