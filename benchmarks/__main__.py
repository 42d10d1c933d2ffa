"""`python -m benchmarks`."""

import sys

if __name__ == "__main__":
    from benchmarks.cli import main  # here: a process that is started from this one need not load all of it

    sys.exit(main())
