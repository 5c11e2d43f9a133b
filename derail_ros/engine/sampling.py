"""A planar run seen at one moment: coordinates, forces and the ledger."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from derail_ros.engine import layout
from derail_ros.engine.arrays import F64, U8, Model, State, Work, make_work
from derail_ros.engine.dynamics import PLAIN, accelerations
from derail_ros.engine.energy import kinetic_energy
from derail_ros.engine.forces.couplers import coupler_energy
from derail_ros.engine.interpolation import interpolate, interpolate_energy
from derail_ros.engine.solver import plain_masses
from derail_ros.vocabulary.errors import ConstraintError
from derail_ros.vocabulary.ledger import residual
from derail_ros.vocabulary.sample import Sample, planar

if TYPE_CHECKING:
    from derail_ros.engine.simulation import PlanarSimulation

WORK_ENTRIES = {
    "brakes": layout.E_BRAKE,
    "ground_trucks": layout.E_GROUND_TRUCK,
    "ground_body": layout.E_GROUND_BODY,
    "collisions": layout.E_COLLISION,
    "striker_dampers": layout.E_DAMPER,
    "knuckles_released": layout.E_KNUCKLE,
    "external": layout.E_EXTERNAL,
    "stabilization_net": layout.E_STAB_NET,
    "stabilization_gross": layout.E_STAB_GROSS,
}
"""Entries of the ledger that are integrated with the state, and their columns."""


def ledger(
    model: Model, initial: float, work: F64, coupled: U8, q: F64, v: F64
) -> dict[str, float]:
    """The energy ledger of a state, J."""
    striker, knuckle = coupler_energy(model, coupled, q)
    entries = {
        "kinetic": float(kinetic_energy(model, v)),
        "striker": float(striker),
        "knuckle": float(knuckle),
        "initial": float(initial),
        **{key: float(work[column]) for key, column in WORK_ENTRIES.items()},
    }
    entries["residual"] = residual(entries)
    return entries


def all_active(state: State, work: Work) -> None:
    """Let the next evaluation look at every pair of the neighbour list."""
    count = int(state.cnt["pairs"][0])
    work.active[0] = count
    work.active[1 : 1 + count] = np.arange(count)


class Sampler:
    """Takes samples of one run; keeps the scratch arrays between them."""

    def __init__(self, run: PlanarSimulation) -> None:
        self._run = run
        self._work: Work | None = None

    def __call__(self, t: float) -> Sample:
        """State and forces at ``t``, within the last step or after the end of the run."""
        run = self._run
        model, s, n = run._model, run._state, run.n_cars
        if self._work is None or len(self._work.pairs) != len(s.pairs):
            self._work = make_work(n, len(s.pairs), 0, True)
            plain_masses(model, self._work.wk)
        work = self._work
        inside = t < run.time
        q, v, a = np.empty((n, 5)), np.empty((n, 5)), np.empty((n, 5))
        energy = s.energy.copy()
        if inside:
            interpolate(s, t, q, v, a)
            interpolate_energy(s, t, energy)
        else:
            q[:], v[:], a[:] = s.q, s.v, s.a
        clock = s.clock.copy()
        clock["t_on"] = s.clock["t_prev"][0] if inside else s.clock["t"][0]
        view = s._replace(
            q=q,
            v=v,
            clock=clock,
            cnt=s.cnt.copy(),
            truck_s=s.truck_s.copy(),
            pair=s.pair.copy(),
            truck_on=(s.truck_on0 if inside else s.truck_on).copy(),
            coupled=(s.coupled0 if inside else s.coupled).copy(),
        )
        all_active(s, work)
        if not accelerations(model, view, work, min(t, run.time), q, v, work.dx, PLAIN):
            raise ConstraintError("the constraint equations cannot be solved", run)
        self._locate_derailed_trucks(view)
        r = work.report
        corner = r[:, layout.R_CORNER :].reshape(n, 4, 4)
        touched = corner[:, :, 0] > 0.0
        return Sample(
            time=t,
            step=run.step_count,
            pose=planar(q),
            velocity=planar(v),
            acceleration=planar(a),
            coupler_yaw=q[:, 3:5].copy(),
            coupler_rate=v[:, 3:5].copy(),
            coupler_acceleration=a[:, 3:5].copy(),
            truck_on=view.truck_on,
            coupled=view.coupled,
            truck_coordinate=view.truck_s,
            rail_force=work.lam_t.copy(),
            brake_force=r[:, layout.R_BRAKE].copy(),
            ground_truck_force=r[:, layout.R_TRUCK : layout.R_TRUCK + 4].reshape(n, 2, 2).copy(),
            ground_body_force=r[:, layout.R_BODY : layout.R_BODY + 2].copy(),
            ground_moment=r[:, layout.R_GROUND_MOMENT].copy(),
            striker_force=r[:, layout.R_STRIKER : layout.R_STRIKER + 2].copy(),
            relative_angle=q[:-1, 4] - q[1:, 3],
            knuckle_moment=r[:-1, layout.R_KNUCKLE].copy(),
            coupler_force=work.lam_c.copy(),
            coupler_gap=self._gap(q, view.coupled),
            collision_force=r[:, layout.R_COLLISION : layout.R_COLLISION + 2].copy(),
            collision_moment=r[:, layout.R_COLLISION + 2].copy(),
            corner_force=corner[:, :, 0].copy(),
            corner_gap=np.where(touched, corner[:, :, 1], math.nan),
            corner_closing_speed=np.where(touched, corner[:, :, 2], math.nan),
            corner_other=corner[:, :, 3].astype(np.int64),
            external_force=r[:, layout.R_EXTERNAL : layout.R_EXTERNAL + 2].copy(),
            external_moment=r[:, layout.R_EXTERNAL + 2].copy(),
            energy=ledger(model, s.clock["initial_energy"][0], energy, view.coupled, q, v),
        )

    def _locate_derailed_trucks(self, view: State) -> None:
        """Track coordinates of trucks off the rails, which the kernels leave where they were."""
        run, q = self._run, view.q
        c, sn = np.cos(q[:, 2]), np.sin(q[:, 2])
        arm = run._model.car["truck"]
        coordinate = view.truck_s
        for k, sign in ((0, 1.0), (1, -1.0)):
            for i in np.flatnonzero(view.truck_on[:, k] == 0):
                coordinate[i, k] = run.track.locate(
                    float(q[i, 0] + sign * arm[i] * c[i]),
                    float(q[i, 1] + sign * arm[i] * sn[i]),
                    float(coordinate[i, k]),
                )[0]

    def _gap(self, q: F64, coupled: U8) -> F64:
        """(N-1,) distance between mated faces, m; 0 once parted."""
        car = self._run._model.car
        c, sn = np.cos(q[:, 2]), np.sin(q[:, 2])

        def face(sign: float, length: str, angle: int) -> F64:
            x = car["pivot"] * c + car[length] * np.cos(q[:, angle])
            y = car["pivot"] * sn + car[length] * np.sin(q[:, angle])
            return q[:, :2] + sign * np.stack([x, y], axis=1)

        apart = face(-1.0, "rear", 4)[:-1] - face(1.0, "front", 3)[1:]
        return np.where(coupled.astype(bool), np.hypot(*apart.T), 0.0)
