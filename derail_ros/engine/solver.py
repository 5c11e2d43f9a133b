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

import numpy as np
from numpy.typing import NDArray

from derail_ros.engine import layout as L
from derail_ros.engine.arrays import Model, State, Work
from derail_ros.engine.forces.couplers import front_rate, rear_rate
from derail_ros.engine.jit import inner_jit, jit, keep_separate

F64 = NDArray[np.float64]


@inner_jit
def plain_mass(car: F64, wk: F64, i: int) -> None:
    """Put the inverse of the constant masses of car ``i`` where ``factor`` looks for it."""
    wk[i, L.W_M] = 1.0 / car[i, L.MASS]
    wk[i, L.W_M + 1] = 0.0
    wk[i, L.W_M + 2] = 0.0
    wk[i, L.W_M + 3] = 1.0 / car[i, L.MASS]
    wk[i, L.W_M + 4] = 0.0
    wk[i, L.W_M + 5] = 1.0 / car[i, L.INERTIA]
    wk[i, L.W_IA] = 1.0 / car[i, L.IC]
    wk[i, L.W_IB] = 1.0 / car[i, L.IC]


@jit
def plain_masses(model: Model, wk: F64) -> None:
    """``plain_mass`` of every car."""
    for i in range(wk.shape[0]):
        plain_mass(model.car, wk, i)


@inner_jit
def factor(model: Model, state: State, work: Work) -> bool:
    """Factor ``J M^-1 J^T`` at the angles in ``work.wk``; False when it is singular."""
    keep_separate()
    car = model.car
    wk = work.wk
    truck_on = state.truck_on
    coupled = state.coupled
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
                a = wk[i, L.W_TRUCK]
                b = wk[i, L.W_TRUCK + 1]
                d = wk[i, L.W_TRUCK + 2]
                kf0 = mxx * a + mxy * b + mxt * d
                kf1 = mxy * a + myy * b + myt * d
                kf2 = mxt * a + myt * b + mtt * d
                gff = a * kf0 + b * kf1 + d * kf2
            if on_r:
                a = wk[i, L.W_TRUCK + 3]
                b = wk[i, L.W_TRUCK + 4]
                d = wk[i, L.W_TRUCK + 5]
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
def solve(model: Model, state: State, work: Work, x: F64) -> None:
    """``M x = work.force + J^T lambda``, ``J x = gamma`` with the factors in ``work.wk``.

    ``x`` is (N, 5); gamma is in ``work.gamma_t`` (N, 2) and ``work.gamma_c`` (N-1, 2), lambda goes
    into ``work.lam_t`` and ``work.lam_c``.
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
