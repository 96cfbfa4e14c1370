"""`warpnerf view`, and the page of `warpnerf train --view`."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from warpnerf.checks import InputError, require_extra
from warpnerf.cli.arguments import RunFolder

if TYPE_CHECKING:
    from warpnerf.scenes.scene import Scene
    from warpnerf.training.trainer import Trainer
    from warpnerf.viewer.session import Session

HOST = "127.0.0.1"


def view_command(
    folder: RunFolder,
    other: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[OTHER]")] = None,
    /,
    scene: str | None = None,
    host: str = HOST,
    port: int | None = None,
    device: str = "cpu",
    threads: int | None = None,
) -> int:
    """Look at a trained run, or at two beside each other, in a page of the browser.

    Args:
        folder: Output folder of a training run, or of blocks.
        other: Of another run in the same coordinates, shown beside it.
        scene: Where the run's photographs are now, if they have moved.
        host: Name or address of this machine to listen at; 0.0.0.0 lets other machines in, whoever
            uses them.
        port: To listen at; 0: any that is free. By default 8080, or the next that is free.
        device: cpu, cuda, cuda:1, ...
        threads: CPU threads; by default one per usable core.
    """
    from warpnerf.blocks.folder import open_trained
    from warpnerf.viewer.server import require_place
    from warpnerf.viewer.view import open_view

    folders = [folder] if other is None else [folder, other]
    for one in folders:
        open_trained(one).read_config()  # before any is loaded
    require_place(host, port)
    with open_view(
        folders, scene=scene, host=host, port=port, device=device, threads=threads
    ) as session:
        print(f"look at {session.address}; Ctrl-C ends it", flush=True)
        session.serve()
    return 0


@dataclass(frozen=True, kw_only=True)
class PageOptions:
    """Where the page of a training is served."""

    host: str
    port: int | None

    @staticmethod
    def chosen(view: bool, host: str | None, port: int | None) -> PageOptions | None:
        """From the options of the command; None: no page.

        Raises:
            InputError: A host or port for no page, or none that can be listened at, or viser is
                missing.
        """
        if not view:
            for name, value in (("host", host), ("port", port)):
                if value is not None:
                    raise InputError(f"--{name} is where --view serves its page; give both.")
            return None
        require_extra("viser", "viewer", "--view")
        from warpnerf.viewer.server import require_place

        options = PageOptions(host=host or HOST, port=port)
        require_place(options.host, options.port)
        return options


def training_page(
    options: PageOptions | None, scene: Scene, trainer: Trainer
) -> AbstractContextManager[Session | None]:
    """The page of a training, within a ``with`` statement; None where none was requested.

    Raises:
        InputError: It cannot be served there.
    """
    if options is None:
        return nullcontext()
    from warpnerf.viewer.painter import Subject
    from warpnerf.viewer.session import Session

    session = Session(
        [Subject(name=scene.name, field=trainer.field, stamp=lambda: trainer.steps_done)],
        scene,
        content_distance=trainer.plan.content_distance,
        training=True,
        host=options.host,
        port=options.port,
    )
    print(f"look at {session.address} while it trains", flush=True)
    return session
