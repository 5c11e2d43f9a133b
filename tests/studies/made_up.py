"""Outcomes made up, and a runner that hands them out, for tests of studies."""

from dataclasses import replace

import numpy as np

from derail_ros.studies.ensemble import JobResult
from derail_ros.vocabulary.outcome import Outcome


def outcome(n=3, **changes):
    """An outcome of a run of ``n`` cars; ``cars_derailed`` stands for the first so many."""
    if "cars_derailed" in changes:
        changes["derailed_cars"] = tuple(range(1, changes.pop("cars_derailed") + 1))
        n = max(n, len(changes["derailed_cars"]))
    values = {
        "derailed_cars": (1, 2),
        "duration": 20.0,
        "peak_force": 5e6,
        "peak_force_pair": (2, 1),
        "peak_force_time": 3.0,
        "peak_resultant": 6e6,
        "car_peak_force": np.array([4e6, 5.1e6] + (n - 2) * [0.0]),
        "scene_length": 60.0,
        "scene_width": 25.0,
        "scene_area": 1500.0,
        "rear_part_first_car": 3,
        "rear_part_coordinate": -3.0,
        "max_coupler_gap": 1e-9,
        "max_truck_offset": 2e-9,
        "energy": {"initial": 1.0},
        "energy_residual": 1e-5,
        "derail_time": np.array([0.0] + (n - 1) * [np.nan]),
    }
    blank = Outcome.nothing(np.zeros((n, 6)), "at rest", 21.0, 5)
    return replace(blank, **(values | changes))


def runner(make):
    """A runner in the manner of ``run_many``: ``make(job)`` gives an outcome or an exception."""

    def run(runs, jobs=None, task=None):
        made = []
        for index, one in enumerate(runs):
            value, error = make(one), None
            if isinstance(value, Exception):
                value, error = None, repr(value)
            made.append(JobResult(index, one, value, error, 0.1))
        yield from reversed(made)

    return run
