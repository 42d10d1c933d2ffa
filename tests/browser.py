"""Chromium for tests of pages, where the machine has it and playwright."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

# Drawn by the CPU: the tests need no graphics card.
ARGUMENTS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
PATIENCE = 60.0  # seconds
NAMES = ("chromium", "chromium-browser", "google-chrome")


@contextmanager
def chromium(width: int = 1000, height: int = 800) -> Iterator[tuple[Any, list[str]]]:
    """A page, and what goes wrong on it: messages of its console, errors, and what it asked the network for.

    The test is skipped without a browser.
    """
    playwright = pytest.importorskip("playwright.sync_api")
    found = next((path for name in NAMES if (path := shutil.which(name))), None)
    if found is None:
        pytest.skip(f"no browser: none of {', '.join(NAMES)} is installed")
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=found, args=ARGUMENTS)
        page = browser.new_page(viewport={"width": width, "height": height})
        wrong: list[str] = []
        page.on("pageerror", lambda error: wrong.append(f"error: {error}"))
        page.on("console", lambda m: wrong.append(m.text) if m.type in ("error", "warning") else None)
        try:
            yield page, wrong
        finally:
            browser.close()


def wait(page: Any, expression: str) -> None:
    """Until the expression is true in the page; `wait_for_function` needs eval, which a page may forbid."""
    end = time.monotonic() + PATIENCE
    while not page.evaluate(f"Boolean({expression})"):
        assert time.monotonic() < end, f"never true: {expression}"
        time.sleep(0.05)
