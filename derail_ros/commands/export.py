"""``derail export``: the histories of the cars as tables."""

from __future__ import annotations

from typing import Annotated

import typer

from derail_ros.commands import common
from derail_ros.commands.common import OK, CommandFailure
from derail_ros.commands.options import Bag, Namespace, NewDir, WhichRun
from derail_ros.commands.review import bag_errors, read


def run(
    bag: Bag,
    output: NewDir,
    form: Annotated[str, typer.Option("--format", help="csv or parquet.")] = "csv",
    run: WhichRun = None,
    namespace: Namespace = None,
) -> int:
    """Write the histories of the cars in a recording as tables."""
    from derail_ros.review.histories import FORMATS, export

    if form not in FORMATS:
        raise CommandFailure(f"--format: {' or '.join(FORMATS)}, not {form!r}")
    if form == "parquet":
        try:
            import pyarrow  # noqa: F401
        except ImportError:
            raise CommandFailure(
                "--format parquet needs pyarrow: pip install 'derail_ros[studies]'"
            ) from None
    found = read(bag, run, namespace)
    output = common.output_directory(output)
    with bag_errors():
        counts = export(found, output, form)
    for name, rows in counts.items():
        print(f"{output / name}  {rows} rows")
    return OK
