"""warpnerf as a method of nerfbaselines: ``nerfbaselines train --method warpnerf``.

nerfbaselines imports this module through the entry point ``nerfbaselines.specs``; nothing else of
warpnerf does. Its cameras have OpenCV axes and lengths as in the dataset's files.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from nerfbaselines import register

from warpnerf.checks import InputError
from warpnerf.config import TrainConfig
from warpnerf.presets import PRESETS
from warpnerf.runs.checkpoint import load_checkpoint, save_checkpoint
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.focus import estimate_extent
from warpnerf.scenes.cameras.overlap import in_picture
from warpnerf.scenes.cameras.undistort import seen_pixels
from warpnerf.scenes.extent.points import Points, extent_by_points, usable
from warpnerf.scenes.scene import Scene, View
from warpnerf.training.coarse import prepare_trainer
from warpnerf.training.state import TrainingState
from warpnerf.training.trainer import Trainer

COEFFICIENTS_OF = {
    "pinhole": (),
    "opencv": ("k1", "k2", "p1", "p2"),
    "opencv_fisheye": ("k1", "k2", "k3", "k4"),
    "full_opencv": ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"),
}
"""What lenses of nerfbaselines are bent by."""
LENSES = tuple(COEFFICIENTS_OF)
"""By the number that its cameras hold."""

FEATURES = ("color", "points3D_xyz")
"""What is requested of datasets; points are left out by those that have none."""

MIN_IN_PICTURES = 0.95
"""Share of a dataset's points that at least two of its cameras must have in their pictures. Matched
points are; those of a model that is not the dataset's lie anywhere, and its loaders do not look."""

CHECKPOINT = "checkpoint.safetensors"

OPTIONS: dict[str, type] = {
    "preset": str,
    "model": str,
    "field": str,
    "sampler": str,
    "scaling": str,
    "appearance": str,
    "steps": int,
    "rays_per_step": int,
    "seed": int,
    "threads": int,
    "voxels": int,
    "content_distance": float,
    "device": str,
}
"""What --set takes, and how each is read; fields of ``TrainConfig`` and ``GridConfig``."""

WORDS = {"content_distance": ("auto", "per-camera"), "voxels": ("auto",)}
"""What some of them may be instead."""


class WarpnerfMethod:
    """A training, or what one has left, behind the interface ``nerfbaselines.Method``.

    An iteration is a step of training, a batch of rays. Later in a training one update follows
    several steps, so the first iteration of these does the work of all.
    """

    def __init__(
        self,
        *,
        checkpoint: str | None = None,
        train_dataset: Any = None,
        config_overrides: dict[str, Any] | None = None,
    ) -> None:
        """Begin a training, resume one, or open what it has left.

        Args:
            checkpoint: A folder that ``save`` wrote; None: begin again.
            train_dataset: Photographs and cameras; None: only to render.
            config_overrides: Names and values of ``OPTIONS``, for a new training.

        Raises:
            InputError: There is nothing to begin with, or an option does not fit.
        """
        state = None if checkpoint is None else load_checkpoint(Path(checkpoint) / CHECKPOINT)
        self._checkpoint = checkpoint
        self._loaded_step = None if state is None else state.progress.step
        self._trainer: Trainer | None = None
        self._state = state
        if train_dataset is not None:
            background = train_dataset["metadata"].get("background_color")
            config = (
                configured(config_overrides or {}, background) if state is None else state.config
            )
            self._trainer = prepare_trainer(scene_of(train_dataset), config, state)
            self._config = config
        elif state is not None:
            self._config = state.config
        else:
            raise InputError("there is nothing to render: give a checkpoint or a dataset.")

    @classmethod
    def get_method_info(cls) -> dict[str, Any]:
        """What the method takes and gives."""
        return {
            "method_id": "warpnerf",
            "required_features": frozenset(FEATURES),
            "supported_camera_models": frozenset(LENSES),
            "supported_outputs": ("color", "depth", "accumulation"),
            "can_resume_training": True,
        }

    def get_info(self) -> dict[str, Any]:
        """The same, and of this training its length, where it began and its configuration."""
        config = asdict(self._config)
        plain = {k: v for k, v in config.items() if isinstance(v, int | float | str | bool)}
        return {
            **self.get_method_info(),
            "num_iterations": self._config.steps,
            "loaded_step": self._loaded_step,
            "loaded_checkpoint": self._checkpoint,
            "batch_size": self._config.rays_per_step,
            "hparams": plain,
        }

    def get_train_embedding(self, index: int) -> None:
        """None: photographs have no embeddings."""

    def optimize_embedding(self, dataset: Any, *, embedding: Any = None) -> dict[str, Any]:
        """Refuse it: photographs have no embeddings.

        Raises:
            InputError: Always.
        """
        raise InputError("warpnerf has no embeddings of photographs to optimise.")

    def train_iteration(self, step: int) -> dict[str, float]:
        """Update, unless the last update went beyond this step already.

        Args:
            step: Steps before it.

        Returns:
            Loss and PSNR of the last batch of rays.
        """
        trainer = self._trainer
        if trainer is None:
            raise InputError("this was opened to render; give the dataset to train.")
        while trainer.steps_done <= step and trainer.fraction < 1.0:
            trainer.update()
        if not trainer.report_due:
            return {"num_rays": self._config.rays_per_step}
        progress = trainer.report()
        return {
            "num_rays": self._config.rays_per_step,
            "loss": progress.loss,
            "psnr": progress.psnr,
        }

    def render(
        self, camera: Any, *, options: dict[str, Any] | None = None
    ) -> dict[str, np.ndarray]:
        """Look through a camera of nerfbaselines.

        Args:
            camera: One.
            options: Which ``outputs`` are wanted, None: all; and by ``output_type_dtypes`` whether
                color shall be float32.

        Returns:
            color [H, W, 3] uint8, depth [H, W] in the dataset's units, and accumulation [H, W],
            both float32. Color is rounded to 8 bits here: nerfbaselines would cut it off, which
            costs up to 0.1 dB.
        """
        seen = self._standing().field.render(camera_of(camera.item()))
        color = seen.rgb
        if (options or {}).get("output_type_dtypes", {}).get("color", "uint8") == "uint8":
            color = np.rint(color * 255.0).astype(np.uint8)
        outputs = {"color": color, "depth": seen.depth, "accumulation": seen.opacity}
        wanted = (options or {}).get("outputs") or tuple(outputs)
        return {name: outputs[name] for name in wanted if name in outputs}

    def save(self, path: str) -> None:
        """Write all that it takes to resume and to render.

        Args:
            path: A folder, which is made where it is missing.
        """
        Path(path).mkdir(parents=True, exist_ok=True)
        save_checkpoint(Path(path) / CHECKPOINT, self._standing())

    def _standing(self) -> TrainingState:
        """The training as it stands, or as it was when it was saved."""
        if self._trainer is not None:
            return self._trainer.state()
        assert self._state is not None
        return self._state


def configured(overrides: dict[str, Any], background: np.ndarray | None) -> TrainConfig:
    """The configuration that --set requests.

    Args:
        overrides: Names and values of ``OPTIONS``; a preset, "fast" unless named, is the start,
            with photographs as they are.
        background: [3] uint8, what is behind the photographs of the dataset, if it says so.

    Raises:
        InputError: A name is unknown, or a value does not fit.
    """
    given: dict[str, Any] = {}
    for name, value in overrides.items():
        if name not in OPTIONS:
            raise InputError(f"--set {name}: there is no such option; use {', '.join(OPTIONS)}.")
        kind = OPTIONS[name]
        try:
            given[name] = value if value in WORDS.get(name, ()) else kind(value)
        except ValueError:
            raise InputError(f"--set {name} must be {kind.__name__}, not {value!r}.") from None
    preset = given.pop("preset", "fast")
    if preset not in PRESETS:
        raise InputError(f"--set preset must be {' or '.join(PRESETS)}, not {preset!r}.")
    # Its protocols measure test views as they are, whatever their exposure.
    config = replace(PRESETS[preset], appearance="none")
    if "steps" in given:
        config = replace(config, time_limit=None)
    if "voxels" in given:
        given["grid"] = replace(config.grid, voxels=given.pop("voxels"))
    for name in ("model", "field", "sampler"):
        if given.get(name) == getattr(config, name).name:  # as the preset has it, not by default
            del given[name]
    if background is not None:
        given["background"] = tuple(float(c) / 255.0 for c in background)
    return replace(config, **given)


def scene_of(dataset: Any) -> Scene:
    """A scene of the training photographs of a dataset.

    Box and content distance are those of its points, where it has some that its cameras see.

    Args:
        dataset: ``nerfbaselines.Dataset`` with its images loaded.

    Raises:
        InputError: A lens is of a kind that is not read, or cameras do not make a scene.
    """
    cameras, images, masks = dataset["cameras"], dataset["images"], dataset.get("masks")
    names = _names(dataset["image_paths"], dataset["image_paths_root"])
    views = []
    for index, name in enumerate(names):
        camera = camera_of(cameras[index])
        image = np.asarray(images[index])[: camera.height, : camera.width]
        mask = seen_pixels(camera)
        if masks is not None and masks[index] is not None:
            given = np.asarray(masks[index])[: camera.height, : camera.width] > 0
            mask = given if mask is None else given & mask
        if mask is not None and not mask.any():
            continue
        views.append(View(name=name, camera=camera, image=np.ascontiguousarray(image), mask=mask))
    order = sorted(range(len(views)), key=lambda i: views[i].name)
    views = [views[i] for i in order]
    see_through = [v.image.shape[2] == 4 and bool((v.image[..., 3] < 255).any()) for v in views]
    unbounded = sum(see_through) < len(views) / 2
    cameras = [view.camera for view in views]
    extent, observed = estimate_extent(cameras, unbounded=unbounded), None
    training = range(len(views))
    points = _points(dataset.get("points3D_xyz"), cameras)
    if points is not None:
        extent, observed = extent_by_points(extent, points, views, training, unbounded)
    return Scene(
        name=str(dataset["metadata"].get("scene") or "dataset"),
        views=views,
        splits={"train": tuple(training), "test": ()},
        box_min=extent.box_min,
        box_max=extent.box_max,
        unbounded=unbounded,
        content_distance=extent.content_distance,
        content_distances=None if observed is None else observed.distances,
        guessed=extent.guessed and observed is None,
        near_content=None if observed is None else observed.near_content,
        observations=None if observed is None else observed.observations,
        points=None if observed is None or points is None else points.sample,
        notes=extent.notes,
    )


def _points(positions: Any, cameras: Sequence[Camera]) -> Points | None:
    """The points of a dataset, [n, 3], if there are some and they are where its cameras look."""
    if positions is None:
        return None
    given = np.asarray(positions, np.float64).reshape(-1, 3)
    points = Points(positions=given[usable(given)], tracks=None, source="the dataset")
    if not len(points.positions):
        return None
    in_pictures = np.sum([in_picture(camera, points.sample) for camera in cameras], axis=0)
    return points if np.mean(in_pictures >= 2) >= MIN_IN_PICTURES else None


def camera_of(camera: Any) -> Camera:
    """One camera of nerfbaselines as ours.

    Args:
        camera: Its pose [3, 4] camera to world in OpenCV axes, fx, fy, cx, cy in pixels, and
            the first of the distortion parameters k1, k2, p1, p2, k3, k4, k5, k6, or all.

    Raises:
        InputError: The lens is of a kind that is not read.
    """
    number = int(camera.camera_models)
    if not 0 <= number < len(LENSES):
        raise InputError(
            f"a lens of the kind {number} is not read; undistort the photographs to one of "
            f"{', '.join(LENSES)}."
        )
    lens = LENSES[number]
    fx, fy, cx, cy = (float(value) for value in camera.intrinsics)
    given = np.asarray(camera.distortion_parameters, np.float64)
    order = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    values = dict(zip(order, map(float, given), strict=False))
    bent: dict[str, Any] = {name: values.get(name, 0.0) for name in COEFFICIENTS_OF[lens]}
    c2w = np.array(camera.poses, np.float64)[:3, :4]
    c2w[:, 1:3] *= -1.0  # from OpenCV's axes to OpenGL's
    width, height = (int(value) for value in camera.image_sizes)
    return Camera(
        width=width,
        height=height,
        fx=fx,
        fy=fy,
        cx=cx,
        cy=cy,
        c2w=c2w,
        fisheye=lens == "opencv_fisheye",
        **bent,
    )


def _names(paths: Sequence[str], root: str) -> list[str]:
    return [Path(path).relative_to(root).as_posix() if root else path for path in paths]


register(
    {
        "id": "warpnerf",
        "method_class": "warpnerf.nerfbaselines:WarpnerfMethod",
        "metadata": {
            "name": "warpnerf",
            "description": "Voxel-grid radiance fields with NVIDIA Warp, on the CPU or on CUDA; "
            "gradients are scaled by distance, so that fewer floaters grow near the cameras.",
        },
        "presets": {name: {"preset": name} for name in PRESETS},
        "required_features": list(FEATURES),
        "supported_camera_models": list(LENSES),
        "supported_outputs": ["color", "depth", "accumulation"],
    }
)
