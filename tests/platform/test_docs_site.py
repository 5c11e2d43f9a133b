"""The documentation site builds without a warning, and the pages in the root lead somewhere."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    """Warnings are errors: of links, anchors, docstrings, and pages that have no place."""
    pytest.importorskip("mkdocs")
    site = tmp_path / "site"
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(site)]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    answer = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert answer.returncode == 0, answer.stderr
    from derail_ros.cli import app, studies

    page = (site / "commands.html").read_text(encoding="utf-8")
    names = [c.name for c in app.registered_commands]
    names += [f"study {c.name}" for c in studies.registered_commands]
    for name in names:
        assert f'<h2 id="derail-{name.replace(" ", "-")}"' in page, name
    api = (site / "api.html").read_text(encoding="utf-8")
    for said in ("inject_rail_break", "cars_derailed", "track_coordinate"):
        assert said in api


@pytest.mark.parametrize("name", ["README.md", "CONTRIBUTING.md", "CHANGELOG.md"])
def test_links_of_the_pages_in_the_root(name: str) -> None:
    text = (ROOT / name).read_text(encoding="utf-8")
    for target, anchor in re.findall(r"\]\((?!https?:)([^)#]+)(?:#([\w-]+))?\)", text):
        path = ROOT / target
        assert path.exists(), target
        if anchor:
            headings = re.findall(r"^#+ (.*)$", path.read_text(encoding="utf-8"), re.M)
            made = {re.sub(r"[^\w -]", "", h).strip().lower().replace(" ", "-") for h in headings}
            assert anchor in made, (target, anchor)
