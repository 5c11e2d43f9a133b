"""Constants of the engine in three dimensions, each with its source, or marked as assumed [A].

Lengths from the top of the rail, upwards, with the car at rest on the rails.
"""

TIME_STEP = 0.002
"""Step, s."""

FLANGE_HEIGHT = 0.028
"""Of a wheel, m; AAR narrow flange, 1 to 1 1/8 in. A wheel that is higher is not guided."""
COUPLER_HEIGHT = 0.876
"""Of the couplers, m: 34 1/2 in, 49 CFR 231."""
KNUCKLE_HEIGHT = 0.28
"""Of an E-type knuckle, m: 11 in. Heads whose heights differ by more have slipped apart."""
COUPLER_MASS = 200.0
"""Of a coupler, kg; taken from its car's [A]."""
COUPLER_ROLL = 200.0
"""Roll inertia of a coupler, kg m^2 [A]."""
LOOSE_STIFFNESS, LOOSE_DAMPING = 0.2e6, 6.0e3
"""What brings a parted coupler back into its pocket, N/m, N s/m: near critical [A]."""
PITCH_STIFFNESS = 3.0e6
"""Of a coupler against its car, N m/rad: mated heads in line carry about 3 MN of buff [A]."""
PITCH_DAMPING = 0.1e6
"""N m s/rad [A]."""
PITCH_LIMIT_E, PITCH_LIMIT_F = 0.20, 0.105
"""Largest pitch of a coupler, rad: for E the two heads pass KNUCKLE_HEIGHT; for F and shelf
couplers 6 degrees, their vertical angling."""

SPRING = 5.0e6
"""Of a truck's springs on one side, N/m: two groups of about 4.3 MN/m are usual for 100 tons
[A]."""
SPRING_DAMPING = 0.15e6
"""Of the same, N s/m: the friction wedges as viscous damping of about a fifth of critical [A]."""
SPRING_TRAVEL = 0.094
"""From free to solid, m: 3 11/16 in, springs D5."""
SPRING_SOLID = 40.0e6
"""Stiffness added beyond, N/m [A]."""
GUIDE = 60.0e6
"""Lateral stiffness of truck and track, one truck, N/m [A]."""
GUIDE_DAMPING = 1.5e6
"""N s/m [A]."""
TRUCK_WEIGHT = 4500.0 * 9.81
"""Of a truck, N: what still holds its wheels down when its springs are free (100 tons [A])."""
TIPPED = 0.5
"""Roll at which a car that hangs on one rail has left it, rad: past its tipping angle."""

GROUND_EPS = 0.05
"""Speed below which the ground's friction fades, m/s: at least this, for steps of 2 ms."""
GROUND_HOLD = 0.06
"""Friction at a point takes at most this share of the car's momentum in a step: for the step."""

ON_SIDE = 0.7854
"""Roll from which a car counts as on its side, rad: 45 degrees."""
SPILLS = 0.66
"""Tilt from which an open car loses its load, rad: 38 degrees, coal's angle of repose."""
