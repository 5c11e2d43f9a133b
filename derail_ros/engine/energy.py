"""Energy of the train, and the balance of the ledger."""

from __future__ import annotations

from derail_ros.engine import layout
from derail_ros.engine.arrays import F64, Model, State
from derail_ros.engine.forces.along import potential_energy
from derail_ros.engine.forces.couplers import coupler_energy
from derail_ros.engine.forces.draft_gear import gear_energy
from derail_ros.engine.jit import inner_jit, jit, keep_separate


@jit
def kinetic_energy(model: Model, v: F64) -> float:
    """Kinetic energy of all bodies, J."""
    total = 0.0
    car = model.car
    for i in range(v.shape[0]):
        total += 0.5 * (
            car[i].mass * (v[i, 0] * v[i, 0] + v[i, 1] * v[i, 1])
            + car[i].inertia * v[i, 2] * v[i, 2]
            + car[i].coupler_inertia * (v[i, 3] * v[i, 3] + v[i, 4] * v[i, 4])
        )
    return total


@jit
def stored_energy(model: Model, state: State, q: F64, v: F64) -> float:
    """Kinetic energy, energy in strikers, knuckles and draft gear, and potential energy, J."""
    striker, knuckle = coupler_energy(model, state.coupled, q)
    total = kinetic_energy(model, v) + striker + knuckle
    if model.par[0].gear != 0.0:
        total += gear_energy(model, state.coupled, q)
    if model.par[0].profile != 0.0:
        total += potential_energy(model, state, q) - model.par[0].datum
    return total


@inner_jit
def energy_residual(model: Model, state: State) -> float:
    """Imbalance of the ledger, J: initial energy + put in - energy now - taken out."""
    keep_separate()
    striker, knuckle = coupler_energy(model, state.coupled, state.q)
    residual = 0.0
    if model.par[0].gear != 0.0:
        residual -= gear_energy(model, state.coupled, state.q)
    if model.par[0].profile != 0.0:
        residual += model.par[0].datum - potential_energy(model, state, state.q)
    if model.par[0].along != 0.0 or model.par[0].gear != 0.0:
        residual += state.energy[layout.E_TRACTION] - state.energy[layout.E_GEAR]
        residual -= state.energy[layout.E_DYNAMIC] + state.energy[layout.E_RESISTANCE]
    residual -= state.energy[layout.E_GUIDANCE]
    residual -= state.energy[layout.E_SLOPE] + state.energy[layout.E_FIXED]
    e = state.energy
    return (
        state.clock[0].initial_energy
        + e[layout.E_EXTERNAL]
        + e[layout.E_STAB_NET]
        - kinetic_energy(model, state.v)
        - striker
        - knuckle
        - e[layout.E_BRAKE]
        - e[layout.E_GROUND_TRUCK]
        - e[layout.E_GROUND_BODY]
        - e[layout.E_COLLISION]
        - e[layout.E_DAMPER]
        - e[layout.E_KNUCKLE]
        + residual
    )
