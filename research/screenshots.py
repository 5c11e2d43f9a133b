"""The pictures of a final scene and of the replay page in ``docs/images``: Mississauga."""

from __future__ import annotations

import io
import tempfile
from pathlib import Path

from PIL import Image

from derail_ros import models
from derail_ros.commands.common import CommandFailure
from derail_ros.recording import record_run
from derail_ros.recording.reader import read_bag
from derail_ros.review import drawing, figures, replay_page
from derail_ros.review.scene import final_scene
from derail_ros.scenario import load_scenario
from research.browser import NoBrowser, start_browser
from research.pages import Options
from research.studies import small

SIZE = (1300, 990)
WIDTH = 1000
DARK = """
const choose = (id, value) => {
  const box = document.getElementById(id);
  box.value = value;
  box.dispatchEvent(new Event("change"));
};
document.getElementById("theme").click();
choose("colour", "force");
choose("marks", "off");
choose("car", "12");
document.getElementById("tab-car").click();
derailReplay.seek(derailReplay.last - 0.3);
"""
SHOTS = {"replay_light": "derailReplay.seek(6.0);", "replay_dark": DARK}


def write(options: Options) -> None:
    """Write the pictures."""
    images = options.images()
    with tempfile.TemporaryDirectory() as folder:
        scenario = load_scenario("mississauga")
        bag = Path(folder) / "mississauga"
        record_run(models.build(scenario.to_params()), scenario, bag)
        run = read_bag(bag)
        scene = drawing.save(figures.final_scene(final_scene(run)), Path(folder) / "s.png", 107)
        small(Image.open(scene), images / "final_scene.png", 160)
        page = replay_page.write(run, Path(folder) / "page.html")
        for name, script in SHOTS.items():
            shot = _shot(page, script)
            size = (WIDTH, WIDTH * SIZE[1] // SIZE[0])
            small(shot.resize(size, Image.Resampling.LANCZOS), images / f"{name}.png", 160)


def _shot(page: Path, script: str) -> Image.Image:
    """The page after a script has run."""
    try:
        browser = start_browser("--hide-scrollbars")
    except NoBrowser as error:
        raise CommandFailure(str(error)) from None
    try:
        # The size of the page itself, whatever the window has around it.
        metrics = {"width": SIZE[0], "height": SIZE[1], "deviceScaleFactor": 2, "mobile": False}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
        browser.get(page.as_uri())
        browser.set_script_timeout(20)
        browser.execute_script(script)
        # Two frames later all is drawn.
        browser.execute_async_script(
            "const done = arguments[0], next = requestAnimationFrame;"
            "next(() => next(() => setTimeout(done, 300)))"
        )
        return Image.open(io.BytesIO(browser.get_screenshot_as_png())).convert("RGB")
    finally:
        browser.quit()
