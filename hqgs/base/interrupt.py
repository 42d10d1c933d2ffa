"""Ctrl-C that lets the work in hand end well."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

ENDINGS = (signal.SIGINT, signal.SIGTERM)  # Ctrl-C, and what batch systems send


@contextmanager
def deferred_interrupt() -> Iterator[threading.Event]:
    """Within this, the first Ctrl-C sets the event that it yields, the second raises KeyboardInterrupt.

    So does SIGTERM.
    """
    requested = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield requested  # signals only reach the main thread
        return

    def on_interrupt(number: int, frame: object) -> None:
        requested.set()
        for ending in ENDINGS:
            signal.signal(ending, signal.default_int_handler)

    before = {ending: signal.signal(ending, on_interrupt) for ending in ENDINGS}
    try:
        yield requested
    finally:
        for ending, handler in before.items():
            # None: it was not set from Python. pycolmap's prints a stack trace, which nobody asked for.
            signal.signal(ending, signal.SIG_DFL if handler is None else handler)
