"""``derail replay``: recorded runs computed again, to the bit."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from derail_ros.commands import common
from derail_ros.commands.common import FAILED, OK, CommandFailure, note
from derail_ros.commands.options import Json
from derail_ros.commands.review import bag_errors
from derail_ros.vocabulary.words import count

if TYPE_CHECKING:
    from derail_ros.recording.manifest import Manifest
    from derail_ros.recording.run_messages import RunMessages


def run(
    bag: Annotated[
        str, typer.Argument(help="A recording: its folder, a file of it, or its manifest.json.")
    ],
    as_json: Json = False,
) -> int:
    """Compute recorded runs again, with their commands, and compare them to the bit.

    The exit code is 3 if anything differs.
    """
    from derail_ros.recording.recomputation import engine_differs, recompute
    from derail_ros.scenario import ScenarioError
    from derail_ros.vocabulary.errors import ParameterError

    manifest, recorded = _found(Path(bag))
    other = engine_differs(manifest)
    if other:
        note("derail: another version of the engine computed this: the bits may differ")
    common.warm_up()
    try:
        results = recompute(manifest, recorded)
    except (ScenarioError, ParameterError, KeyError, TypeError, IndexError) as error:
        raise CommandFailure(f"{bag}: {error}") from None
    same = not any(result.differences for result in results)
    if as_json:
        common.print_json(
            "replay",
            {
                "same": same,
                "same_engine": not other,
                "runs": [result.plain() for result in results],
            },
        )
    else:
        for result in results:
            print(_line(result))
            for difference in result.differences:
                print(f"  {difference}")
    return OK if same else FAILED


def _found(path: Path) -> tuple[Manifest, dict[str, RunMessages] | None]:
    """Manifest and messages at a place: a recording as all commands take it, or a manifest.

    Of a recording without the file its messages tell scenario and commands.
    """
    from derail_ros.recording.decoding import check_version
    from derail_ros.recording.manifest import FILE_NAME
    from derail_ros.recording.recomputation import collect
    from derail_ros.recording.storage import BagError, NotABagError, open_bag

    if path.suffix == ".json":
        manifest = _manifest(path)
        try:
            return manifest, collect(open_bag(path.parent)).runs
        except BagError:
            return manifest, None
    try:
        raw = open_bag(path)
    except NotABagError as error:
        if (path / FILE_NAME).is_file():
            return _manifest(path / FILE_NAME), None
        raise CommandFailure(str(error)) from None
    except BagError as error:
        raise CommandFailure(str(error)) from None
    with bag_errors():
        check_version(raw)
        found = collect(raw)
    beside = raw.path / FILE_NAME  # one beside a file alone may be that of another
    if raw.path.is_dir() and beside.is_file():
        manifest = _manifest(beside)
    else:
        manifest = found.manifest()
        if manifest.settings.get("gathered"):
            note(f"derail: {raw.path}: no manifest: scenario and commands are from its messages")
    if not manifest.runs:
        raise CommandFailure(f"{raw.path}: no run to compute again: no train (topic consist)")
    return manifest, found.runs


def _manifest(path: Path) -> Manifest:
    from derail_ros.recording.manifest import Manifest

    try:
        return Manifest.from_json(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise CommandFailure(f"{path}: {error.strerror or error}") from None
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise CommandFailure(f"{path}: not the manifest of a recording: {error}") from None


def _line(result: Any) -> str:
    text = (
        f"{result.run_id[:8]} {result.scenario}: {count(result.commands, 'command')}, "
        f"{count(result.steps, 'step')}, {result.time:.3f} s, {result.status}: "
    )
    if result.differences:
        return text + "differs"
    proofs = []
    if result.same_state:
        proofs.append("the final state")
    if result.events is not None:
        proofs.append(f"{count(result.events, 'event')} and {count(result.contacts, 'contact')}")
    if not proofs:
        return text + "computed again; nothing was recorded to compare with"
    return text + " and ".join(proofs) + " are the same to the bit"
