"""What is wrong is refused by name, and a run that cannot go on says so and can be kept."""

import dataclasses
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from derail_ros.engine import PlanarSimulation, serial
from derail_ros.vocabulary.errors import (
    CommandError,
    DerailError,
    NonFiniteStateError,
    ParameterError,
    SimulationError,
    StateFormatError,
    StepSizeError,
    TrackEndError,
)
from derail_ros.vocabulary.events import EventKind
from derail_ros.vocabulary.params import (
    BrakeParams,
    BrakeTrigger,
    BrakeUnit,
    IntegrationParams,
    LateralForce,
    TrackParams,
    TrackSegment,
)
from tests.engine.support import free_train, make_car, make_train, start, with_integration

BASE = make_train(
    (make_car(0), make_car(1), make_car(2)),
    speed=10.0,
    lateral=(LateralForce(),),
    triggers=(BrakeTrigger(),),
    breaks=(5.0,),
    track=TrackParams((TrackSegment(500.0), TrackSegment(100.0, 0.0, 0.002)), -250.0),
)


def changed(params, path, value):
    """Parameters with one field replaced; the path as a `ParameterError` names it."""
    name, _, rest = path.partition(".")
    if isinstance(params, tuple):
        k = int(name)
        new = changed(params[k], rest, value) if rest else value
        return (*params[:k], new, *params[k + 1 :])
    if not rest:
        return replace(params, **{name: value})
    return replace(params, **{name: changed(getattr(params, name), rest, value)})


def numbers(value, path=""):
    """Paths of all numbers in the parameters."""
    if dataclasses.is_dataclass(value):
        for f in dataclasses.fields(value):
            yield from numbers(getattr(value, f.name), f"{path}.{f.name}".lstrip("."))
    elif isinstance(value, tuple):
        for k, v in enumerate(value):
            yield from numbers(v, f"{path}.{k}")
    elif isinstance(value, float):
        yield path


def refuse(path, value, field=None):
    """The parameters with that value are refused, and the error names the field."""
    with pytest.raises(ParameterError) as caught:
        PlanarSimulation(changed(BASE, path, value))
    assert caught.value.field == (path if field is None else field)
    assert str(caught.value).startswith(f"{caught.value.field}: ")
    assert len(caught.value.reason) > 5
    assert isinstance(caught.value, DerailError)
    assert isinstance(caught.value, ValueError)


def test_the_base_is_good():
    assert PlanarSimulation(BASE).run().final


# the place and direction of the line are checked where they are used
PATHS = sorted(set(numbers(BASE)))


def test_numbers_are_found():
    assert len(PATHS) > 90
    assert "cars.1.front.k1" in PATHS
    assert "initiation.lateral_forces.0.force" in PATHS


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, "fast", None])
@pytest.mark.parametrize("path", PATHS)
def test_what_is_not_a_finite_number_is_refused(path, value):
    refuse(path, value)


BELOW_ZERO = [
    "cars.0.mass",
    "cars.1.inertia",
    "cars.2.length",
    "cars.0.width",
    "cars.0.pivot_distance",
    "cars.0.truck_distance",
    "cars.0.coupler_inertia",
    "cars.0.front.length",
    "cars.1.rear.striker_arm",
    "cars.1.rear.k1",
    "cars.1.rear.k2",
    "ground.eps",
    "contact.force_max",
    "contact.half_distance",
    "contact.buffer",
    "brakes.signal_speed",
    "derailment.lv_limit",
    "derailment.knuckle_limit_ee",
    "derailment.knuckle_limit_ff",
    "derailment.knuckle_limit_ef",
    "integration.buffer_fraction",
    "integration.max_step",
    "integration.min_step",
    "integration.rest_speed",
    "integration.rest_yaw_rate",
    "integration.rest_hold",
    "integration.time_limit",
    "integration.rtol",
    "track.segments.0.length",
]


@pytest.mark.parametrize("value", [0.0, -1.0])
@pytest.mark.parametrize("path", BELOW_ZERO)
def test_what_must_be_above_zero(path, value):
    refuse(path, value)


NEGATIVE = [
    "cars.0.front.striker_opening",
    "cars.0.front.damping",
    "cars.1.brakes.0.scale",
    "cars.1.brakes.0.delay",
    "cars.1.brakes.0.weight",
    "ground.c_s",
    "ground.c_d",
    "ground.c_v",
    "ground.scale",
    "contact.c1",
    "contact.c2",
    "contact.c3",
    "contact.begin_force",
    "contact.end_force",
    "contact.end_hold",
    "brakes.force",
    "brakes.rise_time",
    "brakes.traction_coefficient",
    "brakes.triggers.0.time",
    "brakes.triggers.0.delay",
    "derailment.break_ahead_of_truck",
    "integration.baumgarte_velocity",
    "integration.baumgarte_position",
    "initiation.speed",
    "initiation.lateral_forces.0.start",
    "initiation.lateral_forces.0.duration",
]


@pytest.mark.parametrize("path", NEGATIVE)
def test_what_must_not_be_negative(path):
    refuse(path, -0.001)


@pytest.mark.parametrize(
    ("path", "value", "field"),
    [
        ("cars", (), "cars"),
        ("cars.1.front.head", "G", None),
        ("cars.1.truck_distance", 7.2, None),
        ("cars.0.rear.length", 0.3, None),
        ("cars.1.represents", 0, None),
        ("cars.1.represents", 2.5, None),
        ("cars.1.represents", 3, None),  # only the last may be virtual
        ("cars.1.brakes.0.shoe", "wood", None),
        ("contact.gap_law", "spline", None),
        ("contact.inside", "odd", None),
        ("contact.end_force", 20e3, None),
        ("integration.method", "euler", None),
        ("integration.stabilization", "hope", None),
        ("integration.rtol", 0.5, None),
        ("integration.min_step", 0.1, None),
        ("brakes.triggers.0.mode", "gentle", None),
        ("brakes.triggers.0.source", "middle", None),
        ("brakes.triggers.0", BrakeTrigger(source="car", car=4), "brakes.triggers.0.car"),
        ("initiation.speed", 300.0, None),
        ("initiation.derailed_trucks", ((4, "front"),), "initiation.derailed_trucks.0"),
        ("initiation.derailed_trucks", ((1, "middle"),), "initiation.derailed_trucks.0"),
        ("initiation.parted_couplings", (1, 3), "initiation.parted_couplings.1"),
        ("initiation.lateral_forces.0.car", 0, None),
        ("initiation.lateral_forces.0.place", "roof", None),
        ("initiation.position", 400.0, None),
        ("initiation.position", -240.0, None),
        ("track.segments.1.curvature_end", 0.2, None),
        ("track.rail_breaks", (5.0, 351.0), "track.rail_breaks.1"),
    ],
)
def test_what_does_not_fit(path, value, field):
    refuse(path, value, field)


def test_a_virtual_body_cannot_start_derailed():
    params = changed(BASE, "cars.2.represents", 5)
    params = changed(params, "initiation.derailed_trucks", ((3, "rear"),))
    with pytest.raises(ParameterError) as caught:
        PlanarSimulation(params)
    assert caught.value.field == "initiation.derailed_trucks.0"


# Commands --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        ({}, "coordinate"),
        ({"coordinate": 3.0, "car": 1}, "coordinate"),
        ({"coordinate": math.nan}, "coordinate"),
        ({"coordinate": math.inf}, "coordinate"),
        ({"coordinate": "here"}, "coordinate"),
        ({"coordinate": 350.5}, "coordinate"),
        ({"coordinate": -251.0}, "coordinate"),
        ({"car": 0}, "car"),
        ({"car": 4}, "car"),
        ({"car": -1}, "car"),
        ({"car": 1.5}, "car"),
        ({"car": math.nan}, "car"),
        ({"car": "first"}, "car"),
        ({"car": 3}, "car"),  # its front truck is off the rails
    ],
)
def test_bad_rail_breaks(arguments, field):
    params = changed(BASE, "initiation.derailed_trucks", ((3, "front"),))
    run = PlanarSimulation(params)
    run.advance_to(0.3)
    before = run.state_hash(), run.events, run.commands
    with pytest.raises(CommandError) as caught:
        run.inject_rail_break(**arguments)
    assert caught.value.field == field
    assert (run.state_hash(), run.events, run.commands) == before


def test_a_break_far_from_the_endless_straight_is_refused():
    run = PlanarSimulation(make_train(2))
    with pytest.raises(CommandError, match="coordinate"):
        run.inject_rail_break(1.1e6)
    assert run.inject_rail_break(-0.9e6) == -0.9e6


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        ({"mode": "gentle"}, "mode"),
        ({"mode": ["instant"]}, "mode"),
        ({"mode": None}, "mode"),
        ({"source": "middle"}, "source"),
        ({"source": 3}, "source"),
        ({"source": "car"}, "car"),
        ({"source": "car", "car": 4}, "car"),
        ({"source": "car", "car": "2"}, "car"),
        ({"source": "car", "car": 1.5}, "car"),
        ({"delay": -0.1}, "delay"),
        ({"delay": math.nan}, "delay"),
        ({"delay": math.inf}, "delay"),
        ({"delay": "soon"}, "delay"),
    ],
)
def test_bad_brake_commands(arguments, field):
    run = PlanarSimulation(BASE)
    run.advance_to(0.3)
    before = run.state_hash(), run.events, run.commands
    with pytest.raises(CommandError) as caught:
        run.trigger_emergency_brake(**arguments)
    assert caught.value.field == field
    assert (run.state_hash(), run.events, run.commands) == before
    # and the run goes on as if nothing had been said
    other = PlanarSimulation(BASE)
    other.advance_to(0.5)
    run.advance_to(0.5)
    assert run.state_hash() == other.state_hash()


def test_no_commands_after_the_end():
    run = PlanarSimulation(with_integration(BASE, time_limit=0.1))
    run.run()
    for command in (lambda: run.inject_rail_break(3.0), run.trigger_emergency_brake):
        with pytest.raises(CommandError) as caught:
            command()
        assert caught.value.field == "run"


def test_time_must_be_a_number():
    with pytest.raises(CommandError):
        PlanarSimulation(BASE).advance_to(math.nan)


# Runs that cannot go on ------------------------------------------------------------------------


def failing(params, error):
    """A run that fails as it should; returns it, after checking what it left."""
    run = PlanarSimulation(params)
    heard = []
    with pytest.raises(error) as caught:
        while not run.ended:
            heard += run.advance_steps(1)
    e = caught.value
    assert type(e) is error
    assert isinstance(e, SimulationError)
    assert e.simulation is run
    assert (e.time, e.step) == (run.time, run.step_count)
    assert run.status == "failed"
    assert run.ended
    assert run.events[-1].kind == EventKind.RUN_FAILED
    # no silence: neither a further step nor a command is taken
    with pytest.raises(SimulationError):
        run.advance_to(run.time + 1.0)
    with pytest.raises(CommandError):
        run.trigger_emergency_brake()
    assert not run.outcome().final or run.outcome().status == "failed"
    # the last accepted state is there to be looked at and kept
    sample = run.sample()
    assert np.isfinite(sample.q).all()
    assert np.isfinite(sample.v).all()
    assert sample.time == run.time
    loaded = PlanarSimulation.from_bytes(run.to_bytes())
    assert loaded.state_hash() == run.state_hash()
    assert loaded.status == "failed"
    assert np.array_equal(loaded.sample().q, sample.q)
    with pytest.raises(SimulationError):
        loaded.advance_steps(1)
    return run


def test_the_end_of_the_line():
    params = make_train(3, speed=20.0, position=300.0, track=BASE.track)
    run = failing(params, TrackEndError)
    # off at the front, within a step of the end
    assert 350.0 < run.sample().truck_coordinate[0, 0] < 350.0 + 0.17
    assert run.time == pytest.approx((50.0 - 5.75) / 20.0, abs=0.02)


def test_the_beginning_of_the_line():
    params = make_train(2, speed=0.0, track=BASE.track, position=-220.0)
    home = PlanarSimulation(params).sample()
    v = np.zeros((2, 5))
    v[:, 0] = -10.0
    run = start(params, v=v)
    # the rear truck of car 2 is nearest
    room = home.truck_coordinate[1, 1] + 250.0
    assert 0.0 < room < 10.0
    with pytest.raises(TrackEndError):
        run.advance_to(5.0)
    assert run.time == pytest.approx(room / 10.0, abs=0.02)


def test_a_step_below_the_floor():
    # a tolerance that steps of a millisecond cannot meet
    params = make_train(
        4, speed=20.0, derailed=((1, "front"), (1, "rear")), lateral=(LateralForce(),)
    )
    run = failing(with_integration(params, rtol=1e-12, min_step=2e-2), StepSizeError)
    assert run.time < 5.0


@pytest.mark.parametrize(
    "params",
    [
        changed(BASE, "initiation.lateral_forces.0.force", 1e308),
        make_train(
            2, speed=10.0, derailed=((1, "front"), (1, "rear")), lateral=(LateralForce(1e200),)
        ),
        make_train(
            2,
            derailed=((1, "front"), (1, "rear")),
            brakes=BrakeParams(force=1e308, triggers=(BrakeTrigger(mode="instant"),)),
        ),
    ],
    ids=["force", "kick", "brakes"],
)
def test_a_state_that_is_no_longer_finite(params):
    run = failing(params, NonFiniteStateError)
    assert run.step_count == 0


def test_a_share_of_the_buffer_that_would_miss_pairs():
    # a car runs into a standing one; steps of any length up to the given share are allowed
    q, v = np.zeros((2, 5)), np.zeros((2, 5))
    q[1, :2], v[1, 0] = (-19.5, 0.2), 8.0

    def peak(share):
        params = free_train(2, parted=(1,), speed=0.0)
        run = start(with_integration(params, buffer_fraction=share), q, v)
        run.advance_to(1.5)
        return run.collisions[0].peak_force

    exact = peak(0.2)
    for share in (1.0, 3.0, 10.0):
        try:
            assert peak(share) == pytest.approx(exact, rel=0.2)
        except ParameterError as error:
            assert error.field == "integration.buffer_fraction"


# Saved states ----------------------------------------------------------------------------------


def saved():
    """A run in the middle of things, as bytes."""
    run = PlanarSimulation(BASE)
    run.advance_to(0.6)
    run.inject_rail_break(car=2)
    run.trigger_emergency_brake()
    run.advance_to(0.8)
    return run.to_bytes()


DATA = saved()


def refuses(data):
    with pytest.raises(StateFormatError):
        PlanarSimulation.from_bytes(data)


def test_the_saved_state_is_good():
    assert PlanarSimulation.from_bytes(DATA).to_bytes() == DATA
    assert PlanarSimulation.from_bytes(bytearray(DATA)).to_bytes() == DATA


@settings(deadline=None, max_examples=300, derandomize=True)
@given(st.integers(0, len(DATA) - 1))
def test_truncated_states(length):
    refuses(DATA[:length])


@settings(deadline=None, max_examples=300, derandomize=True)
@given(st.lists(st.tuples(st.integers(0, len(DATA) - 1), st.integers(1, 255)), min_size=1,
                max_size=4, unique_by=lambda change: change[0]))  # fmt: skip
def test_flipped_bits(changes):
    data = bytearray(DATA)
    for at, bits in changes:
        data[at] ^= bits
    refuses(bytes(data))


@settings(deadline=None, max_examples=200, derandomize=True)
@given(st.binary(max_size=300), st.booleans())
def test_anything_else(data, with_magic):
    refuses(DATA[:13] + data if with_magic else data)


@pytest.mark.parametrize("data", [b"", DATA + b"\0", DATA[1:], DATA * 2, None, "text", 3])
def test_other_things(data):
    refuses(data)


def test_another_version(monkeypatch):
    monkeypatch.setattr(serial, "VERSION", serial.VERSION + 1)
    other = saved()
    monkeypatch.undo()
    with pytest.raises(StateFormatError, match="version"):
        PlanarSimulation.from_bytes(other)


def test_a_whole_file_with_the_wrong_contents():
    # checksums right, contents not those of a run
    header, arrays = serial.unpack(DATA)
    assert serial.pack(header, arrays) == DATA

    def wrong(**changes):
        kept = {k: v for k, v in {**arrays, **changes}.items() if v is not None}
        refuses(serial.pack(header, kept))

    for name, array in arrays.items():
        wrong(**{name: None})
        if array.size:
            wrong(**{name: array.astype(np.float32)})
        if array.size and name not in ("pairs", "mask", "pair", "contact", "breaks"):
            wrong(**{name: np.concatenate([array, array])})
    wrong(another=np.zeros(3))
    for name in header:
        refuses(serial.pack({k: v for k, v in header.items() if k != name}, arrays))
    bad = {**header["params"], "initiation": {**header["params"]["initiation"], "speed": -1.0}}
    refuses(serial.pack({**header, "params": bad}, arrays))
    extra = {**header["params"], "colour": "red"}
    refuses(serial.pack({**header, "params": extra}, arrays))


def test_parameters_survive_saving():
    params = replace(
        BASE,
        integration=IntegrationParams(rtol=1e-7, time_limit=33.0),
        cars=(*BASE.cars[:2], replace(BASE.cars[2], represents=2, contents="grain",
                                      brakes=(BrakeUnit(1.0), BrakeUnit(2.0, "cast_iron")))),
    )  # fmt: skip
    run = PlanarSimulation(params)
    loaded = PlanarSimulation.from_bytes(run.to_bytes())
    assert loaded.params == params
    assert isinstance(loaded.params.cars, tuple)
    assert isinstance(loaded.params.initiation.derailed_trucks, tuple)
