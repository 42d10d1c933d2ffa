"""`python -m hqgs`."""

import sys

from hqgs.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
