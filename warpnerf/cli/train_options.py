"""What `warpnerf train` is given besides a configuration, and which of its options help shows."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from warpnerf.checks import InputError, require_extra, require_whole
from warpnerf.cli.arguments import Settings, Usual
from warpnerf.cli.view import PageOptions


@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """What `warpnerf train` is given besides a configuration."""

    scene: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="[SCENE]")] = None
    """Folder of a scene (transforms.json, Blender, COLMAP, LLFF), an .npz file, builtin:room or
    builtin:room-sparse; or photographs without poses or a video, whose poses are then estimated
    first, as by `warpnerf pose`."""
    output: Path | None = None
    """Folder for configuration, field, log, figures and pictures; by default runs/SCENE-TIME."""
    preset: (
        Literal[
            "fast", "quality", "dvgo", "dvgo-unbounded", "dvgo-llff", "tensorf", "ngp", "mip360"
        ]
        | None
    ) = None
    """Starting point, by default fast, which takes a minute or three on two cores; quality takes a
    quarter of an hour; dvgo, dvgo-unbounded and dvgo-llff are the published hyperparameters of
    DirectVoxGO, tensorf those of TensoRF, ngp those of Instant-NGP, and take hours; mip360 samples
    and contracts as Mip-NeRF 360 does. Other options replace its values."""
    config: Path | None = None
    """Starting point instead of a preset: the config.json of a run, which is repeated, with its
    scene, downscale, masks and split, but for what other options replace."""
    resume: Path | None = None
    """Resume the run in this folder, as it was begun; scene only if it has moved."""
    overwrite: bool = False
    """Replace the run that the output folder holds."""
    downscale: int | None = None
    """Average blocks of so many pixels squared; by default 1, as they are."""
    masks: Path | None = None
    """Folder of images named after the photographs, white where pixels count and black where they
    are ignored; with --resume only if it has moved."""
    images: Literal["auto", "memory", "disk"] = "auto"
    """Where the photographs' pixels are during the training: memory, disk (decoded once, into a
    file without a name in the output folder, gone at the end), or by what is free."""
    split: str | None = None
    """Photographs that are withheld for testing: all (none is withheld, all are trained on), a
    number N (every Nth), sector (an eighth, side by side), or a file that names one a line. By
    default as the scene says, else every 8th."""
    eval_views: Literal["all", "none"] | int = "all"
    """Test views that are rendered and measured at the end: all, none, or so many, spread.
    warpnerf eval does it at any time."""
    eval_every: int | None = None
    """Steps from one look at a few test views during the training to the next; their PSNR is shown
    and logged. Its time counts for no --time-limit."""
    log: Literal["csv", "tensorboard", "wandb"] | None = None
    """Log loss and PSNR besides log.jsonl: csv (log.csv), tensorboard or wandb (Weights & Biases),
    which need pip install "warpnerf[tensorboard]" or "warpnerf[wandb]"."""
    keep: Literal["field", "checkpoint"] | None = None
    """What a finished run keeps: its field alone, or its last checkpoints too, to train for longer
    by --resume with more --steps or a longer --time-limit. By default field, or as it was begun."""
    view: bool = False
    """Serve a page to look at the training in a browser."""
    host: str | None = None
    """Where, by name or address of this machine; by default 127.0.0.1."""
    port: int | None = None
    """Where; 0: any that is free. By default 8080, or the next that is free."""
    model_options: Settings = ()
    """Of the model, such as specular=8 width=64: the same as --model.specular 8
    --model.width 64."""
    loss: Settings = ()
    """What is minimised besides, such as distortion=0.03 entropy=0.001: the same as
    --loss.distortion 0.03 --loss.entropy 0.001."""

    @property
    def page(self) -> PageOptions | None:
        """Where the page of the training is served; None: nowhere."""
        return PageOptions.chosen(self.view, self.host, self.port)

    def require_usable(self) -> None:
        """Raise InputError where an option cannot be followed, before anything is read."""
        PageOptions.chosen(self.view, self.host, self.port)
        if isinstance(self.eval_views, int):
            require_whole("--eval-views", self.eval_views, 1)
        if self.eval_every is not None:
            require_whole("--eval-every", self.eval_every, 1)
        if self.log is not None and self.log != "csv":
            what = f"--log {self.log}"
            require_extra({"tensorboard": "tensorboardX"}.get(self.log, self.log), self.log, what)

    def require_no_looks(self) -> None:
        """Raise InputError where one process is to render between updates: the other processes of
        the training would wait for it."""
        if self.eval_every is not None:
            raise InputError(
                "--eval-every does not go with several processes; leave it out: test views are "
                "looked at when training is done."
            )
        if self.page is not None:
            raise InputError(
                "--view does not go with several processes; leave it out, and look at the run by "
                "warpnerf view."
            )

    def require_no_training(self, run: Path) -> None:
        """Raise InputError where an option is for a training, and only views are left to look at.

        Args:
            run: The folder of the finished run.

        Raises:
            InputError: It would do nothing.
        """
        given = {
            "keep": self.keep is not None,
            "log": self.log is not None,
            "eval-every": self.eval_every is not None,
            "view": self.page is not None,
        }
        idle = [name for name, is_given in given.items() if is_given]
        if idle:
            raise InputError(
                f"--{idle[0]} would do nothing: {run} has been trained and keeps its field alone, "
                "of which only the views are left to look at; leave it out."
            )


USUAL = Usual(
    (
        "output",
        "preset",
        "steps",
        "time_limit",
        "grid.voxels",
        "downscale",
        "masks",
        "split",
        "eval_views",
        "model",
        "resume",
        "keep",
        "config",
        "overwrite",
        "view",
        "scaling",
        "content_distance",
        "box",
        "grid.border",
        "grid.contraction",
        "march.near",
        "device",
        "threads",
        "seed",
        "checkpoint_every",
    )
)
