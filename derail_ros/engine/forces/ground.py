"""Ground: the drag on what has left the rails, and its damping.

Force: ``laws.ground`` at ten points along the body of a car that lies free, else at each truck off
the rails, under an equal share of the weight. Power: what the drag takes out, of bodies and trucks
apart. Damping: minus the derivative of the drag by (Vx, Vy, yaw rate).
"""

from __future__ import annotations

import math

from derail_ros.engine import layout
from derail_ros.engine.arrays import F64, Model, State, Work
from derail_ros.engine.forces.track import truck_arm
from derail_ros.engine.forces.zones import look_up, slope_forces
from derail_ros.engine.jit import inner_jit, keep_separate
from derail_ros.engine.laws.ground import BODY_POINTS, drag, drag_slopes


@inner_jit
def lies_free(state: State, i: int) -> bool:
    """Both couplers of car ``i`` have parted; a missing neighbour counts as parted."""
    n = state.q.shape[0]
    return (i == 0 or state.coupled[i - 1] == 0) and (i == n - 1 or state.coupled[i] == 0)


@inner_jit
def _gather(model: Model, state: State, work: Work, v: F64, stiff: bool) -> int:
    """Points on the ground into ``work.ground``: squared speed, place on the car's axis.

    Those of car ``i`` are the columns ``work.ground_first[i]`` to ``work.ground_first[i + 1]``;
    ``stiff`` leaves out the cars that are not marked as stiff. Returns the number of points.

    The point at r along the axis has the velocity p along and n + yaw rate r across the car.
    """
    car = model.car
    wk = work.wk
    ground = work.ground
    truck_on = state.truck_on
    m = 0
    n = work.scope[0]
    for i in range(n):
        work.ground_first[i] = m
        if (truck_on[i, 0] and truck_on[i, 1]) or (stiff and wk[i].stiff == 0.0):
            continue
        along = wk[i].ct * v[i, 0] + wk[i].st * v[i, 1]
        across = wk[i].ct * v[i, 1] - wk[i].st * v[i, 0]
        rate = v[i, 2]
        if lies_free(state, i):
            part = car[i].half_l / BODY_POINTS
            for k in range(BODY_POINTS):
                r = part * (2.0 * k + (1.0 - BODY_POINTS))
                turned = across + rate * r
                ground[0, m + k] = along * along + turned * turned
                ground[1, m + k] = r
            m += BODY_POINTS
            continue
        for k in range(2):
            if truck_on[i, k] == 0:
                r = truck_arm(car, i, k)
                turned = across + rate * r
                ground[0, m] = along * along + turned * turned
                ground[1, m] = r
                m += 1
    work.ground_first[n] = m
    return m


@inner_jit
def load_of(model: Model, i: int, points: int) -> float:
    """Load on each of the ``points`` of car ``i`` on the ground, N."""
    weight = model.par[0].ground_scale * model.car[i].mass * model.par[0].gravity
    return weight / BODY_POINTS if points == BODY_POINTS else weight / 2


@inner_jit
def _zoned(model: Model, work: Work, q: F64, points: int, damping: bool) -> None:
    """Drag, or its damping, of the points in ``work.ground`` by the constants of their zones."""
    keep_separate()
    ground = work.ground
    look_up(model, work, q)
    for m in range(points):
        speed = math.sqrt(ground[0, m])
        c = (ground[4, m], ground[5, m], ground[6, m], ground[7, m])
        if damping:
            ground[2, m], ground[3, m] = drag_slopes(speed, c[0], c[1], c[2], c[3])
        else:
            ground[2, m] = drag(speed, c[0], c[1], c[2], c[3])


@inner_jit
def ground_forces(model: Model, state: State, work: Work, q: F64, v: F64) -> None:
    """Add the drag at ``(q, v)`` to ``work.force``.

    With g of the points, their sums of g, g r and g r^2 give the force along and across the car,
    its moment and its power.
    """
    keep_separate()
    par = model.par[0]
    wk = work.wk
    ground = work.ground
    force = work.force
    report = work.report
    reporting = report.shape[0] > 0
    c_s = par.ground_cs
    c_d = par.ground_cd
    eps = par.ground_eps
    c_v = par.ground_cv
    points = _gather(model, state, work, v, False)
    if model.zone.shape[0] > 0:
        _zoned(model, work, q, points, False)
        points = 0
    for m in range(points):
        ground[2, m] = drag(math.sqrt(ground[0, m]), c_s, c_d, eps, c_v)
    p_truck = 0.0
    p_body = 0.0
    for i in range(work.scope[0]):
        first = work.ground_first[i]
        last = work.ground_first[i + 1]
        if first == last:
            continue
        body = last - first == BODY_POINTS
        load = load_of(model, i, last - first)
        g0 = 0.0
        g1 = 0.0
        g2 = 0.0
        for m in range(first, last):
            r = ground[1, m]
            g = ground[2, m]
            g0 += g
            g1 += g * r
            g2 += g * r * r
        ct = wk[i].ct
        st = wk[i].st
        rate = v[i, 2]
        across = ct * v[i, 1] - st * v[i, 0]
        fx = -load * (v[i, 0] * g0 - rate * st * g1)
        fy = -load * (v[i, 1] * g0 + rate * ct * g1)
        moment = -load * (across * g1 + rate * g2)
        lost = -(v[i, 0] * fx + v[i, 1] * fy + rate * moment)
        force[i, 0] += fx
        force[i, 1] += fy
        force[i, 2] += moment
        if body:
            p_body += lost
        else:
            p_truck += lost
        if reporting:
            report[i, layout.R_GROUND_MOMENT] = moment
            if body:
                report[i, layout.R_BODY] = fx
                report[i, layout.R_BODY + 1] = fy
            for m in range(first, last if not body else first):
                r = ground[1, m]
                g = load * ground[2, m]
                k = 0 if r > 0.0 else 2
                report[i, layout.R_TRUCK + k] = -g * (v[i, 0] - rate * r * st)
                report[i, layout.R_TRUCK + k + 1] = -g * (v[i, 1] + rate * r * ct)
    work.power[layout.E_GROUND_TRUCK] = p_truck
    work.power[layout.E_GROUND_BODY] = p_body
    if par.slopes != 0.0:
        slope_forces(model, work, v)


@inner_jit
def largest_drag(model: Model, state: State, i: int) -> float:
    """Bound on what the drag adds to the velocities of car ``i``, m/s^2; yaw by its arc."""
    if state.truck_on[i, 0] and state.truck_on[i, 1]:
        return 0.0
    lever = model.car[i].half_l / model.car[i].gyration
    weight = model.par[0].ground_scale * model.par[0].gravity * model.par[0].ground_most
    return weight * (2.0 + lever * lever)


@inner_jit
def ground_damping(model: Model, state: State, work: Work, q: F64, v: F64) -> None:
    """Add the damping of the drag on the stiff cars to their blocks in ``work.wk``.

    At a point with the velocity u it is ``drag_slopes`` times the load: one value across u, one
    along it. Summed up along and across the car, then turned.
    """
    keep_separate()
    par = model.par[0]
    wk = work.wk
    ground = work.ground
    c_s = par.ground_cs
    c_d = par.ground_cd
    eps = par.ground_eps
    c_v = par.ground_cv
    points = _gather(model, state, work, v, True)
    if model.zone.shape[0] > 0:
        _zoned(model, work, q, points, True)
        points = 0
    for m in range(points):
        across, along = drag_slopes(math.sqrt(ground[0, m]), c_s, c_d, eps, c_v)
        ground[2, m] = across
        ground[3, m] = along
    for i in range(work.scope[0]):
        first = work.ground_first[i]
        last = work.ground_first[i + 1]
        if first == last:
            continue
        ct = wk[i].ct
        st = wk[i].st
        p = ct * v[i, 0] + st * v[i, 1]
        n = ct * v[i, 1] - st * v[i, 0]
        # p along the car, n across it, t turning
        pp = 0.0
        pn = 0.0
        pt = 0.0
        nn = 0.0
        nt = 0.0
        tt = 0.0
        for m in range(first, last):
            r = ground[1, m]
            square = ground[0, m]
            u = n + v[i, 2] * r
            share = 0.0
            if square > 0.0:
                share = (ground[3, m] - ground[2, m]) / square
            c_pn = share * p * u
            c_nn = ground[2, m] + share * u * u
            pp += ground[2, m] + share * p * p
            pn += c_pn
            pt += c_pn * r
            nn += c_nn
            nt += c_nn * r
            tt += c_nn * r * r
        load = load_of(model, i, last - first)
        wk[i].c_xx += load * (ct * ct * pp - 2.0 * ct * st * pn + st * st * nn)
        wk[i].c_xy += load * (ct * st * (pp - nn) + (ct * ct - st * st) * pn)
        wk[i].c_xt += load * (ct * pt - st * nt)
        wk[i].c_yy += load * (st * st * pp + 2.0 * ct * st * pn + ct * ct * nn)
        wk[i].c_yt += load * (st * pt + ct * nt)
        wk[i].c_tt += load * tt
