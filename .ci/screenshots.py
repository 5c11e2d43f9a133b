#!/usr/bin/env python3
"""Renew the pictures of final scene and replay page in docs/images from a run of Mississauga."""

import io
import sys
import tempfile
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
IMAGES = ROOT / "docs" / "images"
sys.path.insert(0, str(ROOT))

from derail_ros.engine import PlanarSimulation  # noqa: E402
from derail_ros.recording import record_run  # noqa: E402
from derail_ros.recording.reader import read_bag  # noqa: E402
from derail_ros.review import drawing, figures, replay_page  # noqa: E402
from derail_ros.review.scene import final_scene  # noqa: E402
from derail_ros.scenario import load_scenario  # noqa: E402
from tests.review.conftest import start_browser  # noqa: E402

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


def keep(picture: Image.Image, name: str) -> None:
    """Write a picture as a small file."""
    target = IMAGES / f"{name}.png"
    picture.quantize(160, dither=Image.Dither.NONE).save(target, optimize=True)
    print(target)


def main() -> None:
    """Write the pictures."""
    with tempfile.TemporaryDirectory() as folder:
        scenario = load_scenario("mississauga")
        record_run(PlanarSimulation(scenario.to_params()), scenario, Path(folder) / "mississauga")
        run = read_bag(Path(folder) / "mississauga")
        scene = drawing.save(figures.final_scene(final_scene(run)), Path(folder) / "s.png", 107)
        keep(Image.open(scene).convert("RGB"), "final_scene")
        page = replay_page.write(run, Path(folder) / "page.html")
        for name, script in SHOTS.items():
            browser = start_browser("--hide-scrollbars")
            try:
                # The size of the page itself, whatever the window has around it.
                browser.execute_cdp_cmd(
                    "Emulation.setDeviceMetricsOverride",
                    {
                        "width": SIZE[0],
                        "height": SIZE[1],
                        "deviceScaleFactor": 2,
                        "mobile": False,
                    },
                )
                browser.get(page.as_uri())
                browser.set_script_timeout(20)
                browser.execute_script(script)
                # Two frames later all is drawn.
                browser.execute_async_script(
                    "const done = arguments[0], next = requestAnimationFrame;"
                    "next(() => next(() => setTimeout(done, 300)))"
                )
                picture = Image.open(io.BytesIO(browser.get_screenshot_as_png())).convert("RGB")
            finally:
                browser.quit()
            small = picture.resize((WIDTH, WIDTH * SIZE[1] // SIZE[0]), Image.Resampling.LANCZOS)
            keep(small, name)


if __name__ == "__main__":
    main()
