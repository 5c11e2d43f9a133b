"""Uncertain fields of a scenario: the draws of each member of an ensemble.

A draw depends on the seed, the member and the path alone. It is the same for any number of
members or other uncertain fields. The outer 0.01 % of a distribution are cut off at each end:
what can be drawn was checked when the scenario was read.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from derail_ros.scenario.distributions import mistake, quantile_of
from derail_ros.scenario.errors import Refusal, ScenarioError
from derail_ros.scenario.messages import model_at
from derail_ros.scenario.schema import ScenarioModel, Section, Uncertain

if TYPE_CHECKING:
    from derail_ros.scenario.scenario import Scenario

OUTER = 1e-4
"""Share of a distribution that is cut off at each end."""

NOT_SECTIONS = ("inputs", "uncertain")


def share(seed: int, member: int, path: str) -> float:
    """The share of a path's distribution that lies below the draw of a member."""
    import numpy as np

    key = (member, zlib.crc32(path.encode()))
    stream = np.random.Generator(np.random.Philox(np.random.SeedSequence(seed, spawn_key=key)))
    return min(max(float(stream.random()), OUTER), 1.0 - OUTER)


def drawn(scenario: Scenario, member: int, seed: int = 0) -> dict[str, Any]:
    """What a member draws: dotted path, as it was written -> value, or factor if relative."""
    if member == 0:
        return {}
    return {
        path: quantile_of(spec)(share(seed, member, path))
        for path, spec in scenario.model.uncertain.items()
    }


def overrides(scenario: Scenario, values: dict[str, Any]) -> dict[str, Any]:
    """What a draw changes: dotted path without ``*`` -> value.

    Raises
    ------
    Refusal
        Of a path that is not there, or has no number to be relative to.
    """
    found: dict[str, Any] = {}
    for path, value in values.items():
        spec = scenario.model.uncertain[path]
        for one in _matches(scenario, path):
            if one in found:
                raise Refusal(("uncertain", path), f"varies {one}, which another path varies too")
            found[one] = value * _own(scenario, path, one) if spec.relative else value
    return found


def check(scenario: Scenario) -> None:
    """Check every uncertain field alone, at the ends and the middle of its distribution.

    Raises
    ------
    Refusal
        Naming the path.
    """
    overrides(scenario, dict.fromkeys(scenario.model.uncertain, 1.0))
    for path, spec in scenario.model.uncertain.items():
        place = ("uncertain", path)
        root = model_at(ScenarioModel, (path.partition(".")[0],))
        section = isinstance(root, type) and issubclass(root, Section)
        if not section or path.partition(".")[0] in NOT_SECTIONS:
            raise Refusal(place, "must be the dotted path of a field, as train.speed_kmh")
        if wrong := mistake(spec):
            raise Refusal((*place, *wrong[0]), wrong[1])
        for value in _probes(spec):
            try:
                scenario.drawn_scenario({path: value})
            except ScenarioError as error:
                shown = f"{value:.6g}" if isinstance(value, float) else str(value)
                what = f"{shown} times its own value" if spec.relative else shown
                field = "" if error.field in ("", path) else f"{error.field}: "
                raise Refusal(place, f"can be {what}: {field}{error.reason}") from None


def _probes(spec: Uncertain) -> list[Any]:
    if spec.values is not None:
        return list(dict.fromkeys(spec.values))
    return [quantile_of(spec)(u) for u in (OUTER, 0.5, 1.0 - OUTER)]


def _matches(scenario: Scenario, path: str) -> Iterator[str]:
    """Paths with every entry of a list in the place of ``*``."""
    before, star, after = path.partition(".*.")
    if not star:
        yield path
        return
    listed = scenario.given(before)
    if not isinstance(listed, list) or not listed:
        raise Refusal(("uncertain", path), f"{before} is not a list with entries")
    for i in range(len(listed)):
        yield from _matches(scenario, f"{before}.{i}.{after}")


def _own(scenario: Scenario, path: str, one: str) -> float:
    """The number that a scenario has itself at a path, in the unit of the field."""
    value = scenario.own_value(one)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        reason = f"relative: the scenario has no number at {one}; name the field in its own unit"
        raise Refusal(("uncertain", path), reason)
    return float(value)
