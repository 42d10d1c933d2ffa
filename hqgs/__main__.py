"""`python -m hqgs`, and what the installed command `hqgs` calls."""

import sys


def run() -> int:
    """The command line's exit code, also where Ctrl-C comes while it is being loaded."""
    try:
        from hqgs.cli.main import main

        return main()
    except KeyboardInterrupt:  # before the command line itself can tell
        return 130


if __name__ == "__main__":
    sys.exit(run())
