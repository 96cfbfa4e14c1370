"""Export of a scene as a folder that others train on: photographs, cameras twice, and points.

transforms.json      cameras as nerfstudio and instant-ngp have them, with the split
sparse/0/*.txt       the same as a COLMAP model, for gsplat, 3DGS, Brush
points.ply           points of the trained surface, which transforms.json names
images/              the photographs as they were trained on
masks/               white where pixels count, where any photograph has a mask
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warpnerf.exporting.mesh import points_ply
from warpnerf.exporting.surface import Surface
from warpnerf.media.pictures import picture_files
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.quaternions import quaternions
from warpnerf.scenes.formats.transforms_text import PosedFile, transforms_text
from warpnerf.scenes.scene import Scene

MAX_POINTS = 100_000
"""Points that are written, at most: enough to begin splats from."""


def write_scene(folder: Path, scene: Scene, surface: Surface) -> None:
    """Write the dataset into an empty folder.

    Args:
        folder: Empty.
        scene: What to write; images as they are in memory, so reduced where the run's were.
        surface: Of the field that was trained on it.

    Raises:
        OSError: It cannot be written.
    """
    from PIL import Image

    points = thinned(surface)
    files = picture_files([view.name for view in scene.views], stems=True)
    (folder / "images").mkdir()
    (folder / "sparse" / "0").mkdir(parents=True)
    (folder / "transforms.json").write_text(transforms_json(scene, files))
    (folder / "points.ply").write_bytes(b"".join(points_ply(points)))
    for name, text in colmap_text(scene, files, points).items():
        (folder / "sparse" / "0" / name).write_text(text)
    if _masked(scene):
        (folder / "masks").mkdir()
    for view in scene.views:
        Image.fromarray(view.image).save(folder / "images" / files[view.name])
        if _masked(scene):
            size = (view.camera.height, view.camera.width)
            kept = np.ones(size, bool) if view.mask is None else view.mask
            Image.fromarray(kept).convert("L").save(folder / "masks" / files[view.name])


def thinned(surface: Surface) -> Surface:
    """A surface without its faces, and with MAX_POINTS of its vertices at random, the same ones."""
    n = len(surface.points)
    chosen = np.sort(np.random.default_rng(0).permutation(n)[:MAX_POINTS])
    return Surface(
        points=surface.points[chosen],
        faces=np.zeros((0, 3), np.int32),
        normals=surface.normals[chosen],
        rgb=surface.rgb[chosen],
    )


def transforms_json(scene: Scene, files: dict[str, str]) -> str:
    """The text of transforms.json.

    Args:
        scene: Its views and splits.
        files: Names of the photographs in images/, by the names of the views.
    """
    names = [files[view.name] for view in scene.views]
    posed = [
        PosedFile(
            path=f"images/{name}",
            camera=view.camera,
            mask=f"masks/{name}" if _masked(scene) else None,
        )
        for name, view in zip(names, scene.views, strict=True)
    ]
    given = {split: indices for split, indices in scene.splits.items() if indices}
    test = given.get("test", given["train"])
    given = {"train": given["train"], "val": test, "test": test} | given  # nerfstudio wants all
    splits = {split: [posed[index].path for index in of] for split, of in given.items()}
    return transforms_text(posed, "points.ply", splits)


def colmap_text(scene: Scene, files: dict[str, str], points: Surface) -> dict[str, str]:
    """The files of a COLMAP model as text; its points have no tracks.

    Args:
        scene: Its views.
        files: Names of the photographs, by the names of the views.
        points: What goes to points3D.txt.

    Returns:
        Texts, by the files' names.
    """
    lenses: dict[str, int] = {}
    images = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; then its points: none"]
    for number, view in enumerate(scene.views, 1):
        lens = lenses.setdefault(_lens(view.camera), len(lenses) + 1)
        rotation, translation = _world_to_camera(view.camera)
        pose = " ".join(f"{x:.17g}" for x in (*rotation, *translation))
        images += [f"{number} {pose} {lens} {files[view.name]}", ""]
    cameras = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMETERS"]
    cameras += [f"{number} {lens}" for lens, number in lenses.items()]
    colour = np.round(255.0 * points.rgb).astype(int)
    digits = ".7g" if points.points.dtype == np.float32 else ".12g"
    rows = [
        f"{number} {x:{digits}} {y:{digits}} {z:{digits}} {r} {g} {b} 0"
        for number, ((x, y, z), (r, g, b)) in enumerate(
            zip(points.points.tolist(), colour.tolist(), strict=True), 1
        )
    ]
    texts = {
        "cameras.txt": cameras,
        "images.txt": images,
        "points3D.txt": ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK", *rows],
    }
    return {name: "\n".join(lines) + "\n" for name, lines in texts.items()}


def _masked(scene: Scene) -> bool:
    """Whether any photograph has a mask: nerfstudio wants one for all, then."""
    return any(view.mask is not None for view in scene.views)


def camera_model(camera: Camera) -> str:
    """COLMAP's camera model that a lens is exported as, such as PINHOLE or OPENCV."""
    return _lens(camera).partition(" ")[0]


def _lens(camera: Camera) -> str:
    """A lens as cameras.txt has it, in the simplest of COLMAP's models that holds it."""
    model, numbers = "PINHOLE", [camera.fx, camera.fy, camera.cx, camera.cy]
    bent = [camera.k1, camera.k2, camera.p1, camera.p2]
    if camera.fisheye:
        model, numbers = "OPENCV_FISHEYE", [*numbers, *camera.radial]
    elif camera.k3 != 0.0 or camera.rational:
        divisor = [camera.k4, camera.k5, camera.k6]
        model, numbers = "FULL_OPENCV", [*numbers, *bent, camera.k3, *divisor]
    elif any(bent):
        model, numbers = "OPENCV", [*numbers, *bent]
    text = " ".join(f"{x:.17g}" for x in numbers)
    return f"{model} {camera.width} {camera.height} {text}"


def _world_to_camera(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Quaternion w, x, y, z and translation, world to camera in OpenCV axes."""
    rotation = (camera.c2w[:, :3] * [1.0, -1.0, -1.0]).T
    return quaternions(rotation[None])[0], -rotation @ camera.position
