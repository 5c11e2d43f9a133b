"""A short train, a small study about it, and a runner that computes nothing."""

import itertools
from types import SimpleNamespace

import pytest

SCENARIO = """\
version: 1
title: A short train
train:
  speed_kmh: 20
  consist:
    - {car: source_base_car, count: 5}
track:
  rail_breaks: [0]
initiation:
  derailed_trucks:
    - {car: 1, truck: both}
"""

STUDY = """\
version: 1
title: A small study
scenario: small
design: grid
ensemble: 2
parameters:
  speed: {path: train.speed_kmh, unit: km/h, values: [10, 15]}
  ground: {path: ground.scale, values: [0.8, 1.2]}
"""


@pytest.fixture
def folder(tmp_path):
    """A folder with the scenario and the study."""
    (tmp_path / "small.yaml").write_text(SCENARIO, encoding="utf-8")
    (tmp_path / "study.yaml").write_text(STUDY, encoding="utf-8")
    return tmp_path


@pytest.fixture
def load(folder):
    """``load(text)`` -> a study whose file lies beside the scenario ``small``."""
    from derail_ros.studies.plan import load_study

    numbers = itertools.count()

    def read(text=STUDY):
        path = folder / f"study_{next(numbers)}.yaml"
        path.write_text(text, encoding="utf-8")
        return load_study(path)

    return read


@pytest.fixture
def invented():
    """``invented(function)`` -> a runner whose runs give ``function(point, member)``.

    The function gives some measures by name, or raises: then the run failed.
    """
    from derail_ros.studies.ensemble import JobResult, describe
    from derail_ros.studies.journal import failed_row

    def make(function):
        seen = SimpleNamespace(keys=[])

        def run(runs, *, jobs=None, task=None):
            for index, one in enumerate(runs):
                seen.keys.append(one.key)
                try:
                    row, error = failed_row("", one) | {"status": "at rest"}, None
                    row |= function(*one.key)
                except ValueError as exception:
                    row, error = None, describe(exception)
                yield JobResult(index, one, row, error, 0.0)

        run.seen = seen
        return run

    return make
