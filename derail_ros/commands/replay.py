"""``derail replay``: recorded runs computed again, to the bit."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from derail_ros.commands import common
from derail_ros.commands.common import FAILED, OK, CommandFailure, note
from derail_ros.commands.review import bag_errors


def run(place: str, as_json: bool) -> int:
    """Replay and compare; the exit code."""
    from derail_ros.engine import ParameterError
    from derail_ros.recording.manifest import FILE_NAME
    from derail_ros.recording.replay import as_plain, engine_differs, replay, told_by
    from derail_ros.scenario import ScenarioError

    path = Path(place)
    bag = path if path.is_dir() else path.parent
    manifest = _manifest(path / FILE_NAME if path.is_dir() else path)
    told = None
    recorded = _recorded(bag)
    if recorded is not None:
        with bag_errors():
            told = told_by(recorded)
    other = engine_differs(manifest)
    if other:
        note("derail: another version of the engine computed this: the bits may differ")
    common.warm_up()
    try:
        results = replay(manifest, told)
    except (ScenarioError, ParameterError, KeyError, TypeError, IndexError) as error:
        raise CommandFailure(f"{place}: {error}") from None
    same = not any(result.differences for result in results)
    if as_json:
        common.print_json(
            {
                "same": same,
                "same_engine": not other,
                "runs": [as_plain(result) for result in results],
            }
        )
    else:
        for result in results:
            print(_line(result))
            for difference in result.differences:
                print(f"  {difference}")
    return OK if same else FAILED


def _manifest(path: Path) -> Any:
    from derail_ros.recording import Manifest

    try:
        return Manifest.from_json(path.read_text(encoding="utf-8"))
    except OSError as error:
        hint = "" if path.exists() else "; `derail repair` writes one for a cut-off recording"
        raise CommandFailure(f"{path}: {error.strerror or error}{hint}") from None
    except (ValueError, TypeError, KeyError, AttributeError, json.JSONDecodeError) as error:
        raise CommandFailure(f"{path}: not the manifest of a recording: {error}") from None


def _recorded(folder: Path) -> Any:
    """The messages of the recording beside a manifest, ``None`` if there is none."""
    from derail_ros.recording.replay import needed
    from derail_ros.review.storage import BagError, open_bag

    try:
        return open_bag(folder).messages(needed)
    except BagError:
        return None


def _line(result: Any) -> str:
    plural = "" if result.commands == 1 else "s"
    text = (
        f"{result.run_id[:8]} {result.scenario}: {result.commands} command{plural}, "
        f"{result.steps} steps, {result.time:.3f} s, {result.status}: "
    )
    if result.differences:
        return text + "differs"
    proofs = []
    if result.same_state:
        proofs.append("the final state")
    if result.events is not None:
        proofs.append(f"{result.events} events and {result.contacts} contacts")
    if not proofs:
        return text + "computed again; nothing was recorded to compare with"
    return text + " and ".join(proofs) + " are the same to the bit"
