"""`python -m brokk_rl` is `brokk`: for a process that starts another one, wherever the command was installed."""

import sys

from brokk_rl.cli import main

if __name__ == "__main__":
    sys.exit(main())
