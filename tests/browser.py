"""A headless browser for tests of pages: one for all tests of a process."""

import os
import shutil
from collections.abc import Iterator
from typing import Any

import pytest

_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
_QUIET = (
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
_REQUIRED = "TRMS_REQUIRE_BROWSER"


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """Chromium without a window: the machine's own, else playwright's.

    Without any the tests are skipped, but where ``TRMS_REQUIRE_BROWSER`` is set they fail.
    """
    try:
        from playwright.sync_api import Error, sync_playwright
    except ImportError:
        _do_without("playwright is not installed: pip install playwright")
    executable = next((found for name in _NAMES if (found := shutil.which(name))), None)
    with sync_playwright() as playwright:
        try:
            started = playwright.chromium.launch(executable_path=executable, args=list(_QUIET))
        except Error as error:
            reason = str(error).splitlines()[0]
            _do_without(f"no browser starts ({reason}): install chromium, or playwright install")
        yield started
        started.close()


def _do_without(reason: str) -> None:
    if os.environ.get(_REQUIRED):
        pytest.fail(f"{_REQUIRED} is set, and {reason}")
    pytest.skip(reason)
