"""Splats in a page that any browser opens without a network: viser's client, with the splats in it.

Needs viser, the extra ``viewer``.
"""

from __future__ import annotations

import html

import numpy as np

from warpnerf.checks import require_extra
from warpnerf.exporting.splats import Splats
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.files import printable
from warpnerf.scenes.scene import Scene
from warpnerf.viewer.server import close_server, open_server
from warpnerf.viewer.viewpoint import World, first_look


def require_viser() -> None:
    """Raise InputError where viser is missing."""
    require_extra("viser", "viewer", "a page (.html)")


def splats_html(
    splats: Splats,
    scene: Scene,
    background: tuple[float, float, float],
    begin: Camera | None = None,
) -> list[bytes]:
    """A page of splats, whose title is the scene's name.

    Args:
        splats: What it shows.
        scene: What they were trained on.
        background: rgb in [0, 1].
        begin: What it shows first; None: the view of the first training camera.

    Raises:
        InputError: viser is missing.
    """
    require_viser()
    from viser.transforms import SO3

    world = World.of(scene.content_distance)
    rotations = SO3(splats.rotations.astype(np.float64)).as_matrix()
    spread = world.scale * rotations * splats.scales[:, None, :]
    server = open_server("127.0.0.1", 0)
    try:
        look = first_look(scene.training_cameras, begin)
        world.begin(server, look)
        pixel = np.round(255.0 * np.array(background)).astype(np.uint8)
        server.scene.set_background_image(np.broadcast_to(pixel, (1, 1, 3)).copy())
        server.scene.add_gaussian_splats(
            "/splats",
            centers=world.scale * splats.centres.astype(np.float64),
            covariances=spread @ spread.transpose(0, 2, 1),
            rgbs=splats.rgb,
            opacities=splats.opacity[:, None],
        )
        text = server.scene.as_html()
    finally:
        close_server(server)
    title = f"<title>{html.escape(printable(scene.name))}</title>"
    return [text.replace("<title>Viser</title>", title, 1).encode()]
