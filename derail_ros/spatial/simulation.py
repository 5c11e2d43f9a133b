"""A run in three dimensions: MuJoCo moves the cars; the rest is the planar run's.

Parameters, commands, brakes, events and records are those of :class:`PlanarSimulation`; its state
holds the train seen from above (``kernels.look``).
"""

from __future__ import annotations

import hashlib
import math
import time
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np

from derail_ros.engine import layout, saving
from derail_ros.engine.arrays import State, make_work
from derail_ros.engine.build import build_model, initial_state, validate
from derail_ros.engine.forces.along import potential_energy
from derail_ros.engine.forces.brakes import apply_brakes
from derail_ros.engine.serial import pack, unpack
from derail_ros.engine.simulation import PlanarSimulation
from derail_ros.engine.site import site_outcome
from derail_ros.engine.standing import side_lines
from derail_ros.engine.track import Track
from derail_ros.spatial import constants as c
from derail_ros.spatial import kernels, walls
from derail_ros.spatial.kernels import Space
from derail_ros.spatial.report import make_outcome, make_sample
from derail_ros.spatial.scene import mjcf
from derail_ros.spatial.shapes import body_of, ground_points
from derail_ros.vocabulary.errors import NonFiniteStateError, SimulationError, StateFormatError
from derail_ros.vocabulary.events import Collision, Event, EventKind
from derail_ros.vocabulary.outcome import Outcome
from derail_ros.vocabulary.params import TrainParams
from derail_ros.vocabulary.sample import Sample
from derail_ros.vocabulary.shapes import BED_HEIGHT, RAIL_HEIGHT
from derail_ros.vocabulary.site import zone_slope
from derail_ros.vocabulary.status import ENDS

CAUSES = (
    "rail break", "lateral force", "lifted", "tipped", "angle", "knuckle broke",
    "coupler body broke", "vertical slip",
)  # fmt: skip
"""Causes by their numbers in the kernels."""

SAVED = (
    "wrench", "before", "velocity", "load", "wheel", "ledger",
    "coupler_lift", "pose", "fell", "touch", "count", "height",
)  # fmt: skip
"""Arrays of ``Space`` that are part of the state."""

GROUND_LEVEL = -RAIL_HEIGHT - BED_HEIGHT
"""Of the ground beside the track bed over the rail, m."""
TOUCHES = 4096
"""Room for pairs of cars in contact at once."""


class SpatialSimulation(PlanarSimulation):
    """One derailment in three dimensions.

    Raises
    ------
    ParameterError
        A parameter is out of its range or does not fit the others.
    """

    flat = False
    """Cars move in the plane only, to compare with the planar engine."""
    time_step = c.TIME_STEP

    def __init__(self, params: TrainParams) -> None:
        validate(params)
        self.params = params
        self.track = Track(params.track)
        self._model = build_model(params, self.track)
        self._state = initial_state(params, self._model, self.track)
        self._state.cnt["pairs"] = 0
        self._events: list[Event] = []
        self._commands: list[Any] = []
        self._scheduled: list[Event] = []
        self._seen: dict[int, int] = {}
        self._wall = 0.0
        self._bodies = [body_of(car) for car in params.cars]
        self._mj = mujoco.MjModel.from_xml_string(
            mjcf(params, self._bodies, self.time_step, self.flat)
        )
        self._data = mujoco.MjData(self._mj)
        self._sited = bool(params.site.fixed or params.site.areas)
        self._seen_model = self._model
        if self._sited:
            self._seen_model = self._model._replace(car=self._model.car.copy())
        self._space = self._make_space()
        self._seen_q, self._seen_v = self._state.q.copy(), self._state.v.copy()
        self._make_work()
        self._start()

    def _make_work(self) -> None:
        n = self.n_cars
        rows = 16 * n + 2 * len(self._model.unit) + 64
        self._work = make_work(n, 1, rows, True, len(self._model.fixed))

    def _make_space(self) -> Space:
        n, d, m = self.n_cars, self._data, self._mj
        rows = np.zeros(n, kernels.BODY)
        for i, (car, body) in enumerate(zip(self.params.cars, self._bodies, strict=True)):
            b = m.body(f"car {i + 1}").id
            front, rear = (m.body(f"{end} coupler {i + 1}").id for end in ENDS)
            row = rows[i]
            row["height"], row["width"] = body.height, body.width
            row["bottom"], row["top"] = body.kind.bottom, body.kind.top
            row["share"] = car.represents
            row["spring"] = c.SPRING * car.represents
            row["damping"] = c.SPRING_DAMPING * car.represents
            row["free"] = car.mass * -m.opt.gravity[2] / (4.0 * row["spring"])
            solid = row["free"] - c.SPRING_TRAVEL
            if solid > 0.0:  # k u + k_s (u - travel) carries a quarter of the weight
                row["free"] -= solid * c.SPRING_SOLID / (c.SPRING + c.SPRING_SOLID)
            row["guide"] = c.GUIDE * car.represents
            row["guide_damping"] = c.GUIDE_DAMPING * car.represents
            row["weight"] = c.TRUCK_WEIGHT * car.represents
            joint = m.body_jntadr[b]
            row["qpos"], row["qvel"] = m.jnt_qposadr[joint], m.jnt_dofadr[joint]
            row["body"], row["front"], row["rear"] = b, front, rear
            row["hinge_front"] = m.jnt_dofadr[m.body_jntadr[front]]
            row["hinge_rear"] = m.jnt_dofadr[m.body_jntadr[rear]]
        names = [m.geom(g).name for g in range(m.ngeom)]
        touching = [
            ground_points(found, car)
            for found, car in zip(self._bodies, self.params.cars, strict=True)
        ]
        points = np.zeros((n, max(len(found) for found in touching), 5))
        for i, found in enumerate(touching):
            points[i, : len(found)] = found
        return Space(
            qpos=d.qpos,
            qvel=d.qvel,
            xpos=d.xpos,
            xmat=d.xmat,
            qfrc=d.qfrc_applied,
            eq_active=d.eq_active,
            geom_car=np.array([int(name.rpartition(" ")[2]) - 1 for name in names]),
            body=rows,
            flat=np.array([self.flat], np.uint8),
            points=points,
            n_points=np.array([len(found) for found in touching]),
            beside=np.zeros((n, 2, 3)),
            shelf=np.array([body.shelf for body in self._bodies], np.uint8),
            wrench=np.zeros((3, n, 6)),
            before=np.zeros((n, 6)),
            velocity=np.zeros((n, 6)),
            pose=np.zeros((n, 6)),
            rates=np.zeros((n, 6)),
            wheel=np.zeros((n, 2, 2)),
            xfrc=np.zeros((m.nbody, 6)),
            load=np.zeros((n, 2)),
            ledger=np.zeros(5),
            coupler_lift=np.zeros(max(n - 1, 0)),
            fell=np.zeros((n, 2), np.uint8),
            touch=np.zeros(TOUCHES, kernels.TOUCH),
            count=np.zeros(2, np.int64),
            found=np.zeros(4 * n + TOUCHES, kernels.FOUND),
            height=np.zeros((len(self._state.contact), 2)),
            **self._place(),
        )

    def _place(self) -> dict[str, Any]:
        """The arrays of ``Space`` that belong to the site."""
        n, params, site = self.n_cars, self.params, self.params.site
        slopes = [zone_slope(zone, self.track, site.border) for zone in site.zones]
        ends = np.cumsum([0, *(len(line.pieces) for line in side_lines(params))])
        lines = list(zip(ends, ends[1:], strict=False))
        along = np.zeros((n, 2, 1 + len(lines)))
        sides = [self.track, *side_lines(params)] if lines else []
        for j, line in enumerate(sides):
            for i, (x, y) in enumerate(self._state.q[:, :2]):
                along[i, :, j] = line.locate(float(x), float(y))[0]
        return {
            "crest": np.array([max([0.0, *(s.highest for s in slopes)]) - RAIL_HEIGHT]),
            "rise": np.array([(s.base, s.edge) for s in slopes]).reshape(-1, 2),
            "lines": np.array(lines, dtype=np.int64).reshape(-1, 2),
            "along": along,
            "sides": np.zeros((n, 2, len(lines), 3)),
            "soil": np.zeros(7),
            "wall": np.zeros((n if site.fixed else 0, 6)),
            "tops": np.array([body.height for body in site.fixed]) + GROUND_LEVEL,
            "round": np.array([body.kind.tank for body in self._bodies], np.uint8),
            "span": np.zeros((n, 5)),
            "level": np.zeros(n),
        }

    def _start(self) -> None:
        s, space, d = self._state, self._space, self._data
        for i in range(self.n_cars):
            row = space.body[i]
            p, v = int(row["qpos"]), int(row["qvel"])
            x, y, yaw = s.q[i, :3]
            if self.flat:
                d.qpos[p : p + 3] = x, y, yaw
                d.qvel[v : v + 3] = s.v[i, :3]
            else:
                half = 0.5 * yaw
                d.qpos[p : p + 7] = x, y, row["height"], math.cos(half), 0.0, 0.0, math.sin(half)
                d.qvel[v : v + 6] = *s.v[i, :2], 0.0, 0.0, 0.0, s.v[i, 2]
            shift = int(row["qpos"]) - int(row["qvel"]) + (0 if self.flat else 1)
            for end, name in enumerate(("hinge_front", "hinge_rear")):
                joint = int(row[name])
                d.qpos[joint + shift] = s.q[i, 3 + end] - yaw
                d.qvel[joint] = s.v[i, 3 + end] - s.v[i, 2]
            if self._model.par["gear"][0] and i < len(s.coupling):
                slide = int(row["hinge_rear"]) + (1 if self.flat else 2)
                d.qpos[slide + shift] = s.coupling["travel"][i]
        d.eq_active[:] = s.coupled
        self._announce()
        mujoco.mj_step1(self._mj, d)
        self._model.par["datum"] = potential_energy(self._model, s, s.q)
        self._evaluate()
        space.before[:] = space.velocity
        s.clock["initial_energy"][0] = self._stored()
        self._keep()
        self._drain()

    def _evaluate(self) -> bool:
        """Forces of the state as it stands."""
        kernels.push(self._model, self._state, self._work, self._space, 0.0)
        self._strike(0.0)
        return True

    def _view(self) -> State:
        """The state with the cars' outlines from above, for what the site does."""
        return self._state._replace(q=self._seen_q, v=self._seen_v)

    def _strike(self, h: float) -> None:
        """Forces of fixed bodies, and who is where, after a step of ``h`` s (0: anew)."""
        if self._sited:
            seen, view = self._seen_model, self._view()
            walls.strike(self._model, seen, view, self._work, self._space, h)

    def _stored(self) -> float:
        """Kinetic, elastic and potential energy, J."""
        return sum(self._store().values())

    def _store(self) -> dict[str, float]:
        """Energy now in motion, springs and height, J."""
        mujoco.mj_energyVel(self._mj, self._data)
        ledger = self._space.ledger
        height = ledger[kernels.GRAVITY]
        if self._model.par["profile"][0]:
            height += potential_energy(self._model, self._state, self._state.q)
            height -= self._model.par["datum"][0]
        gear = {}
        if self._model.par["gear"][0]:
            stored = kernels.gear_energy(self._model, self._state, self._space)
            gear = {"draft_gear": float(stored)}
        return {
            "kinetic": float(self._data.energy[1]),
            "striker": float(ledger[kernels.STRIKERS]),
            "knuckle": float(ledger[kernels.KNUCKLES]),
            "suspension": float(ledger[kernels.SPRINGS]),
            "potential": float(height),
            **gear,
        }

    def _keep(self) -> None:
        """Remember the state at the end of the step, for samples within the next."""
        s = self._state
        s.q0[:], s.v0[:], s.a0[:] = s.q, s.v, s.a
        s.truck_on0[:], s.coupled0[:] = s.truck_on, s.coupled
        self._last = self._space.pose.copy(), self._space.rates.copy(), self.growth

    @property
    def growth(self) -> Any:
        """(N, 6) accelerations at the end of the last step, as differences over it."""
        h = self.time - self.previous_time
        rates = self._space.rates
        return (rates - self._last[1]) / h if h > 0.0 else np.zeros_like(rates)

    # --- going on ----------------------------------------------------------------------------

    def _advance(self, t: float, max_steps: int) -> list[Event]:
        first = len(self._events)
        if self._state.cnt["status"][0] == layout.FAILED:
            raise SimulationError("the run has failed before and cannot go on", self)
        began = time.perf_counter()
        try:
            while max_steps > 0 and self.time < t and not self.ended:
                self._step()
                max_steps -= 1
        finally:
            self._wall += time.perf_counter() - began
        return self._events[first:]

    def _step(self) -> None:
        m, d, s, space = self._mj, self._data, self._state, self._space
        model, work, h = self._model, self._work, self.time_step
        if int(s.cnt["contacts"][0]) + TOUCHES + len(s.struck) > len(s.contact):
            self._state = s = saving.grown_contacts(s)
            height = np.zeros((len(s.contact), 2))
            height[: len(space.height)] = space.height
            self._space = space = space._replace(height=height)
        self._keep()
        mujoco.mj_step2(m, d)
        contact = d.contact
        kernels.gather(
            model, s, space, h, d.efc_id[: d.ne], d.efc_force[: d.ne], contact.geom,
            contact.pos, contact.frame, contact.efc_address, d.efc_force,
        )  # fmt: skip
        mujoco.mj_step1(m, d)
        clock = s.clock[0]
        clock["t_prev"] = clock["t"]
        s.cnt["steps"] += 1
        clock["t"] = int(s.cnt["steps"][0]) * h
        if not kernels.observe(model, s, work, space, h):
            s.cnt["status"] = layout.FAILED
            reason = "the state is no longer finite"
            self._events.append(
                Event(EventKind.RUN_FAILED, self.time, self.step_count, cause=reason)
            )
            raise NonFiniteStateError(f"{reason} at t = {self.time:.6f} s", self)
        if not self.ended:
            self._strike(h)
        if space.count[1]:
            for row in space.found[: int(space.count[1])]:
                self._note(row)
        if s.cnt["events"][0] or self._scheduled:
            self._drain()

    def _note(self, row: Any) -> None:
        """Make an event of what a kernel found."""
        s, car, other = self._state, int(row["car"]), int(row["other"])
        x, y, z = (float(v) for v in self._space.pose[car - 1, :3])
        what, value = int(row["kind"]), float(row["value"])
        if what == kernels.LEFT:
            cause = CAUSES[int(row["cause"])]
            if self.params.cars[car - 1].represents > 1:
                s.cnt["status"] = layout.VOID
                self._add_event(EventKind.RUN_VOID, (car,), cause=cause, x=x, y=y, value=value)
                return
            peak = s.peak[car - 1]
            if math.isnan(peak["derail_time"]):
                peak["derail_time"] = self.time
                peak["derail_speed"] = math.hypot(*s.v[car - 1, :2])
            self._add_event(
                EventKind.TRUCK_DERAILED, (car,), truck=(car - 1, other), end=ENDS[other],
                cause=cause, value=value,
            )  # fmt: skip
            follows = self.params.derailment.break_follows_lateral and car <= self.params.n_train
            if cause == "lateral force" and follows:
                place = float(s.truck_s[car - 1, other])
                s.breaks[np.flatnonzero(np.isinf(s.breaks))[0]] = place
                self._add_event(EventKind.RAIL_BREAK_SET, cause=cause, track_coordinate=place)
        elif what == kernels.PARTED:
            self._add_event(
                EventKind.COUPLER_PARTED, (car, other), cause=CAUSES[int(row["cause"])], x=x, y=y,
                z=z, value=value,
            )  # fmt: skip
            if self.params.brakes.vent_on_parting and car < self.params.n_train:
                at = float(self._model.car["distance"][car - 1 : car + 1].mean())
                apply_brakes(self._model, s, at, layout.ARR_CONV, self.time)
                self._add_event(EventKind.BRAKES_TRIGGERED, (car, other), cause="vented", value=at)
        elif what == kernels.SIDE:
            self._add_event(EventKind.CAR_ON_SIDE, (car,), x=x, y=y, z=z, value=value)
        else:
            self._add_event(EventKind.CAR_OVERRIDDEN, (car, other), x=x, y=y, z=z, value=value)

    # --- reports -----------------------------------------------------------------------------

    def _collision(self, k: int) -> Collision:
        z, normal = (float(v) for v in self._space.height[k])
        return replace(super()._collision(k), z=z, normal_z=normal)

    @property
    def statistics(self) -> dict[str, int]:
        """Counters of the computation."""
        d = self._data
        return {"steps": self.step_count, "contacts": int(d.ncon), "constraints": int(d.nefc)}

    def sample(self, t: float | None = None) -> Sample:
        """State and forces at ``t`` within the last step (default: its end).

        Poses are interpolated; forces are those at the end of the step.
        """
        t = self.time if t is None else float(t)
        if not self.previous_time <= t <= self.time and not (self.ended and t > self.time):
            raise ValueError(
                f"t = {t} s is outside the last step ({self.previous_time} to {self.time} s)"
            )
        last = self._last if t < self.time else None
        return make_sample(self, self._state, self._work, self._space, t, last, self.ledger())

    def ledger(self) -> dict[str, float]:
        """The energy ledger now, J."""
        from derail_ros.engine.sampling import ALONG_ENTRIES, WORK_ENTRIES
        from derail_ros.vocabulary.ledger import residual

        s = self._state
        entries = {**self._store(), "initial": float(s.clock["initial_energy"][0])}
        known = WORK_ENTRIES | (ALONG_ENTRIES if self._model.par["along"][0] else {})
        for key, column in known.items():
            if not key.startswith("stabilization"):
                entries[key] = float(s.energy[column])
        par = self._model.par[0]
        for key, column, on in (
            ("draft_gear_friction", layout.E_GEAR, par["gear"]),
            ("guidance", layout.E_GUIDANCE, par["guide_strength"]),
            ("slopes", layout.E_SLOPE, par["slopes"] and self.flat),
            ("fixed_bodies", layout.E_FIXED, len(self._model.fixed)),
        ):
            if on:
                entries[key] = float(s.energy[column])
        entries["suspension_dampers"] = float(self._space.ledger[kernels.DAMPERS])
        entries["residual"] = residual(entries)
        return entries

    def outcome(self) -> Outcome:
        """Result of the run so far."""
        plane = super().outcome()
        if self._sited:
            plane = replace(plane, site=site_outcome(self._seen_from_above()))
        return make_outcome(self, plane, self._space, self._bodies, self.ledger())

    def _seen_from_above(self) -> Any:
        """The run as the planar engine's reports on the site read it."""
        return SimpleNamespace(params=self.params, _model=self._seen_model, _state=self._view())

    @property
    def real_time_factor(self) -> float:
        """Simulated time over the time that the steps of this process took."""
        return self.time / self._wall if self._wall > 0.0 else math.nan

    # --- copies ------------------------------------------------------------------------------

    def to_bytes(self) -> bytes:
        """The whole run: parameters, state, events and commands."""
        kind = mujoco.mjtState.mjSTATE_INTEGRATION
        state = np.empty(mujoco.mj_stateSize(self._mj, kind))
        mujoco.mj_getState(self._mj, self._data, state, kind)
        arrays = {name: getattr(self._space, name) for name in SAVED}
        for name, on in (
            ("wall", self.params.site.fixed), ("along", self.params.tracks),
            ("level", self.params.site.fixed),
        ):  # fmt: skip
            if on:
                arrays[name] = getattr(self._space, name)
        touches, contacts = int(self._space.count[0]), int(self._state.cnt["contacts"][0])
        arrays["touch"] = np.array(arrays["touch"][:touches].tolist(), dtype=float)
        arrays["height"] = arrays["height"][:contacts]
        plane = np.frombuffer(super().to_bytes(), np.uint8)
        pose, rates, growth = self._last
        header = {"mujoco": mujoco.__version__, "flat": self.flat}
        return pack(
            header,
            {
                "plane": plane, "state": state, "pose0": pose, "rates0": rates,
                "growth0": growth, **arrays,
            },
        )  # fmt: skip

    @classmethod
    def from_bytes(cls, data: bytes) -> SpatialSimulation:
        """A run from `to_bytes`; it goes on to the bit as the saved one would have."""
        header, arrays = unpack(data)
        if header.get("mujoco") != mujoco.__version__ or header.get("flat") != cls.flat:
            raise StateFormatError(
                f"the state is of MuJoCo {header.get('mujoco')}; this is {mujoco.__version__}"
            )
        run = super().from_bytes(arrays.pop("plane").tobytes())
        assert isinstance(run, cls)
        run._restore(arrays)
        return run

    def _restore(self, arrays: dict[str, Any]) -> None:
        kind = mujoco.mjtState.mjSTATE_INTEGRATION
        touch = arrays.pop("touch")
        height = np.zeros((len(self._state.contact), 2))
        kept = arrays.pop("height")
        height[: len(kept)] = kept
        self._space = space = self._space._replace(height=height)
        space.touch[: len(touch)] = [tuple(row) for row in touch]
        self._last = tuple(arrays.pop(name) for name in ("pose0", "rates0", "growth0"))
        mujoco.mj_setState(self._mj, self._data, arrays.pop("state"), kind)
        for name, array in arrays.items():
            getattr(space, name)[:] = array
        applied = self._data.qfrc_applied.copy()
        mujoco.mj_step1(self._mj, self._data)
        ledger, work, power = space.ledger.copy(), self._work, self._state.power.copy()
        plane = self._state.q.copy(), self._state.v.copy(), self._state.a.copy()
        kernels.push(self._model, self._state, work, space, 0.0)
        self._state.q[:], self._state.v[:], self._state.a[:] = plane
        self._state.power[:], space.ledger[:] = power, ledger
        self._strike(0.0)
        self._data.qfrc_applied[:] = applied

    def copy(self) -> SpatialSimulation:
        """An independent run at the same state."""
        return type(self).from_bytes(self.to_bytes())

    def state_hash(self) -> str:
        """SHA-256 (hex) of all that decides the future of the run."""
        return hashlib.sha256(self.to_bytes()).hexdigest()


class FlatSimulation(SpatialSimulation):
    """The same in the plane: what is left is compared with the planar engine."""

    flat = True
