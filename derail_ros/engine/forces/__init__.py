"""Forces on the cars, one file a family.

Each family keeps together what belongs to its laws (``engine.laws`` has the formulas):

- the generalized forces, added to ``work.force``, and their powers in ``work.power``;
- the damping that implicit stages need, added to ``work.wk`` (brakes and ground);
- stored energy and constraint rows (couplers, track);
- the moments at which its forces jump or have a kink, as a share of a step or a time.

The coordinates of a car are ``(X, Y, theta, alpha, beta)``: mass centre (m), yaw, absolute angles
of the front and rear coupler body (rad). A force (fx, fy) at the offset (rx, ry) from the mass
centre adds (fx, fy) and the moment ``rx fy - ry fx``. ``dynamics.accelerations`` calls the
families in turn; ``couplers`` comes first and sets the forces that the others add to.
"""
