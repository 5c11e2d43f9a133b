"""Collision of two point masses by impulse and restitution.

Source: Birk, Anderson and Coppens, 1990 (the Anderson model), as E. E. Toma's thesis (1998)
describes it; the coefficient of restitution is not given there: reconstructed [R].

For a closing speed ``u > 0`` (m/s) along the normal of the contact, with ``w_a`` and ``w_b`` the
mobilities of the two masses along it (1/m for a free mass, 0 for one that the rails hold, 1/kg),

    P = (1 + e) u / (w_a + w_b),    energy lost = (1 - e^2) u^2 / (2 (w_a + w_b))

The rotations are not changed: the masses are points.
"""

from __future__ import annotations

from derail_ros.engine.jit import jit


@jit
def collision_impulse(closing: float, w_a: float, w_b: float, restitution: float) -> float:
    """Impulse between the two, N s; 0 when they separate or neither can move."""
    w = w_a + w_b
    if closing <= 0.0 or w <= 0.0:
        return 0.0
    return (1.0 + restitution) * closing / w


@jit
def energy_lost(closing: float, w_a: float, w_b: float, restitution: float) -> float:
    """Kinetic energy that the collision takes out, J."""
    w = w_a + w_b
    if closing <= 0.0 or w <= 0.0:
        return 0.0
    return 0.5 * (1.0 - restitution * restitution) * closing * closing / w
