"""`python -m hqgs`, and what the installed command `hqgs` calls."""

import io
import os
import sys


def run() -> int:
    """The command line's exit code, also where Ctrl-C comes while it is being loaded."""
    # numpy's linear algebra: on small matrices its threads wait for each other, on the rasterizer's cores
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="backslashreplace")  # a path that the console's encoding cannot show
    try:
        from hqgs.cli.main import main

        return main()
    except KeyboardInterrupt:  # before the command line itself can tell
        return 130


if __name__ == "__main__":
    sys.exit(run())
