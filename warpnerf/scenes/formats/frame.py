"""One entry of a scene file: a photograph with its pose, lens, mask and depth, not yet read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from warpnerf.scenes.cameras.lens import Lens
from warpnerf.scenes.images.depths import DepthFile
from warpnerf.scenes.images.masks import Mask


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """One entry of a scene file, checked, its image found but not read."""

    name: str
    """The image's path relative to the scene's folder, with /."""
    path: Path
    """The image."""
    c2w: np.ndarray
    """[3, 4] float64, OpenGL axes, scene units."""
    lens: Lens
    mask: Mask | None = None
    """Which pixels count; None: all."""
    depth: DepthFile | None = None
    """True depth; None: not known."""
    image: np.ndarray | None = None
    """As a view has it, where it was read already; None: it is in ``path``."""
    bounds: tuple[float, float] | None = None
    """Depth of the nearest and of the farthest content, scene units; None: not known."""
