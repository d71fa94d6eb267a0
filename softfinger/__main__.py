"""``python -m softfinger``: the command line."""

import sys

from softfinger.tools.cli import main

if __name__ == "__main__":
    sys.exit(main())
