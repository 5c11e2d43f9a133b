"""What an outcome says of itself where it lies beyond what was compared."""

import math
from dataclasses import replace

import numpy as np

from derail_ros.recording.recorded_run import SampledLine
from derail_ros.vocabulary.events import Event, EventKind
from derail_ros.vocabulary.limits import late_brakes, limits, train_force_limits
from derail_ros.vocabulary.outcome import Outcome, StandingOutcome
from derail_ros.vocabulary.site import SiteOutcome, Struck


def outcome(*cars: tuple[float, float, float]) -> Outcome:
    """All of the cars have derailed; x, y (m) and heading (degrees) of each."""
    pose = np.zeros((len(cars), 6))
    pose[:, [0, 1, 5]] = [(x, y, math.radians(yaw)) for x, y, yaw in cars]
    made = Outcome.nothing(pose, "at rest", 10.0)
    return replace(made, derailed_cars=tuple(range(1, len(cars) + 1)))


def test_a_pile_on_the_straight_has_no_limits() -> None:
    assert limits(outcome((0.0, 2.0, 40.0), (-10.0, 0.1, -30.0)), SampledLine()) == []


def test_cars_that_were_dragged_in_line() -> None:
    pile = [(30.0, 3.0, 60.0), (15.0, 0.5, 2.0), (0.0, 0.5, 184.0), (-15.0, 0.2, -4.9)]
    (said,) = limits(outcome(*pile), SampledLine())
    assert said.startswith("cars 2 and 4 are off the rails but in line with the track; they count")
    assert limits(outcome((0.0, 1.6, 0.0)), SampledLine()) == [], "beside the track"


def test_a_place_in_three_dimensions_was_compared_with_no_accident() -> None:
    flat = outcome((0.0, 2.0, 40.0))
    site = SiteOutcome(fixed=(Struck("wall", 1e6, 1e5, (1,)),))
    assert limits(replace(flat, site=site), SampledLine()) == [], "the planar model"
    tall = replace(flat, values={"pile_height_m": 4.4})
    assert limits(tall, SampledLine()) == []
    assert limits(replace(tall, site=SiteOutcome()), SampledLine()) == []
    for more in ({"site": site}, {"standing": StandingOutcome(2)}):
        (said,) = limits(replace(tall, **more), SampledLine())
        assert "in three dimensions" in said and "no accident" in said


def test_in_a_curve_headings_are_those_of_the_track() -> None:
    s = np.linspace(0.0, 300.0, 301)
    radius = 250.0
    line = SampledLine(
        s, radius * np.sin(s / radius), radius * (1 - np.cos(s / radius)), s / radius,
        np.full(len(s), 1 / radius),
    )  # fmt: skip
    x, y, heading, _ = line.point(200.0)
    curve, dragged = limits(outcome((x, y, math.degrees(heading) + 3.0)), line)
    assert "a curve of 250 m radius" in curve
    assert dragged.startswith("car 1 is off the rails but in line")
    (curve,) = limits(outcome((x, y, 0.0)), line)
    assert "a curve of 250 m radius" in curve


def test_brakes_that_waited_for_a_coupling_to_part() -> None:
    first = Event(EventKind.TRUCK_DERAILED, 0.5, 1, (3,))
    later = Event(EventKind.TRUCK_DERAILED, 9.0, 1, (4,))
    signal = Event(EventKind.BRAKE_SIGNAL_REACHED, 20.0, 1, (2,))

    def brakes(time: float, cause: str = "vented") -> Event:
        return Event(EventKind.BRAKES_TRIGGERED, time, 1, cause=cause)

    (said,) = late_brakes([first, later, brakes(15.7), signal, brakes(19.0)])
    assert said.startswith("the emergency brakes began 15.2 s after the first derailment")
    assert late_brakes([first, brakes(6.0), later, brakes(19.0)]) == []
    assert late_brakes([brakes(0.0, "conventional from the front"), first, brakes(19.0)]) == []
    assert late_brakes([first, later, brakes(15.7, "command: all cars at once")]) == []
    assert late_brakes([brakes(15.7), first]) == late_brakes([first]) == late_brakes([]) == []


def test_forces_that_couplers_and_cars_do_not_bear() -> None:
    assert train_force_limits([2.8e6], [4.4e6]) == []
    assert train_force_limits([math.nan], [math.nan]) == []
    draft, buff = train_force_limits([20.3e6], [18.2e6])
    assert draft == (
        "the largest draft force is 20.3 MN, above the 2.89 MN at which knuckles break "
        "(AAR M-211): couplings do not break in tension here; set couplers.knuckle_strength_N"
    )
    assert buff == (
        "the largest buff force is 18.2 MN, above the 4.45 MN for which car bodies are tested "
        "(AAR M-1001): nothing yields in this model"
    )
    (buff,) = train_force_limits([3.4e6], [18.2e6], breaks=True)
    assert buff.startswith("the largest buff force")


def test_forces_of_an_ensemble() -> None:
    (draft,) = train_force_limits([20.3e6, 2.0e6, 3.0e6, math.nan], [0.0, 1e6, 2e6, math.nan])
    assert draft.startswith("the largest draft force is, in 2 of 4 runs (20.3 MN at most), above")
