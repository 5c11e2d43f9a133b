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
    """Points on the ground into ``work.ground``: velocity, place on the car's axis, load.

    Those of car ``i`` are the columns ``work.ground_first[i]`` to ``work.ground_first[i + 1]``;
    ``stiff`` leaves out the cars that are not marked as stiff. Returns the number of points.
    """
    car = model.car
    wk = work.wk
    ground = work.ground
    truck_on = state.truck_on
    n = v.shape[0]
    m = 0
    for i in range(n):
        work.ground_first[i] = m
        if (truck_on[i, 0] and truck_on[i, 1]) or (stiff and wk[i].stiff == 0.0):
            continue
        weight = model.par[0].ground_scale * car[i].mass * model.par[0].gravity
        nx = -v[i, 2] * wk[i].st
        ny = v[i, 2] * wk[i].ct
        if lies_free(state, i):
            for k in range(BODY_POINTS):
                r = car[i].half_l * ((2.0 * k + 1.0) / BODY_POINTS - 1.0)
                ground[0, m + k] = v[i, 0] + r * nx
                ground[1, m + k] = v[i, 1] + r * ny
                ground[2, m + k] = r
                ground[3, m + k] = weight / BODY_POINTS
            m += BODY_POINTS
            continue
        for k in range(2):
            if truck_on[i, k] == 0:
                r = truck_arm(car, i, k)
                ground[0, m] = v[i, 0] + r * nx
                ground[1, m] = v[i, 1] + r * ny
                ground[2, m] = r
                ground[3, m] = weight / 2
                m += 1
    work.ground_first[n] = m
    return m


@inner_jit
def _zoned(model: Model, work: Work, q: F64, points: int, damping: bool) -> None:
    """Drag, or its damping, of the points in ``work.ground`` by the constants of their zones."""
    keep_separate()
    ground = work.ground
    look_up(model, work, q)
    for m in range(points):
        speed = math.sqrt(ground[0, m] * ground[0, m] + ground[1, m] * ground[1, m])
        c = (ground[6, m], ground[7, m], ground[8, m], ground[9, m])
        if damping:
            ground[4, m], ground[5, m] = drag_slopes(speed, c[0], c[1], c[2], c[3])
        else:
            ground[4, m] = drag(speed, c[0], c[1], c[2], c[3])


@inner_jit
def ground_forces(model: Model, state: State, work: Work, q: F64, v: F64) -> None:
    """Add the drag at ``(q, v)`` to ``work.force``."""
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
        speed = math.sqrt(ground[0, m] * ground[0, m] + ground[1, m] * ground[1, m])
        ground[4, m] = drag(speed, c_s, c_d, eps, c_v)
    p_truck = 0.0
    p_body = 0.0
    for i in range(v.shape[0]):
        first = work.ground_first[i]
        last = work.ground_first[i + 1]
        if first == last:
            continue
        body = last - first == BODY_POINTS
        fx = 0.0
        fy = 0.0
        moment = 0.0
        lost = 0.0
        for m in range(first, last):
            ux = ground[0, m]
            uy = ground[1, m]
            r = ground[2, m]
            g = ground[4, m] * ground[3, m]
            px = -g * ux
            py = -g * uy
            fx += px
            fy += py
            moment += r * (wk[i].ct * py - wk[i].st * px)
            lost -= px * ux + py * uy
            if reporting and not body:
                k = 0 if r > 0.0 else 2
                report[i, layout.R_TRUCK + k] = px
                report[i, layout.R_TRUCK + k + 1] = py
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
    work.power[layout.E_GROUND_TRUCK] = p_truck
    work.power[layout.E_GROUND_BODY] = p_body
    if par.slopes != 0.0:
        slope_forces(model, work)


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
    along it.
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
        speed = math.sqrt(ground[0, m] * ground[0, m] + ground[1, m] * ground[1, m])
        across, along = drag_slopes(speed, c_s, c_d, eps, c_v)
        ground[4, m] = across
        ground[5, m] = along
    for i in range(v.shape[0]):
        for m in range(work.ground_first[i], work.ground_first[i + 1]):
            ux = ground[0, m]
            uy = ground[1, m]
            bx = -ground[2, m] * wk[i].st
            by = ground[2, m] * wk[i].ct
            across = ground[4, m] * ground[3, m]
            along = ground[5, m] * ground[3, m]
            v2 = ux * ux + uy * uy
            share = 0.0
            if v2 > 0.0:
                share = (along - across) / v2
            cxx = across + share * ux * ux
            cxy = share * ux * uy
            cyy = across + share * uy * uy
            wk[i].c_xx += cxx
            wk[i].c_xy += cxy
            wk[i].c_xt += cxx * bx + cxy * by
            wk[i].c_yy += cyy
            wk[i].c_yt += cxy * bx + cyy * by
            wk[i].c_tt += cxx * bx * bx + 2.0 * cxy * bx * by + cyy * by * by
