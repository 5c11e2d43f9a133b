"""A planar run seen at one moment: coordinates, forces and the ledger."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from derail_ros.engine import layout
from derail_ros.engine.arrays import F64, U8, Model, State, Work, make_work
from derail_ros.engine.blocks import prepare
from derail_ros.engine.dynamics import PLAIN, accelerations
from derail_ros.engine.energy import kinetic_energy
from derail_ros.engine.forces.along import potential_energy
from derail_ros.engine.forces.couplers import coupler_energy
from derail_ros.engine.forces.draft_gear import gear_energy
from derail_ros.engine.interpolation import interpolate, interpolate_energy
from derail_ros.engine.solver import plain_masses
from derail_ros.engine.standing import car_lines
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


ALONG_ENTRIES = {
    "traction": layout.E_TRACTION,
    "dynamic_brake": layout.E_DYNAMIC,
    "resistance": layout.E_RESISTANCE,
}
"""The same of the forces along the track, where there are some."""


def ledger(model: Model, state: State, work: F64, coupled: U8, q: F64, v: F64) -> dict[str, float]:
    """The energy ledger of a state with the work entries ``work``, J."""
    striker, knuckle = coupler_energy(model, coupled, q)
    par = model.par[0]
    initial = state.clock["initial_energy"][0]
    entries = {
        "kinetic": float(kinetic_energy(model, v)),
        "striker": float(striker),
        "knuckle": float(knuckle),
        "initial": float(initial),
        **{key: float(work[column]) for key, column in WORK_ENTRIES.items()},
    }
    if par["gear"]:
        entries["draft_gear"] = float(gear_energy(model, coupled, q))
        entries["draft_gear_friction"] = float(work[layout.E_GEAR])
    if par["guide_strength"]:
        entries["guidance"] = float(work[layout.E_GUIDANCE])
    if par["slopes"]:
        entries["slopes"] = float(work[layout.E_SLOPE])
    if len(model.fixed):
        entries["fixed_bodies"] = float(work[layout.E_FIXED])
    if par["along"]:
        entries |= {key: float(work[column]) for key, column in ALONG_ENTRIES.items()}
    if par["profile"]:
        entries["potential"] = float(potential_energy(model, state, q) - par["datum"])
    entries["residual"] = residual(entries)
    return entries


def raised(track: Any, pose: F64, truck_s: F64, own: int, velocity: F64 | None = None) -> F64:
    """The pose of cars on the grades of the track: height (m) and pitch (rad).

    Those behind the ``own`` of the train are shown at its height too. Adds the vertical velocity
    (m/s) to ``velocity``.
    """
    if len(track.grades):
        for i, (x, y) in enumerate(pose[:, :2]):
            hint = float(truck_s[i].mean()) if i < own else None
            s, _ = track.locate(float(x), float(y), hint)
            pose[i, 2], grade = track.height(s)
            pose[i, 4] = -math.atan(grade)
            if velocity is not None:
                c, sn = math.cos(pose[i, 5]), math.sin(pose[i, 5])
                velocity[i, 2] = grade * (velocity[i, 0] * c + velocity[i, 1] * sn)
    return pose


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
            self._work = make_work(n, len(s.pairs), 0, True, len(model.fixed))
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
            struck=s.struck.copy(),
            group=s.group.copy(),
            coupling=s.coupling.copy(),
            loose=s.loose,
            truck_on=(s.truck_on0 if inside else s.truck_on).copy(),
            coupled=(s.coupled0 if inside else s.coupled).copy(),
        )
        if inside:
            view.coupling["travel"] = view.coupling["travel0"]
            view.coupling["share"] = view.coupling["share0"]
        prepare(model, view, work, q, v)
        if not accelerations(model, view, work, min(t, run.time), q, v, work.dx, PLAIN):
            raise ConstraintError("the constraint equations cannot be solved", run)
        self._locate_derailed_trucks(view)
        velocity = planar(v)
        r = work.report
        corner = r[:, layout.R_CORNER :].reshape(n, 4, 4)
        touched = corner[:, :, 0] > 0.0
        return Sample(
            time=t,
            step=run.step_count,
            pose=raised(run.track, planar(q), view.truck_s, run.params.n_train, velocity),
            velocity=velocity,
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
            energy=ledger(model, view, energy, view.coupled, q, v),
            cars=self._along(r),
            couplings=self._couplings(work, view),
        )

    def _locate_derailed_trucks(self, view: State) -> None:
        """Track coordinates of trucks off the rails, which the kernels leave where they were."""
        run, q = self._run, view.q
        c, sn = np.cos(q[:, 2]), np.sin(q[:, 2])
        arm = run._model.car["truck"]
        lines = car_lines(run.params, run.track)
        coordinate = view.truck_s
        for k, sign in ((0, 1.0), (1, -1.0)):
            for i in np.flatnonzero(view.truck_on[:, k] == 0):
                coordinate[i, k] = lines[i].locate(
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
        gap = np.hypot(*apart.T)
        if self._run._model.par["gear"][0]:  # along the coupler it is the travel of the gear
            gap = np.abs(apart[:, 1] * np.cos(q[:-1, 4]) - apart[:, 0] * np.sin(q[:-1, 4]))
        return np.where(coupled.astype(bool), gap, 0.0)

    def _along(self, report: F64) -> dict[str, F64]:
        """Forces along the track, where there are some: (N,)."""
        if not self._run._model.par["along"][0]:
            return {}
        names = ("grade_force_N", "resistance_N", "locomotive_force_N")
        return {name: report[:, layout.R_ALONG + k].copy() for k, name in enumerate(names)}

    def _couplings(self, work: Work, view: State) -> dict[str, F64]:
        """Largest forces so far and the travel of the draft gear: (N-1,)."""
        told = {"max_draft_N": view.coupling["draft"], "max_buff_N": view.coupling["buff"]}
        told = {name: values.copy() for name, values in told.items()}
        if self._run._model.par["gear"][0]:
            reach = work.wk["reach"][:-1] - self._run._model.car["rear"][:-1]
            told["draft_gear_travel_m"] = np.where(view.coupled.astype(bool), reach, 0.0)
        return told
