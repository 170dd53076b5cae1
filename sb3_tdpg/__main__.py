"""Run the command line: ``python -m sb3_tdpg``."""

import sys

from sb3_tdpg.cli import main

if __name__ == "__main__":
    sys.exit(main())
