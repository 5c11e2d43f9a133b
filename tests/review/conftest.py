"""A browser for the tests of the replay page, and recordings for all of reviewing."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from research import browser as headless
from research.browser import find_browser  # noqa: F401
from tests.conftest import BROWSER, UNCHECKED
from tests.recordings import bag, run, sqlite_bag  # noqa: F401


def start_browser(*arguments: str, size: tuple[int, int] = (1300, 950)) -> Any:
    """A headless browser; the test that asks for it is skipped, loudly, where there is none."""
    try:
        return headless.start_browser(*arguments, size=size)
    except headless.NoBrowser as error:
        pytest.skip(f"{UNCHECKED}{BROWSER}: {error}")


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A headless browser."""
    driver = start_browser()
    yield driver
    driver.quit()
