"""Hooks of the documentation site: files beside docs/, and the page of the commands."""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parents[1]
BESIDE = ["CHANGELOG.md", "CONTRIBUTING.md", "config/derail_ros.foxglove.json"]
LINK = re.compile(r"\]\(((?:\.\./)*)([\w./-]+)(#[\w-]*)?\)")


def beside() -> list[str]:
    """Files that pages link to and that are not in docs/."""
    return [*BESIDE, *(p.relative_to(ROOT).as_posix() for p in (ROOT / "examples").iterdir())]


def on_files(files: Any, config: Any) -> Any:
    """Take in the files beside docs/."""
    for name in beside():
        files.append(File(name, str(ROOT), config.site_dir, config.use_directory_urls))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Lead links out of docs/, or into it from the root, to where the files are on the site."""
    name = page.file.src_path
    here = posixpath.dirname(name)
    home = here if name in BESIDE else posixpath.join("docs", here)
    known = set(beside())

    def moved(match: re.Match[str]) -> str:
        up, path, anchor = match.groups()
        target = posixpath.normpath(posixpath.join(home, up + path))
        if target not in known and not (name in BESIDE and target.startswith("docs/")):
            return match[0]
        place = posixpath.relpath(target.removeprefix("docs/"), here or ".")
        return f"]({place}{anchor or ''})"

    markdown = LINK.sub(moved, markdown)
    return markdown.replace("<!-- commands -->", commands()) if name == "commands.md" else markdown


def commands() -> str:
    """What ``derail COMMAND --help`` says, of all commands."""
    import typer

    from derail_ros.cli import app

    return "\n".join(_group(typer.main.get_command(app), "derail"))


def _group(group: Any, name: str) -> list[str]:
    lines = []
    for key, command in group.commands.items():
        if hasattr(command, "commands"):
            lines += [f"## {name} {key}", "", command.help or "", ""]
            lines += _group(command, f"{name} {key}")
            continue
        takes = [
            f" {p.name.upper()}" if p.required else f" [{p.name.upper()}]"
            for p in command.params
            if p.param_type_name == "argument"
        ]
        lines += [f"## {name} {key}", "", f"`{name} {key}{''.join(takes)}`", ""]
        lines += [_text(command.help), "", "| | |", "| --- | --- |"]
        for p in command.params:
            names = ", ".join(f"`{o}`" for o in (*p.opts, *p.secondary_opts))
            if p.param_type_name == "argument":
                names = f"`{p.name.upper()}`"
            lines.append(f"| {names} | {_text(getattr(p, 'help', ''))} |")
        lines.append("")
    return lines


def _text(text: str | None) -> str:
    text = " ".join((text or "").split())
    return re.sub(r"([|<>*_\[\]])", r"\\\1", text)
