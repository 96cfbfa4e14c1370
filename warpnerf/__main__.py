"""``python -m warpnerf`` is the command ``warpnerf``."""

import sys

from warpnerf.cli.start import start

if __name__ == "__main__":
    sys.exit(start())
