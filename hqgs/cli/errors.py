"""How every command ends that does not succeed: one line on stderr and an exit code."""

from __future__ import annotations

import errno
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


_WORDS = {
    errno.EEXIST: "exists already: choose another name",
    errno.EACCES: "cannot be read or written: no permission",
    errno.EPERM: "cannot be read or written: no permission",
    errno.ENOENT: "is not there",
    errno.ENOTDIR: "is inside a file, not a folder",
    errno.EISDIR: "is a folder, wanted a file",
    errno.ENOSPC: "cannot be written: the disk is full",
    errno.EROFS: "cannot be written: the disk is read-only",
}


def fail(code: int, message: str | Exception) -> int:
    """Print the message as one line; return the exit code."""
    if isinstance(message, OSError) and message.errno in _WORDS and message.filename is not None:
        message = f"{message.filename} {_WORDS[message.errno]}"
    print(f"hqgs: {' '.join(str(message).split())}", file=sys.stderr)
    return code
