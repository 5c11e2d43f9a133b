"""Docstrings of this project for mkdocstrings: ``name : description`` has no type."""

from __future__ import annotations

import re
from typing import Any

import griffe

SECTION = re.compile(r"^(Parameters|Attributes)\n-+\n(.*?)(?=^\w[^\n]*\n-+\n|\Z)", re.M | re.S)
ROLE = re.compile(r":(?:meth|attr|func|class|mod|data|exc):(`+)")
ITEM = re.compile(r"^([\w*][\w, *]*?) : (.*(?:\n[ \t]+.*)*)", re.M)


class Described(griffe.Extension):
    """Move what follows a colon into the description, and drop the roles of references."""

    def on_instance(self, *, obj: Any, **kwargs: Any) -> None:
        """Change a docstring as it is collected."""
        if obj.docstring is not None:
            text = SECTION.sub(_section, obj.docstring.value)
            obj.docstring.value = ROLE.sub(r"\1", text)


def _section(match: re.Match[str]) -> str:
    def item(found: re.Match[str]) -> str:
        text = " ".join(found[2].split())
        return "\n".join(f"{name.strip()}\n    {text}" for name in found[1].split(","))

    return f"{match[1]}\n{'-' * len(match[1])}\n{ITEM.sub(item, match[2])}"
