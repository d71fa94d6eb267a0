"""Run the command line: ``python -m softfinger``."""

import sys

from softfinger.tools.cli import main

if __name__ == "__main__":
    sys.exit(main())
