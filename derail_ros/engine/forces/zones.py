"""Zones of the ground: constants of their own, and slopes.

Force: within a polygon the drag of ``forces.ground`` has the zone's constants; on its slope with
the rise r (per metre, along x and y) the weight W on a point off the rails adds ``-W r``. Across a
border the constants and the slope pass over within ``border`` metres, as a cubic of the distance:
error control follows it as any other force, and a place lies half in each zone at the border
itself. Power: what slopes take out; less than nothing downhill.
"""

from __future__ import annotations

import math

from derail_ros.engine import layout
from derail_ros.engine.arrays import F64, Model, State, Work
from derail_ros.engine.jit import inner_jit, keep_separate
from derail_ros.engine.laws.ground import BODY_POINTS
from derail_ros.engine.outlines import depth, from_edge


@inner_jit
def _share(d: float, border: float) -> float:
    """How much of a zone a place has that lies ``d`` (m) within it."""
    if d >= 0.5 * border:
        return 1.0
    if d <= -0.5 * border:
        return 0.0
    t = d / border + 0.5
    return t * t * (3.0 - 2.0 * t)


@inner_jit
def look_up(model: Model, work: Work, q: F64) -> None:
    """Constants and slope of the ground at the points in ``work.ground`` into its rows 4 to 9."""
    keep_separate()
    par = model.par[0]
    ground = work.ground
    half = 0.5 * par.border
    for i in range(q.shape[0]):
        for m in range(work.ground_first[i], work.ground_first[i + 1]):
            x = q[i, 0] + ground[1, m] * work.wk[i].ct
            y = q[i, 1] + ground[1, m] * work.wk[i].st
            c_s = par.ground_cs
            c_d = par.ground_cd
            eps = par.ground_eps
            c_v = par.ground_cv
            rise_x = 0.0
            rise_y = 0.0
            for z in range(model.zone.shape[0]):
                row = model.zone[z]
                if not (row.x0 - half < x < row.x1 + half and row.y0 - half < y < row.y1 + half):
                    continue
                d = depth(model.outline, int(row.first), int(row.last), x, y)
                share = _share(d, par.border)
                c_s += share * (row.c_s - c_s)
                c_d += share * (row.c_d - c_d)
                eps += share * (row.eps - eps)
                c_v += share * (row.c_v - c_v)
                rise_x += share * (row.rise_x - rise_x)
                rise_y += share * (row.rise_y - rise_y)
            ground[4, m] = c_s
            ground[5, m] = c_d
            ground[6, m] = eps
            ground[7, m] = c_v
            ground[8, m] = rise_x
            ground[9, m] = rise_y


@inner_jit
def slope_forces(model: Model, work: Work, v: F64) -> None:
    """Add the push of the slopes at the points in ``work.ground`` to ``work.force``."""
    keep_separate()
    ground = work.ground
    force = work.force
    wk = work.wk
    taken = 0.0
    for i in range(force.shape[0]):
        first = work.ground_first[i]
        last = work.ground_first[i + 1]
        body = last - first == BODY_POINTS
        weight = model.car[i].mass * model.par[0].gravity / (BODY_POINTS if body else 2)
        for m in range(first, last):
            fx = -weight * ground[8, m]
            fy = -weight * ground[9, m]
            r = ground[1, m]
            moment = r * (wk[i].ct * fy - wk[i].st * fx)
            force[i, 0] += fx
            force[i, 1] += fy
            force[i, 2] += moment
            taken -= fx * v[i, 0] + fy * v[i, 1] + moment * v[i, 2]
            if work.report.shape[0] > 0:
                k = layout.R_BODY
                if not body:
                    k = layout.R_TRUCK + (0 if r > 0.0 else 2)
                work.report[i, k] += fx
                work.report[i, k + 1] += fy
                work.report[i, layout.R_GROUND_MOMENT] += moment
    work.power[layout.E_SLOPE] = taken


@inner_jit
def limit_border(model: Model, state: State, h: float) -> float:
    """The step ``h``, or less: no car off the rails moves over a border within one step.

    On a border it may move a quarter of its width, away from it by so much more.
    """
    q = state.q
    v = state.v
    border = model.par[0].border
    for i in range(q.shape[0]):
        if state.truck_on[i, 0] and state.truck_on[i, 1]:
            continue
        speed = math.sqrt(v[i, 0] * v[i, 0] + v[i, 1] * v[i, 1])
        speed += abs(v[i, 2]) * model.car[i].half_l
        reach = model.car[i].half_l + border + h * speed
        for z in range(model.zone.shape[0]):
            row = model.zone[z]
            x = q[i, 0]
            y = q[i, 1]
            if not (row.x0 - reach < x < row.x1 + reach and row.y0 - reach < y < row.y1 + reach):
                continue
            for k in range(int(row.first), int(row.last)):
                d = math.sqrt(from_edge(model.outline, k, x, y)[0])
                way = 0.25 * border + max(0.0, d - model.car[i].half_l - 0.5 * border)
                if h * speed > way:
                    h = way / speed
    return h
