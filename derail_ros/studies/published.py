"""The published runs of the source's model, and known facts of the accidents."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from derail_ros.studies.records import Distribution, Ensemble

if TYPE_CHECKING:
    from derail_ros.vocabulary.params import TrainParams


NOISE = {"peak_force_N": 0.08}
"""Measure -> relative scatter of the source's own values: at quotients of 1.0, 1.6, 2.4 and 3.0
it prints 10.3 MN, at 2.0 it prints 9.47."""


@dataclass(frozen=True)
class PublishedCase:
    """A published run.

    Attributes
    ----------
    name, title : key and words
    scenario, overrides : the train
    published : key of a measure -> published value, SI units
    source : where it is published
    """

    name: str
    title: str
    scenario: str
    published: Mapping[str, Any]
    overrides: Mapping[str, Any] = field(default_factory=dict)
    source: str = ""

    def distribution(self, ensemble: Ensemble, key: str) -> Distribution:
        """A measure of an ensemble of this case beside its published value."""
        value = self.published.get(key)
        found = ensemble.distribution(key, None if value is None else float(value))
        return replace(found, noise=NOISE.get(key, 0.0))

    @property
    def pair(self) -> tuple[int, int] | None:
        """The published pair of the largest force: (a, b), a struck b."""
        pair = self.published.get("peak_force_pair")
        return None if pair is None else (int(pair[0]), int(pair[1]))


@dataclass(frozen=True)
class Published:
    """All published runs.

    Attributes
    ----------
    cases : those that are compared
    beside : those that are shown and count in no goal
    goals : key of a goal -> ``at_least`` and ``at_most``
    text : what the source says of its runs (``data/published.yaml``), for ``statements``
    accidents : scenario -> what is known of the accident itself
    same_train : scenario -> the name of the same train in ``accidents``
    """

    cases: tuple[PublishedCase, ...]
    beside: tuple[PublishedCase, ...]
    goals: Mapping[str, Mapping[str, float]]
    text: Mapping[str, Any] = field(default_factory=dict)
    accidents: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    same_train: Mapping[str, str] = field(default_factory=dict)

    def accident(self, scenario: str) -> Mapping[str, float]:
        """Known facts of the accident of a scenario; empty for other trains."""
        return self.accidents.get(self.same_train.get(scenario, scenario), {})

    def of_run(self, scenario: str, params: TrainParams) -> Mapping[str, Any]:
        """The published values of a run of a scenario; nothing if there are none."""
        from derail_ros.scenario import ScenarioError, load_scenario

        for case in (*self.beside, *self.cases):
            if case.scenario != scenario:
                continue
            try:
                own = load_scenario(case.scenario).with_overrides(case.overrides).to_params()
            except ScenarioError:
                continue
            if own == params:
                return case.published
        return {}


def load_published() -> Published:
    """Read the published runs that come with the package."""
    import yaml

    text = (files("derail_ros.studies") / "data" / "published.yaml").read_text(encoding="utf-8")
    data = yaml.safe_load(text)
    return Published(
        tuple(PublishedCase(**case) for case in data["cases"]),
        tuple(PublishedCase(**case) for case in data["beside"]),
        data["goals"],
        data["text"],
        data["accidents"],
        data["same_train"],
    )
