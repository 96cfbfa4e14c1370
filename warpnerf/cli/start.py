"""Where the command begins: signals are heard before anything is imported that takes a while."""

from __future__ import annotations

import sys

from warpnerf.runtime.signals import Stopped, raise_when_asked


def start() -> int:
    """Run the command.

    Returns:
        What ``warpnerf.cli.main.main`` does.
    """
    raise_when_asked()
    try:
        from warpnerf.cli.main import main

        return main()
    except Stopped as stopped:
        print("stopped", file=sys.stderr)
        return stopped.exit_code
