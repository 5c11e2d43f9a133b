"""A headless browser, for the replay page."""

from __future__ import annotations

import shutil
from typing import Any

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
DRIVERS = ("chromedriver", "chromium.chromedriver")


class NoBrowser(RuntimeError):
    """What is missing."""


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
    """Start Chromium.

    Raises
    ------
    NoBrowser
        Browser, driver or selenium are not installed.
    """
    found = find_browser()
    if isinstance(found, str):
        raise NoBrowser(found)
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
