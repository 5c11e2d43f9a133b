"""Parameters of a run: frozen objects, SI units, validated when the run is built.

Defaults marked [R] are reconstructed: the surviving copy of the source (E. E. Toma, *A Computer
Model of a Derailment*, PhD thesis, Queen's University, 1998) lost or never gave them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from derail_ros.vocabulary.site import SiteParams

GRAVITY = 9.81
"""Acceleration of gravity, m/s^2."""
PLANAR = "planar"
"""Name of the default model."""
METHODS = ("rkf45", "row")
"""Methods of integration: the explicit reference, and the one with implicit friction."""
BRAKE_SYSTEMS = ("conventional", "two_way_eot", "distributed_power", "ecp")
"""Brake systems; their places are the codes that kernels use."""
LATER: Mapping[str, Any] = {"left_out_at_default": True}
"""Marks a field that came later than the format of saved states (``vocabulary.plain``)."""


@dataclass(frozen=True)
class CouplerType:
    """A coupler, its striker and its draft gear (source, coupler table).

    Attributes
    ----------
    name : e.g. "F79"
    head : "E" or "F"; decides the knuckle moment of a mated pair
    length : pivot to mated face ``d_C``, m
    striker_arm : pivot to striker contact ``d_st``, m
    striker_opening : striker opening ``d_so``, m
    k1 : stiffness up to the opening, N/m
    k2 : stiffness beyond the opening, N/m [R]
    damping : damper in parallel, N s/m
    """

    name: str
    head: str
    length: float
    striker_arm: float
    striker_opening: float
    k1: float
    k2: float = 50.0e6
    damping: float = 4000.0


@dataclass(frozen=True)
class BrakeUnit:
    """The brake of one real car, carried by a modelled car or by the virtual body.

    Attributes
    ----------
    distance : arc length from the centre of car 1 back along the train, m
    shoe : "composition", "cast_iron" or "none"
    scale : size factor ``K_b``, 1
    delay : delay of this car's own brake after the signal reaches it, s
    weight : mass the traction limited mode counts for this unit, kg
    force : full emergency force at rest, N, in place of ``BrakeParams.force`` times ``scale``
    hand : force of the hand brake at rest, N; it acts from the start, on the same shoes
    """

    distance: float
    shoe: str = "composition"
    scale: float = 1.0
    delay: float = 0.0
    weight: float = 0.0
    force: float | None = field(default=None, metadata=LATER)
    hand: float = field(default=0.0, metadata=LATER)


@dataclass(frozen=True)
class Car:
    """One body of the train.

    Attributes
    ----------
    mass : total mass m, kg
    inertia : yaw inertia about the mass centre (coupler masses included), kg m^2
    length, width : collision rectangle L x w, m
    pivot_distance : centre to coupler pivot ``d_P``, m
    truck_distance : centre to truck pivot ``d_T``, m
    front, rear : couplers
    coupler_inertia : inertia of each coupler body ``I_c``, kg m^2
    brakes : brake units of this body (one; the virtual body has one for each car it stands for)
    represents : number of real cars this body stands for; more than 1 makes it virtual:
        it never derails and never collides
    name : label, e.g. the type of the car
    contents : what it carries
    locomotives, loads, empties : how many of the cars it stands for are that; a car whose load
        is not known is not one of them
    coupled_length : of a virtual body, the length over couplers of the cars it stands for, m
    resistance : ``r0, r1, r2`` of its resistance ``r0 + r1 v + r2 v^2``, N, N s/m, N s^2/m^2
    tractive_effort, dynamic_brake : of a locomotive: largest effort over speed, (m/s, N) rising
        in speed, straight between the points and constant beyond
    """

    mass: float
    inertia: float
    length: float
    width: float
    pivot_distance: float
    truck_distance: float
    front: CouplerType
    rear: CouplerType
    coupler_inertia: float = 20_000.0
    brakes: tuple[BrakeUnit, ...] = ()
    represents: int = 1
    name: str = ""
    contents: str = ""
    locomotives: int = field(default=0, metadata=LATER)
    loads: int = field(default=0, metadata=LATER)
    empties: int = field(default=0, metadata=LATER)
    coupled_length: float = field(default=0.0, metadata=LATER)
    resistance: tuple[float, float, float] = field(default=(0.0, 0.0, 0.0), metadata=LATER)
    tractive_effort: tuple[tuple[float, float], ...] = field(default=(), metadata=LATER)
    dynamic_brake: tuple[tuple[float, float], ...] = field(default=(), metadata=LATER)


@dataclass(frozen=True)
class TrackSegment:
    """A piece of alignment whose curvature changes linearly with arc length (a clothoid).

    Attributes
    ----------
    length : arc length, m
    curvature_start, curvature_end : 1/m, positive to the left; equal on a tangent (0) or a
        circular curve (1/R)
    """

    length: float
    curvature_start: float = 0.0
    curvature_end: float = 0.0


@dataclass(frozen=True)
class GradeChange:
    """Where the grade changes: a vertical curve (a parabola) with its middle there.

    Attributes
    ----------
    at : track coordinate, m; -inf for the grade at the beginning of the track
    grade : from there on, rise per metre, positive uphill in the direction of travel
    length : of the vertical curve, m; 0 is a kink
    """

    at: float
    grade: float
    length: float = 0.0


@dataclass(frozen=True)
class TrackParams:
    """The centre line.

    Attributes
    ----------
    segments : alignment in order of rising track coordinate. Empty: an endless straight along
        +X with track coordinate X
    start_coordinate : track coordinate of the beginning of the first segment, m
    start_x, start_y, start_heading : its place (m) and direction (rad)
    rail_breaks : track coordinates of the breaks present at the start, m
    grades : changes of the grade in order of rising track coordinate; level before the first
    curve_resistance : resistance in a curve times its radius over the mass, m^2/s^2
    """

    segments: tuple[TrackSegment, ...] = ()
    start_coordinate: float = 0.0
    start_x: float = 0.0
    start_y: float = 0.0
    start_heading: float = 0.0
    rail_breaks: tuple[float, ...] = ()
    grades: tuple[GradeChange, ...] = field(default=(), metadata=LATER)
    curve_resistance: float = field(default=0.0, metadata=LATER)


@dataclass(frozen=True)
class LateralForce:
    """A force that starts the motion.

    It keeps its direction in space: the left normal of the track where the truck stands at the
    start (global +Y on the straight [R]).

    Attributes
    ----------
    force : N, positive to the left
    car : car number, from 1
    place : "front" (front truck), "rear" (rear truck) or "centre"
    start, duration : s
    """

    force: float = 50_000.0
    car: int = 1
    place: str = "front"
    start: float = 0.0
    duration: float = 1.0


@dataclass(frozen=True)
class InitiationParams:
    """How the run starts.

    Attributes
    ----------
    speed : speed of the train along the track, m/s
    position : track coordinate of the mass centre of car 1, m
    derailed_trucks : ``(car number, "front" | "rear")`` derailed from the start
    parted_couplings : ``i`` for the coupling between cars i and i + 1, parted from the start
    lateral_forces : forces that start the motion
    """

    speed: float
    position: float = 0.0
    derailed_trucks: tuple[tuple[int, str], ...] = ((1, "front"), (1, "rear"))
    parted_couplings: tuple[int, ...] = ()
    lateral_forces: tuple[LateralForce, ...] = (LateralForce(),)


@dataclass(frozen=True)
class BrakeTrigger:
    """An emergency application.

    Attributes
    ----------
    time : when it is made, s
    source : "front", "rear", "both_ends" or "car"
    car : car number, for source "car"
    mode : "conventional", "instant" (no propagation, no rise), "traction_limited", or
        "instant_traction_limited"
    delay : overall delay, s
    """

    time: float = 0.0
    source: str = "front"
    car: int = 0
    mode: str = "conventional"
    delay: float = 0.0


@dataclass(frozen=True)
class BrakeParams:
    """Constants of the brake law.

    Attributes
    ----------
    force : full-service emergency force ``F0`` of a car at rest with ``K_b = 1``, N [R]
    rise_time : time from zero to full force, s
    signal_speed : propagation of the emergency signal, m/s
    traction_coefficient : ``mu_t`` of the traction limited mode
    vent_on_parting : a parted coupling starts the emergency from there, both ways
    triggers : applications present from the start
    system : how an emergency spreads (``BRAKE_SYSTEMS``); along the brake pipe in all but "ecp"
    remote : places that a radio orders to vent too, as arc length behind the centre of car 1, m:
        the rear end ("two_way_eot"), the locomotives within and behind ("distributed_power")
    radio_delay : from the leading locomotive's noticing an emergency to the venting there, s; with
        distributed power, from any locomotive's noticing it to the venting at all others
    """

    force: float = 64_000.0
    rise_time: float = 10.0
    signal_speed: float = 290.0
    traction_coefficient: float = 0.3
    vent_on_parting: bool = False
    triggers: tuple[BrakeTrigger, ...] = (BrakeTrigger(),)
    system: str = field(default="conventional", metadata=LATER)
    remote: tuple[float, ...] = field(default=(), metadata=LATER)
    radio_delay: float = field(default=1.0, metadata=LATER)


@dataclass(frozen=True)
class Notch:
    """A setting of locomotives.

    Attributes
    ----------
    time : when it is made, s; 0 holds at the start at once
    notch : 8 to 1 power, 0 idle, -1 to -8 dynamic brake
    cars : car numbers of the locomotives it is for; (): all
    """

    time: float
    notch: int
    cars: tuple[int, ...] = ()


@dataclass(frozen=True)
class TractionParams:
    """How locomotives pull and brake.

    Attributes
    ----------
    notches : settings in order of their time; idle before the first
    response_time : from none to the full effort, s
    cut_time : from the arrival of an emergency at a locomotive to no effort, s
    keep_dynamic : an emergency leaves the dynamic brake on
    """

    notches: tuple[Notch, ...] = ()
    response_time: float = 20.0
    cut_time: float = 1.0
    keep_dynamic: bool = False


@dataclass(frozen=True)
class DraftGearParams:
    """Draft gear along every coupling, both gears of it together (``engine.laws.draft_gear``).

    Attributes
    ----------
    on : couplings stretch and shorten; otherwise they are rigid along the train
    slack : free slack, m
    preload : N
    stiffness : of loading, N/m
    unloading : force on unloading over that on loading; 1: no friction
    transition : travel from one line to the other, m
    travel : beyond which the gears are solid, m
    solid : stiffness added beyond, N/m
    start : 1 stretched at the start, -1 bunched, 0 in the middle of the slack
    """

    on: bool = False
    slack: float = 0.05
    preload: float = 240e3
    stiffness: float = 12.85e6
    unloading: float = 0.2
    transition: float = 0.005
    travel: float = 0.15
    solid: float = 100e6
    start: float = 1.0


@dataclass(frozen=True)
class WeakCoupling:
    """A coupling with a strength of its own: ``coupling`` i joins cars i and i + 1; N."""

    coupling: int
    strength: float
    part: str = "knuckle"


@dataclass(frozen=True)
class CouplingParams:
    """Couplings along the train.

    Attributes
    ----------
    gear : draft gear
    knuckle_strength, body_strength : tension at which the knuckle and the coupler body break, N;
        0: never
    weak : couplings with a strength of their own
    """

    gear: DraftGearParams = field(default_factory=DraftGearParams)
    knuckle_strength: float = 0.0
    body_strength: float = 0.0
    weak: tuple[WeakCoupling, ...] = ()

    @property
    def breaks(self) -> bool:
        """Every coupling breaks at some tension."""
        return bool(self.knuckle_strength or self.body_strength)


@dataclass(frozen=True)
class GroundParams:
    """Ground reaction ``K(v) = c_d + (c_s - c_d) exp(-v/eps) + c_v v`` times the load.

    The source prints ``c_s``, ``c_d`` and ``eps``; its equation, and the unit of the 3.0 that it
    prints for ``c_v``, are lost [R].
    """

    c_s: float = 0.8
    c_d: float = 0.7
    eps: float = 0.01
    c_v: float = 0.03
    scale: float = 1.0


@dataclass(frozen=True)
class ContactParams:
    """Collision law. The source prints all but its form, and when a contact begins and ends.

    Attributes
    ----------
    force_max : ``F_max``, N
    half_distance : ``d_c`` at which the force is half of ``F_max``, m
    buffer : ``d_b`` beyond which there is none, m
    c1, c2, c3 : speed factor ``c1 v|v| + c2 v + c3``
    gap_law : shape of the bell, "gaussian", "lorentzian", "sech2" or "quartic" [R]
    inside : inside a body, the same bell ("even") or ``F_max`` ("held") [R]
    begin_force, end_force, end_hold : a contact is an event from ``begin_force`` (N) until it
        has been below ``end_force`` (N) for ``end_hold`` (s) [R]
    """

    force_max: float = 3.0e6
    half_distance: float = 0.08
    buffer: float = 0.8
    c1: float = 0.025
    c2: float = 0.1
    c3: float = 1.0
    gap_law: str = "gaussian"
    inside: str = field(default="held", metadata=LATER)
    begin_force: float = 10_000.0
    end_force: float = 5_000.0
    end_hold: float = 0.020


@dataclass(frozen=True)
class DerailmentParams:
    """When constraints are removed.

    Attributes
    ----------
    lv_limit : derailment quotient: a truck leaves the rails when ``|lambda| > LV m g / 2``
    lv_hold : for so long it must be exceeded, s; 0: at once. The 50 ms of AAR's chapter 11 keep
        out blows that are too short for a wheel to climb
    truck_play : how far a truck moves sideways from the middle until it bears on the rail, m; in
        buff coupled cars stand askew by it (``engine.forces.track``); 0: they stand straight
    guide_strength : force across the track with which rails guide a derailed truck at most, N;
        0: they do not (``engine.forces.guidance``)
    guide_stiffness, guide_play : of the rail, N/m; offset from which it guides, m; assumed
    break_follows_lateral : a lateral derailment also breaks the rail there (rail roll-over) [R]
    break_ahead_of_truck : how far ahead of its front truck a break opens "under" a car, m
    knuckle_limit_ee, knuckle_limit_ff, knuckle_limit_ef : coupling angle limits, rad
    """

    lv_limit: float = 2.0
    break_follows_lateral: bool = False
    break_ahead_of_truck: float = 0.5
    knuckle_limit_ee: float = 0.90
    knuckle_limit_ff: float = 0.71
    knuckle_limit_ef: float = 0.80
    lv_hold: float = field(default=0.0, metadata=LATER)
    truck_play: float = field(default=0.0, metadata=LATER)
    guide_strength: float = field(default=0.0, metadata=LATER)
    guide_stiffness: float = field(default=2e6, metadata=LATER)
    guide_play: float = field(default=0.6, metadata=LATER)


@dataclass(frozen=True)
class IntegrationParams:
    """How the run is integrated.

    Attributes
    ----------
    method : "row", of order 4 with implicit friction near rest, or "rkf45", the reference
    rtol : relative error allowed per step, of the embedded method: of order 3 in "row"; 1e-4
        suits "rkf45"
    stabilization : "projection" or "baumgarte"
    baumgarte_velocity, baumgarte_position : ``a`` (1/s) and ``b`` (1/s^2) [R]
    locate_crossings : find break crossings, lateral derailments and coupling failures inside the
        step; False gives the source's form, tested only at the ends of steps
    buffer_fraction : no corner of a car that may turn moves further than this share of the buffer
        in one step; near another body not as that body sees it either
    max_step, min_step : s
    rest_speed, rest_yaw_rate, rest_hold : the run ends when all cars have been slower than this
        (m/s, rad/s) for that long (s) [R]
    time_limit : the run ends with the first step that ends at this time or later, s
    """

    method: str = "row"
    rtol: float = 1e-3
    stabilization: str = "projection"
    baumgarte_velocity: float = 30.0
    baumgarte_position: float = 50.0
    locate_crossings: bool = True
    buffer_fraction: float = 0.2
    max_step: float = 0.05
    min_step: float = 1e-9
    rest_speed: float = 0.3
    rest_yaw_rate: float = 0.05
    rest_hold: float = 0.5
    time_limit: float = 120.0


@dataclass(frozen=True)
class VariantParams:
    """Laws of an earlier model in place of this one's; the defaults change nothing.

    Attributes
    ----------
    held_moment : the moment between coupler heads is held beyond its largest value
        (``laws.joint``) instead of falling (``laws.knuckle``)
    moment_widening : its dead band is wider by this much, rad
    whole_car : a car leaves the rails with both trucks as its front truck passes a break
    collisions : cars collide
    """

    held_moment: bool = False
    moment_widening: float = 0.0
    whole_car: bool = False
    collisions: bool = True


@dataclass(frozen=True)
class SecondTrack:
    """A track beside the main one: its centre line, level, without breaks in its rails."""

    name: str
    line: TrackParams


@dataclass(frozen=True)
class StandingCut:
    """Coupled cars that stand at the start, without a brake pipe under pressure.

    Attributes
    ----------
    track : row of ``TrainParams.tracks``
    position : coordinate of the first car's mass centre there, m; the others stand behind it
    cars : how many
    """

    track: int
    position: float
    cars: int


@dataclass(frozen=True)
class TrainParams:
    """Everything a run is built from; ``model`` names the engine that computes it.

    ``cars`` are the train's own, then those of the cuts in ``standing``, in their order.
    """

    cars: tuple[Car, ...]
    initiation: InitiationParams
    track: TrackParams = field(default_factory=TrackParams)
    brakes: BrakeParams = field(default_factory=BrakeParams)
    ground: GroundParams = field(default_factory=GroundParams)
    contact: ContactParams = field(default_factory=ContactParams)
    derailment: DerailmentParams = field(default_factory=DerailmentParams)
    integration: IntegrationParams = field(default_factory=IntegrationParams)
    variant: VariantParams = field(default_factory=VariantParams, metadata=LATER)
    model: str = field(default=PLANAR, metadata=LATER)
    traction: TractionParams = field(default_factory=TractionParams, metadata=LATER)
    couplings: CouplingParams = field(default_factory=CouplingParams, metadata=LATER)
    site: SiteParams = field(default_factory=SiteParams, metadata=LATER)
    tracks: tuple[SecondTrack, ...] = field(default=(), metadata=LATER)
    standing: tuple[StandingCut, ...] = field(default=(), metadata=LATER)

    @property
    def n_train(self) -> int:
        """Number of the train's own bodies."""
        return len(self.cars) - sum(cut.cars for cut in self.standing)

    @property
    def cut_numbers(self) -> tuple[int, ...]:
        """For each car the number of its cut of standing cars, from 1; 0 for the train's own."""
        sizes = (self.n_train, *(cut.cars for cut in self.standing))
        return tuple(number for number, size in enumerate(sizes) for _ in range(size))

    @property
    def alone(self) -> TrainParams:
        """The train without the cars on second tracks."""
        return replace(self, cars=self.cars[: self.n_train], tracks=(), standing=())
