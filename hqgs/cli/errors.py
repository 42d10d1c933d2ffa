"""How every command ends that does not succeed: one line on stderr and an exit code."""

from __future__ import annotations

import sys

from hqgs.base.files import FolderBusyError

BAD_INPUT = (
    ValueError,
    FolderBusyError,
    FileNotFoundError,
    FileExistsError,
    NotADirectoryError,
    IsADirectoryError,
    PermissionError,
)  # exit code 2; any other OSError, such as a full disk, is 1


def fail(code: int, message: str) -> int:
    """Print the message as one line; return the exit code."""
    print(f"hqgs: {' '.join(message.split())}", file=sys.stderr)
    return code
