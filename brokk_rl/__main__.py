"""Run the command `brokk` as `python -m brokk_rl`, for processes that start other ones."""

import sys

from brokk_rl.cli import main

if __name__ == "__main__":
    sys.exit(main())
