"""Scenarios for a simulator: by name or as text from a client, with limits; ready to run."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

from derail_ros import models
from derail_ros.recording import session
from derail_ros.recording.session import Prepared
from derail_ros.scenario import Scenario, ScenarioError, load_scenario_by_name, loads_scenario
from derail_ros.vocabulary.errors import DerailError

MAX_CARS = 1000
MAX_YAML = 512 * 1024
"""Bytes of a scenario that a client sends."""


@functools.cache
def warm_up(model: str) -> None:
    """Prepare a model's engine, once a process: compile or load kernels."""
    models.engine(model).warm_up()


def read(name: str, text: str, dirs: Sequence[str], model: str = "") -> Scenario:
    """A scenario by its name or from its text; no path from a client is opened.

    ``model``: in place of its own.

    Raises
    ------
    ValueError
        With the reason for which it is refused.
    """
    if name and text:
        raise ValueError("scenario_name and scenario_yaml are both given; give one of them")
    if not name and not text:
        raise ValueError("neither scenario_name nor scenario_yaml is given; give one of them")
    if len(text.encode()) > MAX_YAML:
        raise ValueError("scenario_yaml is over 512 KB")
    try:
        scenario = loads_scenario(text, dirs=dirs) if text else load_scenario_by_name(name, dirs)
        if model:
            scenario = scenario.with_overrides({"model": model})
    except ScenarioError as error:
        raise ValueError(str(error)) from error
    if scenario.n_cars > MAX_CARS:
        raise ValueError(f"the train must have at most {MAX_CARS} cars, got {scenario.n_cars}")
    return scenario


def prepare(
    name: str, text: str, speed_kmh: float, *, dirs: Sequence[str], frame_id: str, model: str = ""
) -> Prepared:
    """Read a scenario and make it ready to run, from any thread.

    A speed of 0 is the scenario's own.

    Raises
    ------
    ValueError
        With the reason for which it is refused.
    """
    scenario = read(name, text, dirs, model)
    if not math.isfinite(speed_kmh) or speed_kmh < 0.0:
        raise ValueError(f"speed_kmh must be a finite number from 0 up, got {speed_kmh}")
    try:
        warm_up(scenario.model.model)
        prepared = session.prepare(scenario, speed_kmh)
    except (ScenarioError, DerailError) as error:
        raise ValueError(str(error)) from error
    if text:
        # It has no name. A name with a blank in it is that of no scenario file.
        prepared.name = f"{scenario.title} (inline)"
    prepared.warm(frame_id)
    return prepared
