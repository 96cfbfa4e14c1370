"""What is minimised: a small frozen value, refused when wrong, as those of ``warpnerf.config``."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

from warpnerf.checked import checked
from warpnerf.checks import InputError, require_at_least, require_one_of, require_positive, said

HUBER_DELTA = 0.1


WEIGHTS_OF_LOSSES = ("distortion", "entropy", "opacity", "sample_colour", "near_clip")
"""Fields of LossConfig that weigh a loss."""

OPACITY = 1e-3
"""What ``LossConfig.opacity`` is by auto."""


@checked("loss")
@dataclass(frozen=True, kw_only=True)
class LossConfig:
    """What training minimises: the mean over rays of the photometric loss, which is a sum over the
    three channels, and of the others, each times its weight. A weight of 0 leaves a loss out.

    Systems that take the mean over the channels give a third of these weights, but for near_clip.
    """

    photometric: Literal["squared", "huber"] = "squared"
    """The photometric loss of a ray's colour against its pixel. huber: as squared up to huber_delta
    in a channel, from there on a line."""
    huber_delta: float = HUBER_DELTA
    """Where that line begins, of colours in [0, 1]."""
    distortion: float = 0.0
    """Weight of the distortion loss: density concentrates along a ray. Distances count as
    t / (D + t), with D the content distance in use; with auto and per-camera, the scene's."""
    distortion_rise: float = 1.0
    """How many times its weight of the start distortion has at the end, 1e-6 to 1e6. Halfway it has
    the weight that is configured, and each hundredth of a training multiplies it by as much. 1: it
    stays the same."""
    entropy: float = 0.0
    """Weight of the entropy of the remaining light: a ray ends at something opaque, or meets
    nothing."""
    opacity: float | Literal["auto"] = 0.0
    """Weight of -log of the opacity of rays: each ends at something opaque. For photographs without
    alpha, whose pixels all show something; auto: 0.001, but 0 for objects with alpha, and where a
    background is given (``TrainConfig.losses_for``)."""
    sample_colour: float = 0.0
    """Weight of the squared errors of the colours of single samples. For models that have such:
    all but deferred."""
    near_clip: float = 0.0
    """Weight of the sum of raw densities nearer to the camera than near_clip_distance, as DVGO
    pushes them down; for comparison. DVGO does not divide by the rays of a step: its weight 1 is
    3 rays_per_step here."""
    near_clip_distance: float = 0.0
    """How near that is, scene units."""

    def __post_init__(self) -> None:
        """Refuse what cannot be minimised."""
        require_one_of("loss.photometric", self.photometric, ("squared", "huber"))
        require_positive("loss.huber_delta", self.huber_delta)
        if isinstance(self.opacity, str) and self.opacity != "auto":
            raise InputError(f"loss.opacity must be auto or a number, not {said(self.opacity)}.")
        for name in (*WEIGHTS_OF_LOSSES, "near_clip_distance"):
            if name != "opacity" or self.opacity != "auto":
                require_at_least(f"loss.{name}", getattr(self, name), 0.0)
        require_positive("loss.distortion_rise", self.distortion_rise)
        if not 1e-6 <= self.distortion_rise <= 1e6 or not (
            self.distortion == 0.0 or self.distortion_rise == 1.0 or 1e-20 < self.distortion < 1e20
        ):
            raise InputError(
                "loss.distortion_rise must lie between 1e-6 and 1e6, and loss.distortion, which it "
                f"multiplies, within float32, not {said(self.distortion_rise)} and "
                f"{said(self.distortion)}."
            )
        if self.photometric != "huber" and self.huber_delta != HUBER_DELTA:
            raise InputError(
                f"loss.huber_delta is {self.huber_delta:g}, but loss.photometric is squared; set "
                "that to huber, or leave huber_delta out."
            )
        if self.near_clip == 0.0 and self.near_clip_distance > 0.0:
            raise InputError(
                "loss.near_clip_distance does nothing while loss.near_clip is 0; give both, or "
                "leave near_clip_distance out."
            )
        if self.near_clip > 0.0 and self.near_clip_distance == 0.0:
            raise InputError(
                "loss.near_clip needs loss.near_clip_distance, the distance up to which raw "
                "densities are pushed down; give both, or leave near_clip at 0."
            )

    def at(self, fraction: float) -> LossConfig:
        """The weights when so much of a training is done.

        Args:
            fraction: Of it, [0, 1].

        Returns:
            The same, with what changes as it is then, and staying so.
        """
        if self.distortion_rise == 1.0:
            return self
        weight = self.distortion * self.distortion_rise ** (math.floor(100 * fraction) / 100 - 0.5)
        return replace(self, distortion=weight, distortion_rise=1.0)

    @property
    def kinds(self) -> tuple[str, ...]:
        """Which loss terms there are besides the squared error; kernels are compiled for them."""
        huber = ("huber",) if self.photometric == "huber" else ()
        return huber + tuple(name for name in WEIGHTS_OF_LOSSES if getattr(self, name) != 0.0)


USUAL_LOSSES = LossConfig(distortion=0.03, distortion_rise=100.0, entropy=1e-3, opacity="auto")
"""What trainings minimise by default. Without the entropy of remaining light, colours of an MLP
make up for walls that stay soft; without opacity, the background makes up for what is as dark as
it."""
