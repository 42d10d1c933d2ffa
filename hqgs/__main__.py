"""`python -m hqgs`."""

import sys

if __name__ == "__main__":
    try:
        from hqgs.cli.main import main

        sys.exit(main())
    except KeyboardInterrupt:  # before the command line itself can tell
        sys.exit(130)
