"""``derail compare``: two recordings side by side."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from derail_ros.commands import common
from derail_ros.commands.common import OK
from derail_ros.commands.options import Bag, Json, written
from derail_ros.commands.review import bag_errors, read


def run(
    first: Bag,
    second: Bag,
    output: Annotated[Path | None, written("Write text, JSON and both scenes there.")] = None,
    as_json: Json = False,
) -> int:
    """Compare two recordings: measures, scenes and events."""
    from derail_ros.review import comparison

    a, b = read(first), read(second)
    if output is not None:
        output = common.output_directory(output)
    facts = comparison.compare(a, b)
    text = comparison.text(facts)
    if output is not None:
        from derail_ros.review.drawing import save

        with bag_errors():
            common.write_json(output / "comparison.json", facts)
            (output / "comparison.txt").write_text(
                comparison.text(facts, most=1000), encoding="utf-8"
            )
            save(comparison.scenes(a, b), output / "scenes.png")
    if as_json:
        common.print_json("comparison", facts)
        return OK
    print(text, end="")
    if output is not None:
        print(f"\nin {output}: comparison.txt, comparison.json, scenes.png")
    return OK
