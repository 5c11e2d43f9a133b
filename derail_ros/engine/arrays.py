"""Arrays of a run, by what they are for.

``Model`` never changes during a run (an injected break or brake changes ``State`` only), ``State``
is all that decides the future and the record so far, ``Work`` is scratch. N cars, M brake units, P
rows for neighbouring pairs, K rows for contacts; columns in ``layout``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from derail_ros.engine import layout, pointers
from derail_ros.engine.laws.ground import BODY_POINTS

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]


Rows = NDArray[np.void]
"""Rows of a table of ``layout``."""


class Model(NamedTuple):
    """Parameters of a run."""

    par: Rows  # (1,) PAR
    car: Rows  # (N,) CAR
    striker: Rows  # (N, 2) STRIKER
    knuckle: Rows  # (N-1,) KNUCKLE
    unit: Rows  # (M,) UNIT
    unit_start: I64  # (N+1,)
    remote: F64  # places that a radio orders to vent, m behind car 1
    lateral: Rows  # (F,) PUSH
    track: Rows  # (pieces,) TRACK
    side: Rows  # (pieces,) TRACK of all second tracks, one after the other
    link: Rows  # (N-1,) LINK
    along: Rows  # (N,) ALONG
    effort: Rows  # (points,) EFFORT
    setting: Rows  # (points,) SETTING
    grade: Rows  # (pieces,) GRADE
    table: F64  # of the integration method
    outline: Rows  # (V,) OUTLINE
    zone: Rows  # (Z,) ZONE
    fixed: Rows  # (B,) FIXED
    area: Rows  # (A,) AREA


class State(NamedTuple):
    """Mutable state of a run."""

    q: F64  # (N, 5)
    v: F64
    a: F64
    q0: F64  # beginning of the last step
    v0: F64
    a0: F64
    a1: F64  # acceleration at its end with the constraints of that step
    rail_force: F64  # (N, 2)
    coupler_force: F64  # (N-1, 2)
    truck_s: F64  # (N, 2) track coordinates (between steps: of q)
    truck_on: U8  # (N, 2)
    coupled: U8  # (N-1,)
    truck_on0: U8  # constraints of the last step
    coupled0: U8
    arrival: F64  # (M, 4) arrival times of the brake signal
    reached: U8  # (M,) its arrival has been reported
    breaks: F64  # (B,) track coordinates, infinite where unused
    energy: F64  # (N_ENERGY,)
    power: F64  # (N_POWER,) at q, v
    energy0: F64  # at the beginning of the last step
    power0: F64
    power1: F64  # at its end, with the constraints of that step
    clock: Rows  # (1,) CLOCK
    cnt: Rows  # (1,) COUNT
    built: F64  # (N, 2) places at which the neighbour list was made
    pairs: I64  # (P, 2)
    mask: U8  # (P, 8)
    pair: Rows  # (P,) PAIR
    contact: Rows  # (K,) CONTACT
    peak: Rows  # (N,) PEAK
    coupling: Rows  # (N-1,) COUPLING
    over_since: F64  # (N, 2) when a truck passed its lateral limit, nan below it
    loose: U8  # (N, 2) derailed trucks that no rail guides any more
    struck: Rows  # (N B,) PAIR of a car and a fixed body
    hold: I64  # (N, 4 B + V) which side of which edge a corner is held on, see forces.fixed
    dent: F64  # (N, 4 B + V) how far a corner has pushed a body in, m
    group: Rows  # (G,) GROUP of edges of fixed bodies that give way together
    inside: U8  # (N, A) the car has been there


class Work(NamedTuple):
    """Scratch of the kernels."""

    wk: Rows  # (N,) WORK
    row: Rows  # (N, 2) ROW
    ang: F64  # (3, 3 N) angles, sines, cosines
    ground: F64  # (10, 10 N) points on the ground: squared speed; place on the axis; two results;
    # in zones also c_s, c_d, eps, c_v and the slope along x and y
    ground_first: I64  # (N+1,) first of a car's points
    force: F64  # (N, 5)
    stage_q: F64
    stage_v: F64
    kq: F64  # (stages, N, 5)
    kv: F64
    power: F64  # (N_POWER,)
    mean_power: F64  # over the step
    kp: F64  # (stages, N_POWER)
    trial: Rows  # (1,) TRIAL
    gamma_t: F64  # (N, 2)
    gamma_c: F64  # (N-1, 2)
    lam_t: F64
    lam_c: F64
    dx: F64  # (N, 5)
    truck_s: F64  # (N, 2) at the beginning of the step
    event: Rows  # (E,) EVENT
    report: F64  # (N or 0, layout.N_REPORT)
    order: I64  # (N,) cars along X
    place: I64  # (N,) and the place of each among them
    pairs: I64  # (P, 2) next neighbour list
    mask: U8
    pair: Rows
    blank: Rows  # (1,) PAIR, zero
    within_q: F64  # (N, 5) of a pair, at a moment within the last step
    within_v: F64
    within_wk: Rows
    within_force: F64  # (N, 5)
    bound: U8  # (N,) 1: the car can only move along the track, see blocks
    head: I64  # (N,) first car of the block that a car belongs to
    tail: I64  # (N,) and its last one
    live: I64  # (1 + N,) number and list of the cars that may turn or bend
    scope: I64  # (2,) number of the cars, from the first, that evaluations look at; 1: they give
    # the rail forces too, and the forces inside blocks
    active: I64  # (1 + P,) number and rows of the pairs that may touch in this step
    corners: I64  # (1 + P,) and which of their corners may: bit 4 side + corner
    near: I64  # (1 + N B, 4) number of rows; car, fixed body and its edges that it may touch


for kind in (Model, State, Work):
    pointers.register(kind)

ALL_CORNERS = 255
"""``Work.corners`` of a pair of which every corner may touch."""

SLOPES = 8
"""Room for the stages of a method and the slope at its end."""


def make_work(n: int, pair_rows: int, event_rows: int, report: bool, fixed: int = 0) -> Work:
    """Scratch for ``n`` cars and ``fixed`` bodies."""
    return Work(
        wk=np.zeros(n, layout.WORK),
        row=np.zeros((n, 2), layout.ROW),
        ang=np.zeros((3, 3 * n)),
        ground=np.zeros((10, BODY_POINTS * n)),
        ground_first=np.zeros(n + 1, dtype=np.int64),
        force=np.zeros((n, 5)),
        stage_q=np.zeros((n, 5)),
        stage_v=np.zeros((n, 5)),
        kq=np.zeros((SLOPES, n, 5)),
        kv=np.zeros((SLOPES, n, 5)),
        power=np.zeros(layout.N_POWER),
        mean_power=np.zeros(layout.N_POWER),
        kp=np.zeros((SLOPES, layout.N_POWER)),
        trial=np.zeros(1, layout.TRIAL),
        gamma_t=np.zeros((n, 2)),
        gamma_c=np.zeros((max(n - 1, 0), 2)),
        lam_t=np.zeros((n, 2)),
        lam_c=np.zeros((max(n - 1, 0), 2)),
        dx=np.zeros((n, 5)),
        truck_s=np.zeros((n, 2)),
        event=np.zeros(event_rows, layout.EVENT),
        report=np.zeros((n if report else 0, layout.N_REPORT)),
        order=np.arange(n),
        place=np.zeros(n, dtype=np.int64),
        pairs=np.zeros((pair_rows, 2), dtype=np.int64),
        mask=np.zeros((pair_rows, 8), dtype=np.uint8),
        pair=np.zeros(pair_rows, layout.PAIR),
        blank=np.zeros(1, layout.PAIR),
        within_q=np.zeros((n, 5)),
        within_v=np.zeros((n, 5)),
        within_wk=np.zeros(n, layout.WORK),
        within_force=np.zeros((n, 5)),
        bound=np.zeros(n, dtype=np.uint8),
        head=np.arange(n),
        tail=np.arange(n),
        live=np.concatenate([[n], np.arange(n)]),
        scope=np.array([n, 1]),
        active=np.zeros(1 + pair_rows, dtype=np.int64),
        corners=np.full(1 + pair_rows, ALL_CORNERS),
        near=np.zeros((1 + n * fixed, 4), dtype=np.int64),
    )
