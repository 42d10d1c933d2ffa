"""PyAV, which reads and writes films."""

from __future__ import annotations

from typing import Any

FPS = 30  # frames a second of films and camera paths, where nothing else is said


def pyav(what: str) -> Any:
    """The module PyAV, which is imported when it is used. ValueError where it is missing: `what` needs it."""
    try:
        import av
        import av.error
    except ImportError as error:
        raise ValueError(
            f"{what} needs PyAV, the extra 'video': pip install 'hqgs[video]' ({error})"
        ) from error
    return av
