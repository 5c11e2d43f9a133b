#!/usr/bin/env python3
"""Renew the pictures of the replay page in docs/images from a run of Mississauga."""

import io
import sys
import tempfile
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from derail_ros.engine import Simulation  # noqa: E402
from derail_ros.recording import record_run  # noqa: E402
from derail_ros.review import replay  # noqa: E402
from derail_ros.review.bag import read_bag  # noqa: E402
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


def main() -> None:
    """Write both pictures."""
    with tempfile.TemporaryDirectory() as folder:
        scenario = load_scenario("mississauga")
        record_run(Simulation(scenario.to_params()), scenario, Path(folder) / "mississauga")
        page = replay.write(read_bag(Path(folder) / "mississauga"), Path(folder) / "page.html")
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
            target = ROOT / "docs" / "images" / f"{name}.png"
            small.quantize(160, dither=Image.Dither.NONE).save(target, optimize=True)
            print(target)


if __name__ == "__main__":
    main()
