"""A training between two updates, as a value: all that it takes to resume exactly as before."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import numpy as np
import warp as wp

from warpnerf.checks import InputError
from warpnerf.config import TrainConfig
from warpnerf.model.interface import Model
from warpnerf.model.sampler_kinds import SamplerKind
from warpnerf.model.storage_kinds import AUTO_FIELD, StorageKind
from warpnerf.rendering.field import Field
from warpnerf.scenes.cameras.focus import find_focus
from warpnerf.scenes.scene import Scene
from warpnerf.training.plan import OlderPlan, TrainingPlan

MAY_CHANGE = ("device", "threads", "checkpoint_every")
"""Fields of TrainConfig that a resumed training may change: what is computed stays the same. The
first two change how sums are rounded, and so the last bits."""

MAY_GROW = ("steps", "time_limit")
"""Fields that it may raise. Learning rates, growth and weights of losses then follow the longer
schedule."""


@dataclass(frozen=True, kw_only=True)
class Progress:
    """Training progress."""

    step: int
    """Steps done."""
    fraction: float
    """Of the whole training, [0, 1]."""
    seconds: float
    """Of training, those before a resumption included; compiling does not count."""
    loss: float
    """Of the last update: mean over its rays of what is minimised, by weights as they are then."""
    psnr: float
    """Of the squared error of the last update's rays, dB; in the field's colours, where exposures
    are taken out of the photographs, and of averages of pixels while the grid is coarse
    (``TrainConfig.average_pixels``)."""
    samples_per_ray: float
    """Visited steps per ray of the last update."""
    size: tuple[int, int, int]
    """Nodes of the grid."""
    occupied: float
    """Share of cells that are not free, [0, 1]."""
    seen: float = 1.0
    """Share of the pixels, as blocks of them tell, that rays are drawn from, (0, 1]; those of all
    others meet nothing, and ``loss``, ``psnr`` and ``samples_per_ray`` do not count them."""

    test_psnr: float | None = None
    """Mean over a few test views, dB, where they were rendered since the last report
    (``held_out.HeldOut``)."""

    @property
    def picture_psnr(self) -> float:
        """PSNR over whole pictures, dB: pixels that rays are not drawn from count as exact."""
        return self.psnr - 10.0 * math.log10(self.seen)

    def __str__(self) -> str:
        """Step, loss, PSNR, grid size and steps per second, in a line."""
        speed = self.step / max(self.seconds, 1e-6)
        size = " x ".join(str(n) for n in self.size)
        drawn = f" ({self.psnr:.2f} over {self.seen:.0%} of pixels)"
        test = "" if self.test_psnr is None else f"test PSNR {self.test_psnr:.2f}  "
        return (
            f"step {self.step}  loss {self.loss:.5f}  "
            f"PSNR {self.picture_psnr:.2f}{drawn if self.seen < 1.0 else ''}  {test}"
            f"grid {size}  {speed:.1f} steps/s"
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class TrainingState:
    """A checkpoint in memory: a training between two updates. Batches are functions of seed and
    step: no random state."""

    plan: TrainingPlan | OlderPlan
    """What it goes by; on the CPU with the number of threads that it used."""
    scene_digest: str
    """``scene_digest`` of what it trains on."""
    grown: int
    """How often the grid has grown."""
    updates: int
    """How often the optimiser has updated the grid."""
    restarted: int = 0
    """Updates before the optimiser last restarted, see ``OptimConfig.restart_at_growth``."""
    progress: Progress
    """Where it stands: steps done, seconds, loss."""
    field: Field
    """Grid, weights, free space; live arrays if from a trainer, which its next update changes."""
    optimiser: dict[str, dict[str, wp.array]]
    """What the optimiser keeps of each parameter, by its name."""

    @property
    def config(self) -> TrainConfig:
        """The training configuration."""
        return self.plan.config

    def copied_to(self, device: wp.Device) -> TrainingState:
        """A deep copy: the same training with arrays of its own.

        Args:
            device: Where they lie.

        Returns:
            A state that no trainer changes.
        """
        optimiser = {
            name: {key: wp.clone(array, device=device) for key, array in arrays.items()}
            for name, arrays in self.optimiser.items()
        }
        return replace(self, field=self.field.copied_to(device), optimiser=optimiser)

    def decided(self, config: TrainConfig) -> TrainConfig:
        """A configuration to resume with, with what auto stands for in this training.

        Args:
            config: How to resume.

        Returns:
            The same, or with the field and voxels that the training began with.
        """
        plan = self.plan
        if isinstance(plan, OlderPlan):  # when these were made, nothing was auto
            return config
        decided, begun = config.for_kind(plan.kind), plan.config
        if config.field == AUTO_FIELD and type(decided.field) is type(begun.field):
            decided = replace(decided, field=begun.field)  # another version's had other options
        if config.grid.voxels == "auto":
            decided = replace(decided, grid=replace(decided.grid, voxels=begun.grid.voxels))
        return decided

    def plan_of(self, scene: Scene, config: TrainConfig) -> TrainingPlan:
        """The training plan to resume by: the one that it began with.

        Args:
            scene: What it trains on.
            config: Its own, but for what may change, see MAY_CHANGE.

        Returns:
            That plan, with this configuration.
        """
        plan = self.plan
        if isinstance(plan, OlderPlan):
            plan = plan.completed(scene, self.field.lattice.space)
        return replace(plan, config=self.decided(config))

    def require_same(self, scene: Scene, config: TrainConfig) -> None:
        """Raise InputError unless this scene and configuration would continue as begun.

        Args:
            scene: Photographs and cameras.
            config: How to resume.

        Raises:
            InputError: A field that decides the result differs, or the photographs do.
        """
        self.require_same_config(config)
        if scene_digest(scene) != self.scene_digest:
            raise InputError(
                f"{scene.name} is not what the training to be resumed has seen: its photographs, "
                "masks, cameras or split have changed; bring them back, or start a new training."
            )

    def require_same_config(self, config: TrainConfig) -> None:
        """Raise InputError unless a configuration would continue as begun; see MAY_CHANGE.

        Args:
            config: How to resume.

        Raises:
            InputError: A field that decides the result differs.
        """
        require_same_config(self.config, self.decided(config))

    def require_longer(self, config: TrainConfig) -> None:
        """Raise InputError unless a schedule leaves something to train.

        Args:
            config: How to resume, with a limit raised.

        Raises:
            InputError: A limit is reached all the same: another, or one raised too little.
        """
        for name, done in (("steps", self.progress.step), ("time_limit", self.progress.seconds)):
            limit = getattr(config, name)
            if limit is not None and done >= limit:
                option = "--" + name.replace("_", "-")
                raise InputError(
                    f"{name} is {limit}, which the training to be resumed has reached, so that it "
                    f"would be no longer; raise {option} above {math.ceil(done)}."
                )


def require_same_config(begun: TrainConfig, asked: TrainConfig) -> None:
    """Raise InputError unless a configuration would continue what another has begun.

    Args:
        begun: Of the training to be resumed.
        asked: How to resume it; may differ in MAY_CHANGE, and raise MAY_GROW.

    Raises:
        InputError: A field that decides the result differs.
    """
    for name, new, old in differences(asked, begun):
        if name in MAY_GROW and None not in (new, old) and new > old:
            continue
        raise InputError(
            f"{name} is {new}, but the training to be resumed has {old}, and the result "
            f"would be that of neither; leave {name} as it was, or start a new training."
        )


def raised(begun: TrainConfig, asked: TrainConfig) -> list[str]:
    """The fields of MAY_GROW that a resumed training raises.

    Args:
        begun: Of the training to be resumed.
        asked: How to resume it.
    """
    return [name for name, new, _ in differences(asked, begun) if name in MAY_GROW]


def differences(ours: TrainConfig, theirs: TrainConfig) -> Iterator[tuple[str, Any, Any]]:
    """Name and both values of each field that decides the result and differs."""
    for name, value, other in _pairs("", ours, theirs):
        if value != other and name not in MAY_CHANGE:
            yield name, value, other


def _pairs(prefix: str, ours: Any, theirs: Any) -> Iterator[tuple[str, Any, Any]]:
    for field in fields(ours):
        name, value, other = field.name, getattr(ours, field.name), getattr(theirs, field.name)
        if is_dataclass(value) and type(value) is type(other):
            yield from _pairs(f"{prefix}{name}.", value, other)
        elif isinstance(value, Model | StorageKind | SamplerKind):
            yield f"{prefix}{name}", value.name, other.name
        else:
            yield f"{prefix}{name}", value, other


def not_finite(what: str, plan: TrainingPlan, step: int) -> FloatingPointError:
    """The error of a training whose numbers have run away, with what helps against that.

    Args:
        what: Is not finite: "... is", or "... are".
        plan: Of the training.
        step: After which it was seen.
    """
    smaller = "smaller weights of losses, " if plan.losses.kinds else ""
    return FloatingPointError(
        f"{what} not finite after step {step}; choose a content distance that fits "
        f"the scene, the clamped scaling, {smaller}or lower learning rates."
    )


def require_finite(
    values: Iterable[tuple[str, float | np.ndarray]], plan: TrainingPlan, step: int
) -> None:
    """Raise FloatingPointError where numbers of a training are not finite.

    Args:
        values: What they are, "... is" or "... are", and the numbers.
        plan: Of the training.
        step: After which they are looked at.
    """
    for what, numbers in values:
        if not np.isfinite(numbers).all():
            raise not_finite(what, plan, step)


def scene_digest(scene: Scene, splits: Sequence[str] = ("train",)) -> str:
    """SHA-256 over what training draws from: pixels, masks and cameras of the training views.

    Or of the views of other splits as well, one after the other.

    Poses count to 1e-5 of the content distance that the cameras tell, and pixels of the camera to
    1e-3: another machine may round what it computes of them otherwise.
    """
    unit = scene.content_distance
    if scene.content_distances is not None:  # of points, which may come and go beside a scene
        unit = find_focus(scene.training_cameras).distance
    digest = hashlib.sha256()
    for index in [index for split in splits for index in scene.splits[split]]:
        view = scene.views[index]
        camera = view.camera
        lens = (camera.fx, camera.fy, camera.cx, camera.cy)
        distortion = [camera.k1, camera.k2, camera.k3, camera.p1, camera.p2]
        distortion += [camera.k4, 1.0] if camera.fisheye else []
        distortion += [camera.k4, camera.k5, camera.k6] if camera.rational else []
        numbers = (
            np.round(lens, 3),
            np.round([*distortion, *camera.c2w[:, :3].ravel()], 5),
            np.round(camera.position / unit, 5),
        )
        digest.update(f"{view.image.shape}".encode())
        digest.update((np.concatenate(numbers) + 0.0).tobytes())  # no -0
        digest.update(np.ascontiguousarray(view.image).data)
        mask = view.mask
        if mask is not None:
            digest.update(b"mask" + np.packbits(mask).tobytes())
    return digest.hexdigest()
