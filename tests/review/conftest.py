"""A browser for the tests of the replay page, and recordings for all of reviewing."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from typing import Any

import pytest

from tests.conftest import BROWSER, UNCHECKED
from tests.recordings import bag, run, sqlite_bag  # noqa: F401

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
DRIVERS = ("chromedriver", "chromium.chromedriver")


def find_browser() -> tuple[str, str] | str:
    """Paths of a browser and its driver, or what is missing."""
    try:
        import selenium  # noqa: F401
    except ImportError:
        return "selenium is not installed"
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    driver = next(filter(None, map(shutil.which, DRIVERS)), None)
    if browser is None or driver is None:
        return "no Chromium with chromedriver (Debian: apt-get install chromium chromium-driver)"
    return browser, driver


def start_browser(*arguments: str, size: tuple[int, int] = (1300, 950)) -> Any:
    """A headless browser; the test that asks for it is skipped, loudly, where there is none."""
    found = find_browser()
    if isinstance(found, str):
        pytest.skip(f"{UNCHECKED}{BROWSER}: {found}")
    from selenium import webdriver
    from selenium.webdriver.chrome.options import Options
    from selenium.webdriver.chrome.service import Service

    options = Options()
    options.binary_location = found[0]
    for argument in (
        "--headless=new",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-dev-shm-usage",
        "--force-device-scale-factor=1",
        f"--window-size={size[0]},{size[1]}",
        *arguments,
    ):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    return webdriver.Chrome(options=options, service=Service(found[1]))


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A headless browser."""
    driver = start_browser()
    yield driver
    driver.quit()
