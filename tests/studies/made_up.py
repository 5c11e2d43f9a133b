"""Outcomes made up, and a runner that hands them out, for tests of studies."""

from types import SimpleNamespace

import numpy as np

from derail_ros.studies.ensemble import Result


def outcome(**changes):
    """An outcome of a run."""
    values = {
        "cars_derailed": 10,
        "derailed_cars": (1, 2),
        "duration": 20.0,
        "peak_force": 5e6,
        "peak_force_pair": (2, 1),
        "peak_force_time": 3.0,
        "peak_resultant": 6e6,
        "cars_above_5MN": (2,),
        "cars_above_10MN": (),
        "car_peak_force": np.array([5e6, 5e6, 0.0]),
        "scene_length": 60.0,
        "scene_width": 25.0,
        "scene_area": 1500.0,
        "rear_stop": -3.0,
        "max_coupler_gap": 1e-9,
        "max_truck_offset": 2e-9,
        "energy_initial": 1.0,
        "energy": {},
        "energy_residual": 1e-5,
        "void": False,
        "status": "at rest",
        "time": 21.0,
        "steps": 5,
        "rejected_steps": 0,
    }
    values["derail_time"] = (0.0,)
    return SimpleNamespace(**(values | changes))


def runner(make):
    """A runner in the manner of ``run_many``: ``make(run)`` gives an outcome or an exception."""

    def run(runs, jobs=None, task=None):
        made = []
        for index, one in enumerate(runs):
            value = make(one)
            failed = isinstance(value, Exception)
            made.append(
                Result(index, one, None if failed else value, repr(value) if failed else None, 0.1)
            )
        yield from reversed(made)

    return run
