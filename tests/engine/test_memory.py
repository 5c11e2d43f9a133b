"""What a run holds does not grow with the time it simulates; long trains fit."""

import subprocess
import sys

import pytest

RESIDENT = """
import os
from dataclasses import replace
from derail_ros.engine import PlanarSimulation, warm_up
from derail_ros.vocabulary.params import *

def resident():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")

coupler = CouplerType("F73", "F", 1.524, 1.220, 0.300, 4.88e6)
car = Car(68e3, 1.165e6, 14.1, 2.6, 6.65, 5.75, coupler, coupler, brakes=())
"""

# The first car is off the rails, and nothing slows it down.
ROLLING = """
run = PlanarSimulation(TrainParams(
    cars=(car,) * 10,
    initiation=InitiationParams(speed=10.0, derailed_trucks=((1, "front"), (1, "rear"))),
    brakes=BrakeParams(triggers=()),
    ground=GroundParams(scale=0.0),
    integration=IntegrationParams(max_step=2e-3, time_limit=1e9),
))
run.advance_to(20.0)
run.sample()
before, steps = resident(), run.step_count
run.advance_to(220.0)
run.sample()
assert not run.ended and run.step_count > 10 * steps > 50_000
print(resident() - before)
"""

LONG_TRAIN = """
warm_up()
before = resident()
run = PlanarSimulation(TrainParams(
    cars=(car,) * 1000,
    initiation=InitiationParams(speed=10.0, derailed_trucks=((1, "front"), (1, "rear"))),
    integration=IntegrationParams(time_limit=20.0),
))
outcome = run.run()
assert run.n_cars == 1000 and run.ended
assert outcome.energy_residual < 1e-2 and outcome.max_coupler_gap < 1e-6
print(resident() - before)
"""


def grown(code):
    """Bytes, from a process of its own."""
    if not sys.platform.startswith("linux"):
        pytest.skip("memory is read from /proc, which only Linux has")
    done = subprocess.run(
        [sys.executable, "-c", RESIDENT + code], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return int(done.stdout)


def test_a_run_ten_times_as_long_takes_no_more_memory():
    # one float a step would be a megabyte
    assert grown(ROLLING) < 300_000


def test_a_thousand_cars():
    assert grown(LONG_TRAIN) < 10e6
