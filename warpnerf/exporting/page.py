"""Splats in a page that any browser opens without a network: viser's client, with the splats in it.

Needs viser, the extra ``viewer``.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
from collections.abc import Sequence

import numpy as np

from warpnerf.checks import InputError
from warpnerf.exporting.splats import Splats
from warpnerf.scenes.camera import Camera
from warpnerf.scenes.scene import up_direction


def require_viser() -> None:
    """Raise InputError where viser is missing."""
    if importlib.util.find_spec("viser") is None:
        raise InputError(
            'a page (.html) needs viser; pip install "warpnerf[viewer]", or choose another ending.'
        )


def splats_html(
    splats: Splats, cameras: Sequence[Camera], background: tuple[float, float, float]
) -> list[bytes]:
    """A page of splats that begins with the view of the first camera.

    Args:
        splats: What it shows.
        cameras: Those of the training; they tell which way is up.
        background: rgb in [0, 1].

    Raises:
        InputError: viser is missing.
    """
    require_viser()
    import viser
    from viser.transforms import SO3

    rotations = SO3(splats.rotations.astype(np.float64)).as_matrix()
    spread = rotations * splats.scales[:, None, :]
    with contextlib.redirect_stdout(io.StringIO()):  # it tells where it serves, which is nowhere
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
        try:
            scene = server.scene
            pixel = np.round(255.0 * np.array(background)).astype(np.uint8)
            scene.set_background_image(np.broadcast_to(pixel, (1, 1, 3)).copy())
            if cameras:
                camera = cameras[0]
                scene.set_up_direction(up_direction(cameras))
                distance = float(
                    np.median(np.linalg.norm(splats.centres - camera.position, axis=1))
                )
                server.initial_camera.position = tuple(camera.position)
                server.initial_camera.look_at = tuple(camera.position + distance * camera.forward)
                server.initial_camera.fov = 2.0 * float(np.arctan(camera.height / 2 / camera.fy))
            scene.add_gaussian_splats(
                "/splats",
                centers=splats.centres,
                covariances=spread @ spread.transpose(0, 2, 1),
                rgbs=splats.rgb,
                opacities=splats.opacity[:, None],
            )
            text = scene.as_html()
        finally:
            server.stop()
    return [text.encode()]
