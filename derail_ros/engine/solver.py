"""Constraint forces and accelerations at O(N).

Lagrange's equations with multipliers (augmented method):

    M qdd = Q + J^T lambda,    J qdd = gamma    =>    (J M^-1 J^T) lambda = gamma - J M^-1 Q

Rows of J: one for each truck on the rails (its offset from the centre line; lambda is the lateral
force of the rail, N) and two for each intact coupling k between cars k and k + 1 (rear face of the
first less front face of the second; lambda is the force of the second on the first, N).

``J M^-1 J^T`` is banded. It is factored in two levels. A car's truck rows touch only its own
(X, Y, theta), so they are eliminated car by car: what is left of a car is its mobility

    W = M^-1 - M^-1 Jt^T (Jt M^-1 Jt^T)^-1 Jt M^-1     (3 x 3)

and the couplings form a symmetric positive definite block tridiagonal system with 2 x 2 blocks

    D_k = W_BB(k) + W_FF(k + 1),   off-diagonal -W_FB

(B rear face, F front face), solved by block LDL^T along the train. A removed row is left out of
its block; nothing else changes. Where draft gear works along a coupling (``forces.draft_gear``)
its D^-1 is ``n n^T / (n^T D n)``, n across the coupler: lambda has no part along it.

Cars of a block (``blocks``) count as one: W has only its entry along the track, the inverse of the
mass of all. Its forces across the track go to the rails alone.

``M^-1`` is a symmetric 3 x 3 block for (X, Y, theta) and two scalars for the coupler bodies, so
that the same factorization serves integrators that add an implicit damping to M.
"""

from __future__ import annotations

from typing import Any

from derail_ros.engine.arrays import F64, Model, Rows, State, Work
from derail_ros.engine.forces.couplers import front_rate, rear_rate
from derail_ros.engine.jit import inner_jit, jit, keep_separate


@inner_jit
def plain_mass(car: Rows, wk: Rows, i: int) -> None:
    """Put the inverse of the constant masses of car ``i`` where ``factor`` looks for it."""
    w = wk[i]
    w.m_xx = 1.0 / car[i].mass
    w.m_xy = 0.0
    w.m_xt = 0.0
    w.m_yy = 1.0 / car[i].mass
    w.m_yt = 0.0
    w.m_tt = 1.0 / car[i].inertia
    w.m_front = 1.0 / car[i].coupler_inertia
    w.m_rear = 1.0 / car[i].coupler_inertia
    w.reach = car[i].rear


@jit
def plain_masses(model: Model, wk: Rows) -> None:
    """``plain_mass`` of every car."""
    for i in range(wk.shape[0]):
        plain_mass(model.car, wk, i)


@inner_jit
def _mobility(w: Any, front: Any, rear: Any, on_f: bool, on_r: bool) -> bool:
    """Eliminate the truck rows of a car: W, P and G^-1 into its row; False when singular."""
    xx = w.m_xx
    xy = w.m_xy
    xt = w.m_xt
    yy = w.m_yy
    yt = w.m_yt
    tt = w.m_tt
    ok = True
    if on_f or on_r:
        # K = M^-1 Jt^T, G = Jt K
        kf0 = 0.0
        kf1 = 0.0
        kf2 = 0.0
        kr0 = 0.0
        kr1 = 0.0
        kr2 = 0.0
        gff = 1.0
        grr = 1.0
        gfr = 0.0
        if on_f:
            kf0 = xx * front.nx + xy * front.ny + xt * front.arm
            kf1 = xy * front.nx + yy * front.ny + yt * front.arm
            kf2 = xt * front.nx + yt * front.ny + tt * front.arm
            gff = front.nx * kf0 + front.ny * kf1 + front.arm * kf2
        if on_r:
            kr0 = xx * rear.nx + xy * rear.ny + xt * rear.arm
            kr1 = xy * rear.nx + yy * rear.ny + yt * rear.arm
            kr2 = xt * rear.nx + yt * rear.ny + tt * rear.arm
            grr = rear.nx * kr0 + rear.ny * kr1 + rear.arm * kr2
            if on_f:
                gfr = rear.nx * kf0 + rear.ny * kf1 + rear.arm * kf2
        det = gff * grr - gfr * gfr
        if not det > 0.0:
            ok = False
            det = 1.0
        iff = grr / det
        irr = gff / det
        ifr = -gfr / det
        w.g_ff = iff if on_f else 0.0
        w.g_fr = ifr
        w.g_rr = irr if on_r else 0.0
        # P = K G^-1
        w.p_fx = kf0 * iff + kr0 * ifr
        w.p_fy = kf1 * iff + kr1 * ifr
        w.p_ft = kf2 * iff + kr2 * ifr
        w.p_rx = kf0 * ifr + kr0 * irr
        w.p_ry = kf1 * ifr + kr1 * irr
        w.p_rt = kf2 * ifr + kr2 * irr
        xx -= w.p_fx * kf0 + w.p_rx * kr0
        xy -= w.p_fx * kf1 + w.p_rx * kr1
        xt -= w.p_fx * kf2 + w.p_rx * kr2
        yy -= w.p_fy * kf1 + w.p_ry * kr1
        yt -= w.p_fy * kf2 + w.p_ry * kr2
        tt -= w.p_ft * kf2 + w.p_rt * kr2
    w.w_xx = xx
    w.w_xy = xy
    w.w_xt = xt
    w.w_yy = yy
    w.w_yt = yt
    w.w_tt = tt
    return ok


@inner_jit
def weigh_blocks(work: Work) -> None:
    """Masses of the blocks, or of single cars that are bound, to their first cars."""
    for i in range(work.wk.shape[0]):
        if work.bound[i] and work.head[i] == i:
            mass = 0.0
            for j in range(i, work.tail[i] + 1):
                mass += 1.0 / work.wk[j].m_xx
            work.wk[i].block = mass


@inner_jit
def _bound_mobility(work: Work, i: int) -> None:
    """Mobility of the block that car ``i`` leads, or of a car that is bound, into its ends."""
    mass = work.wk[i].block
    for j in (i, work.tail[i]):
        w = work.wk[j]
        w.w_xx = 1.0 / mass
        w.w_xy = 0.0
        w.w_xt = 0.0
        w.w_yy = 0.0
        w.w_yt = 0.0
        w.w_tt = 0.0


@inner_jit
def factor(model: Model, state: State, work: Work) -> bool:
    """Factor ``J M^-1 J^T`` at the angles in ``work.wk``; False when it is singular."""
    keep_separate()
    car = model.car
    wk = work.wk
    truck_on = state.truck_on
    coupled = state.coupled
    head = work.head
    tail = work.tail
    geared = model.par[0].gear != 0.0
    n = work.scope[0]
    ok = True
    for i in range(n):
        w = wk[i]
        on_f = truck_on[i, 0] != 0
        on_r = truck_on[i, 1] != 0
        if work.bound[i]:
            if head[i] == i:
                _bound_mobility(work, i)
            elif tail[i] != i:
                continue
        elif not _mobility(w, work.row[i, 0], work.row[i, 1], on_f, on_r):
            ok = False
        # columns W J_F^T and W J_B^T of the attachments at the pivots
        ox = -car[i].pivot * w.st
        oy = car[i].pivot * w.ct
        w.fx_x = w.w_xx + w.w_xt * ox
        w.fx_y = w.w_xy + w.w_yt * ox
        w.fx_t = w.w_xt + w.w_tt * ox
        w.fy_x = w.w_xy + w.w_xt * oy
        w.fy_y = w.w_yy + w.w_yt * oy
        w.fy_t = w.w_yt + w.w_tt * oy
        w.bx_x = w.w_xx - w.w_xt * ox
        w.bx_y = w.w_xy - w.w_yt * ox
        w.bx_t = w.w_xt - w.w_tt * ox
        w.by_x = w.w_xy - w.w_xt * oy
        w.by_y = w.w_yy - w.w_yt * oy
        w.by_t = w.w_yt - w.w_tt * oy

    for k in range(n - 1):
        if coupled[k] == 0 or head[k + 1] <= k:
            continue
        a = wk[k]
        b = wk[k + 1]
        # W_BB of car k, with its rear coupler body
        ax = car[k].pivot * a.st
        ay = -car[k].pivot * a.ct
        s = a.reach * a.reach * a.m_rear
        dxx = a.bx_x + ax * a.bx_t + s * a.sb * a.sb
        dxy = a.by_x + ax * a.by_t - s * a.sb * a.cb
        dyy = a.by_y + ay * a.by_t + s * a.cb * a.cb
        # W_FF of car k + 1, with its front coupler body
        bx = -car[k + 1].pivot * b.st
        by = car[k + 1].pivot * b.ct
        s = car[k + 1].front * car[k + 1].front * b.m_front
        dxx += b.fx_x + bx * b.fx_t + s * b.sa * b.sa
        dxy += b.fy_x + bx * b.fy_t - s * b.sa * b.ca
        dyy += b.fy_y + by * b.fy_t + s * b.ca * b.ca
        ahead = head[k] - 1
        if ahead >= 0 and coupled[ahead]:
            # L = -W_BF(k) ties this coupling to the one in front
            a.l_xx = -(a.fx_x + ax * a.fx_t)
            a.l_xy = -(a.fy_x + ax * a.fy_t)
            a.l_yx = -(a.fx_y + ay * a.fx_t)
            a.l_yy = -(a.fy_y + ay * a.fy_t)
            e = wk[ahead]
            txx = a.l_xx * e.d_xx + a.l_xy * e.d_xy
            txy = a.l_xx * e.d_xy + a.l_xy * e.d_yy
            tyx = a.l_yx * e.d_xx + a.l_yy * e.d_xy
            tyy = a.l_yx * e.d_xy + a.l_yy * e.d_yy
            dxx -= txx * a.l_xx + txy * a.l_xy
            dxy -= txx * a.l_yx + txy * a.l_yy
            dyy -= tyx * a.l_yx + tyy * a.l_yy
        if geared:
            # only the row across the rear coupler is there: the inverse on its direction
            across = a.sb * a.sb * dxx - 2.0 * a.sb * a.cb * dxy + a.cb * a.cb * dyy
            a.d_xx = a.sb * a.sb / across
            a.d_xy = -a.sb * a.cb / across
            a.d_yy = a.cb * a.cb / across
            continue
        det = dxx * dyy - dxy * dxy
        if not det > 0.0:
            ok = False
            det = 1.0
        a.d_xx = dyy / det
        a.d_xy = -dxy / det
        a.d_yy = dxx / det
    return ok


@inner_jit
def solve(model: Model, state: State, work: Work, x: F64) -> None:
    """``M x = work.force + J^T lambda``, ``J x = gamma`` with the factors in ``work.wk``.

    ``x`` is (N, 5); gamma is in ``work.gamma_t`` (N, 2) and ``work.gamma_c`` (N-1, 2), lambda goes
    into ``work.lam_t`` and ``work.lam_c``, all of it if ``work.scope`` says so.
    """
    keep_separate()
    car = model.car
    wk = work.wk
    truck_on = state.truck_on
    coupled = state.coupled
    force = work.force
    gamma_t = work.gamma_t
    gamma_c = work.gamma_c
    lam_t = work.lam_t
    lam_c = work.lam_c
    head = work.head
    tail = work.tail
    n = work.scope[0]
    loads = work.scope[1] != 0
    for i in range(n):
        w = wk[i]
        x[i, 3] = force[i, 3] * w.m_front
        x[i, 4] = force[i, 4] * w.m_rear
        if work.bound[i]:
            if head[i] == i:
                f0 = 0.0
                last = min(tail[i], n - 1)
                for j in range(i, last + 1):
                    f0 += force[j, 0]
                    x[j, 1] = 0.0
                    x[j, 2] = 0.0
                x[i, 0] = w.w_xx * f0
                x[last, 0] = x[i, 0]
            continue
        f0 = force[i, 0]
        f1 = force[i, 1]
        f2 = force[i, 2]
        a0 = w.w_xx * f0 + w.w_xy * f1 + w.w_xt * f2
        a1 = w.w_xy * f0 + w.w_yy * f1 + w.w_yt * f2
        a2 = w.w_xt * f0 + w.w_yt * f1 + w.w_tt * f2
        if truck_on[i, 0] or truck_on[i, 1]:
            gf = gamma_t[i, 0] if truck_on[i, 0] else 0.0
            gr = gamma_t[i, 1] if truck_on[i, 1] else 0.0
            a0 += w.p_fx * gf + w.p_rx * gr
            a1 += w.p_fy * gf + w.p_ry * gr
            a2 += w.p_ft * gf + w.p_rt * gr
        x[i, 0] = a0
        x[i, 1] = a1
        x[i, 2] = a2

    # couplings: eliminate from the front
    for k in range(n - 1):
        if coupled[k] == 0:
            lam_c[k, 0] = 0.0
            lam_c[k, 1] = 0.0
            continue
        if head[k + 1] <= k:
            continue
        a = wk[k]
        bx, by = rear_rate(car, x, wk, k)
        fx, fy = front_rate(car, x, wk, k + 1)
        a.rx = gamma_c[k, 0] - bx + fx
        a.ry = gamma_c[k, 1] - by + fy
        ahead = head[k] - 1
        if ahead >= 0 and coupled[ahead]:
            e = wk[ahead]
            ux = e.d_xx * e.rx + e.d_xy * e.ry
            uy = e.d_xy * e.rx + e.d_yy * e.ry
            a.rx -= a.l_xx * ux + a.l_xy * uy
            a.ry -= a.l_yx * ux + a.l_yy * uy
    # and substitute from the rear
    for k in range(n - 2, -1, -1):
        if coupled[k] == 0 or head[k + 1] <= k:
            continue
        a = wk[k]
        rx = a.rx
        ry = a.ry
        behind = tail[k + 1]
        if behind < n - 1 and coupled[behind]:
            b = wk[behind]
            rx -= b.l_xx * lam_c[behind, 0] + b.l_yx * lam_c[behind, 1]
            ry -= b.l_xy * lam_c[behind, 0] + b.l_yy * lam_c[behind, 1]
        lam_c[k, 0] = a.d_xx * rx + a.d_xy * ry
        lam_c[k, 1] = a.d_xy * rx + a.d_yy * ry

    for i in range(n):
        if tail[i] == i and head[i] < i:
            x[i, 0] = 0.0  # what the coupling behind a block adds is gathered here
    for k in range(n - 1):
        if coupled[k] == 0 or head[k + 1] <= k:
            continue
        a = wk[k]
        b = wk[k + 1]
        lx = lam_c[k, 0]
        ly = lam_c[k, 1]
        x[k, 0] += a.bx_x * lx + a.by_x * ly
        x[k, 1] += a.bx_y * lx + a.by_y * ly
        x[k, 2] += a.bx_t * lx + a.by_t * ly
        x[k, 4] += a.reach * a.m_rear * (a.sb * lx - a.cb * ly)
        x[k + 1, 0] -= b.fx_x * lx + b.fy_x * ly
        x[k + 1, 1] -= b.fx_y * lx + b.fy_y * ly
        x[k + 1, 2] -= b.fx_t * lx + b.fy_t * ly
        x[k + 1, 3] += car[k + 1].front * b.m_front * (b.sa * lx - b.ca * ly)

    # all cars of a block go together; what a joint carries follows from the cars ahead of it
    for i in range(n):
        last = min(tail[i], n - 1)
        if head[i] < i or last == i:
            continue
        a0 = x[i, 0] + x[last, 0] if last == tail[i] else x[i, 0]
        if not loads:
            for j in range(i, last + 1):
                x[j, 0] = a0
            continue
        carried = 0.0
        if i > 0 and coupled[i - 1]:
            carried = lam_c[i - 1, 0]
        for j in range(i, last + 1):
            x[j, 0] = a0
            if j < last:
                carried += a0 / wk[j].m_xx - force[j, 0]
                lam_c[j, 0] = carried
                lam_c[j, 1] = 0.0

    if not loads:
        return
    # rail forces: G^-1 gamma - P^T (Q + coupler forces)
    for i in range(n):
        lam_t[i, 0] = 0.0
        lam_t[i, 1] = 0.0
        if truck_on[i, 0] == 0 and truck_on[i, 1] == 0:
            continue
        w = wk[i]
        f0 = force[i, 0]
        f1 = force[i, 1]
        f2 = force[i, 2]
        arm = car[i].pivot
        if i < n - 1 and coupled[i]:
            lx = lam_c[i, 0]
            ly = lam_c[i, 1]
            f0 += lx
            f1 += ly
            f2 += arm * (w.st * lx - w.ct * ly)
        if i > 0 and coupled[i - 1]:
            lx = lam_c[i - 1, 0]
            ly = lam_c[i - 1, 1]
            f0 -= lx
            f1 -= ly
            f2 -= arm * (w.ct * ly - w.st * lx)
        if work.bound[i]:
            f2 /= car[i].truck
            lam_t[i, 0] = -0.5 * (f1 + f2)
            lam_t[i, 1] = -0.5 * (f1 - f2)
            continue
        gf = gamma_t[i, 0] if truck_on[i, 0] else 0.0
        gr = gamma_t[i, 1] if truck_on[i, 1] else 0.0
        if truck_on[i, 0]:
            lam_t[i, 0] = w.g_ff * gf + w.g_fr * gr - (w.p_fx * f0 + w.p_fy * f1 + w.p_ft * f2)
        if truck_on[i, 1]:
            lam_t[i, 1] = w.g_fr * gf + w.g_rr * gr - (w.p_rx * f0 + w.p_ry * f1 + w.p_rt * f2)
