r"""How far a car that lies free may roll: an estimate from its kinetic energy.

Source: Birk, Anderson and Coppens, 1990 (the Anderson model), as E. E. Toma's thesis (1998)
describes it: once uncoupled on both ends a tank car's kinetic energy gives its roll, limited when
the top fittings reach the ground; inputs are the height of the mass centre, the track width, the
speed and the friction. Its equations are not given there: reconstructed [R], as follows.

With h the height of the mass centre, a half the track width, r = sqrt(a^2 + h^2), v the speed at
which the car came free, mu the friction of the ground, R the radius of the shell (m, m/s):

1. A car tips only if the ground can hold its feet: ``mu h > a``.
2. To fall over it must lift its mass centre: ``v^2 / (2 g) > r - h``; below that it rocks to where
   ``r sin(phi0 + phi) - h = v^2 / (2 g)``, ``tan(phi0) = h / a``, and falls back.
3. What is left, ``v^2 / (2 g) - (r - h)``, is spent on the ground: the car comes down on its side
   (a quarter turn) and rolls on its shell over ``s = (v^2 / (2 g) - (r - h)) / mu``, so that
   ``phi = pi/2 + s / R``,
4. until the top fittings, ``h_f`` above the shell, reach the ground:
   ``phi <= pi - arccos(R / (R + h_f))``.

All of the speed counts, whatever its direction, so this is an upper bound.
"""

from __future__ import annotations

import math

from derail_ros.engine.jit import jit


@jit
def roll_limit(radius: float, fittings: float) -> float:
    """Roll at which the top fittings touch the ground, rad; lengths in m."""
    return math.pi - math.acos(radius / (radius + fittings))


@jit
def roll_angle(
    speed: float,
    height: float,
    track_width: float,
    friction: float,
    radius: float,
    fittings: float,
    gravity: float,
) -> tuple[float, float]:
    """Final roll and largest roll on the way, rad, of a car that came free at ``speed`` (m/s)."""
    a = 0.5 * track_width
    if friction * height <= a:
        return 0.0, 0.0
    r = math.sqrt(a * a + height * height)
    head = 0.5 * speed * speed / gravity
    barrier = r - height
    if head <= barrier:
        peak = math.asin((height + head) / r) - math.atan2(height, a)
        return 0.0, max(peak, 0.0)
    phi = 0.5 * math.pi + (head - barrier) / (friction * radius)
    phi = min(phi, roll_limit(radius, fittings))
    return phi, phi
