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
its block; nothing else changes.

``M^-1`` is a symmetric 3 x 3 block for (X, Y, theta) and two scalars for the coupler bodies, so
that the same factorization serves integrators that add an implicit damping to M.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from derail_ros.engine import layout as L
from derail_ros.engine.arrays import Model
from derail_ros.engine.jit import inner_jit, jit, keep_separate
from derail_ros.engine.track import locate

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]


@jit
def plain_masses(model: Model, wk: F64) -> None:
    """Put the inverse of the constant mass matrix where ``factor`` looks for it."""
    for i in range(wk.shape[0]):
        wk[i, L.W_M] = 1.0 / model.car[i, L.MASS]
        wk[i, L.W_M + 1] = 0.0
        wk[i, L.W_M + 2] = 0.0
        wk[i, L.W_M + 3] = 1.0 / model.car[i, L.MASS]
        wk[i, L.W_M + 4] = 0.0
        wk[i, L.W_M + 5] = 1.0 / model.car[i, L.INERTIA]
        wk[i, L.W_IA] = 1.0 / model.car[i, L.IC]
        wk[i, L.W_IB] = 1.0 / model.car[i, L.IC]


@inner_jit
def truck_rows(car: F64, track: F64, truck_s: F64, truck_on: U8, q: F64, wk: F64) -> None:
    """Rows of J, offsets and curvature terms of the trucks on the rails.

    Also moves ``truck_s`` to the foot points (for a straight track it is X).
    """
    keep_separate()
    straight = track.shape[0] == 0
    for i in range(q.shape[0]):
        ct = wk[i, L.W_CT]
        st = wk[i, L.W_ST]
        for k in range(2):
            if truck_on[i, k] == 0:
                continue
            r = car[i, L.DT] if k == 0 else -car[i, L.DT]
            base = L.W_TF if k == 0 else L.W_TR
            x = q[i, 0] + r * ct
            y = q[i, 1] + r * st
            if straight:
                wk[i, base] = 0.0
                wk[i, base + 1] = 1.0
                wk[i, base + 2] = r * ct
                wk[i, L.W_CUF + k] = 0.0
                wk[i, L.W_OFF + k] = y
                truck_s[i, k] = x
            else:
                s, d, h, kappa, _ = locate(track, x, y, truck_s[i, k])
                nx = -math.sin(h)
                ny = math.cos(h)
                wk[i, base] = nx
                wk[i, base + 1] = ny
                wk[i, base + 2] = r * (ct * ny - st * nx)
                wk[i, L.W_CUF + k] = kappa / (1.0 - kappa * d)
                wk[i, L.W_OFF + k] = d
                truck_s[i, k] = s


@inner_jit
def factor(car: F64, truck_on: U8, coupled: U8, wk: F64) -> bool:
    """Factor ``J M^-1 J^T`` at the angles in ``wk``; False when it is singular."""
    keep_separate()
    n = wk.shape[0]
    ok = True
    for i in range(n):
        mxx = wk[i, L.W_M]
        mxy = wk[i, L.W_M + 1]
        mxt = wk[i, L.W_M + 2]
        myy = wk[i, L.W_M + 3]
        myt = wk[i, L.W_M + 4]
        mtt = wk[i, L.W_M + 5]
        on_f = truck_on[i, 0] != 0
        on_r = truck_on[i, 1] != 0
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
                a = wk[i, L.W_TF]
                b = wk[i, L.W_TF + 1]
                d = wk[i, L.W_TF + 2]
                kf0 = mxx * a + mxy * b + mxt * d
                kf1 = mxy * a + myy * b + myt * d
                kf2 = mxt * a + myt * b + mtt * d
                gff = a * kf0 + b * kf1 + d * kf2
            if on_r:
                a = wk[i, L.W_TR]
                b = wk[i, L.W_TR + 1]
                d = wk[i, L.W_TR + 2]
                kr0 = mxx * a + mxy * b + mxt * d
                kr1 = mxy * a + myy * b + myt * d
                kr2 = mxt * a + myt * b + mtt * d
                grr = a * kr0 + b * kr1 + d * kr2
                if on_f:
                    gfr = a * kf0 + b * kf1 + d * kf2
            det = gff * grr - gfr * gfr
            if not det > 0.0:
                ok = False
                det = 1.0
            iff = grr / det
            irr = gff / det
            ifr = -gfr / det
            wk[i, L.W_G] = iff if on_f else 0.0
            wk[i, L.W_G + 1] = ifr
            wk[i, L.W_G + 2] = irr if on_r else 0.0
            # P = K G^-1
            pf0 = kf0 * iff + kr0 * ifr
            pf1 = kf1 * iff + kr1 * ifr
            pf2 = kf2 * iff + kr2 * ifr
            pr0 = kf0 * ifr + kr0 * irr
            pr1 = kf1 * ifr + kr1 * irr
            pr2 = kf2 * ifr + kr2 * irr
            wk[i, L.W_P] = pf0
            wk[i, L.W_P + 1] = pf1
            wk[i, L.W_P + 2] = pf2
            wk[i, L.W_P + 3] = pr0
            wk[i, L.W_P + 4] = pr1
            wk[i, L.W_P + 5] = pr2
            mxx -= pf0 * kf0 + pr0 * kr0
            mxy -= pf0 * kf1 + pr0 * kr1
            mxt -= pf0 * kf2 + pr0 * kr2
            myy -= pf1 * kf1 + pr1 * kr1
            myt -= pf1 * kf2 + pr1 * kr2
            mtt -= pf2 * kf2 + pr2 * kr2
        wk[i, L.W_W] = mxx
        wk[i, L.W_W + 1] = mxy
        wk[i, L.W_W + 2] = mxt
        wk[i, L.W_W + 3] = myy
        wk[i, L.W_W + 4] = myt
        wk[i, L.W_W + 5] = mtt
        # columns W J_F^T and W J_B^T of the attachments at the pivots
        ox = -car[i, L.DP] * wk[i, L.W_ST]
        oy = car[i, L.DP] * wk[i, L.W_CT]
        wk[i, L.W_F] = mxx + mxt * ox
        wk[i, L.W_F + 1] = mxy + myt * ox
        wk[i, L.W_F + 2] = mxt + mtt * ox
        wk[i, L.W_F + 3] = mxy + mxt * oy
        wk[i, L.W_F + 4] = myy + myt * oy
        wk[i, L.W_F + 5] = myt + mtt * oy
        wk[i, L.W_B] = mxx - mxt * ox
        wk[i, L.W_B + 1] = mxy - myt * ox
        wk[i, L.W_B + 2] = mxt - mtt * ox
        wk[i, L.W_B + 3] = mxy - mxt * oy
        wk[i, L.W_B + 4] = myy - myt * oy
        wk[i, L.W_B + 5] = myt - mtt * oy

    for k in range(n - 1):
        if coupled[k] == 0:
            continue
        # W_BB of car k, with its rear coupler body
        ox = car[k, L.DP] * wk[k, L.W_ST]
        oy = -car[k, L.DP] * wk[k, L.W_CT]
        s = car[k, L.DCR] * car[k, L.DCR] * wk[k, L.W_IB]
        dxx = wk[k, L.W_B] + ox * wk[k, L.W_B + 2] + s * wk[k, L.W_SB] * wk[k, L.W_SB]
        dxy = wk[k, L.W_B + 3] + ox * wk[k, L.W_B + 5] - s * wk[k, L.W_SB] * wk[k, L.W_CB]
        dyy = wk[k, L.W_B + 4] + oy * wk[k, L.W_B + 5] + s * wk[k, L.W_CB] * wk[k, L.W_CB]
        # W_FF of car k + 1, with its front coupler body
        ox = -car[k + 1, L.DP] * wk[k + 1, L.W_ST]
        oy = car[k + 1, L.DP] * wk[k + 1, L.W_CT]
        s = car[k + 1, L.DCF] * car[k + 1, L.DCF] * wk[k + 1, L.W_IA]
        dxx += (
            wk[k + 1, L.W_F]
            + ox * wk[k + 1, L.W_F + 2]
            + s * wk[k + 1, L.W_SA] * wk[k + 1, L.W_SA]
        )
        dxy += (
            wk[k + 1, L.W_F + 3]
            + ox * wk[k + 1, L.W_F + 5]
            - s * wk[k + 1, L.W_SA] * wk[k + 1, L.W_CA]
        )
        dyy += (
            wk[k + 1, L.W_F + 4]
            + oy * wk[k + 1, L.W_F + 5]
            + s * wk[k + 1, L.W_CA] * wk[k + 1, L.W_CA]
        )
        if k > 0 and coupled[k - 1]:
            # L = -W_BF(k) ties this coupling to the one in front
            ox = car[k, L.DP] * wk[k, L.W_ST]
            oy = -car[k, L.DP] * wk[k, L.W_CT]
            lxx = -(wk[k, L.W_F] + ox * wk[k, L.W_F + 2])
            lxy = -(wk[k, L.W_F + 3] + ox * wk[k, L.W_F + 5])
            lyx = -(wk[k, L.W_F + 1] + oy * wk[k, L.W_F + 2])
            lyy = -(wk[k, L.W_F + 4] + oy * wk[k, L.W_F + 5])
            wk[k, L.W_L] = lxx
            wk[k, L.W_L + 1] = lxy
            wk[k, L.W_L + 2] = lyx
            wk[k, L.W_L + 3] = lyy
            exx = wk[k - 1, L.W_D]
            exy = wk[k - 1, L.W_D + 1]
            eyy = wk[k - 1, L.W_D + 2]
            txx = lxx * exx + lxy * exy
            txy = lxx * exy + lxy * eyy
            tyx = lyx * exx + lyy * exy
            tyy = lyx * exy + lyy * eyy
            dxx -= txx * lxx + txy * lxy
            dxy -= txx * lyx + txy * lyy
            dyy -= tyx * lyx + tyy * lyy
        det = dxx * dyy - dxy * dxy
        if not det > 0.0:
            ok = False
            det = 1.0
        wk[k, L.W_D] = dyy / det
        wk[k, L.W_D + 1] = -dxy / det
        wk[k, L.W_D + 2] = dxx / det
    return ok


@inner_jit
def rear_rate(car: F64, v: F64, wk: F64, k: int) -> tuple[float, float]:
    """Velocity of the rear face of car ``k``, m/s."""
    return (
        v[k, 0] + car[k, L.DP] * wk[k, L.W_ST] * v[k, 2] + car[k, L.DCR] * wk[k, L.W_SB] * v[k, 4],
        v[k, 1] - car[k, L.DP] * wk[k, L.W_CT] * v[k, 2] - car[k, L.DCR] * wk[k, L.W_CB] * v[k, 4],
    )


@inner_jit
def front_rate(car: F64, v: F64, wk: F64, k: int) -> tuple[float, float]:
    """Velocity of the front face of car ``k``, m/s."""
    return (
        v[k, 0] - car[k, L.DP] * wk[k, L.W_ST] * v[k, 2] - car[k, L.DCF] * wk[k, L.W_SA] * v[k, 3],
        v[k, 1] + car[k, L.DP] * wk[k, L.W_CT] * v[k, 2] + car[k, L.DCF] * wk[k, L.W_CA] * v[k, 3],
    )


@inner_jit
def coupling_rate(car: F64, v: F64, wk: F64, k: int) -> tuple[float, float]:
    """``J v`` of coupling ``k``, m/s."""
    bx, by = rear_rate(car, v, wk, k)
    fx, fy = front_rate(car, v, wk, k + 1)
    return bx - fx, by - fy


@inner_jit
def solve(
    car: F64,
    truck_on: U8,
    coupled: U8,
    wk: F64,
    force: F64,
    gamma_t: F64,
    gamma_c: F64,
    x: F64,
    lam_t: F64,
    lam_c: F64,
) -> None:
    """``M x = force + J^T lambda``, ``J x = gamma`` with the factors in ``wk``.

    ``force`` and ``x``: (N, 5); ``gamma_t``, ``lam_t``: (N, 2); ``gamma_c``, ``lam_c``: (N-1, 2).
    """
    keep_separate()
    n = wk.shape[0]
    for i in range(n):
        f0 = force[i, 0]
        f1 = force[i, 1]
        f2 = force[i, 2]
        a0 = wk[i, L.W_W] * f0 + wk[i, L.W_W + 1] * f1 + wk[i, L.W_W + 2] * f2
        a1 = wk[i, L.W_W + 1] * f0 + wk[i, L.W_W + 3] * f1 + wk[i, L.W_W + 4] * f2
        a2 = wk[i, L.W_W + 2] * f0 + wk[i, L.W_W + 4] * f1 + wk[i, L.W_W + 5] * f2
        if truck_on[i, 0] or truck_on[i, 1]:
            gf = gamma_t[i, 0] if truck_on[i, 0] else 0.0
            gr = gamma_t[i, 1] if truck_on[i, 1] else 0.0
            a0 += wk[i, L.W_P] * gf + wk[i, L.W_P + 3] * gr
            a1 += wk[i, L.W_P + 1] * gf + wk[i, L.W_P + 4] * gr
            a2 += wk[i, L.W_P + 2] * gf + wk[i, L.W_P + 5] * gr
        x[i, 0] = a0
        x[i, 1] = a1
        x[i, 2] = a2
        x[i, 3] = force[i, 3] * wk[i, L.W_IA]
        x[i, 4] = force[i, 4] * wk[i, L.W_IB]

    # couplings: eliminate from the front
    for k in range(n - 1):
        if coupled[k] == 0:
            lam_c[k, 0] = 0.0
            lam_c[k, 1] = 0.0
            continue
        bx, by = rear_rate(car, x, wk, k)
        fx, fy = front_rate(car, x, wk, k + 1)
        rx = gamma_c[k, 0] - bx + fx
        ry = gamma_c[k, 1] - by + fy
        if k > 0 and coupled[k - 1]:
            ux = wk[k - 1, L.W_D] * wk[k - 1, L.W_RX] + wk[k - 1, L.W_D + 1] * wk[k - 1, L.W_RY]
            uy = (
                wk[k - 1, L.W_D + 1] * wk[k - 1, L.W_RX] + wk[k - 1, L.W_D + 2] * wk[k - 1, L.W_RY]
            )
            rx -= wk[k, L.W_L] * ux + wk[k, L.W_L + 1] * uy
            ry -= wk[k, L.W_L + 2] * ux + wk[k, L.W_L + 3] * uy
        wk[k, L.W_RX] = rx
        wk[k, L.W_RY] = ry
    # and substitute from the rear
    for k in range(n - 2, -1, -1):
        if coupled[k] == 0:
            continue
        rx = wk[k, L.W_RX]
        ry = wk[k, L.W_RY]
        if k < n - 2 and coupled[k + 1]:
            lx = lam_c[k + 1, 0]
            ly = lam_c[k + 1, 1]
            rx -= wk[k + 1, L.W_L] * lx + wk[k + 1, L.W_L + 2] * ly
            ry -= wk[k + 1, L.W_L + 1] * lx + wk[k + 1, L.W_L + 3] * ly
        lam_c[k, 0] = wk[k, L.W_D] * rx + wk[k, L.W_D + 1] * ry
        lam_c[k, 1] = wk[k, L.W_D + 1] * rx + wk[k, L.W_D + 2] * ry

    for k in range(n - 1):
        if coupled[k] == 0:
            continue
        lx = lam_c[k, 0]
        ly = lam_c[k, 1]
        x[k, 0] += wk[k, L.W_B] * lx + wk[k, L.W_B + 3] * ly
        x[k, 1] += wk[k, L.W_B + 1] * lx + wk[k, L.W_B + 4] * ly
        x[k, 2] += wk[k, L.W_B + 2] * lx + wk[k, L.W_B + 5] * ly
        x[k, 4] += car[k, L.DCR] * wk[k, L.W_IB] * (wk[k, L.W_SB] * lx - wk[k, L.W_CB] * ly)
        x[k + 1, 0] -= wk[k + 1, L.W_F] * lx + wk[k + 1, L.W_F + 3] * ly
        x[k + 1, 1] -= wk[k + 1, L.W_F + 1] * lx + wk[k + 1, L.W_F + 4] * ly
        x[k + 1, 2] -= wk[k + 1, L.W_F + 2] * lx + wk[k + 1, L.W_F + 5] * ly
        x[k + 1, 3] += (
            car[k + 1, L.DCF]
            * wk[k + 1, L.W_IA]
            * (wk[k + 1, L.W_SA] * lx - wk[k + 1, L.W_CA] * ly)
        )

    # rail forces: G^-1 gamma - P^T (Q + coupler forces)
    for i in range(n):
        lam_t[i, 0] = 0.0
        lam_t[i, 1] = 0.0
        if truck_on[i, 0] == 0 and truck_on[i, 1] == 0:
            continue
        f0 = force[i, 0]
        f1 = force[i, 1]
        f2 = force[i, 2]
        arm = car[i, L.DP]
        if i < n - 1 and coupled[i]:
            lx = lam_c[i, 0]
            ly = lam_c[i, 1]
            f0 += lx
            f1 += ly
            f2 += arm * (wk[i, L.W_ST] * lx - wk[i, L.W_CT] * ly)
        if i > 0 and coupled[i - 1]:
            lx = lam_c[i - 1, 0]
            ly = lam_c[i - 1, 1]
            f0 -= lx
            f1 -= ly
            f2 -= arm * (wk[i, L.W_CT] * ly - wk[i, L.W_ST] * lx)
        gf = gamma_t[i, 0] if truck_on[i, 0] else 0.0
        gr = gamma_t[i, 1] if truck_on[i, 1] else 0.0
        if truck_on[i, 0]:
            lam_t[i, 0] = (
                wk[i, L.W_G] * gf
                + wk[i, L.W_G + 1] * gr
                - (wk[i, L.W_P] * f0 + wk[i, L.W_P + 1] * f1 + wk[i, L.W_P + 2] * f2)
            )
        if truck_on[i, 1]:
            lam_t[i, 1] = (
                wk[i, L.W_G + 1] * gf
                + wk[i, L.W_G + 2] * gr
                - (wk[i, L.W_P + 3] * f0 + wk[i, L.W_P + 4] * f1 + wk[i, L.W_P + 5] * f2)
            )


@inner_jit
def coupling_gap(car: F64, q: F64, wk: F64, k: int) -> tuple[float, float]:
    """Rear face of car ``k`` less front face of car ``k + 1``, m."""
    gx = (
        q[k, 0]
        - q[k + 1, 0]
        - car[k, L.DP] * wk[k, L.W_CT]
        - car[k, L.DCR] * wk[k, L.W_CB]
        - car[k + 1, L.DP] * wk[k + 1, L.W_CT]
        - car[k + 1, L.DCF] * wk[k + 1, L.W_CA]
    )
    gy = (
        q[k, 1]
        - q[k + 1, 1]
        - car[k, L.DP] * wk[k, L.W_ST]
        - car[k, L.DCR] * wk[k, L.W_SB]
        - car[k + 1, L.DP] * wk[k + 1, L.W_ST]
        - car[k + 1, L.DCF] * wk[k + 1, L.W_SA]
    )
    return gx, gy


@inner_jit
def truck_rate(v: F64, wk: F64, i: int, k: int) -> float:
    """``J v`` of truck ``k`` of car ``i``: its speed along the track's left normal, m/s."""
    base = L.W_TF if k == 0 else L.W_TR
    return wk[i, base] * v[i, 0] + wk[i, base + 1] * v[i, 1] + wk[i, base + 2] * v[i, 2]


@inner_jit
def acceleration_gamma(
    par: F64,
    car: F64,
    truck_on: U8,
    coupled: U8,
    q: F64,
    v: F64,
    wk: F64,
    gamma_t: F64,
    gamma_c: F64,
) -> None:
    """``gamma = -(dJ/dt) v``, with Baumgarte's terms unless positions are projected."""
    n = q.shape[0]
    stabilize = par[L.PROJECT] == 0.0
    a = par[L.B_VEL]
    b = par[L.B_POS]
    for i in range(n):
        for k in range(2):
            if truck_on[i, k] == 0:
                continue
            base = L.W_TF if k == 0 else L.W_TR
            nx = wk[i, base]
            ny = wk[i, base + 1]
            r = car[i, L.DT] if k == 0 else -car[i, L.DT]
            # centripetal part of the truck's acceleration, and the turning of the normal
            r2 = r * v[i, 2] * v[i, 2]
            tx = v[i, 0] - r * v[i, 2] * wk[i, L.W_ST]
            ty = v[i, 1] + r * v[i, 2] * wk[i, L.W_CT]
            along = ny * tx - nx * ty
            g = r2 * (nx * wk[i, L.W_CT] + ny * wk[i, L.W_ST]) + wk[i, L.W_CUF + k] * along * along
            if stabilize:
                g -= a * truck_rate(v, wk, i, k) + b * wk[i, L.W_OFF + k]
            gamma_t[i, k] = g
    for k in range(n - 1):
        if coupled[k] == 0:
            continue
        w1 = car[k, L.DP] * v[k, 2] * v[k, 2]
        w2 = car[k, L.DCR] * v[k, 4] * v[k, 4]
        w3 = car[k + 1, L.DP] * v[k + 1, 2] * v[k + 1, 2]
        w4 = car[k + 1, L.DCF] * v[k + 1, 3] * v[k + 1, 3]
        gx = -(
            w1 * wk[k, L.W_CT]
            + w2 * wk[k, L.W_CB]
            + w3 * wk[k + 1, L.W_CT]
            + w4 * wk[k + 1, L.W_CA]
        )
        gy = -(
            w1 * wk[k, L.W_ST]
            + w2 * wk[k, L.W_SB]
            + w3 * wk[k + 1, L.W_ST]
            + w4 * wk[k + 1, L.W_SA]
        )
        if stabilize:
            rx, ry = coupling_rate(car, v, wk, k)
            px, py = coupling_gap(car, q, wk, k)
            gx -= a * rx + b * px
            gy -= a * ry + b * py
        gamma_c[k, 0] = gx
        gamma_c[k, 1] = gy


@inner_jit
def constraint_error(car: F64, truck_on: U8, coupled: U8, q: F64, wk: F64) -> tuple[float, float]:
    """Largest coupler gap and largest truck offset, m (``truck_rows`` must have been called)."""
    gap = 0.0
    offset = 0.0
    for i in range(q.shape[0]):
        for k in range(2):
            if truck_on[i, k]:
                offset = max(offset, abs(wk[i, L.W_OFF + k]))
        if i < q.shape[0] - 1 and coupled[i]:
            gx, gy = coupling_gap(car, q, wk, i)
            gap = max(gap, math.sqrt(gx * gx + gy * gy))
    return gap, offset
