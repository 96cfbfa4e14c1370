"""``python -m warpnerf`` is the command ``warpnerf``."""

import sys

from warpnerf.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
